"""The Director: draws goals from above a percentile of fear (thesis, 3.3 and 3.4)."""

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from deimos.checks import check_choice, check_range
from deimos.goals import picks
from deimos.goals.fear_selector import FearSelector, FearSelectorConfig
from deimos.goals.selector import Spaces


@dataclass(frozen=True, kw_only=True)
class Config(FearSelectorConfig):
    """A fear network ranks uniform candidates; the goal is drawn from the most feared end of the ranking."""

    percentile: float = 25.0
    """p, in [0, 100]: the share of candidates that is discarded as too easy [%]. 0 is Uniform, 100 argmax."""
    rule: Literal["percentile", "argmin", "argmax"] = "percentile"
    """Draw above the percentile, or take the least (Coop) or the most (Antagonist) feared goal."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("percentile", self.percentile, 0.0, 100.0)
        check_choice("rule", self.rule, ["percentile", "argmin", "argmax"])

    def build(self, spaces: Spaces, seed: int) -> "Director":
        """See ``SelectorConfig.build``."""
        return Director(self, spaces, seed)


class Director(FearSelector):
    """See ``Config``."""

    config: Config

    def choose(self, score: Tensor, draw: Tensor) -> Tensor:
        """See ``FearSelector.choose``."""
        return picks.by_rule(score, draw, self.config.rule, self.config.percentile)
