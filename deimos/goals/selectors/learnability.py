"""Learnability: goals that the policy sometimes fails.

Rutherford et al., *No Regrets*, NeurIPS 2024, arXiv:2408.15099. The paper scores levels by p (1 - p) with p
measured in rollouts; here the calibrated fear network gives p for free.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from deimos.checks import check_choice, check_range
from deimos.goals import picks
from deimos.goals.fear_selector import FearSelector, FearSelectorConfig
from deimos.goals.selector import Spaces


@dataclass(frozen=True, kw_only=True)
class Config(FearSelectorConfig):
    """Goals in proportion to, or among the best by, p (1 - p), with p the calibrated probability of a crash."""

    rule: Literal["proportional", "percentile", "band"] = "proportional"
    """Draw in proportion to p (1 - p), from above its percentile, or from among those whose p is in the band
    (Florensa et al. 2018, goals of intermediate difficulty; the nearest to it where none is)."""
    percentile: float = 90.0
    """Share of candidates that ``percentile`` discards, in [0, 100] [%]."""
    low: float = 0.1
    """Lower end of the band, in [0, 1)."""
    high: float = 0.9
    """Upper end of the band, in (low, 1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("rule", self.rule, ["proportional", "percentile", "band"])
        check_range("percentile", self.percentile, 0.0, 100.0)
        check_range("low", self.low, 0.0, 1.0)
        check_range("high", self.high, 0.0, 1.0)
        if not self.low < self.high:
            raise ValueError(f"low must be below high, got {self.low} and {self.high}.")

    def build(self, spaces: Spaces, seed: int) -> "Learnability":
        """See ``SelectorConfig.build``."""
        return Learnability(self, spaces, seed)


class Learnability(FearSelector):
    """See ``Config``."""

    config: Config

    def choose(self, score: Tensor, draw: Tensor) -> Tensor:
        """See ``FearSelector.choose``."""
        p = self.calibration.probability(score)
        if self.config.rule == "band":
            outside = torch.maximum(self.config.low - p, p - self.config.high).clamp(min=0)
            nearest = outside.amin(dim=1, keepdim=True)
            return picks.in_proportion((outside == nearest).float(), draw)
        return picks.by_rule(p * (1 - p), draw, self.config.rule, self.config.percentile)
