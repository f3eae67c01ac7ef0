"""What would become of every candidate? Exact outcomes, by trying each in a clone of the world.

Robustness against a weak fear network is no robustness, and a fear network is judged against the truth.
Both need worlds that can be cloned, and time: N candidates cost N T steps of a policy per decision.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from deimos import picks
from deimos.env import Env
from deimos.selector import GoalSelector, Proposal


@dataclass(frozen=True)
class Clones:
    """Worlds to try candidates in.

    Attributes:
        probe: Worlds of the same kind as those that are cloned, as many as are tried at a time.
        act: The policy: observations (n, obs_dim) to actions (n, action_dim).
    """

    probe: Env
    act: Callable[[Tensor], Tensor]

    @torch.no_grad()
    def try_out(self, env: Env, rows: Tensor, candidates: Tensor) -> Tensor:
        """Let the policy pursue every candidate for T steps.

        Args:
            env: The worlds at the moment of the choice; they are not touched.
            rows: Which of them, int64, shape (B,).
            candidates: Goals for each, shape (B, N, goal_dim); N at most the worlds of ``probe``.

        Returns:
            Steps survived, int64 in [0, T], shape (B, N): T where the policy did not crash.
        """
        count = candidates.shape[1]
        size = self.probe.num_envs // count
        if size < 1:
            raise ValueError(f"candidates must be at most the {self.probe.num_envs} worlds of probe, got {count}.")
        parts = zip(rows.split(size), candidates.split(size), strict=True)
        return torch.cat([self._try_some(env, part, goals) for part, goals in parts])

    def _try_some(self, env: Env, rows: Tensor, candidates: Tensor) -> Tensor:
        probe, count = self.probe, candidates.shape[1]
        clones = torch.arange(len(rows) * count, device=rows.device)
        probe.copy_worlds(rows.repeat_interleave(count), clones, origin=env)
        probe.set_goals(clones, candidates.flatten(0, 1))
        survived = torch.zeros(probe.num_envs, dtype=torch.int64, device=rows.device)
        alive = torch.ones(probe.num_envs, dtype=torch.bool, device=rows.device)
        for _ in range(probe.goal_period):
            alive &= ~probe.step(self.act(probe.obs)).terminated
            survived += alive
        return survived[: len(clones)].view(-1, count)


class Oracle(GoalSelector):
    """A Director whose fear is the truth: the sooner a candidate crashes the policy, the more it is feared.

    Args:
        env: The worlds whose goals it chooses.
        clones: Where it tries candidates, with the policy that acts in ``env``.
        rule: How it picks; see ``picks.by_rule``.
        percentile: p, in [0, 100]; for the rule ``percentile`` only.
        candidates: N: uniform candidates per decision.
    """

    def __init__(
        self, env: Env, clones: Clones, rule: picks.Rule = "argmax", percentile: float = 0.0, candidates: int = 100
    ) -> None:
        self.num_candidates = candidates
        self._env, self._clones = env, clones
        self._rule, self._percentile = rule, percentile

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``; scores are T - steps survived."""
        survived = self._clones.try_out(self._env, rows, candidates)
        score = (self._env.goal_period - survived).float()
        pick = picks.by_rule(score, draws[:, 0], self._rule, self._percentile)
        return Proposal(picks.take(candidates, pick), picks.take(score, pick))
