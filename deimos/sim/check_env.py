"""Does an environment keep the contract? ``check_env`` tests its claims in turn and names the first broken one."""

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from deimos.checks import SimulationError
from deimos.nn.host import own_settings
from deimos.sim.env import Env, EnvConfig, Step

WORLDS = 6
LONGEST_PERIOD = 6  # T of the copies: long enough to see that a goal is not due earlier
STEPS = 20  # through three goals
UNTIL_CRASH = 200  # steps with one action, by which most worlds have crashed if they do
PENALTY = 2.0  # in multiples of the largest reward
COUNTS = ("episode_count", "goal_count")
FLAGS = ("terminated", "truncated", "goal_due", "invalid")

Build = Callable[..., Env]
"""Makes another copy: ``num_envs``, ``seed``, ``env_offset`` and ``config`` may be given."""
Claims = Iterator[tuple[bool | Tensor, str]]
"""What must hold, everywhere if it is a tensor, and the message if it does not."""


@own_settings()
def check_env(env: Env) -> None:
    """Raise ``ValueError`` if an environment breaks the contract of ``deimos.sim.env``; name what it forgot.

    It builds small copies of the environment from its configuration, with a shorter goal period and, except for one
    check, no penalty for crashes; ``env`` itself is left alone. Actions are random, so faults that only rare states
    show are not found, and the cost of a crash is only checked if a random action, held for 200 steps, crashes a world.

    Args:
        env: The environment, as ``Config.build`` gave it.
    """
    if not isinstance(env.config, EnvConfig):
        raise ValueError(f"config must be the environment's EnvConfig, got {type(env.config).__name__}.")
    short = replace(env.config.with_goal_period(min(env.goal_period, LONGEST_PERIOD)), crash_penalty=0.0)

    def build(num_envs: int = WORLDS, seed: int = 0, env_offset: int = 0, config: EnvConfig = short) -> Env:
        return config.build(num_envs, env.device, seed, env_offset)

    for check in (
        _check_layout, _check_views, _check_start, _check_observation, _check_draws, _check_candidates, _check_step,
        _check_clocks, _check_reset, _check_set_goals, _check_repeats, _check_bounds, _check_clones, _check_resume,
        _check_penalty, _check_faults,
    ):  # fmt: skip
        for holds, message in check(build(), build):
            if not torch.as_tensor(holds).all():
                raise ValueError(f"{type(env).__name__}: {message}")


def _has_type(name: str, tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> tuple[bool, str]:
    found = tuple(tensor.shape)
    return (found, tensor.dtype) == (shape, dtype), f"{name} must be {dtype}{shape}, got {tensor.dtype}{found}."


def _are_equal(found: dict[str, Tensor], expected: dict[str, Tensor], message: str) -> Claims:
    """Both hold the same numbers; otherwise the message gets the name of those that differ."""
    for name, value in expected.items():
        same = torch.allclose(found[name].double(), value.double(), rtol=0, atol=0, equal_nan=True)
        yield same, message.format(name=name)


def _raises(kind: type[Exception], call: Callable[[], object]) -> bool:
    try:
        call()
    except kind:
        return True
    return False


def _actions(env: Env, count: int, seed: int = 0) -> Tensor:
    """Random actions within the bounds, shape (count, num_envs, action_dim)."""
    shape, draws = (count, env.num_envs, env.action_dim), torch.Generator().manual_seed(seed)
    noise = 2 * torch.rand(shape, generator=draws, dtype=torch.float32) - 1
    return (noise * min(env.action_bound, 1.0)).to(env.device)


def _rows(env: Env, *rows: int) -> Tensor:
    return torch.tensor(rows or range(env.num_envs), device=env.device)


def _at(tensors: dict[str, Tensor], rows: Tensor) -> dict[str, Tensor]:
    return {name: tensor[rows] for name, tensor in tensors.items()}


def _results(step: Step) -> dict[str, Tensor]:
    found = {field.name: getattr(step, field.name) for field in fields(step)}
    return {name: value.clone() for name, value in found.items() if value is not None}


def _spoil(step: Step) -> None:
    """Overwrite a step's numbers, so that the next one cannot pass them off as its own."""
    for tensor in (step.reward, step.tracking):
        if tensor is not None:
            tensor.fill_(torch.nan)


def _advance(env: Env, action: Tensor) -> dict[str, Tensor]:
    """One step, new goals and resets, as in a loop; copies of the step's results and of the state after it."""
    step = env.step(action)
    results = {f"Step.{name}": value for name, value in _results(step).items()}
    done = step.terminated | step.truncated
    due = (step.goal_due & ~done).nonzero().squeeze(1)
    if len(due):
        env.set_goals(due, env.sample_goals(due, 2)[:, 1].clone())
    env.reset(done)
    return results | env.state_dict()


def _check_layout(env: Env, build: Build) -> Claims:
    """The public attributes agree with each other."""
    names = [field.name for field in env.layout]
    yield names.count("goal") == 1, f"layout must have one field named 'goal', got {', '.join(names)}."
    for field in env.layout:
        scales = len(field.scale) if isinstance(field.scale, tuple) else field.size
        yield scales == field.size >= 1, f"layout: {field.name} must have a scale for each of its components."
    goal = env.layout[names.index("goal")]
    yield goal.seen_by == "both", f"layout: the goal must be seen by both, got '{goal.seen_by}'."
    yield env.num_envs == WORLDS, f"num_envs must be what build was given, {WORLDS}, got {env.num_envs}."
    yield _has_type("obs", env.obs, (WORLDS, env.obs_dim), torch.float32)
    yield _has_type("episode_step", env.episode_step, (WORLDS,), torch.int32)
    for name in COUNTS:
        yield name in env.tensors, f"tensors must hold {name}, the address of the worlds' draws."
    for name, tensor in env.tensors.items():
        yield len(tensor) == WORLDS, f"tensors: {name} must have the worlds along its first axis."
    covered = torch.zeros(env.goal_dim, dtype=torch.int64)
    for group in env.goal_groups:
        covered[group] += 1
    yield covered == 1, "goal_groups must name every component of a goal once."
    yield len(env.goal_group_names) == len(env.goal_groups), "goal_group_names must name every group once."
    weights = env.goal_group_weights
    valid = len(weights) in (0, len(env.goal_groups)) and min(weights, default=0.0) >= 0.0
    yield valid, "goal_group_weights must be empty, or a number of at least 0 for every group."
    yield len(env.strata()) in (0, WORLDS), "strata must name every world's kind, or be empty."


def _check_views(env: Env, build: Build) -> Claims:
    """All tensors are views made once, and torch sees what the kernels write."""
    first_action, *actions, last_action = _actions(env, env.goal_period + 3)

    def views(action: Tensor) -> dict[str, Tensor]:
        step = env.step(action)
        return env.tensors | {name: getattr(step, name) for name in ("obs", "reward", *FLAGS)}

    first = views(first_action)  # kept alive, so that no other memory can get their addresses
    for action in actions:
        _advance(env, action)
    for name, view in views(last_action).items():
        same = view.data_ptr() == first[name].data_ptr()
        yield same, f"{name} must stay where it is: write into it, never rebind it."
    yield first["obs"].data_ptr() == env.obs.data_ptr(), "Step.obs and obs must be the same memory."
    for name, copy in env.state_dict().items():
        yield copy.data_ptr() != first[name].data_ptr(), f"state_dict must give copies, but {name} is a view."


def _check_start(env: Env, build: Build) -> Claims:
    """A built environment has begun its first episodes; ``restart`` begins them again."""
    begun = env.tensors["episode_count"] == 1
    yield (
        begun,
        "an episode must have begun in every world: end the constructor with begin(), call begin_episode in the reset.",
    )
    yield env.obs.isfinite(), "the first observation must be finite: the reset must write all of it."
    yield len(env.goal.unique(dim=0)) > 1, "first goals must differ and be seen: begin_episode, write_goal."
    first = env.state_dict()
    for action in _actions(env, 3):
        env.step(action)
    env.restart()
    yield from _are_equal(env.state_dict(), first, "restart must begin the first episodes again, but {name} differs.")
    yield (env.goal != build(seed=1).goal).any(), "first goals must depend on the seed."
    env.restart(torch.full((env.goal_dim,), 0.25, dtype=torch.float32, device=env.device))
    changed = (env.obs[:, env.goal_slice] != first["obs"][:, env.goal_slice]).any()
    yield changed, "first goals must heed goal_scale: reset must use the range that it is given."


def _check_observation(env: Env, build: Build) -> Claims:
    """Kernels write all of the observation, nothing but the goal into the goal's slot, and nothing behind it."""
    if not hasattr(env, "beyond_obs"):  # not a WarpEnv, tested without Warp
        return  # others may keep their state in obs
    made: Any = env
    state = torch.ones(env.obs_dim, dtype=torch.bool, device=env.device)
    state[env.goal_slice] = False
    order = "write columns 0, 1, ... in the layout's order, the goal last"

    def claims(what: str) -> Claims:
        behind = made.beyond_obs.isnan()
        yield behind, f"the {what} must not write beyond the {env.obs_dim} columns of the layout, which is too narrow."
        shown = torch.isclose(env.goal, made.seen_goals(), rtol=1e-4, atol=1e-5)
        yield shown, f"the {what} must write nothing but the goal into the goal's slot of obs: {order}."
        columns = (~env.obs.isfinite()).any(0).nonzero().squeeze(1).tolist()
        yield not columns, f"the {what} must write all of obs, but left out the columns {columns}: {order}."

    for action in _actions(env, 3):
        env.obs[:, state] = torch.nan
        made.beyond_obs.fill_(torch.nan)
        env.step(action)
        yield from claims("step")
    env.obs.fill_(torch.nan)
    env.reset(torch.ones(WORLDS, dtype=torch.bool, device=env.device))
    yield from claims("reset")


def _check_draws(env: Env, build: Build) -> Claims:
    """What a world draws depends only on its global number."""
    shard, rows = build(WORLDS // 2, env_offset=WORLDS // 2), _rows(env)[WORLDS // 2 :]
    message = "draws must be addressed by world_offset + env: world 0 of a shard must be that of the whole ({name})."
    yield from _are_equal(shard.tensors, _at(env.tensors, rows), message)
    ours, theirs = env.draw(rows), shard.draw(_rows(shard))
    yield _has_type("draw(rows)", ours, (len(rows), 4), torch.float32)
    yield theirs == ours, message.format(name="draw")
    yield (ours >= 0) & (ours < 1), "draw must give numbers in [0, 1)."


def _check_candidates(env: Env, build: Build) -> Claims:
    """Candidates have valid shapes, are repeatable, and independent of the other worlds that ask."""
    every = _rows(env)
    goals = env.sample_goals(every, 8).clone()
    yield _has_type("sample_goals(rows, 8)", goals, (WORLDS, 8, env.goal_dim), torch.float32)
    yield goals.isfinite(), "sample_goals must give finite goals."
    few = env.sample_goals(every[[4, 1]], 8) == goals[[4, 1]]
    yield few, "sample_goals must not depend on the other worlds that ask, or on when they do."
    yield env.sample_goals(every, 3) == goals[:, :3], "sample_goals must give the first ones of a longer list."
    env.set_goals(every, goals[:, 0])
    again = (env.sample_goals(every, 8) != goals).any(2)
    yield again, "sample_goals must give other goals once a goal was set: count it."


def _check_step(env: Env, build: Build) -> Claims:
    """A step returns what it promises, never resets and never changes a goal."""
    wide = torch.zeros(WORLDS, env.action_dim + 1, dtype=torch.float32, device=env.device)
    yield _raises(ValueError, lambda: env.step(wide)), f"step must refuse actions of shape {tuple(wide.shape)}."
    groups = len(env.goal_groups)
    counts = {name: env.tensors[name].clone() for name in COUNTS}
    for age, action in enumerate(_actions(env, STEPS), 1):
        before = env.episode_step.clone()
        step = env.step(action)
        yield _has_type("Step.obs", step.obs, (WORLDS, env.obs_dim), torch.float32)
        yield _has_type("Step.reward", step.reward, (WORLDS,), torch.float32)
        for name in FLAGS:
            yield _has_type(f"Step.{name}", getattr(step, name), (WORLDS,), torch.bool)
        yield (step.tracking is None) == (groups == 1), "Step.tracking must be given where goals have groups."
        if step.tracking is not None:
            yield _has_type("Step.tracking", step.tracking, (WORLDS, groups), torch.float32)
            met = (step.tracking >= 0) & (step.tracking <= 1)
            yield met, "Step.tracking must be in [0, 1]: the step must write it in every world."
        yield step.obs.isfinite(), "Step.obs must be finite: the step must write all of it."
        sound = step.reward.isfinite() & (step.reward >= 0)
        yield sound, "Step.reward must be finite and at least 0: the step must write it in every world."
        yield ~(step.terminated & step.truncated), "a world that crashed must not be truncated too."
        yield from _are_equal(env.tensors, counts, "step must not reset a world or change a goal, but {name} changed.")
        moved = env.episode_step == before + 1
        yield moved, f"step {age} must advance episode_step by one: the kernel must call end_step."
        _spoil(step)


def _check_clocks(env: Env, build: Build) -> Claims:
    """A goal falls due when it has been in force for T steps, and stays due; episodes end at the time limit."""
    env.set_goals(_rows(env), env.sample_goals(_rows(env), 1)[:, 0].clone())
    for age, action in enumerate(_actions(env, env.goal_period + 1), 1):
        step = env.step(action)
        valid = step.goal_due | step.invalid if age >= env.goal_period else ~step.goal_due
        due = "be due after" if age >= env.goal_period else "not be due before"
        yield valid, f"a goal must {due} T = {env.goal_period} steps, but this fails after {age} steps."
    if env.time_limit:
        env.restart()
        env.episode_step.fill_(env.time_limit - 1)
        step = env.step(_actions(env, 1)[0])
        ended = step.truncated | step.terminated
        yield ended, f"episodes must be truncated at the time limit of {env.time_limit} steps."


def _check_reset(env: Env, build: Build) -> Claims:
    """A masked reset begins episodes where it is asked to, and leaves the other worlds alone."""
    for action in _actions(env, 3):
        env.step(action)
    before = env.state_dict()
    own, others = _rows(env, 1, 4), _rows(env, 0, 2, 3, 5)
    env.reset(torch.isin(_rows(env), own))
    message = "reset must leave the worlds outside its mask alone, but {name} changed there."
    yield from _are_equal(_at(env.tensors, others), _at(before, others), message)
    begun = env.tensors["episode_count"][own] == before["episode_count"][own] + 1
    yield begun, "reset must count the episodes that it begins: the kernel must call begin_episode."
    yield env.episode_step[own] == 0, "reset must start episode_step at 0."
    yield env.tensors["goal_count"][own] == before["goal_count"][own], "first goals must not count in goal_count."
    changed = (env.goal[own] != before["obs"][own][:, env.goal_slice]).any(1)
    yield changed, "reset must give a new first goal and show it: the kernel must call write_goal."


def _check_set_goals(env: Env, build: Build) -> Claims:
    """New goals are seen as they were given, are counted, and leave the other worlds alone."""
    env.step(_actions(env, 1)[0])
    before = env.state_dict()
    rows, others = _rows(env, 4, 1), _rows(env, 0, 2, 3, 5)
    goals = env.sample_goals(rows, 3)[:, 2].clone()
    env.set_goals(rows, goals)
    message = "set_goals must leave the other worlds alone, but {name} changed there."
    yield from _are_equal(_at(env.tensors, others), _at(before, others), message)
    shown = torch.isclose(env.goal[rows], goals, rtol=1e-4, atol=1e-5)
    yield shown, "set_goals must show the goals that it was given in the goal's slot of obs."
    yield env.tensors["goal_count"][rows] == before["goal_count"][rows] + 1, "set_goals must count in goal_count."
    yield env.state(env.obs)[rows] == env.state(before["obs"])[rows], "set_goals must leave the state alone."
    after = env.state_dict()
    env.set_goals(_rows(env), goals[:1].expand(env.num_envs, -1), _rows(env) == 4)
    message = "set_goals must leave the rows outside of where alone, but {name} changed there."
    yield from _are_equal(_at(env.tensors, others), _at(after, others), message)
    yield env.tensors["goal_count"][4] == after["goal_count"][4] + 1, "set_goals must give a goal to the rows in where."


def _check_repeats(env: Env, build: Build) -> Claims:
    """Two environments with the same seed do the same, bit for bit."""
    twin, cause = build(), "draws must be addressed, and arrays, action_dim too, as large as what is read of them"
    for age, action in enumerate(_actions(env, STEPS), 1):
        message = f"the same seed must give the same numbers, but {{name}} differs after {age} steps: {cause}."
        yield from _are_equal(_advance(twin, action), _advance(env, action), message)
    yield set(env.report()) == set(twin.report()), "report must have the same keys every time."


def _check_bounds(env: Env, build: Build) -> Claims:
    """Actions beyond their range act like its bounds."""
    twin, (low, high) = build(), (end.to(env.device) for end in env.action_range)
    for sign in _actions(env, 3).sign():
        bound = torch.where(sign < 0, low, high)  # may be infinite
        end, beyond = (torch.where(bound.isfinite(), each, sign) for each in (bound, bound + sign * (high - low)))
        message = "the step must clip actions to action_range, as a deployed policy does, but beyond it {name} differs."
        yield from _are_equal(_results(twin.step(beyond)), _results(env.step(end)), message)


def _check_clones(env: Env, build: Build) -> Claims:
    """Clones of worlds, even in another environment, stay equal under the same actions if nothing is drawn."""
    quiet = env.config.for_evaluation()
    env, other = build(config=quiet), build(config=quiet, seed=1)
    actions = _actions(env, 3 + env.goal_period)
    for action in actions[:3]:
        _advance(env, action)
    source, target = _rows(env, 0, 3), _rows(other, 5, 2)
    other.copy_worlds(source, target, env)
    message = "clones must move alike, but {name} differs: allocate must know all that a step reads (resume=True)."
    for action in actions[3:]:
        copied = action.clone()
        copied[target] = action[source]
        ours, theirs = _results(env.step(action)), _results(other.step(copied))
        yield from _are_equal(_at(theirs, target), _at(ours, source), message)


def _check_resume(env: Env, build: Build) -> Claims:
    """A continuation from a state dictionary equals an uninterrupted one."""
    resumed = build()
    actions = _actions(env, STEPS + STEPS // 2)
    for action in actions[: STEPS // 2]:
        _advance(env, action)
    for action in _actions(env, 2, seed=1):
        resumed.step(action)
    resumed.load_state_dict(env.state_dict())
    message = "a resume must be exact, but {name} differs: tensors must hold everything that a step reads."
    for action in actions[STEPS // 2 :]:
        yield from _are_equal(_advance(resumed, action), _advance(env, action), message)


def _check_penalty(env: Env, build: Build) -> Claims:
    """A crash costs its penalty on its step, after all clipping, and nothing else changes."""
    config = replace(env.config, crash_penalty=PENALTY)
    punished, cost = build(config=config), PENALTY * config.largest_reward
    yield punished.crash_penalty == cost, "crash_penalty must be the configuration's times its largest_reward."
    action = _actions(env, 1)[0].sign() * min(env.action_bound, 1.0)
    for _ in range(UNTIL_CRASH):
        steps = env.step(action), punished.step(action)
        plain, step = map(_results, steps)
        yield plain["reward"].isfinite(), "Step.reward must be finite: the step must write it, after a crash too."
        for each in steps:
            _spoil(each)
        charged = plain.pop("reward") - step.pop("reward")
        right = torch.isclose(charged, cost * plain["terminated"], rtol=1e-4, atol=1e-5)
        yield (
            right,
            "the step of a crash, and no other, must cost crash_penalty, taken off after the reward is clipped.",
        )
        yield from _are_equal(step, plain, "crash_penalty must change the reward alone, but {name} differs.")
        if plain["terminated"].any():
            break


def _check_faults(env: Env, build: Build) -> Claims:
    """Sound worlds pass ``check``; an action that is not finite does not."""
    action = _actions(env, 1)[0]
    env.step(action)
    env.check()
    action[2, 0] = torch.nan
    env.step(action)
    stops = _raises(SimulationError, env.check)
    yield stops, "check must stop the run after an action that is not finite: give end_step its cause."
