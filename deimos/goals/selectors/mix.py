"""Some uniform goals among a method's own."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from deimos.checks import check_range
from deimos.goals.methods import method
from deimos.goals.selector import Delegate, GoalSelector, Proposal, SelectorConfig, Spaces, uniform_proposal


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """A method chooses the goals, but a share of them is drawn uniformly."""

    base: str = "p75"
    """Name of the method."""
    share: float = 0.2
    """Share of uniform goals, in [0, 1]."""

    def __post_init__(self) -> None:
        method(self.base)
        check_range("share", self.share, 0.0, 1.0)

    def build(self, spaces: Spaces, seed: int) -> "Mix":
        """See ``SelectorConfig.build``."""
        return Mix(self, spaces, seed)


class Mix(Delegate):
    """See ``Config``. The uniform goals have no score and are marked as probes."""

    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        self.config = config
        self.parts = (method(config.base).build(spaces, seed),)

    @property
    def current(self) -> GoalSelector:
        """See ``Delegate.current``."""
        return self.parts[0]

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        share = self.config.share
        free, others = draws[:, 3] < share, draws.clone()
        # Where the method chooses, the fourth number is not uniform; it is scaled to be, for methods that use it.
        others[:, 3] = ((draws[:, 3] - share) / max(1.0 - share, 1e-6)).clamp_(min=0.0)
        own = self.current.propose(rows, state, goal, candidates, others)
        anything = uniform_proposal(candidates, draws[:, 0]).goal
        return replace(
            own,
            goal=torch.where(free.unsqueeze(1), anything, own.goal),
            weight=None if own.weight is None else own.weight * ~free,
            percentile=None if own.percentile is None else own.percentile.masked_fill(free, 50.0),
            score=own.score.masked_fill(free, torch.nan),
            probe=free if own.probe is None else free | own.probe,
            note=None if own.note is None else own.note * ~free,
        )

    def load_state_dict(self, state: dict) -> None:
        """See ``GoalSelector.load_state_dict``; earlier versions saved the method alone."""
        super().load_state_dict(state if "parts" in state else {"parts": [state]})
