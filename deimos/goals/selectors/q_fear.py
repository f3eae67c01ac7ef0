"""Q-fear: how likely is a crash now, or under the worst of the goals that may follow?

Source: Q-learning's target (Watkins 1989) for the crashes of a policy under an adversary that keeps choosing.
Hypothesis: a Director that sees beyond T steps leads policies into states that a sequential attacker would find.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from deimos.checks import check_range
from deimos.goals import picks
from deimos.goals.interactions import Interactions, Resolved, assign
from deimos.goals.selector import Proposal, Spaces
from deimos.goals.selectors import director
from deimos.nn.ranks import gather_rows


@dataclass(frozen=True, kw_only=True)
class Config(director.Config):
    """A Director whose fear learns y = 1 for a crash, else beta times its fear of the worst goal that follows."""

    percentile: float = 75.0
    """p, in [0, 100]: the share of candidates that is discarded as too easy [%]."""
    beta: float = 0.9
    """Weight of what follows, in [0, 1); 0 is the Director."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("beta", self.beta, 0.0, 1.0 - 1e-6)

    def build(self, spaces: Spaces, seed: int) -> "QFear":
        """See ``SelectorConfig.build``."""
        return QFear(self, spaces, seed)


class QFear(director.Director):
    """See ``Config``.

    The worst goal is the candidate of the next decision that was feared most; how much it is feared is computed again
    in every fit. ``fear`` is then no longer a probability of crashing within T steps.
    """

    config: Config
    is_calibrated = False
    inputs_per_row: ClassVar[int] = 2  # an interaction, and the worst that could follow it: NaN if unknown
    saved = (*director.Director.saved, "_worst")
    unknown = (*director.Director.unknown, "_worst")
    by_world = ("_worst",)

    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        super().__init__(config, spaces, seed)
        self._sizes = [spaces.state_dim, spaces.goal_dim, spaces.goal_dim]
        # Of the latest decision of every world: state, goal until then, and the most feared candidate.
        shape = spaces.num_envs, sum(self._sizes)
        self._worst = torch.full(shape, torch.nan, dtype=torch.float32, device=spaces.device)

    def issued(
        self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, chosen: Proposal,
        where: Tensor | None = None,
    ) -> None:  # fmt: skip
        """See ``GoalSelector.issued``."""
        super().issued(rows, state, goal, candidates, chosen, where)
        lesson: Tensor | float = torch.nan
        if self.fear.fitted:
            worst = picks.take(candidates, self.score(state, goal, candidates).argmax(1))
            lesson = torch.cat([self._seen(state), goal, worst], dim=1).float()
        assign(self._worst, rows, lesson, where)

    def rows(self, window: Resolved, interactions: Interactions) -> Tensor:
        """See ``FearSelector.rows``."""
        worst, known = gather_rows(self._worst)[window.env], interactions.followed(window).unsqueeze(1)
        worst = worst.where(known, torch.full_like(known, torch.nan, dtype=torch.float32))
        return torch.cat([super().rows(window, interactions), worst], dim=1)

    def fit(self, rows: Tensor, crashed: Tensor, weight: Tensor) -> float:
        """See ``FearSelector.fit``."""
        inputs, worst = rows.chunk(2, dim=1)
        known = worst.isfinite().all(1)
        state, goal, next_goal = worst[known].split(self._sizes, dim=1)
        target = crashed.float()
        if len(state):
            feared = self.calibration.probability(self.fear.score(state, goal, next_goal.unsqueeze(1)).squeeze(1))
            target[known] = torch.maximum(target[known], self.config.beta * feared)
        return self.fear.fit_rows(inputs, crashed, weight, target)
