"""It searches all goals for the most feared one, by the cross-entropy method (Rubinstein 1999) and by gradients.

A hundred candidates in three dimensions leave gaps that a policy may fall into.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.checks import check_at_least, check_positive, check_range
from deimos.goals import picks
from deimos.goals.fear import Fear
from deimos.goals.selector import GoalSelector, Proposal, uniform_proposal
from deimos.run.attack import Attack, Target, learn_fear
from deimos.run.attackers import argmax_long
from deimos.sim.env import Env


@dataclass(frozen=True, kw_only=True)
class Config(argmax_long.Config):
    """Its network is that of ``argmax-long``."""

    rounds: int = 3
    """Rounds of the cross-entropy method, at least 1."""
    samples: int = 100
    """Goals of a round, at least ``elite``."""
    elite: int = 10
    """Most feared goals that the next round is drawn around, at least 2."""
    ascents: int = 10
    """Steps along the gradient of fear, from the most feared goal, at least 0."""
    stride: float = 0.05
    """Length of such a step, as a share of half a side of the box of goals, in (0, 1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("rounds", self.rounds, 1)
        check_at_least("elite", self.elite, 2)
        check_at_least("samples", self.samples, self.elite)
        check_at_least("ascents", self.ascents, 0)
        check_positive("stride", self.stride)
        check_range("stride", self.stride, 0.0, 1.0)

    def prepare(self, target: Target) -> Attack:
        """See ``AttackerConfig.prepare``."""
        fear, facts = learn_fear(target, self.longer * target.steps, own_goals=True)
        return Attack(lambda env: Search(self, env, fear), facts)


class Search(GoalSelector):
    """See ``Config``. Where valid goals do not form a box, it takes the most feared of all its candidates.

    Args:
        config: How it searches.
        env: The worlds whose goals it chooses.
        fear: What it maximises.
    """

    def __init__(self, config: Config, env: Env, fear: Fear) -> None:
        self._config, self._env, self._fear = config, env, fear
        self.num_candidates = config.rounds * config.samples

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``; the candidates supply the randomness that the search needs."""
        if not self._fear.fitted:
            return uniform_proposal(candidates, draws[:, 0])
        bounds = self._env.goal_bounds(rows)
        if bounds is None:
            score = self._fear.score(state, goal, candidates)
            pick = score.argmax(1)
            return Proposal(picks.take(candidates, pick), picks.take(score, pick))
        found = self._cross_entropy(state, goal, candidates, *bounds)
        return self._ascend(state, goal, found, *bounds)

    def _cross_entropy(self, state: Tensor, goal: Tensor, candidates: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """The most feared goal of all rounds, shape (B, goal_dim): uniform ones, then normal ones around the elite."""
        low, high = low.unsqueeze(1), high.unsqueeze(1)
        place = 2.0 * (candidates - low) / (high - low) - 1.0  # uniform in [-1, 1]
        normal = 2.0**0.5 * place.clamp(-1 + 1e-6, 1 - 1e-6).erfinv()
        tried: list[Tensor] = []
        scores: list[Tensor] = []
        for noise in normal.split(self._config.samples, dim=1):
            if tried:
                best = scores[-1].topk(self._config.elite, dim=1).indices.unsqueeze(2).expand(-1, -1, goal.shape[1])
                elite = tried[-1].gather(1, best)
                spread, middle = torch.std_mean(elite, dim=1, keepdim=True)
                tried.append((middle + spread * noise).clamp(low, high))
            else:
                tried.append(candidates[:, : self._config.samples])
            scores.append(self._fear.score(state, goal, tried[-1]))
        return picks.take(torch.cat(tried, dim=1), torch.cat(scores, dim=1).argmax(1))

    def _ascend(self, state: Tensor, goal: Tensor, start: Tensor, low: Tensor, high: Tensor) -> Proposal:
        """The most feared goals on the ascents from given ones, shape (B, goal_dim)."""
        half = (high - low) / 2
        way = [start]
        for _ in range(self._config.ascents):
            with torch.enable_grad():
                point = way[-1].detach().requires_grad_()
                total = self._fear.network(torch.cat([state, goal, point], dim=1)).sum()
                (slope,) = torch.autograd.grad(total, point)
            uphill = torch.nn.functional.normalize(slope * half, dim=1)  # in units of the box
            way.append((point.detach() + self._config.stride * half * uphill).clamp(low, high))
        tried = torch.stack(way, dim=1)
        score = self._fear.score(state, goal, tried)
        pick = score.argmax(1)
        return Proposal(picks.take(tried, pick), picks.take(score, pick))
