"""A run's shield: calibrated on fresh worlds, then tried under Naive and under attackers that learn about it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from deimos.checks import RunError, check_at_least, check_choice, one_line
from deimos.goals.fear_selector import FearSelector
from deimos.goals.shield import (
    GUARANTEES,
    MODES,
    SCORES,
    Guarantee,
    Mode,
    Shield,
    crashes_needed,
    threshold,
)
from deimos.learn.policy import Policy, load_policy
from deimos.nn.layout import goal_field
from deimos.nn.seeds import generator
from deimos.nn.threads import torch_on_one
from deimos.run.attack import Attack, Target, attacker, names, uniform_goals
from deimos.run.evaluation import EvalConfig, Progress, check_memory, make_target, play, weights_hash
from deimos.run.fear import load_fear
from deimos.run.folder import RunFolder
from deimos.run.loop import GoalLoop
from deimos.run.trainer import TrainConfig
from deimos.sim.env import Env

SHIELD = "shield.json"
Rule = Callable[[Env, Tensor, Tensor], Tensor]
"""The risk of goals, shape (B, N), for worlds, int64, shape (B,), and goals, shape (B, N, goal_dim)."""


def without_pool() -> tuple[str, ...]:
    """Names of the attackers that need no file."""
    return tuple(name for name in names() if not attacker(name).needs_pool)


@dataclass(frozen=True, kw_only=True)
class ShieldConfig:
    """How a shield is calibrated and tried."""

    alpha: float = 0.1
    """Largest share of the goals that would crash the policy that the shield lets through, in (0, 1)."""
    mode: Mode = "stop"
    """What replaces a refused goal: ignore keeps the active goal, project takes the nearest acceptable one,
    stop the safe one. Against the worst attacker stop is the strongest: project gives it the worst acceptable goal."""
    guarantee: Guarantee = "conditional"
    """What stays below alpha: marginal, the mean over calibrations; conditional, this calibration with a confidence of
    95 %."""
    worlds: int = 20_000
    """Worlds that it is calibrated and tested in, half of them each, one goal per world; at least 2."""
    candidates: int = 100
    """Uniform goals that project may take, at least 1."""
    alphas: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4, 0.6, 0.8)
    """Values of alpha to try under Naive and ``argmax`` for the trade-off, as far as the crashes allow."""

    def __post_init__(self) -> None:
        for alpha in (self.alpha, *self.alphas):
            if not 0.0 < alpha < 1.0:
                raise ValueError(f"alpha must be in (0, 1), got {alpha}.")
        check_choice("mode", self.mode, MODES)
        check_choice("guarantee", self.guarantee, GUARANTEES)
        check_at_least("worlds", self.worlds, 2)
        check_at_least("candidates", self.candidates, 1)


@dataclass(frozen=True)
class Outcomes:
    """Uniform goals, one from each world, and their outcomes."""

    score: Tensor
    """Logits of the fear network at issue, shape (n,)."""
    crashed: Tensor
    """Whether each goal led to a crash, bool, shape (n,)."""

    def half(self, odd: bool) -> "Outcomes":
        """Those of every other world."""
        rows = slice(int(odd), None, 2)
        return Outcomes(self.score[rows], self.crashed[rows])


@torch.no_grad()
def collect(
    target: Target, afraid: FearSelector, worlds: int, steps: int, seed: int,
    progress: Callable[[float], None] = lambda share: None,
) -> Outcomes:  # fmt: skip
    """Let a policy act under uniform goals and take one goal from each world, at random among those that ended.

    Goals in one world depend on each other; those in different worlds are independent, as a calibration needs.

    Args:
        target: The policy.
        afraid: Selector whose fear network scores the goals.
        worlds: Number of worlds, at least 1.
        steps: Steps of each, at least 2 T.
        seed: Seed of the worlds.
        progress: Called with the share that is done.
    """
    env = target.build(worlds, seed)
    loop = GoalLoop(env, uniform_goals(env), window=steps)
    for t in range(steps):
        loop.advance(env.step(target.policy(env.obs)), in_time=True)
        if t % 100 == 0:
            progress(t / steps)
    env.check()
    done = loop.outcomes()
    place = torch.randperm(len(done), generator=generator(seed, "shield calibration")).to(env.device)
    first = torch.full((worlds,), -1, dtype=torch.int64, device=env.device)
    first.scatter_reduce_(0, done.env, place, "amax")
    one = done.where(place == first[done.env])
    score = afraid.score(one.state, one.goal, one.next_goal.unsqueeze(1)).squeeze(1)
    return Outcomes(score, one.crashed)


def fear_rule(afraid: FearSelector) -> Rule:
    """The fear network's logits."""
    return lambda env, rows, goals: afraid.score(env.state(env.obs[rows]), env.goal[rows], goals)


def random_rule(env: Env, rows: Tensor, goals: Tensor) -> Tensor:
    """A uniform random number in [0, 1) for every decision, which neither Naive nor an attacker uses."""
    return env.draw(rows)[:, 3:].clone().expand(goals.shape[:2])


def plain_rule(env: Env) -> tuple[str, Rule] | None:
    """A rule that a person might use: closeness to the wall, or a robot's tilt; ``None`` if neither is known."""
    if env.place(torch.zeros(1, dtype=torch.int64, device=env.device)) is not None:

        def near(env: Env, rows: Tensor, goals: Tensor) -> Tensor:
            place = env.place(rows)
            assert place is not None
            return place.abs().amax(1, keepdim=True).expand(goals.shape[:2])

        return "distance to the wall", near
    fields = [field.name for field in env.layout]
    if "gravity" not in fields:
        return None
    up = sum(field.size for field in env.layout[: fields.index("gravity")]) + 2
    return "tilt", lambda env, rows, goals: env.obs[rows, up : up + 1].expand(goals.shape[:2])


class Guard:
    """A shield in the loop, a ``GoalGuard``; counts the goals that it is asked about and those that it refuses.

    Args:
        shield: The shield.
        rule: Gives the risk that it decides by.
        candidates: Uniform goals that it may take instead, at least 1.
    """

    def __init__(self, shield: Shield, rule: Rule, candidates: int) -> None:
        self._shield, self._rule, self._candidates = shield, rule, candidates
        self._asked, self._refused = 0, torch.zeros((), dtype=torch.int64)

    def __call__(self, env: Env, rows: Tensor, goal: Tensor) -> Tensor:
        """The goals that the listed worlds get."""
        candidates = env.sample_goals(rows, self._candidates)
        made = self._shield.choose(
            lambda goals: self._rule(env, rows, goals), env.goal[rows], goal.detach(), candidates
        )
        self._asked += len(rows)
        self._refused = self._refused.to(env.device) + made.refused.sum()  # only read on demand: reading synchronises
        return made.goal

    @property
    def refused(self) -> float:
        """Share of the goals that were refused; NaN before the first."""
        return self._refused.item() / self._asked if self._asked else float("nan")


class Trial:
    """Calibrates shields for a policy and tries them on it.

    Args:
        target: The policy, and what attackers may spend on it.
        afraid: Selector whose fear network the shields use.
        config: How they are made.
        eval_config: How the policy is evaluated, and its attackers.
        progress: Called with the progress.
    """

    def __init__(
        self, target: Target, afraid: FearSelector, config: ShieldConfig, eval_config: EvalConfig,
        progress: Progress = lambda stage, share: None,
    ) -> None:  # fmt: skip
        self.config = config
        self._target, self._afraid, self._eval, self._progress = target, afraid, eval_config, progress
        env = target.build(1, eval_config.seed)
        self._plain, self._goal_period = plain_rule(env), env.goal_period
        self._safe, self._range = env.rest_goal(), _seen_range(env)
        self._scale = _goal_scale(env)
        seed, report = eval_config.seed + 2, partial(progress, "calibrating")  # attackers learn in worlds of seed + 1
        self.outcomes = collect(target, afraid, config.worlds, eval_config.steps, seed, report)
        self._calibration, self._test = self.outcomes.half(False), self.outcomes.half(True)

    def threshold(self, alpha: float) -> float:
        """The threshold for a miss rate; ``ValueError`` as in ``goals.shield.threshold``."""
        return threshold(self._crashes, alpha, self.config.guarantee)

    def _is_possible(self, alpha: float) -> bool:
        """Whether there are enough crashes for a miss rate."""
        return len(self._crashes) >= crashes_needed(alpha, self.config.guarantee)

    def _shield(self, score: float) -> Shield:
        return Shield(score, self.config.mode, self._safe, self._range.tolist())

    def _guard(self, rule: Rule, score: float) -> Callable[[], Guard]:
        """Makes guards with counts at 0; under a rule that does not distinguish goals, project stops."""
        return lambda: Guard(self._shield(score), rule, self.config.candidates)

    def run(self) -> dict[str, Any]:
        """Calibrate, test, and try under Naive and every attacker, compared with both baselines.

        Returns:
            ``deploy``, what a deployment needs, see ``Shield.from_dict``, in physical units; ``test``, miss rates on
            worlds that it was not calibrated on; ``trials``, rows of ``measure``; and ``tradeoff``, the same for
            several miss rates.

        Raises:
            RunError: If there are too few crashes to calibrate on; the message says how many are needed.
        """
        attackers = self._eval.attackers
        try:
            limit = self.threshold(self.config.alpha)
        except ValueError as error:
            raise RunError(self._too_few(error)) from error
        trials = self.measure("no shield", None, attackers) + self._beside(limit, attackers)
        few, tradeoff = tuple(name for name in attackers if name == "argmax"), []
        for other in filter(self._is_possible, self.config.alphas):
            tradeoff += [row | {"alpha": other} for row in self._beside(self.threshold(other), few)]
        return {
            "deploy": self._for_deployment(), "test": self._tested(limit), "trials": trials, "tradeoff": tradeoff
        }  # fmt: skip

    @property
    def _crashes(self) -> Tensor:
        """Scores of the crashes for the calibration."""
        return self._calibration.score[self._calibration.crashed]

    def _too_few(self, error: ValueError) -> str:
        """What to do about too few crashes."""
        need, there = crashes_needed(self.config.alpha, self.config.guarantee), len(self._crashes)
        enough = need + 2.0 * math.sqrt(need)  # on average: two standard deviations below are still enough
        worlds = f"about {round(enough / there * self.config.worlds):,}" if there else "many more"
        return (
            f"{error} These are from {len(self._calibration.score):,} goals, of half the worlds; calibrate in "
            f"{worlds} worlds (--worlds), or with a larger --alpha."
        )

    def _beside(self, score: float, attackers: Sequence[str]) -> list[dict[str, Any]]:
        """Rows of the shield with a threshold, and of baselines that refuse equally many Naive goals."""
        rows = self.measure("shield", self._guard(fear_rule(self._afraid), score), attackers)
        share = rows[0]["refused"]
        rows += self.measure("random refusal", self._guard(random_rule, 1.0 - share), attackers)
        if self._plain:
            name, rule = self._plain
            seen = self._scores(rule).sort().values
            level = seen[min(len(seen) - 1, round((1.0 - share) * len(seen)))].item()
            rows += self.measure(name, self._guard(rule, level), attackers)
        return rows

    def _scores(self, rule: Rule) -> Tensor:
        """The risk that a rule gives uniform goals, none of them refused, shape (n,)."""
        env, scores = self._target.build(self._eval.worlds, self._eval.seed), []

        def note(env: Env, rows: Tensor, goal: Tensor) -> Tensor:
            scores.append(rule(env, rows, goal.unsqueeze(1)).squeeze(1))
            return goal

        report = partial(self._progress, "baseline")
        play(env, self._target.policy, uniform_goals(env), self._eval.steps, report, guard=note)
        return torch.cat(scores)

    def measure(self, shield: str, guard: Callable[[], Guard] | None, attackers: Sequence[str]) -> list[dict[str, Any]]:
        """Try a shield under Naive and under attackers, which learn with it in their worlds.

        Args:
            shield: Its name.
            guard: Makes the shield's guards; ``None`` for no shield.
            attackers: Their names.

        Returns:
            A row for each: what chose the ``goals``, the share ``refused``, the ``crash_rate`` of the ``interactions``
            (all that were asked for, refused or not), and ``tracking``, how well the goals that the shield let through
            or gave instead are met, in [0, 1]; see ``evaluation.play``. Also the facts of an attacker.
        """
        target, rows = replace(self._target, guard=guard and guard(), learnt=[]), []
        for goals in ("naive", *attackers):
            stage = f"{shield}, {goals}"
            attack = Attack(uniform_goals)
            if goals != "naive":
                attack = attacker(goals).prepare(replace(target, progress=partial(self._progress, f"{stage} learns")))
            env, own = target.build(self._eval.worlds_against(goals), self._eval.seed), guard and guard()
            row = play(
                env, target.policy, attack.selector(env), self._eval.steps, partial(self._progress, stage), guard=own
            )
            facts = attack.facts_beside(["shield", "goals", "refused", *row], goals)
            tracking = row.get("matching", row["return_per_step"])
            rows.append({
                "shield": shield, "goals": goals, "refused": own.refused if own else 0.0, "tracking": tracking,
                **{name: row[name] for name in ("crash_rate", "interactions", "interaction_crashes", "crashes")},
                **facts,
            })  # fmt: skip
        return rows

    def _for_deployment(self) -> dict[str, Any]:
        """What a deployment needs, with goals in physical units; a guarantee without enough crashes has none."""
        alpha, known = self.config.alpha, self._crashes
        limits: dict[str, float | None] = {
            name: threshold(known, alpha, name) if len(known) >= crashes_needed(alpha, name) else None
            for name in GUARANTEES
        }
        scores = self._calibration.score.double().sort().values
        kept = torch.linspace(0, len(scores) - 1, min(SCORES, len(scores)), dtype=torch.float64).round().long()
        safe = zip(self._safe, self._scale.tolist(), strict=True)
        return {
            "alpha": alpha, "mode": self.config.mode, "guarantee": self.config.guarantee,
            "threshold": limits, "goal_period": self._goal_period, "crashes": len(known), "goals": len(scores),
            "safe_goal": [None if value is None else value / scale for value, scale in safe],
            "goal_range": (self._range / self._scale).tolist(), "scores": scores[kept.to(scores.device)].tolist(),
        }  # fmt: skip

    def _tested(self, limit: float) -> dict[str, Any]:
        """Rates of misses and of refused goals in worlds that it was not calibrated on."""
        score, crashed = self._test.score, self._test.crashed
        missed, refused = (score[crashed] < limit).double().mean().item(), (score >= limit).double().mean().item()
        return {"crashes": int(crashed.sum()), "goals": len(score), "miss_rate": missed, "refused": refused}


def _goal_scale(env: Env) -> Tensor:
    """Factors by which the policy sees the components of a goal, shape (goal_dim,)."""
    field = goal_field(env.layout)
    return torch.as_tensor(field.scale, dtype=torch.float32, device=env.device).expand(field.size)


def _seen_range(env: Env) -> Tensor:
    """Half side of the box of goals, as the policy sees them, shape (goal_dim,); 1 where there is no box."""
    scale = _goal_scale(env)
    reach = torch.ones_like(scale) if env.goal_range is None else env.goal_range * scale
    return reach.masked_fill(reach == 0.0, 1.0)  # where all goals are the same, as at speed 0, any unit will do


def shield_run(
    folder: RunFolder, config: TrainConfig, shield: ShieldConfig, eval_config: EvalConfig, device: torch.device,
    progress: Progress = lambda stage, share: None,
) -> dict[str, Any]:  # fmt: skip
    """Make the shield of a run and store it, with what was measured, in its ``shield.json``.

    Args:
        folder: The run.
        config: Its configuration.
        shield: How the shield is made.
        eval_config: How it is tried.
        device: Where to simulate.
        progress: Called with the progress.

    Returns:
        See ``Trial.run``.

    Raises:
        RunError: If the run has no fear network, there are too few crashes to calibrate on, or too many worlds for the
            memory.
    """
    folder.require_writable()
    policy = load_policy(folder.path, str(device))
    env_config = config.env.resolved(device)
    check_memory(env_config, replace(eval_config, worlds=shield.worlds, attackers=()), device)
    check_memory(env_config, eval_config, device)
    afraid = load_fear(folder, config, env_config.build(1, device, config.seed))
    if afraid is None:
        raise RunError(
            f"{folder.path} has no fear network that has learnt (those of Deimos 0.1 are not read), which a shield "
            "needs; train with a method that has one, such as --method p25."
        )
    with torch_on_one():
        target = make_target(policy.scaled, env_config, eval_config, device)
        found = Trial(target, afraid, shield, eval_config, progress).run()
    found["deploy"] = {"weights": weights_hash(policy.actor)} | found["deploy"]
    folder.write_json(SHIELD, found)
    return found


def read_shield(folder: RunFolder, weights: str) -> dict[str, Any] | None:
    """What a deployment needs of a run's shield; ``None`` if the run has none.

    Args:
        folder: The run.
        weights: Hash of the weights of its policy.

    Raises:
        RunError: If the shield was made for a policy of other weights, or its file is broken.
    """
    if not (folder.path / SHIELD).exists():
        return None
    try:
        shield = folder.read_json(SHIELD)["deploy"]
        known = shield["weights"]
    except (KeyError, TypeError) as error:
        raise RunError(f"{folder.path / SHIELD} is not a shield file; make it again with deimos shield.") from error
    if known != weights:
        raise RunError(
            f"{folder.path / SHIELD} was made for an earlier policy; make it again with deimos shield, or delete it."
        )
    return shield


def stored_guard(folder: RunFolder, policy: Policy, env: Env, afraid: FearSelector | None, mode: Mode) -> Guard:
    """The shield of a run, for its own worlds.

    Args:
        folder: The run.
        policy: Its policy.
        env: The worlds.
        afraid: The run's selector, whose fear network the shield was calibrated for.
        mode: What replaces the goals that it refuses.

    Raises:
        RunError: If the run has no shield that fits.
    """
    stored = read_shield(folder, weights_hash(policy.actor))
    if stored is None or afraid is None:
        raise RunError(f"{folder.path} has no shield; make one with deimos shield.")
    scale = _goal_scale(env).tolist()
    try:
        safe = [None if value is None else value * each for value, each in zip(stored["safe_goal"], scale, strict=True)]
        reach = [value * each for value, each in zip(stored["goal_range"], scale, strict=True)]
        shield = Shield.from_dict(stored | {"safe_goal": safe, "goal_range": reach}, mode)
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{folder.path / SHIELD} is not a shield for these goals: {one_line(error)}") from error
    return Guard(shield, fear_rule(afraid), ShieldConfig.candidates)
