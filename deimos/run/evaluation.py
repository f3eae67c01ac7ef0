"""How good and how safe a policy is: against uniform goals (Naive) and against the worst ones (Adversary).

Every policy meets the same goals: the i-th goal of a world depends on the evaluation's seed, the world and i alone. The
Adversary is the argmax Director with a fear network of its own, trained after the policy, so that it knows this
policy's weaknesses and not those of some training run.
"""

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import torch
from torch import Tensor, nn

from deimos.checks import check_at_least, check_choice, check_range
from deimos.goals.fear import Fear, FearConfig, auroc
from deimos.goals.interactions import Resolved
from deimos.goals.selector import GoalSelector, Proposal
from deimos.goals.selectors import director, uniform
from deimos.learn.policy import load_policy
from deimos.nn.threads import on_threads
from deimos.run.config import to_dict
from deimos.run.folder import RunFolder
from deimos.run.loop import GoalLoop, spaces
from deimos.run.oracle import Clones, Oracle
from deimos.sim.env import Env, EnvConfig

Policy = Callable[[Tensor], Tensor]
"""Observations, shape (n, obs_dim), to actions, shape (n, action_dim)."""
Progress = Callable[[str, float], None]
"""Called now and then with the stage's name and the share of it that is done."""

WEAK_CRASHES, WEAK_AUROC = 100, 0.6  # below either, resisting the Adversary proves nothing
FITS = 15  # fits of the Adversary's network during its ``adversary_steps``
HELD_OUT = 5  # every fifth world of the collection is kept for the Adversary's AUROC


@dataclass(frozen=True, kw_only=True)
class EvalConfig:
    """How a policy is evaluated (thesis, 4.1.3)."""

    worlds: int = 2000
    """Parallel worlds, at least 1."""
    steps: int = 2000
    """Steps of every world, at least 2 T."""
    seed: int = 1_000_003
    """Seed of the worlds and their goals, in [0, 2^32 - 1). The same for all policies that are to be compared."""
    adversary_steps: int = 1500
    """Steps of every world that the Adversary learns from, at least 1; more where its data is still too small."""
    adversary_interactions: int = 20_000
    """Interactions that it needs, at least 0."""
    adversary_crashes: int = 500
    """Crashes among them that it needs, at least 0."""
    adversary_enough: Literal["all", "any"] = "all"
    """``all``: it collects until all of these are reached. ``any``: it stops at whichever limit comes first,
    interactions or crashes; simulators of robots are too slow for more."""
    adversary_patience: int = 10
    """It gives up collecting after this many times ``adversary_steps``, at least 1."""
    fear: FearConfig = field(default_factory=lambda: FearConfig(epochs=20, minibatches=32, min_per_class=8))
    """The Adversary's fear network."""
    oracle_worlds: int = 0
    """Worlds that also meet an oracle Adversary, which tries every candidate in clones of the world and asks for
    the one that crashes the policy soonest, or else for the one that the Adversary's network fears most; 200 is
    plenty, 0 leaves it out. It costs N T steps per goal."""

    def __post_init__(self) -> None:
        for name in ("worlds", "steps", "adversary_steps", "adversary_patience"):
            check_at_least(name, getattr(self, name), 1)
        for name in ("adversary_interactions", "adversary_crashes", "oracle_worlds"):
            check_at_least(name, getattr(self, name), 0)
        check_choice("adversary_enough", self.adversary_enough, ["all", "any"])
        check_range("seed", self.seed, 0, 2**32 - 2)


def weights_hash(module: nn.Module) -> str:
    """First 16 hexadecimal digits of the SHA-256 of all weights."""
    digest = hashlib.sha256()
    for name, value in module.state_dict().items():
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def evaluate_run(
    folder: RunFolder, env_config: EnvConfig, config: EvalConfig, device: torch.device,
    progress: Progress = lambda stage, share: None, *, again: bool = True,
) -> list[dict]:  # fmt: skip
    """Evaluate the policy of a run, and keep the rows in its ``evaluation.json``.

    There they replace the rows of the same evaluation of the same weights. One of another T, size, seed or engine, or
    of an Adversary that was trained otherwise, is another evaluation, and stays beside them. Rows that the folder has
    are made ``again`` or given back as they are; for the other arguments see ``evaluate``.

    Returns:
        The rows of this evaluation, those of ``evaluate`` with the policy's ``weights_hash``.
    """
    policy = load_policy(folder.path, str(device))
    env_config = env_config.resolved(device)
    weights = {"weights": weights_hash(policy.actor)}
    known = folder.read_json("evaluation.json") if (folder.path / "evaluation.json").exists() else []
    identities = [(identity | weights).items() for identity in _identities(env_config, config)]
    same = [row for row in known if any(row.items() >= identity for identity in identities)]
    if len(same) == len(identities) and not again:
        return same
    with on_threads(1):  # sums of torch's depend on its threads
        fresh = [row | weights for row in evaluate(policy.scaled, env_config, config, device, progress)]
    folder.write_json("evaluation.json", [row for row in known if row not in same] + fresh)
    return fresh


def elsewhere(folder: RunFolder, rows: list[dict]) -> list[dict]:
    """Rows of the folder that differ from these of an evaluation in nothing but the engine: how it did elsewhere."""

    def identity(row: dict) -> list:
        return [
            row.get(key) for key in ("goals", "goal_period", "seed", "worlds", "steps", "adversary_setting", "weights")
        ]

    here = {row.get("engine") for row in rows}
    same = [identity(row) for row in rows]
    known = folder.read_json("evaluation.json")
    return [row for row in known if row.get("engine") not in here and identity(row) in same]


def _identities(env_config: EnvConfig, config: EvalConfig) -> list[dict]:
    """What each row of an evaluation says of how it was made, which tells it from the rows of other evaluations."""
    trained = {name: value for name, value in to_dict(config).items() if name not in ("steps", "oracle_worlds")}
    setting = hashlib.sha256(json.dumps(trained, sort_keys=True).encode()).hexdigest()[:12]
    engine = {"engine": env_config.engine} if hasattr(env_config, "engine") else {}
    sizes = {"naive": config.worlds, "adversary": config.worlds, "oracle": config.oracle_worlds}
    return [
        {"goals": goals, "goal_period": env_config.goal_period, "seed": config.seed, "worlds": worlds,
         "steps": config.steps} | engine | ({} if goals == "naive" else {"adversary_setting": setting})
        for goals, worlds in sizes.items() if worlds
    ]  # fmt: skip


def evaluate(
    policy: Policy, env_config: EnvConfig, config: EvalConfig, device: torch.device,
    progress: Progress = lambda stage, share: None,
) -> list[dict]:  # fmt: skip
    """Evaluate a policy against Naive and against Adversary.

    Args:
        policy: What acts; of a Gaussian policy, its deterministic (mean) actions.
        env_config: The environment that it was trained in; randomisations are switched off.
        config: Sizes and seed.
        device: Where to simulate.
        progress: Told how far it is.

    Returns:
        One row for ``naive`` and one for ``adversary``, and one for ``oracle`` if asked for: what ``play`` gives, and
        ``score``: the place of its ``return_per_step`` between that of the policy that does nothing (0) and that of the
        environment's reference policy (1), both under Naive goals; NaN where there is none. For the Adversary also
        what ``train_adversary`` gives, and ``adversary_setting``, a hash of all that fixed its training but the policy.

    Raises:
        ValueError: If ``steps`` is below 2 T: no interaction would end in time.
    """
    env_config = env_config.for_evaluation().resolved(device)
    if config.steps < 2 * env_config.goal_period:
        raise ValueError(f"steps must be at least 2 T = {2 * env_config.goal_period}, got {config.steps}.")

    def build(worlds: int = config.worlds, seed: int = config.seed) -> Env:
        return env_config.build(worlds, device, seed)

    scale = _scale(build, config.steps, progress)
    fear, collection = train_adversary(policy, build(seed=config.seed + 1), config, partial(progress, "collection"))
    choosers: dict[str, Callable[[Env], GoalSelector]] = {
        "naive": _naive,
        "adversary": lambda env: argmax_director(env, fear),
        "oracle": lambda env: Oracle(env, Clones(build, policy), fear=fear),
    }
    rows = []
    for identity in _identities(env_config, config):
        goals, env = identity["goals"], build(identity["worlds"])
        row = {"goals": goals} | play(env, policy, choosers[goals](env), config.steps, partial(progress, goals))
        row |= collection if goals == "adversary" else {}
        row["score"] = (row["return_per_step"] - scale[0]) / (scale[1] - scale[0]) if scale else math.nan
        rows.append(row | identity)
    return rows


def _naive(env: Env) -> GoalSelector:
    return uniform.Config().build(spaces(env), 0)


def _scale(build: Callable[[], Env], steps: int, progress: Progress) -> tuple[float, float] | None:
    """Return per step of the zero-action policy and of the reference policy, if there is one."""
    env = build()
    nothing = torch.zeros(env.num_envs, env.action_dim, device=env.device)
    reference = env.reference_policy()
    if reference is None:
        return None
    low = play(env, lambda obs: nothing, _naive(env), steps, partial(progress, "zero action"))
    high = play(build(), reference, _naive(env), steps, partial(progress, "reference"))
    return low["return_per_step"], high["return_per_step"]


@torch.no_grad()
def play(
    env: Env, policy: Policy, selector: GoalSelector, steps: int, progress: Callable[[float], None] = lambda share: None
) -> dict:
    """Let a policy act under a selector's goals and count.

    Returns:
        ``reward`` per transition, ``crashes``, ``crashes_per_1000`` transitions, ``interactions`` (issued early enough
        to end in time), ``crash_rate`` (share of those that crashed), steps and crashes under first goals apart.
        ``return_per_step``, the mean over interactions of (sum of the rewards over the T steps, 0 from a crash on) / T,
        cannot be raised by crashing, unlike the reward per transition: a crash puts a particle back to the origin, far
        from every wall. ``tracking`` has the mean of every group of goal components, ``strata`` the same and more by
        kind of world, where there are kinds, and ``errors`` the median of each of ``Env.errors`` over all goals that
        were survived, at the end of their period.
    """
    loop = GoalLoop(env, selector, window=steps)
    totals = torch.zeros(4, env.num_envs, dtype=torch.float64, device=env.device)
    reward, crashes, first_goal_steps, first_goal_crashes = totals
    tracking = torch.zeros(env.num_envs, len(env.goal_groups), dtype=torch.float64, device=env.device)
    errors = {name: torch.empty(steps, env.num_envs, device=env.device) for name in env.errors}
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
        loop.advance(step)
        if t % 100 == 0:
            progress(t / steps)
    env.check()
    done = loop.outcomes()
    reward_sum, crash_count, first_count, first_crash_count = totals.sum(1).tolist()
    transitions = steps * env.num_envs
    crashed = int(done.crashed.sum())
    return {
        "reward": reward_sum / transitions,
        "crashes": int(crash_count),
        "crashes_per_1000": 1000 * crash_count / transitions,
        "interactions": len(done),
        "interaction_crashes": crashed,
        "crash_rate": crashed / len(done) if len(done) else math.nan,
        "first_goal_steps": int(first_count),
        "first_goal_crashes": int(first_crash_count),
        "return_per_step": done.reward.double().mean().item() / env.goal_period,
        "goal_groups": list(env.goal_group_names),
        "tracking": (tracking.mean(0) / steps).tolist(),
        "crashes_per_minute": 60 * crash_count / (transitions * env.dt) if env.has_seconds else math.nan,
        "strata": _by_stratum(env.strata(), crashes, tracking / steps, done),
        "errors": {name: values.nanmedian().item() for name, values in errors.items()},
    }


def _by_stratum(strata: list[str], crashes: Tensor, tracking: Tensor, done: Resolved) -> dict[str, dict]:
    """Worlds, crashes, mean tracking and the share of survived interactions of every kind of world."""
    rows = {}
    for name in sorted(set(strata)):
        own = torch.tensor([stratum == name for stratum in strata], device=crashes.device)
        success = 1.0 - done.crashed[own[done.env]].float().mean().item()  # NaN where no interaction has ended
        rows[name] = {
            "worlds": int(own.sum()), "crashes": int(crashes[own].sum()),
            "tracking": tracking[own].mean(0).tolist(), "success": success,
        }  # fmt: skip
    return rows


def argmax_director(env: Env, fear: Fear) -> director.Director:
    """A Director that asks for the candidate that a fear network, as it is at that time, fears most."""
    selector = director.Config(rule="argmax", fear=fear.config).build(spaces(env), 0)
    selector.fear = fear
    return selector


def train_adversary(
    policy: Policy, env: Env, config: EvalConfig, progress: Callable[[float], None] = lambda share: None
) -> tuple[Fear, dict]:
    """Train a fear network on a finished policy.

    Half of the goals of the collection are uniform and half are the network's own argmax: uniform goals alone would
    show few crashes of a safe policy, its own choices alone no survivals.

    Returns:
        The network, and ``adversary_interactions``, ``adversary_crashes``, ``adversary_steps``, ``adversary_auroc`` (on
        every fifth world, which it did not learn from; NaN where they hold no pair to rank) and ``weak_adversary``:
        whether it has seen so few crashes, or ranks so badly, that resisting it proves nothing.
    """
    fear = Fear(config.fear, env.state_dim, env.goal_dim, env.device, config.seed)
    collector = _Collector(env, fear)
    limit = config.adversary_steps * config.adversary_patience
    loop = GoalLoop(env, collector, window=limit)
    pause = max(env.goal_period, config.adversary_steps // FITS)
    for t in range(1, limit + 1):
        with torch.no_grad():
            step = env.step(policy(env.obs))
        loop.advance(step)
        if t % pause == 0 or t == limit:
            progress(min(1.0, t / config.adversary_steps))
            data = loop.outcomes()
            learnt_from = data.where(data.env % HELD_OUT != 0)
            fear.fit(learnt_from, epochs=1)
            if _enough(config, len(data), int(data.crashed.sum()), t):
                break
    env.check()
    fear.fit(learnt_from)
    fear.check()
    quality = _quality(fear, data.where(data.env % HELD_OUT == 0))
    crashes = int(data.crashed.sum())
    return fear, {
        "adversary_steps": t,
        "adversary_interactions": len(data),
        "adversary_crashes": crashes,
        "adversary_auroc": quality,
        "weak_adversary": not fear.fitted or crashes < WEAK_CRASHES or quality < WEAK_AUROC,
    }


def _quality(fear: Fear, held_out: Resolved) -> float:
    """How often the network ranks a crash above a survival under a goal of the same kind, its own or a uniform one.

    Between the kinds, to tell which goals are its own would tell much of what crashes.
    """
    if not fear.fitted or not len(held_out):
        return math.nan
    logits = fear.score(held_out.state, held_out.goal, held_out.next_goal.unsqueeze(1)).squeeze(1)
    ranked = pairs = 0.0
    for kind in (held_out.probe, ~held_out.probe):
        crashed = held_out.crashed[kind]
        count = float(crashed.sum() * (~crashed).sum())
        if count:
            ranked += count * auroc(logits[kind], crashed)
            pairs += count
    return ranked / pairs if pairs else math.nan


def _enough(config: EvalConfig, interactions: int, crashes: int, steps: int) -> bool:
    """Whether the Adversary has seen enough."""
    counts = (interactions >= config.adversary_interactions, crashes >= config.adversary_crashes)
    return any(counts) if config.adversary_enough == "any" else all(counts) and steps >= config.adversary_steps


class _Collector(GoalSelector):
    """Half uniform goals, which are marked as probes, half the argmax of a fear network that is being trained."""

    def __init__(self, env: Env, fear: Fear) -> None:
        self._uniform = _naive(env)
        self._argmax = argmax_director(env, fear)
        self.num_candidates = self._argmax.num_candidates

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        free = self._uniform.propose(rows, state, goal, candidates, draws)
        own = self._argmax.propose(rows, state, goal, candidates, draws)
        coin = draws[:, 1] < 0.5
        return replace(own, goal=torch.where(coin.unsqueeze(1), free.goal, own.goal), probe=coin)
