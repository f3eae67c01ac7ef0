"""Uniform goals: the baseline, and what Naive means in evaluation."""

from collections.abc import Hashable
from dataclasses import dataclass

from torch import Tensor

from deimos.checks import check_at_least
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig, Spaces, uniform_proposal


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

    dense = True

    def __init__(self, config: Config) -> None:
        self.num_candidates = config.candidates

    def graph_key(self) -> Hashable:
        """See ``GoalSelector.graph_key``."""
        return ()

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        return uniform_proposal(candidates, draws[:, 0])
