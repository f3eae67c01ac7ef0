"""Some uniform goals among a method's own."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from deimos import picks
from deimos.checks import check_range
from deimos.interactions import Interactions
from deimos.rollout import Rollout
from deimos.selector import Critic, GoalSelector, Proposal, SelectorConfig, Spaces


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """A method chooses the goals, but a share of them is drawn uniformly."""

    base: str = "p75"
    """Name of the method."""
    share: float = 0.2
    """Share of uniform goals, in [0, 1]."""

    def __post_init__(self) -> None:
        from deimos.methods import method

        method(self.base)
        check_range("share", self.share, 0.0, 1.0)

    def build(self, spaces: Spaces, seed: int) -> "Mix":
        """See ``SelectorConfig.build``."""
        return Mix(self, spaces, seed)


class Mix(GoalSelector):
    """See ``Config``. The uniform goals have no score and are marked as probes."""

    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        from deimos.methods import method

        self.config = config
        self.base = method(config.base).build(spaces, seed)
        self.parts = (self.base,)

    @property
    def num_candidates(self) -> int:  # type: ignore[override]
        """See ``GoalSelector.num_candidates``."""
        return self.base.num_candidates

    @property
    def needs_rollout(self) -> bool:  # type: ignore[override]
        """See ``GoalSelector.needs_rollout``."""
        return self.base.needs_rollout

    @property
    def first_goals_scaled(self) -> bool:  # type: ignore[override]
        """See ``GoalSelector.first_goals_scaled``."""
        return self.base.first_goals_scaled

    def goal_range(self) -> Tensor | None:
        """See ``GoalSelector.goal_range``."""
        return self.base.goal_range()

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        own = self.base.propose(rows, state, goal, candidates, draws)
        free = draws[:, 3] < self.config.share
        anything = picks.take(candidates, picks.uniformly(draws[:, 0], candidates.shape[1]))
        return replace(
            own,
            goal=torch.where(free.unsqueeze(1), anything, own.goal),
            score=own.score.masked_fill(free, torch.nan),
            probe=free if own.probe is None else free | own.probe,
            note=None if own.note is None else own.note * ~free,
        )

    def critic(self) -> Critic | None:
        """See ``GoalSelector.critic``."""
        return self.base.critic()

    def learn(self, interactions: Interactions, rollout: Rollout | None) -> dict[str, float]:
        """See ``GoalSelector.learn``."""
        return self.base.learn(interactions, rollout)

    def check(self) -> None:
        """See ``GoalSelector.check``."""
        self.base.check()

    def state_dict(self) -> dict:
        """See ``GoalSelector.state_dict``."""
        return self.base.state_dict()

    def load_state_dict(self, state: dict) -> None:
        """See ``GoalSelector.load_state_dict``."""
        self.base.load_state_dict(state)
