"""One method first, another later (thesis: VDS, then Director p75 for the second half of the training)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from deimos.checks import SimulationError
from deimos.goals.interactions import Interactions
from deimos.goals.methods import method
from deimos.goals.selector import Delegate, GoalSelector, SelectorConfig, Spaces, Transitions


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """The first method chooses the goals up to a share of the training, the second one after that."""

    first: str = "vds"
    """Name of the first method. It keeps learning as long as it chooses, and longer if it supplies the learner's
    baseline."""
    second: str = "p75"
    """Name of the second method. It learns from the start what the first one's goals teach: outcomes and transitions.
    (It sees no candidates, which RND, grid and PLR learn from as well, before it chooses.)"""
    at: float = 0.5
    """Share of the training after which it switches, in (0, 1)."""

    def __post_init__(self) -> None:
        for name in (self.first, self.second):
            method(name)
        if not 0.0 < self.at < 1.0:
            raise ValueError(f"at must be in (0, 1), or the schedule never switches; got {self.at}.")

    def build(self, spaces: Spaces, seed: int) -> "Schedule":
        """See ``SelectorConfig.build``."""
        return Schedule(self, spaces, seed)


class Schedule(Delegate):
    """See ``Config``."""

    # A run that is resumed with a larger budget keeps the schedule that it began with.
    saved = (*Delegate.saved, "switched", "_switch", "_keys")

    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        self.config = config
        self.parts = tuple(method(name).build(spaces, seed) for name in (config.first, config.second))
        self._switch = config.at * spaces.require_total_steps("schedule")
        self.switched = False
        """Whether the second method chooses."""
        self._keys: list[str] = []  # what the first method logs: every row of a run has the same columns

    @property
    def current(self) -> GoalSelector:
        """See ``Delegate.current``."""
        return self.parts[self.switched]

    def critic(self) -> Callable[[Tensor], Tensor] | None:
        """See ``GoalSelector.critic``."""
        # Whichever supplies the baseline keeps doing so: the learner's own critic has learnt nothing meanwhile.
        return self.current.critic() or self.parts[0].critic()

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """See ``GoalSelector.learn``."""
        row = {"schedule/switched": float(self.switched)}
        first, second = self.parts
        # The scores at issue are those of the method that chose: the other one must not be evaluated by them.
        of_first, of_second = interactions, interactions.without_scores()
        if self.switched:
            of_first, of_second = of_second, of_first
        if self.switched and first.critic() is None:
            row |= dict.fromkeys(self._keys, math.nan)
        else:
            learnt = first.learn(of_first, rollout)
            self._keys = list(learnt)
            row |= learnt
        row |= second.learn(of_second, rollout)
        self.switched = self.switched or interactions.now >= self._switch
        return row

    def check(self) -> None:
        """See ``GoalSelector.check``."""
        for name, part in zip((self.config.first, self.config.second), self.parts, strict=True):
            try:
                part.check()
            except SimulationError as error:
                raise SimulationError(f"{name}: {error}") from error
