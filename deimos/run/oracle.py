"""What would be the outcome of every candidate? Exact answers, by trying each in a clone of the world.

Robustness against a weak fear network is not robustness, and a fear network must be judged by the truth. Both need
worlds that can be cloned, and time: N candidates cost N T steps of a policy per decision.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from deimos.goals import picks
from deimos.goals.fear import Fear
from deimos.goals.selector import GoalSelector, Proposal
from deimos.run.loop import GoalGuard
from deimos.sim.env import Env

MOST = {"cpu": 10_000, "cuda": 200_000}
"""Clones at a time, by the type of the device."""


@runtime_checkable
class SeesWorlds(Protocol):
    """A selector that needs more than tensors; a training run shows it its worlds before the first choice."""

    def see(self, env: Env, clones: "Clones") -> None:
        """Take note of the worlds.

        Args:
            env: The worlds whose goals it chooses; it must not touch them.
            clones: Where it may try goals, with the mean actions of the policy as it is at the time.
        """
        ...


class Clones:
    """Worlds to try candidates in.

    They come in sets of 1, 2, 4, ... times the candidates of a decision, each made when it is first needed: a set is
    stepped as a whole, and one world's decision should not wait for ten thousand clones.

    Args:
        build: Makes a number of worlds like those that are cloned.
        act: The policy: observations (n, obs_dim) to actions (n, action_dim).
        limit: Largest number of clones at a time; a decision gets as many as it has candidates in any case. ``None``
            for ``MOST`` of the device: a GPU is idle with fewer, and a CPU's caches are full with more.
        guard: Has the last word on the candidates that they pursue; ``None`` for none.
    """

    def __init__(
        self, build: Callable[[int], Env], act: Callable[[Tensor], Tensor], limit: int | None = None,
        guard: GoalGuard | None = None,
    ) -> None:  # fmt: skip
        self.act = act
        self._build, self._limit, self._guard = build, limit, guard
        self._sets: dict[int, Env] = {}

    @torch.no_grad()
    def try_out(self, env: Env, rows: Tensor, candidates: Tensor) -> Tensor:
        """Let the policy pursue every candidate for T steps.

        Args:
            env: The worlds at the moment of the choice; they are not touched.
            rows: Which of them, int64, shape (B,).
            candidates: Goals for each, shape (B, N, goal_dim).

        Returns:
            Steps survived, int64 in [0, T], shape (B, N): T where the policy did not crash.
        """
        size = max(1, (self._limit or MOST[env.device.type]) // candidates.shape[1])
        parts = zip(rows.split(size), candidates.split(size), strict=True)
        return torch.cat([self._try_some(env, part, goals) for part, goals in parts])

    def _try_some(self, env: Env, rows: Tensor, candidates: Tensor) -> Tensor:
        count = candidates.shape[1]
        size = count << (len(rows) - 1).bit_length()  # the smallest set with room for them
        if size not in self._sets:
            self._sets[size] = self._build(size)
        probe = self._sets[size]
        clones = torch.arange(len(rows) * count, device=rows.device)
        probe.copy_worlds(rows.repeat_interleave(count), clones, origin=env)
        goals = candidates.flatten(0, 1)
        probe.set_goals(clones, goals if self._guard is None else self._guard(probe, clones, goals))
        survived = torch.zeros(probe.num_envs, dtype=torch.int64, device=rows.device)
        alive = torch.ones(probe.num_envs, dtype=torch.bool, device=rows.device)
        for _ in range(env.goal_period):
            alive &= ~probe.step(self.act(probe.obs)).terminated
            survived += alive
        return survived[: len(clones)].view(-1, count)


class Oracle(GoalSelector):
    """A Director whose fear is the truth: the sooner a candidate crashes the policy, the more it is feared.

    The truth ends after T steps. Where no candidate crashes the policy by then, it cannot tell one that leaves
    it rushing at a wall from one that leaves it at rest; a learnt fear network often can.

    Args:
        env: The worlds whose goals it chooses.
        clones: Where it tries candidates, with the policy that acts in ``env``.
        rule: How it picks; see ``picks.by_rule``.
        percentile: p, in [0, 100]; for the rule ``percentile`` only.
        candidates: N, uniform candidates per decision.
        fear: Ranks candidates that tie by the truth; ``None`` leaves ties to chance.
    """

    def __init__(
        self, env: Env, clones: Clones, rule: picks.Rule = "argmax", percentile: float = 0.0, candidates: int = 100,
        fear: Fear | None = None,
    ) -> None:  # fmt: skip
        self.num_candidates = candidates
        self._fear = fear
        self._env, self._clones = env, clones
        self._rule, self._percentile = rule, percentile

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``; scores are T - steps survived, plus up to 1 for what a fear network adds."""
        survived = self._clones.try_out(self._env, rows, candidates)
        score = (self._env.goal_period - survived).float()
        if self._fear is not None and self._fear.fitted:
            logit = self._fear.score(state, goal, candidates)
            score += logit.argsort(dim=1).argsort(dim=1) / candidates.shape[1]  # ranks: sigmoids would tie at 1
        pick = picks.by_rule(score, draws[:, 0], self._rule, self._percentile)
        picked = picks.take(score, pick)
        return Proposal(picks.take(candidates, pick), picked, percentile=picks.percentile(score, picked))
