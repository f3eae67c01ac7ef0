"""The hand-made curriculum: uniform goals whose range grows as they are met (Legged Gym; thesis, 4.1.2)."""

from collections.abc import Hashable
from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.checks import check_at_least
from deimos.goals.interactions import Interactions
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig, Spaces, Transitions, uniform_proposal


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """Uniform goals, first goals included, from a range that grows per group of components when it is tracked well."""

    start: float = 0.25
    """Share of the range at the start, in (0, 1]."""
    growth: float = 0.25
    """What the share grows by, in (0, 1]."""
    threshold: float = 0.8
    """Mean tracking over the interactions since the last growth that a group must reach, in (0, 1)."""
    min_interactions: int = 1000
    """Interactions that a growth must be based on, at least 1."""

    def __post_init__(self) -> None:
        for name in ("start", "growth"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in (0, 1], got {getattr(self, name)}.")
        if not 0.0 < self.threshold < 1.0:
            raise ValueError(f"threshold must be in (0, 1), got {self.threshold}.")
        check_at_least("min_interactions", self.min_interactions, 1)

    def build(self, spaces: Spaces, seed: int) -> "Curriculum":
        """See ``SelectorConfig.build``."""
        return Curriculum(self, spaces)


class Curriculum(GoalSelector):
    """See ``Config``."""

    needs_tracking = True
    first_goals_scaled = True
    dense = True
    saved = ("_range", "share", "_since", "_counted_at", "_sum", "_count")

    def __init__(self, config: Config, spaces: Spaces) -> None:
        self.config = config
        self._groups = spaces.groups
        self._range = torch.full((spaces.goal_dim,), config.start, dtype=torch.float32, device=spaces.device)
        groups = len(spaces.groups)
        self.share = [config.start] * groups
        """Share of the range of every group, in (0, 1]."""
        self._since = [0] * groups  # step that the count began at
        self._counted_at = 0  # step of the last call of learn
        self._sum, self._count = [0.0] * groups, [0] * groups

    def goal_range(self) -> Tensor:
        """See ``GoalSelector.goal_range``."""
        return self._range

    def graph_key(self) -> Hashable:
        """See ``GoalSelector.graph_key``."""
        return ()

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        return uniform_proposal(candidates, draws[:, 0])

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """Widen the range of every group that was tracked well under the range that it has."""
        done = interactions.resolved(self._counted_at)
        self._counted_at = interactions.now
        row: dict[str, float] = {}
        for i, group in enumerate(self._groups):
            own = done.issued > self._since[i]  # goals of the very step were issued before the range grew
            self._count[i] += int(own.sum())
            self._sum[i] += done.tracking[own, i].double().sum().item()
            tracking = self._sum[i] / self._count[i] if self._count[i] else float("nan")
            row |= {f"cl/tracking_{i}": tracking, f"cl/range_{i}": self.share[i]}
            if self._count[i] >= self.config.min_interactions and tracking >= self.config.threshold:
                self.share[i] = min(1.0, self.share[i] + self.config.growth)
                self._range[group] = self.share[i]
            if self._count[i] >= self.config.min_interactions:
                self._since[i], self._sum[i], self._count[i] = interactions.now, 0.0, 0
        return row
