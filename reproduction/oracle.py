"""A Director with perfect fear: it tries every candidate in clones of the simulator.

Source: a control that readers of the thesis ask for. Hypothesis: where this is no better than the Director, it is not
for want of a better fear network. Importing this module makes ``oracle`` a selector; it costs N T steps of the policy
per goal.
"""

from dataclasses import dataclass

from torch import Tensor

from deimos import plugins
from deimos.checks import check_at_least, check_choice, check_range
from deimos.goals import picks, selectors
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig, Spaces
from deimos.run.oracle import Clones, Oracle
from deimos.sim.env import Env


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """A Director that ranks candidates by the steps that the policy survives under each."""

    percentile: float = 75.0
    """p, in [0, 100]: the share of candidates that is discarded as too easy [%]."""
    rule: picks.Rule = "percentile"
    """Draw above the percentile, or take the least (argmin) or the most (argmax) dangerous goal."""
    candidates: int = 25
    """N: uniform candidates per decision, at least 1."""

    def __post_init__(self) -> None:
        check_range("percentile", self.percentile, 0.0, 100.0)
        check_choice("rule", self.rule, picks.RULES)
        check_at_least("candidates", self.candidates, 1)

    def build(self, spaces: Spaces, seed: int) -> "OracleDirector":
        """See ``SelectorConfig.build``."""
        return OracleDirector(self)


class OracleDirector(GoalSelector):
    """See ``Config``. What it tries are the policy's mean actions; candidates that nobody crashes on tie."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.num_candidates = config.candidates
        self._oracle: Oracle | None = None

    def see(self, env: Env, clones: Clones) -> None:
        """See ``deimos.run.oracle.SeesWorlds``."""
        config = self.config
        self._oracle = Oracle(env, clones, config.rule, config.percentile, config.candidates)

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``; scores are T - steps survived.

        Raises:
            RuntimeError: If it has seen no worlds: only a training run of Deimos shows them.
        """
        if self._oracle is None:
            raise RuntimeError("The oracle has seen no worlds to clone; it works in a training run of Deimos only.")
        return self._oracle.propose(rows, state, goal, candidates, draws)


plugins.register(selectors, "oracle", __name__)
