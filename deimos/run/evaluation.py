"""How good and how safe a policy is: against uniform goals (Naive) and against attackers.

Every policy meets the same worlds, and under uniform goals the same goals: the i-th of a world depends only on
the evaluation's seed, the world and i. An attacker that learns is trained after the policy, so that it knows this
policy's weaknesses and not those of some training run.
"""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from deimos.checks import RunError, check_at_least, check_is, check_names, check_seed
from deimos.files import read_bytes
from deimos.goals.fear import FearConfig
from deimos.goals.interactions import Resolved
from deimos.goals.selector import GoalSelector
from deimos.learn.policy import load_policy
from deimos.nn.host import own_settings
from deimos.nn.threads import torch_on_one
from deimos.run import memory
from deimos.run.attack import Attack, Policy, Target, attacker, uniform_goals
from deimos.run.config import to_dict
from deimos.run.folder import RunFolder
from deimos.run.loop import GoalGuard, GoalLoop
from deimos.sim.env import Env, EnvConfig

EVALUATION = "evaluation.json"
_ROW: dict[str, Any] = {
    "goals": str, "weights": str, "worlds": int, "steps": int, "goal_period": int,
    "crash_rate": int | float | None, "score": int | float | None,
}  # fmt: skip
"""What every row of it has, and of what type."""

Progress = Callable[[str, float], None]
"""Called now and then with the stage's name and the share of it that is done."""


@dataclass(frozen=True, kw_only=True)
class EvalConfig:
    """How a policy is evaluated (thesis, 4.1.3)."""

    worlds: int = 2000
    """Parallel worlds, at least 1."""
    steps: int = 2000
    """Steps of every world, at least 2 T."""
    seed: int = 1_000_003
    """Seed of the worlds and their goals, in [0, 2^32 - 2). The same for all policies that are to be compared."""
    attackers: tuple[str, ...] = ("argmax", "scripted")
    """Attackers of the policy, by name, each at most once (docs/how_to/evaluate.md)."""
    adversary_steps: int = 1500
    """Steps of every world that ``argmax``, the thesis's Adversary, learns from, at least 1. Other attackers that learn
    take a multiple of it, the same for every policy."""
    fear: FearConfig = field(default_factory=lambda: FearConfig(epochs=20, minibatches=32, min_per_class=1))
    """The fear network of an attacker."""
    pool: Path | None = None
    """File of the attacker ``pooled``, which ``deimos pool`` makes."""
    oracle_worlds: int = 200
    """Worlds that meet the attacker oracle, which tries goals in clones at N T steps per goal; at least 1."""

    def __post_init__(self) -> None:
        for name in ("worlds", "steps", "adversary_steps", "oracle_worlds"):
            check_at_least(name, getattr(self, name), 1)
        check_seed(self.seed, spare=2)  # the next one is for what attackers learn from, the one after it for the shield
        check_is("fear", self.fear, FearConfig)
        check_names("attackers", self.attackers)
        for name in self.attackers:
            if attacker(name).needs_pool and self.pool is None:
                raise ValueError(f"pool must be a file of deimos pool for the attacker {name}, got none.")
        if len(set(self.attackers)) < len(self.attackers):
            raise ValueError(f"attackers must be different, got {', '.join(self.attackers)}.")

    def worlds_against(self, goals: str) -> int:
        """Worlds that meet an attacker, or ``naive`` goals."""
        few = goals != "naive" and attacker(goals).few_worlds
        return min(self.worlds, self.oracle_worlds) if few else self.worlds


Scale = tuple[str, float, float]
"""What a score is made of, and its values at scores 0 and 1."""
Once = Callable[[dict, Callable[[], Scale]], Scale]
"""Gives a scale, from what it depends on and a function that computes it."""


def _at_once(task: dict, compute: Callable[[], Scale]) -> Scale:
    return compute()


def weights_hash(module: nn.Module) -> str:
    """First 16 hexadecimal digits of the SHA-256 of all weights."""
    digest = hashlib.sha256()
    for name, value in module.state_dict().items():
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


@own_settings()
def evaluate_run(
    folder: RunFolder, env_config: EnvConfig, config: EvalConfig, device: torch.device,
    progress: Progress = lambda stage, share: None, *, again: bool = True, once: Once = _at_once,
) -> list[dict]:  # fmt: skip
    """Evaluate the policy of a run, and keep the rows in its ``evaluation.json``.

    There they replace the rows of the same evaluation of the same weights. One with another T, size, seed or engine, or
    with an Adversary that was trained differently, is another evaluation, and is kept. Rows that the folder has are
    made ``again`` or returned as they are; for the other arguments see ``evaluate``.

    Returns:
        The rows of this evaluation, those of ``evaluate`` with the policy's ``weights_hash``.
    """
    policy = load_policy(folder.path, str(device))
    env_config = env_config.resolved(device)
    weights = {"weights": weights_hash(policy.actor)}
    known = read_evaluation(folder)
    identities = [(identity | weights).items() for identity in _identities(env_config, config)]
    same = [row for identity in identities for row in known if row.items() >= identity]
    if len(same) == len(identities) and not again:
        return same
    folder.require_writable()

    def keep(row: dict) -> None:
        """Write a row as soon as it is made: a kill loses only the one in progress."""
        made = row | weights
        identity = next(identity for identity in identities if made.items() >= identity)
        with folder.adding(EVALUATION):
            others = [other for other in read_evaluation(folder) if not other.items() >= identity]
            folder.write_json(EVALUATION, [*others, made])

    with torch_on_one():
        there = [] if again else same
        rows = evaluate(policy.scaled, env_config, config, device, progress, known=there, keep=keep, once=once)
    return [row | weights for row in rows]


def read_evaluation(folder: RunFolder) -> list[dict]:
    """The rows of a run's ``evaluation.json``; none if there is no such file.

    Raises:
        RunError: If it cannot be read, or a row lacks what every row has.
    """
    rows = folder.read_rows(EVALUATION)
    for number, row in enumerate(rows, 1):
        for name, kinds in _ROW.items():
            if not isinstance(row.get(name), kinds) or isinstance(row.get(name), bool):
                words = "a text" if kinds is str else "a number"
                raise RunError(
                    f"{folder.path / EVALUATION}, row {number}: {name} must be {words}, got {row.get(name)!r:.80}."
                )
    return rows


def check_memory(env_config: EnvConfig, config: EvalConfig, device: torch.device) -> None:
    """Raise ``RunError`` for an evaluation that does not fit in memory: all its interactions are kept until its end."""
    memory.require_worlds(config.worlds, 0, device)
    budgets = [("steps", config.steps)]
    budgets += [("adversary_steps", attacker(name).learning_steps(config.adversary_steps)) for name in config.attackers]
    for name, steps in budgets:
        memory.require_interactions(
            "The interactions of an evaluation", config.worlds, steps, env_config.goal_period, device,
            f"use fewer worlds, or lower {name}",
        )  # fmt: skip


def require_pool(config: EvalConfig) -> None:
    """Raise ``RunError`` unless the file of an attacker that needs one can be read."""
    for name in config.attackers:
        if attacker(name).needs_pool and config.pool is not None:
            _read(config.pool)


def elsewhere(folder: RunFolder, rows: list[dict]) -> list[dict]:
    """Rows of the folder that differ from these of an evaluation only in the engine."""

    def identity(row: dict) -> list:
        keys = ("goals", "goal_period", "seed", "worlds", "steps", "environment", "adversary_setting", "weights")
        return [row.get(key) for key in keys]

    here = {row.get("engine") for row in rows}
    same = [identity(row) for row in rows]
    known = read_evaluation(folder)
    return [row for row in known if row.get("engine") not in here and identity(row) in same]


def _identities(env_config: EnvConfig, config: EvalConfig) -> list[dict]:
    """What each row of an evaluation says of how it was made, which distinguishes it from those of others."""
    shared = {name: value for name, value in to_dict(config).items() if name in ("worlds", "seed", "fear")}
    environment, engine = (
        _environment(env_config),
        {"engine": env_config.engine} if hasattr(env_config, "engine") else {},
    )
    return [
        {"goals": goals, "goal_period": env_config.goal_period, "seed": config.seed,
         "worlds": config.worlds_against(goals), "steps": config.steps, "environment": environment}
        | engine
        | ({} if goals == "naive" else {"adversary_setting": _setting(shared, config, goals)})
        for goals in ("naive", *config.attackers)
    ]  # fmt: skip


def _environment(env_config: EnvConfig) -> str:
    """A hash of a task as it is evaluated, except for what rows say themselves; files count by their contents."""
    try:
        files = env_config.file_hashes()
    except OSError as error:
        raise RunError(f"{error.filename} cannot be read ({error.strerror}).") from error
    task = asdict(env_config.for_evaluation()) | files
    return _digest({name: value for name, value in task.items() if name not in ("goal_period", "engine")})


def _digest(data: dict) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True, default=str).encode()).hexdigest()[:12]


def _setting(shared: dict, config: EvalConfig, name: str) -> str:
    """A hash of all that determines how an attacker was made, except for the policy."""
    made = shared | {"adversary_steps": config.adversary_steps, "attacker": name} | to_dict(attacker(name))
    if attacker(name).needs_pool:
        assert config.pool is not None
        made["pool"] = hashlib.sha256(_read(config.pool)).hexdigest()
    return _digest(made)


def _read(path: Path) -> bytes:
    try:
        return read_bytes(path)
    except OSError as error:
        raise RunError(f"{path} cannot be read ({error.strerror}).") from error


@own_settings()
def evaluate(
    policy: Policy, env_config: EnvConfig, config: EvalConfig, device: torch.device,
    progress: Progress = lambda stage, share: None, *, known: Sequence[dict] = (),
    keep: Callable[[dict], None] = lambda row: None, once: Once = _at_once,
) -> list[dict]:  # fmt: skip
    """Evaluate a policy against uniform goals and against attackers.

    Args:
        policy: Gives the actions; for a Gaussian policy, the deterministic (mean) ones.
        env_config: The environment that it was trained in; randomisations are switched off.
        config: Sizes, seed and attackers.
        device: Where to simulate.
        progress: Called with the progress.
        known: Existing rows of this policy: they are returned and not made again.
        keep: Called with each row that is made, before the next is begun.
        once: Gives the scale of the score, from what it depends on and a function that computes it; a study keeps it.

    Returns:
        A row for ``naive`` and one for every attacker: in ``goals`` its name, what ``play`` returns, and ``score``: for
        robots the place of its ``matching`` between standing still (0) and perfect tracking (1); otherwise that of its
        ``return_per_step`` between the policy that does nothing (0) and the environment's reference policy (1), both
        under Naive goals; NaN where there is none, or both are equal. A policy that crashes may be below 0. For an
        attacker also its facts, see ``deimos.run.attack``, and ``adversary_setting``, a hash of all that determined how
        it was made, except for the policy. In ``environment`` each has a hash of the task.

    Raises:
        ValueError: If ``steps`` is below 2 T: no interaction would end in time.
    """
    env_config = env_config.for_evaluation().resolved(device)
    check_memory(env_config, config, device)
    if config.steps < 2 * env_config.goal_period:
        raise ValueError(f"steps must be at least 2 T = {2 * env_config.goal_period}, got {config.steps}.")
    target = make_target(policy, env_config, config, device)
    identities = _identities(env_config, config)
    task = {name: value for name, value in identities[0].items() if name != "goals"} | {"device": device.type}
    measure, low, high = once(task, lambda: score_scale(target.build, config, progress))
    rows = []
    for identity in identities:
        goals = identity["goals"]
        if there := next((row for row in known if row.items() >= identity.items()), None):
            rows.append(there)
            continue
        attack = Attack(uniform_goals)
        if goals != "naive":
            attack = attacker(goals).prepare(replace(target, progress=partial(progress, f"{goals} learns")))
        env = target.build(identity["worlds"], config.seed)
        row = play(env, policy, attack.selector(env), config.steps, partial(progress, goals))
        facts = attack.facts_beside(["score", *row, *identity], goals)
        score = (row[measure] - low) / (high - low) if high != low else math.nan
        rows.append({"goals": goals} | row | facts | {"score": score} | identity)
        keep(rows[-1])
    return rows


def make_target(policy: Policy, env_config: EnvConfig, config: EvalConfig, device: torch.device) -> Target:
    """A policy as attackers meet it; for the arguments see ``evaluate``."""
    quiet = env_config.for_evaluation().resolved(device)
    return Target(
        policy=policy, build=lambda worlds, seed: quiet.build(worlds, device, seed), worlds=config.worlds,
        steps=config.adversary_steps, seed=config.seed, fear=config.fear, pool=config.pool,
    )  # fmt: skip


def worst(policies: Sequence[Sequence[dict]]) -> list[dict]:
    """The worst that attackers did to each policy, among those that every policy has met.

    The largest of several noisy rates is too large. So the attacker is chosen by its crashes in worlds of even number
    and reported by those in worlds of odd number. Where there are kinds of worlds, those of each are numbered
    separately, so that both halves have the same mix.

    Args:
        policies: For each, the rows of one evaluation; those of ``naive`` goals do not count.

    Returns:
        For each policy the ``attacker``, its ``crash_rate``, and the number of ``interactions`` behind that rate; empty
        where no attacker met all of them. Of attackers that tie, it is the first.
    """
    by_name = [
        {row["goals"]: halves for row in rows if row["goals"] != "naive" and (halves := _halves(row))}
        for rows in policies
    ]
    shared = [name for name in (by_name[0] if by_name else {}) if all(name in own for own in by_name)]
    if not shared:
        return []
    names = [max(shared, key=lambda name: own[name][0]) for own in by_name]
    return [
        {"attacker": name, "crash_rate": own[name][1], "interactions": own[name][2]}
        for name, own in zip(names, by_name, strict=True)
    ]


def _halves(row: dict) -> tuple[float, float, int] | None:
    """Share of interactions that crashed in even worlds, in odd ones, and how many there were in odd ones."""
    even = row.get("even_interactions") or 0
    if not 0 < even < row["interactions"]:  # from an earlier version, or too few
        return None
    crashed, odd = row["even_interaction_crashes"], row["interactions"] - even
    return crashed / even, (row["interaction_crashes"] - crashed) / odd, odd


def score_scale(
    build: Callable[[int, int], Env], config: EvalConfig, progress: Progress = lambda stage, share: None
) -> Scale:
    """What the score is made of, and its values at scores 0 and 1; see ``evaluate``."""
    env = build(config.worlds, config.seed)
    rest = env.tracking_at_rest()
    if rest is not None:
        return "matching", rest, 1.0
    nothing = torch.zeros(env.num_envs, env.action_dim, dtype=torch.float32, device=env.device)
    reference = env.reference_policy()
    if reference is None:
        return "return_per_step", math.nan, math.nan
    low = play(env, lambda obs: nothing, uniform_goals(env), config.steps, partial(progress, "zero action"))
    env = build(config.worlds, config.seed)
    high = play(env, reference, uniform_goals(env), config.steps, partial(progress, "reference"))
    return "return_per_step", low["return_per_step"], high["return_per_step"]


@torch.no_grad()
def play(
    env: Env, policy: Policy, selector: GoalSelector, steps: int,
    progress: Callable[[float], None] = lambda share: None, *, guard: GoalGuard | None = None,
) -> dict:  # fmt: skip
    """Let a policy act under a selector's goals, on which ``guard`` has the last word, and count.

    Returns:
        ``reward`` per transition, ``crashes``, ``crashes_per_1000`` transitions, ``interactions`` (issued early enough
        to end in time), ``crash_rate`` (share of those that crashed), those of worlds of even number (see ``worst``)
        separately, and steps and crashes under first goals.
        ``return_per_step`` is the mean over interactions of (sum of the rewards over the T steps, 0 from a crash on) /
        T: unlike the reward per transition it excludes the steps after a crash, but later interactions may gain by one,
        which puts a particle far from every wall. ``matching``, where goals have several groups of components, is the
        same for their tracking, weighted by ``Env.goal_group_weights``. ``tracking`` has the mean of every group over
        transitions, ``strata`` the same and more by kind of world, where there are kinds, and ``errors`` the median of
        each of ``Env.errors`` over all goals that were survived, at the end of their period.
    """
    loop = GoalLoop(env, selector, window=steps, guard=guard)
    totals = torch.zeros(4, env.num_envs, dtype=torch.float64, device=env.device)
    reward, crashes, first_goal_steps, first_goal_crashes = totals
    tracking = torch.zeros(env.num_envs, len(env.goal_groups), dtype=torch.float64, device=env.device)
    errors = {name: reward.new_empty(steps, env.num_envs, dtype=torch.float32) for name in env.errors}
    for t in range(steps):
        step = env.step(policy(env.obs))
        first = ~loop.interactions.active
        reward += step.reward
        tracking += step.reward.unsqueeze(1) if step.tracking is None else step.tracking
        crashes += step.terminated
        met = step.goal_due & ~step.terminated
        for name, values in errors.items():
            values[t] = torch.where(met, env.errors[name], torch.nan)
        first_goal_steps += first
        first_goal_crashes += first & step.terminated
        loop.advance(step, in_time=True)
        if t % 100 == 0:
            progress(t / steps)
    env.check()
    done = loop.outcomes()
    reward_sum, crash_count, first_count, first_crash_count = totals.sum(1).tolist()
    transitions, kinds = steps * env.num_envs, env.strata()
    crashed, even = int(done.crashed.sum()), _numbers(kinds or [""] * env.num_envs, done.env.device)[done.env] % 2 == 0
    return {
        "reward": reward_sum / transitions,
        "crashes": int(crash_count),
        "crashes_per_1000": 1000 * crash_count / transitions,
        "interactions": len(done),
        "interaction_crashes": crashed,
        "crash_rate": crashed / len(done) if len(done) else math.nan,
        "even_interactions": int(even.sum()),
        "even_interaction_crashes": int((even & done.crashed).sum()),
        "first_goal_steps": int(first_count),
        "first_goal_crashes": int(first_crash_count),
        "return_per_step": done.reward.double().mean().item() / env.goal_period,
        **({} if len(env.goal_groups) == 1 else {"matching": _matching(env, done)}),
        "goal_groups": list(env.goal_group_names),
        "tracking": (tracking.mean(0) / steps).tolist(),
        "crashes_per_minute": 60 * crash_count / (transitions * env.dt) if env.has_seconds else math.nan,
        "strata": _by_stratum(kinds, crashes, tracking / steps, done),
        "errors": {name: values.nanmedian().item() for name, values in errors.items()},
    }


def _numbers(kinds: Sequence[str], device: torch.device) -> Tensor:
    """Every world's number among those of its kind, from 0, int64, shape (num_envs,)."""
    counts: Counter[str] = Counter()
    numbers = []
    for kind in kinds:
        numbers.append(counts[kind])
        counts[kind] += 1
    return torch.tensor(numbers, device=device)


def _matching(env: Env, done: Resolved) -> float:
    """Mean tracking over interactions, 0 from a crash on, in [0, 1]; NaN if all weights are 0."""
    counts = env.goal_group_weights or [1.0] * len(env.goal_groups)
    weights = torch.tensor(counts, dtype=torch.float64, device=done.tracking.device)
    return (done.tracking.double().mean(0) @ weights / weights.sum()).item()


def _by_stratum(strata: list[str], crashes: Tensor, tracking: Tensor, done: Resolved) -> dict[str, dict]:
    """Worlds, crashes, mean tracking, the share of survived interactions and their counts of every kind of world."""
    rows = {}
    for name in sorted(set(strata)):
        own = torch.tensor([stratum == name for stratum in strata], device=crashes.device)
        crashed = done.crashed[own[done.env]]
        success = 1.0 - crashed.float().mean().item()  # NaN where no interaction has ended
        rows[name] = {
            "worlds": int(own.sum()), "crashes": int(crashes[own].sum()), "tracking": tracking[own].mean(0).tolist(),
            "success": success, "interactions": len(crashed), "interaction_crashes": int(crashed.sum()),
        }  # fmt: skip
    return rows
