"""The interface of attackers, which choose the goals of a finished policy so that it crashes.

A file of ``deimos.run.attackers``, or a module that is registered under the entry-point group of that name, is an
attacker. It may learn about the policy first, for a number of steps that is the same for every policy: one that could
go on until it has seen enough crashes would be stronger against unsafe policies for that reason alone.
"""

import abc
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from deimos import plugins
from deimos.checks import RunError
from deimos.goals.fear import Fear, FearConfig, auroc
from deimos.goals.interactions import Resolved
from deimos.goals.selector import GoalSelector, Proposal
from deimos.goals.selectors import director, uniform
from deimos.run import attackers
from deimos.run.loop import GoalGuard, GoalLoop, spaces
from deimos.sim.env import Env

Policy = Callable[[Tensor], Tensor]
"""Observations, shape (n, obs_dim), to actions, shape (n, action_dim)."""

FITS = 15  # fits of an attacker's network while it chooses goals itself
HELD_OUT = 5  # every fifth world is kept for the network's AUROC
_NUMBERS = np.generic, Tensor  # types whose ``item`` is a number of Python's


@dataclass(frozen=True, kw_only=True)
class Target:
    """A policy that is attacked, and what an attacker may spend on it."""

    policy: Policy
    """Gives the actions; for a Gaussian policy, the mean ones."""
    build: Callable[[int, int], Env]
    """Makes a number of worlds, with a seed; without randomisations."""
    worlds: int
    """Worlds to learn in, at least 1."""
    steps: int
    """Steps of each that the thesis's Adversary learns from, at least 1: the unit of every attacker's budget."""
    seed: int
    """Seed of the worlds that it is evaluated in, and of an attacker's own draws."""
    fear: FearConfig
    """Size of a fear network, and how it learns."""
    pool: Path | None = None
    """The file of ``pooled``."""
    guard: GoalGuard | None = None
    """Has the last word on the goals of its worlds, as a shield does; ``None`` for none."""
    progress: Callable[[float], None] = field(default=lambda share: None, compare=False)
    """Called now and then with the share of the preparation that is done."""
    learnt: list["Learnt"] = field(default_factory=list, repr=False, compare=False)
    """What ``learn_fear`` has trained so far: several attackers ask for the same network."""


@dataclass(frozen=True)
class Learnt:
    """A fear network that ``learn_fear`` has trained, and what it was asked for."""

    target: Target
    """The policy, and the network, worlds and seed that it was learnt about with: an attacker may change these."""
    steps: int
    own_goals: bool
    fear: Fear
    facts: dict[str, Any]


@dataclass(frozen=True)
class Attack:
    """An attacker that is ready."""

    selector: Callable[[Env], GoalSelector]
    """Makes the selector of goals for some worlds."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Numbers and texts that are added to the row of the evaluation; see ``learn_fear``."""

    def facts_beside(self, row: Iterable[str], who: str) -> dict[str, Any]:
        """``facts`` for a row of an evaluation, as its file holds them.

        Args:
            row: Names that the row already has.
            who: Name of the attacker.

        Raises:
            RunError: If a fact has one of these names, or is neither a number nor a text.
        """
        facts = {name: value.item() if isinstance(value, _NUMBERS) else value for name, value in self.facts.items()}
        if taken := sorted({*row} & facts.keys()):
            raise RunError(f"Facts of the attacker {who} must not repeat names of the row, got {', '.join(taken)}.")
        for name, value in facts.items():
            if not isinstance(value, int | float | str | None):
                raise RunError(f"The fact {name} of the attacker {who} must be a number or a text, got {value!r:.80}.")
        return facts


class AttackerConfig(abc.ABC):
    """The interface of an attacker's ``Config``: a frozen dataclass in which every field has a default."""

    few_worlds: ClassVar[bool] = False
    """Whether a goal costs so much that it attacks only ``EvalConfig.oracle_worlds`` worlds."""

    needs_pool: ClassVar[bool] = False
    """Whether it is made from the file ``EvalConfig.pool``."""

    def learning_steps(self, steps: int) -> int:
        """Steps of every world that it learns from, where the thesis's Adversary learns from ``steps``."""
        return 0

    @abc.abstractmethod
    def prepare(self, target: Target) -> Attack:
        """Learn what it needs about a policy."""


def names() -> list[str]:
    """Names of all attackers, sorted."""
    return sorted(_plugins())


def _plugins() -> dict[str, str]:
    """Names of the plug-ins by those of the attackers, which have hyphens instead of underscores."""
    return {name.replace("_", "-"): name for name in plugins.names(attackers)}


def attacker(name: str) -> AttackerConfig:
    """The configuration of an attacker.

    Raises:
        ValueError: If no attacker has this name; the message lists them.
    """
    if name not in _plugins():
        raise ValueError(f"Unknown attacker '{name}'; choose from: {', '.join(names())}.")
    return plugins.load(attackers, _plugins()[name]).Config()


def require_heard(among: Iterable[str], pool: Path | None, oracle_worlds: int | None = None) -> None:
    """Refuse settings that none of some attackers takes: they would have no effect.

    Raises:
        RunError: If a pool, or a number of worlds, is given, and none of the attackers takes it.
    """
    who = [attacker(name) for name in among]
    if pool is not None and not any(each.needs_pool for each in who):
        raise RunError("pool is the file of the attacker pooled; add --attackers pooled.")
    if oracle_worlds is not None and not any(each.few_worlds for each in who):
        raise RunError("oracle_worlds are those of the attacker oracle; add --attackers oracle.")


def uniform_goals(env: Env) -> GoalSelector:
    """Naive: uniform goals."""
    return uniform.Config().build(spaces(env), 0)


def argmax_director(env: Env, fear: Fear) -> director.Director:
    """A Director that asks for the candidate that a fear network, as it is at that time, fears most."""
    selector = director.Config(rule="argmax", memory=0, fear=fear.config).build(spaces(env), 0)
    selector.fear = fear
    return selector


def learn_fear(target: Target, steps: int, *, own_goals: bool) -> tuple[Fear, dict[str, Any]]:
    """Train a fear network on a finished policy; for the arguments see ``collect``.

    It is trained once for all attackers of an evaluation that ask for the same of the same target.

    Returns:
        The network, and ``adversary_steps``, ``adversary_interactions``, ``adversary_crashes``, ``adversary_auroc`` (on
        every fifth world, which it did not learn from; NaN where they hold no pair to rank) and ``uninformed``: whether
        it has learnt nothing, because it saw no crash or no survival, so that goals are uniform.
    """
    asked = target, steps, own_goals
    known = next((each for each in target.learnt if (each.target, each.steps, each.own_goals) == asked), None)
    if known is None:
        known = Learnt(*asked, *fear_of([target], steps, own_goals=own_goals))
        target.learnt.append(known)
    return known.fear, dict(known.facts)


def fear_of(targets: Sequence[Target], steps: int, *, own_goals: bool) -> tuple[Fear, dict[str, Any]]:
    """Train one fear network on policies of one environment; see ``learn_fear``, and ``collect`` for the arguments."""
    fear, data = collect(targets, steps, own_goals=own_goals)
    fear.fit(learnt_from(data))
    fear.check()
    return fear, {
        "adversary_steps": steps * len(targets), "adversary_interactions": len(data),
        "adversary_crashes": int(data.crashed.sum()),
        "adversary_auroc": quality(fear, data.where(data.env % HELD_OUT == 0)), "uninformed": not fear.fitted,
    }  # fmt: skip


def collect(targets: Sequence[Target], steps: int, *, own_goals: bool) -> tuple[Fear, Resolved]:
    """Let policies act, each in its own worlds, to learn from what happens.

    Args:
        targets: The policies, at least 1, of one environment.
        steps: Steps of every world, at least 1.
        own_goals: Whether every other goal is the network's own argmax, as far as it has learnt by then. Uniform goals
            show few crashes of a safe policy, its own choices alone no survivals. False for uniform goals alone.

    Returns:
        The network, which has learnt nothing yet unless it chose goals, and all interactions.
    """
    first = targets[0]
    envs = [target.build(target.worlds, target.seed + 1) for target in targets]
    fear = Fear(first.fear, envs[0].state_dim, envs[0].goal_dim, envs[0].device, first.seed)
    loops = [
        GoalLoop(env, Explorer(env, fear) if own_goals else uniform_goals(env), window=steps, guard=target.guard)
        for target, env in zip(targets, envs, strict=True)
    ]
    pause = max(envs[0].goal_period, steps // FITS)
    for t in range(1, steps + 1):
        for target, env, loop in zip(targets, envs, loops, strict=True):
            with torch.no_grad():
                step = env.step(target.policy(env.obs))
            loop.advance(step)
        if t % pause == 0:
            first.progress(t / steps)
            if own_goals:
                fear.fit(learnt_from(_outcomes(loops)), epochs=1)
    for env in envs:
        env.check()
    return fear, _outcomes(loops)


def _outcomes(loops: Sequence[GoalLoop]) -> Resolved:
    """All interactions of some loops, one loop after the other."""
    found = [loop.outcomes() for loop in loops]
    return Resolved(**{each.name: torch.cat([getattr(part, each.name) for part in found]) for each in fields(Resolved)})


def learnt_from(data: Resolved) -> Resolved:
    """What a network may learn from: all but every fifth world."""
    return data.where(data.env % HELD_OUT != 0)


def quality(fear: Fear, held_out: Resolved) -> float:
    """How often the network ranks a crash above a survival under a goal of the same kind, its own or a uniform one.

    Across the kinds, recognising its own goals would be enough to predict many crashes.
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


class Explorer(GoalSelector):
    """Half uniform goals, which are marked as probes, half the argmax of a fear network that is being trained."""

    dense = True

    def __init__(self, env: Env, fear: Fear) -> None:
        self._uniform = uniform_goals(env)
        self._argmax = argmax_director(env, fear)
        self.num_candidates = self._argmax.num_candidates

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        free = self._uniform.propose(rows, state, goal, candidates, draws)
        own = self._argmax.propose(rows, state, goal, candidates, draws)
        coin = draws[:, 1] < 0.5
        return replace(own, goal=torch.where(coin.unsqueeze(1), free.goal, own.goal), probe=coin)
