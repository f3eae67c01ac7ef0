"""The grid-adaptive curriculum (Margolis et al., *Rapid Locomotion*, RSS 2022, arXiv:2205.02824, section III-B)."""

from collections.abc import Hashable
from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.checks import check_at_least, check_positive
from deimos.goals import picks
from deimos.goals.interactions import Interactions
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig, Spaces, Transitions, uniform_proposal
from deimos.nn.ranks import max_over_ranks


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """Goals by the weights of grid cells, which rise around every cell whose goals are tracked well."""

    bins: int = 8
    """Cells along every component of a goal, at least 2. Every group of components has its own grid."""
    start: float = 0.5
    """Share of the range whose cells have weight 1 at the start, in (0, 1]; the others have weight 0."""
    growth: float = 0.2
    """What a well-tracked goal adds to the weights of its cell and its neighbours, up to 1. In (0, 1]."""
    reach: float = 1.0
    """How far a neighbour may be along every component [cells], positive."""
    threshold: float = 0.8
    """Mean tracking that a goal must reach, in (0, 1)."""
    candidates: int = 100
    """N: uniform candidates per decision, at least 1."""

    def __post_init__(self) -> None:
        check_at_least("bins", self.bins, 2)
        for name in ("start", "growth"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in (0, 1], got {getattr(self, name)}.")
        check_positive("reach", self.reach, finite=True)
        if not 0.0 < self.threshold < 1.0:
            raise ValueError(f"threshold must be in (0, 1), got {self.threshold}.")
        check_at_least("candidates", self.candidates, 1)

    def build(self, spaces: Spaces, seed: int) -> "Grid":
        """See ``SelectorConfig.build``."""
        return Grid(self, spaces)


class Grid(GoalSelector):
    """See ``Config``. Until it has learnt once, and so knows how far goals reach, it is uniform.

    Cells reach as far as goals do from the middle of their range; without a ``goal_box``, the middle is 0.

    Raises:
        ValueError: If a group's grid would have more than 2^20 cells.
    """

    needs_tracking = True
    dense = True
    saved = ("_weights", "_seen", "_half", "_learnt_at", "fitted")

    def __init__(self, config: Config, spaces: Spaces) -> None:
        self.config = config
        self.num_candidates = config.candidates
        device = spaces.device
        components = torch.arange(spaces.goal_dim, device=device)
        self._groups = [components[group] for group in spaces.groups]
        largest = config.bins ** max(len(group) for group in self._groups)
        if largest > 2**20:
            raise ValueError(f"bins must give at most 2^20 cells per group, got {config.bins} bins: {largest} cells.")
        self._weights = tuple(self._initial(len(group), device) for group in self._groups)
        # The cells are cut from ``_half`` below to ``_half`` above the middle: as far as candidates have been seen.
        self._middle = torch.tensor(spaces.goal_middle or [0.0] * spaces.goal_dim, dtype=torch.float32, device=device)
        self._seen, self._half = torch.zeros_like(self._middle), torch.zeros_like(self._middle)
        self._learnt_at = 0  # step of the last call of learn
        self.fitted = False
        """Whether it is known how far goals reach."""

    def _initial(self, dims: int, device: torch.device) -> Tensor:
        """Weight 1 in the middle of the range, shape (bins,) * dims."""
        bins = self.config.bins
        middle = (torch.arange(bins, device=device) + 0.5) * (2.0 / bins) - 1.0
        inside = (middle.abs() <= self.config.start).float()
        weights = torch.ones([], dtype=torch.float32, device=device)
        for _ in range(dims):
            weights = weights.unsqueeze(-1) * inside
        return weights

    def graph_key(self) -> Hashable:
        """See ``GoalSelector.graph_key``."""
        return (self.fitted,)

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``; scores are weights."""
        if not self.fitted:
            return uniform_proposal(candidates, draws[:, 0])
        cell = self._cells(candidates)
        weight = torch.ones(candidates.shape[:2], dtype=torch.float32, device=candidates.device)
        for i, group in enumerate(self._groups):
            weight *= self._weights[i][cell[..., group].unbind(-1)]
        pick = picks.in_proportion(weight, draws[:, 0])
        return Proposal(picks.take(candidates, pick), picks.take(weight, pick))

    def issued(
        self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, chosen: Proposal,
        where: Tensor | None = None,
    ) -> None:  # fmt: skip
        """See ``GoalSelector.issued``."""
        seen = (candidates - self._middle).abs().amax(1)
        seen = seen if where is None else seen.masked_fill_(~where.unsqueeze(1), 0.0)
        torch.maximum(self._seen, seen.amax(0), out=self._seen)

    def _cells(self, goal: Tensor) -> Tensor:
        """Cell of every component, int64, same shape."""
        share = (goal - self._middle) / (2 * self._half) + 0.5
        return (share * self.config.bins).long().clamp(0, self.config.bins - 1)

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """Raise the weights around the cells of goals that were tracked well."""
        done = interactions.resolved(self._learnt_at)
        self._learnt_at = interactions.now
        if bool((max_over_ranks(self._seen) > 0).any()):
            self._half.copy_(self._seen.masked_fill(self._seen == 0, 1.0))  # what never varies is always in one cell
            self.fitted = True
        row = {}
        for i, group in enumerate(self._groups):
            good = done.tracking[:, i] >= self.config.threshold
            if self.fitted and bool(good.any()):
                self._raise(i, self._cells(done.next_goal[good])[:, group])
            row[f"grid/weight_{i}"] = self._weights[i].mean().item()
            row[f"grid/good_{i}"] = good.float().mean().item()
        return row

    def _raise(self, i: int, cells: Tensor) -> None:
        """Add ``growth`` for each of ``cells``, shape (n, dims), to everything within reach of it."""
        weights, dims = self._weights[i], cells.shape[1]
        hits = torch.zeros_like(weights)
        hits.index_put_(cells.unbind(1), hits.new_ones(len(cells)), accumulate=True)
        places = torch.arange(self.config.bins, device=hits.device)
        near = ((places.unsqueeze(0) - places.unsqueeze(1)).abs() <= self.config.reach).float()
        for _ in range(dims):  # the neighbourhood is a box, so it is summed along one component after another
            hits = torch.tensordot(hits, near, dims=([0], [0]))
        weights.add_(self.config.growth * hits).clamp_(max=1.0)
