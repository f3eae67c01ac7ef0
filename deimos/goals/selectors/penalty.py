"""What a crash penalty does without any choice of goals.

Source: the control that the thesis argues against (2.2.2.2 and 3.1: penalties make policies timid) and never runs.
Hypothesis: a plain penalty buys the safety that a Director buys.
"""

from dataclasses import dataclass

from deimos.checks import check_range
from deimos.goals.methods import method
from deimos.goals.selector import Delegate, GoalSelector, SelectorConfig, Spaces


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """A method chooses the goals, and every crash costs the learner some of its reward."""

    base: str = "uniform"
    """Name of the method."""
    size: float = 30.0
    """What a crash costs, in units of the largest reward of a step, in [0, 1e6]."""

    def __post_init__(self) -> None:
        method(self.base)
        check_range("size", self.size, 0.0, 1e6)

    def build(self, spaces: Spaces, seed: int) -> "Penalty":
        """See ``SelectorConfig.build``."""
        return Penalty(self, spaces, seed)


class Penalty(Delegate):
    """See ``Config``. Rewards in logs and evaluations are without it."""

    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        self.config = config
        self.parts = (method(config.base).build(spaces, seed),)

    crash_penalty = property(lambda self: self.config.size)

    @property
    def current(self) -> GoalSelector:
        """See ``Delegate.current``."""
        return self.parts[0]
