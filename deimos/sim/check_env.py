"""Does an environment keep its promises? ``check_env`` tries one after another and names the first that is broken."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from deimos.checks import SimulationError
from deimos.sim.env import Env, EnvConfig, Step

WORLDS = 6
LONGEST_PERIOD = 6  # T of the copies: long enough to see that a goal is not due before
STEPS = 20  # through three goals
FLAGS = ("terminated", "truncated", "goal_due", "invalid")


def check_env(env: Env) -> None:
    """Raise ``ValueError`` if an environment breaks the contract of ``deimos.sim.env``; name what it forgot.

    It builds small copies of the environment from its configuration, with a shorter goal period and no penalty for
    crashes; ``env`` itself is left alone. Actions are random, so what only rare states would show is not found.

    Args:
        env: The environment, as ``Config.build`` gave it.
    """
    if not isinstance(env.config, EnvConfig):
        raise ValueError(f"config must be the environment's EnvConfig, got {type(env.config).__name__}.")
    config = replace(env.config.with_goal_period(min(env.goal_period, LONGEST_PERIOD)), crash_penalty=0.0)
    trial = _Trial(type(env).__name__, config, env.device)
    for check in (
        _check_layout, _check_views, _check_start, _check_draws, _check_candidates, _check_step, _check_clocks,
        _check_time_limit, _check_reset, _check_set_goals, _check_repeats, _check_clones, _check_resume, _check_faults,
    ):  # fmt: skip
        check(trial)


@dataclass(frozen=True)
class _Trial:
    """What the checks share: how to build copies, and what to call them in messages."""

    name: str
    config: EnvConfig
    device: torch.device

    def copy(self, num_envs: int = WORLDS, seed: int = 0, env_offset: int = 0) -> Env:
        return self.config.build(num_envs, self.device, seed, env_offset)

    def actions(self, env: Env, seed: int = 0) -> Iterator[Tensor]:
        """Random actions within the bounds, for ever."""
        generator = torch.Generator().manual_seed(seed)
        while True:
            noise = 2 * torch.rand(env.num_envs, env.action_dim, generator=generator) - 1
            yield (noise * min(env.action_bound, 1.0)).to(self.device)

    def require(self, holds: bool | Tensor, message: str) -> None:
        if not bool(holds):
            raise ValueError(f"{self.name}: {message}")

    def require_tensor(self, name: str, tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
        found = (tuple(tensor.shape), tensor.dtype)
        self.require(found == (shape, dtype), f"{name} must be {dtype}{shape}, got {tensor.dtype}{found[0]}.")

    def require_equal(self, found: dict[str, Tensor], expected: dict[str, Tensor], message: str) -> None:
        """Both hold the same numbers; else say which do not."""
        for name, value in expected.items():
            same = torch.allclose(found[name].double(), value.double(), rtol=0, atol=0, equal_nan=True)
            self.require(same, message.format(name=name))


def _rows(env: Env, *rows: int) -> Tensor:
    return torch.tensor(rows or range(env.num_envs), device=env.device)


def _at(tensors: dict[str, Tensor], rows: Tensor) -> dict[str, Tensor]:
    return {name: tensor[rows] for name, tensor in tensors.items()}


def _results(step: Step) -> dict[str, Tensor]:
    names = [name for name in Step.__dataclass_fields__ if getattr(step, name) is not None]
    return {name: getattr(step, name).clone() for name in names}


def _advance(env: Env, action: Tensor) -> dict[str, Tensor]:
    """One step, new goals and resets, as a loop has them; copies of the step's results and of all that follows."""
    step = env.step(action)
    results = {f"Step.{name}": value for name, value in _results(step).items()}
    done = step.terminated | step.truncated
    due = (step.goal_due & ~done).nonzero().squeeze(1)
    if len(due):
        env.set_goals(due, env.sample_goals(due, 2)[:, 1].clone())
    env.reset(done)
    return results | env.state_dict()


def _check_layout(trial: _Trial) -> None:
    """The attributes that everybody reads agree with each other."""
    env = trial.copy()
    names = [field.name for field in env.layout]
    trial.require(names.count("goal") == 1, f"layout must have one field named 'goal', got {', '.join(names)}.")
    for field in env.layout:
        scales = len(field.scale) if isinstance(field.scale, tuple) else field.size
        trial.require(scales == field.size >= 1, f"layout: {field.name} must have a scale for each of its components.")
    goal = env.layout[names.index("goal")]
    trial.require(goal.seen_by == "both", f"layout: the goal must be seen by both, got '{goal.seen_by}'.")
    trial.require(env.num_envs == WORLDS, f"num_envs must be what build was given, {WORLDS}, got {env.num_envs}.")
    trial.require_tensor("obs", env.obs, (WORLDS, env.obs_dim), torch.float32)
    trial.require_tensor("episode_step", env.episode_step, (WORLDS,), torch.int32)
    for name in ("episode_count", "goal_count"):
        trial.require(name in env.tensors, f"tensors must hold {name}, the address of the worlds' draws.")
    for name, tensor in env.tensors.items():
        trial.require(len(tensor) == WORLDS, f"tensors: {name} must have the worlds along its first axis.")
    covered = torch.zeros(env.goal_dim, dtype=torch.int64)
    for group in env.goal_groups:
        covered[group] += 1
    trial.require((covered == 1).all(), "goal_groups must name every component of a goal once.")
    trial.require(len(env.strata()) in (0, WORLDS), "strata must name every world's kind, or be empty.")


def _check_views(trial: _Trial) -> None:
    """All tensors are views made once, and torch sees what the kernels write."""
    env = trial.copy()
    actions = trial.actions(env)
    step = env.step(next(actions))

    def addresses() -> dict[str, int]:
        views = env.tensors | {name: getattr(step, name) for name in ("obs", "reward", *FLAGS)}
        return {name: view.data_ptr() for name, view in views.items()}

    first = addresses()
    for _ in range(env.goal_period + 1):
        _advance(env, next(actions))
    step = env.step(next(actions))
    for name, address in addresses().items():
        trial.require(address == first[name], f"{name} must stay where it is: write into it, never rebind it.")
    trial.require(step.obs.data_ptr() == env.obs.data_ptr(), "Step.obs and obs must be the same memory.")
    for name, copy in env.state_dict().items():
        trial.require(copy.data_ptr() != first[name], f"state_dict must give copies, but {name} is a view.")


def _check_start(trial: _Trial) -> None:
    """A built environment has begun its first episodes; ``restart`` begins them again."""
    env = trial.copy()
    begun = env.tensors["episode_count"] == 1
    trial.require(begun.all(), "an episode must have begun in every world: end the constructor with begin().")
    trial.require(env.obs.isfinite().all(), "the first observation must be finite: the reset must write all of it.")
    trial.require(len(env.goal.unique(dim=0)) > 1, "first goals must differ and be seen: begin_episode, write_goal.")
    first = env.state_dict()
    for action, _ in zip(trial.actions(env), range(3), strict=False):
        env.step(action)
    env.restart()
    trial.require_equal(env.state_dict(), first, "restart must begin the first episodes again, but {name} differs.")
    other = trial.copy(seed=1)
    trial.require((env.goal != other.goal).any(), "first goals must depend on the seed.")
    env.restart(torch.full((env.goal_dim,), 0.25, device=env.device))
    trial.require((env.obs[:, env.goal_slice] != first["obs"][:, env.goal_slice]).any(),
                  "first goals must heed goal_scale: reset must use the range that it is given.")  # fmt: skip


def _check_draws(trial: _Trial) -> None:
    """What a world draws depends on its global number alone."""
    whole, shard = trial.copy(), trial.copy(WORLDS // 2, env_offset=WORLDS // 2)
    rows = _rows(whole)[WORLDS // 2 :]
    message = "draws must be addressed by world_offset + env: world 0 of a shard must be that of the whole ({name})."
    trial.require_equal(shard.tensors, _at(whole.tensors, rows), message)
    ours, theirs = whole.draw(rows), shard.draw(_rows(shard))
    trial.require_tensor("draw(rows)", ours, (len(rows), 4), torch.float32)
    trial.require_equal({"draw": theirs}, {"draw": ours}, message)
    trial.require((ours >= 0).all() and (ours < 1).all(), "draw must give numbers in [0, 1).")


def _check_candidates(trial: _Trial) -> None:
    """Candidates are valid shapes, repeatable, and independent of who else asks."""
    env = trial.copy()
    goals = env.sample_goals(_rows(env), 8).clone()
    trial.require_tensor("sample_goals(rows, 8)", goals, (WORLDS, 8, env.goal_dim), torch.float32)
    trial.require(goals.isfinite().all(), "sample_goals must give finite goals.")
    few = env.sample_goals(_rows(env, 4, 1), 8)
    trial.require_equal({"a": few}, {"a": goals[[4, 1]]}, "sample_goals must not depend on who else asks, or when.")
    fewer = env.sample_goals(_rows(env), 3)
    trial.require_equal({"a": fewer}, {"a": goals[:, :3]}, "sample_goals must give the first ones of a longer list.")
    env.set_goals(_rows(env), goals[:, 0])
    again = env.sample_goals(_rows(env), 8)
    trial.require((again != goals).any(2).all(), "sample_goals must give other goals once a goal was set: count it.")


def _check_step(trial: _Trial) -> None:
    """A step gives what it promises, never resets and never changes a goal."""
    env = trial.copy()
    shape = (WORLDS, env.action_dim + 1)
    try:
        env.step(torch.zeros(shape, device=env.device))
    except ValueError:
        pass
    else:
        trial.require(False, f"step must refuse actions of the shape {shape}.")
    groups = len(env.goal_groups)
    counts = {name: env.tensors[name].clone() for name in ("episode_count", "goal_count")}
    for action, age in zip(trial.actions(env), range(1, STEPS + 1), strict=False):
        before = env.episode_step.clone()
        step = env.step(action)
        trial.require_tensor("Step.obs", step.obs, (WORLDS, env.obs_dim), torch.float32)
        trial.require_tensor("Step.reward", step.reward, (WORLDS,), torch.float32)
        for name in FLAGS:
            trial.require_tensor(f"Step.{name}", getattr(step, name), (WORLDS,), torch.bool)
        trial.require((step.tracking is None) == (groups == 1), "Step.tracking must be given where goals have groups.")
        if step.tracking is not None:
            trial.require_tensor("Step.tracking", step.tracking, (WORLDS, groups), torch.float32)
            within = (step.tracking >= 0) & (step.tracking <= 1)
            trial.require(within.all(), "Step.tracking must be in [0, 1].")
        trial.require(step.obs.isfinite().all(), "Step.obs must be finite: the step must write all of it.")
        trial.require((step.reward.isfinite() & (step.reward >= 0)).all(), "Step.reward must be finite and at least 0.")
        both = step.terminated & step.truncated
        trial.require(not both.any(), "a world that crashed must not be truncated too.")
        trial.require_equal(env.tensors, counts, "step must not reset a world or change a goal, but {name} changed.")
        moved = env.episode_step == before + 1
        trial.require(moved.all(), f"step {age} must advance episode_step by one: the kernel must call end_step.")


def _check_clocks(trial: _Trial) -> None:
    """A goal falls due when it has been in force for T steps, and stays due."""
    env = trial.copy()
    env.set_goals(_rows(env), env.sample_goals(_rows(env), 1)[:, 0].clone())
    for action, age in zip(trial.actions(env), range(1, env.goal_period + 2), strict=False):
        step = env.step(action)
        valid = step.goal_due | step.invalid if age >= env.goal_period else ~step.goal_due
        due = "due from then on" if age >= env.goal_period else "not be due before"
        trial.require(valid.all(), f"a goal must be {due} T = {env.goal_period} steps, but not so after {age} steps.")


def _check_time_limit(trial: _Trial) -> None:
    """Episodes end at the time limit, where there is one, and never before for that reason."""
    env = trial.copy()
    if env.time_limit:
        env.episode_step.fill_(env.time_limit - 1)
        step = env.step(next(trial.actions(env)))
        ended = step.truncated | step.terminated
        trial.require(ended.all(), f"episodes must be truncated at the time limit of {env.time_limit} steps.")


def _check_reset(trial: _Trial) -> None:
    """A masked reset begins episodes where it is asked to, and touches nobody else."""
    env = trial.copy()
    for action, _ in zip(trial.actions(env), range(3), strict=False):
        env.step(action)
    before = env.state_dict()
    own, others = _rows(env, 1, 4), _rows(env, 0, 2, 3, 5)
    env.reset(torch.isin(_rows(env), own))
    message = "reset must leave the worlds outside its mask alone, but {name} changed there."
    trial.require_equal(_at(env.tensors, others), _at(before, others), message)
    begun = env.tensors["episode_count"][own] == before["episode_count"][own] + 1
    trial.require(begun.all(), "reset must count the episodes that it begins: the kernel must call begin_episode.")
    trial.require((env.episode_step[own] == 0).all(), "reset must start episode_step at 0.")
    same = env.tensors["goal_count"][own] == before["goal_count"][own]
    trial.require(same.all(), "first goals must not count in goal_count.")
    changed = (env.goal[own] != before["obs"][own][:, env.goal_slice]).any(1)
    trial.require(changed.all(), "reset must give a new first goal and show it: the kernel must call write_goal.")


def _check_set_goals(trial: _Trial) -> None:
    """New goals are seen as they were given, count, and touch nobody else."""
    env = trial.copy()
    env.step(next(trial.actions(env)))
    before = env.state_dict()
    rows, others = _rows(env, 4, 1), _rows(env, 0, 2, 3, 5)
    goals = env.sample_goals(rows, 3)[:, 2].clone()
    env.set_goals(rows, goals)
    message = "set_goals must leave the other worlds alone, but {name} changed there."
    trial.require_equal(_at(env.tensors, others), _at(before, others), message)
    shown = torch.isclose(env.goal[rows], goals, rtol=1e-4, atol=1e-5)
    trial.require(shown.all(), "set_goals must show the goals that it was given in the goal's slot of obs.")
    counted = env.tensors["goal_count"][rows] == before["goal_count"][rows] + 1
    trial.require(counted.all(), "set_goals must count in goal_count.")
    state = {"state": env.state(env.obs)[rows]}
    trial.require_equal(state, {"state": env.state(before["obs"])[rows]}, "set_goals must leave the state alone.")


def _check_repeats(trial: _Trial) -> None:
    """Two environments of one seed do the same, bit for bit."""
    env, twin = trial.copy(), trial.copy()
    for action, t in zip(trial.actions(env), range(STEPS), strict=False):
        message = f"the same seed must give the same numbers, but {{name}} differs after {t + 1} steps."
        trial.require_equal(_advance(twin, action), _advance(env, action), message)
    trial.require(set(env.report()) == set(twin.report()), "report must have the same keys every time.")


def _check_clones(trial: _Trial) -> None:
    """Clones of worlds, in another environment too, stay equal under the same actions where nothing is drawn."""
    trial = replace(trial, config=trial.config.for_evaluation())
    env, other = trial.copy(), trial.copy(seed=1)
    actions = trial.actions(env)
    for _ in range(3):
        _advance(env, next(actions))
    source, target = _rows(env, 0, 3), _rows(other, 5, 2)
    other.copy_worlds(source, target, env)
    needs = "allocate must know of every array that a step reads (resume=True)"
    for _ in range(env.goal_period):
        action = next(actions)
        copied = action.clone()
        copied[target] = action[source]
        ours, theirs = _results(env.step(action)), _results(other.step(copied))
        trial.require_equal(
            _at(theirs, target), _at(ours, source), f"clones must move alike, but {{name}} differs: {needs}."
        )


def _check_resume(trial: _Trial) -> None:
    """What goes on from a state dictionary equals what was never stopped."""
    env, resumed = trial.copy(), trial.copy()
    actions = trial.actions(env)
    for _ in range(STEPS // 2):
        _advance(env, next(actions))
    state = env.state_dict()
    for action, _ in zip(trial.actions(env, seed=1), range(2), strict=False):
        resumed.step(action)
    resumed.load_state_dict(state)
    for _ in range(STEPS):
        action = next(actions)
        message = "a resume must be exact, but {name} differs: tensors must hold everything that a step reads."
        trial.require_equal(_advance(resumed, action), _advance(env, action), message)


def _check_faults(trial: _Trial) -> None:
    """Sound worlds pass ``check``; an action that is not finite does not."""
    env = trial.copy()
    action = next(trial.actions(env))
    env.step(action)
    env.check()
    action[2, 0] = torch.nan
    env.step(action)
    try:
        env.check()
    except SimulationError:
        return
    trial.require(False, "check must stop the run after an action that is not finite: give end_step its cause.")
