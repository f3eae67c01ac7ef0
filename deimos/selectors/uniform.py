"""Uniform goals: the baseline, and what Naive means in evaluation."""

from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.checks import check_at_least
from deimos.selector import GoalSelector, Proposal, SelectorConfig, Spaces


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """Every goal is drawn uniformly."""

    candidates: int = 1
    """Goals to pick from, at least 1. One is enough; with as many as a Director has, and p = 0 there,
    both choose the very same goals."""

    def __post_init__(self) -> None:
        check_at_least("candidates", self.candidates, 1)

    def build(self, spaces: Spaces, seed: int) -> "Uniform":
        """See ``SelectorConfig.build``."""
        return Uniform(self)


class Uniform(GoalSelector):
    """See ``Config``."""

    def __init__(self, config: Config) -> None:
        self.num_candidates = config.candidates

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        count = candidates.shape[1]
        pick = (draws[:, 0] * count).long().clamp(max=count - 1)
        chosen = candidates.gather(1, pick.view(-1, 1, 1).expand(-1, 1, candidates.shape[2])).squeeze(1)
        no_opinion = torch.full_like(draws[:, 0], torch.nan)
        return Proposal(chosen, no_opinion)
