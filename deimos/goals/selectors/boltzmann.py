"""The Boltzmann Director: a soft adversary whose rationality grows (after Reddi et al. 2023, arXiv:2311.01642)."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.checks import check_range
from deimos.goals import picks
from deimos.goals.fear_selector import FearSelector, FearSelectorConfig
from deimos.goals.interactions import Interactions
from deimos.goals.selector import Spaces, Transitions
from deimos.nn.graphs import Mirrored


@dataclass(frozen=True, kw_only=True)
class Config(FearSelectorConfig):
    """A goal is drawn with a probability in proportion to exp(beta * logit of fear)."""

    beta: float = 1.0
    """Rationality at the end; 0 is Uniform, large is the Antagonist, negative cooperates. Finite."""
    beta_start: float = 0.0
    """Rationality at the start, finite."""
    anneal: float = 0.5
    """Share of the training over which it changes linearly, in [0, 1]; 0 begins with ``beta``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("beta", "beta_start"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}.")
        check_range("anneal", self.anneal, 0.0, 1.0)

    def build(self, spaces: Spaces, seed: int) -> "Boltzmann":
        """See ``SelectorConfig.build``."""
        return Boltzmann(self, spaces, seed)


class Boltzmann(FearSelector):
    """See ``Config``."""

    config: Config
    # A run that is resumed with a larger budget keeps the schedule that it began with.
    saved = (*FearSelector.saved, "beta", "_steps")
    beta = Mirrored("_beta")
    """Rationality now."""

    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        super().__init__(config, spaces, seed)
        self._steps = config.anneal * spaces.require_total_steps("boltzmann") if config.anneal else 0.0
        self._beta = torch.zeros((), dtype=torch.float64, device=spaces.device)
        self.beta = config.beta_start if self._steps else config.beta

    def choose(self, score: Tensor, draw: Tensor) -> Tensor:
        """See ``FearSelector.choose``."""
        return picks.in_proportion(torch.softmax(self._beta * score, dim=1), draw)

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """See ``FearSelector.learn``."""
        way = min(1.0, interactions.now / self._steps) if self._steps else 1.0
        self.beta = self.config.beta_start + way * (self.config.beta - self.config.beta_start)
        return super().learn(interactions, rollout) | {"fear/beta": self.beta}
