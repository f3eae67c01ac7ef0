"""Fear times novelty: goals that the policy sometimes fails and has not met often.

Source: p (1 - p) of learnability (Rutherford et al. 2024, arXiv:2408.15099), novelty of RND (Burda et al. 2019,
arXiv:1810.12894); drawing one of several networks for every decision samples from a posterior (Osband et al., *Deep
Exploration via Bootstrapped DQN*, NeurIPS 2016). Hypothesis: the safety of RND at the performance of learnability.
"""

from collections.abc import Hashable
from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.checks import check_at_least, check_range
from deimos.goals import picks
from deimos.goals.fear import Fear
from deimos.goals.fear_selector import FearSelector, FearSelectorConfig
from deimos.goals.interactions import Interactions
from deimos.goals.selector import Proposal, Spaces, Transitions
from deimos.goals.selectors import rnd
from deimos.nn.seeds import derive


@dataclass(frozen=True, kw_only=True)
class Config(FearSelectorConfig):
    """Goals in proportion to p (1 - p) times their rank in novelty to the power of eta."""

    eta: float = 4.0
    """0 for fear alone; the larger, the more novelty counts. In [0, 100]."""
    heads: int = 4
    """Fear networks, one of which is drawn for every decision, at least 1."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("eta", self.eta, 0.0, 100.0)
        check_at_least("heads", self.heads, 1)

    def build(self, spaces: Spaces, seed: int) -> "Novelty":
        """See ``SelectorConfig.build``."""
        return Novelty(self, spaces, seed)


class Novelty(FearSelector):
    """See ``Config``. The first network is the one whose forecasts are judged and calibrated."""

    config: Config
    saved = (*FearSelector.saved, "heads", "rnd")

    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        super().__init__(config, spaces, seed)
        sizes = config.fear, spaces.state_dim, spaces.goal_dim, spaces.device
        self.heads = tuple(Fear(*sizes, derive(seed, f"fear head {k}")) for k in range(1, config.heads))
        """The networks after the first, which is ``fear``."""
        self.rnd = rnd.Config(candidates=config.candidates).build(spaces, seed)
        """What measures novelty."""

    def graph_key(self) -> Hashable:
        """See ``GoalSelector.graph_key``."""
        return super().graph_key(), self.rnd.graph_key()

    def issued(
        self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, chosen: Proposal,
        where: Tensor | None = None,
    ) -> None:  # fmt: skip
        """See ``GoalSelector.issued``."""
        super().issued(rows, state, goal, candidates, chosen, where)
        self.rnd.issued(rows, state, goal, candidates, chosen, where)

    def ranking(self, state: Tensor, goal: Tensor, candidates: Tensor, score: Tensor, draws: Tensor) -> Tensor:
        """See ``FearSelector.ranking``."""
        logits = torch.stack([score, *(head.score(self._seen(state), goal, candidates) for head in self.heads)])
        head = picks.uniformly(draws[:, 3], len(logits))
        p = self.calibration.probability(logits[head, torch.arange(len(head), device=head.device)])
        weight = p * (1.0 - p)
        if self.rnd.fitted:
            rank = self.rnd.surprise(state, goal, candidates).argsort(dim=1).argsort(dim=1).float() + 1.0
            weight = weight * (rank / candidates.shape[1]) ** self.config.eta
        return super().ranking(state, goal, candidates, weight, draws)

    def choose(self, score: Tensor, draw: Tensor) -> Tensor:
        """See ``FearSelector.choose``; the scores are weights here."""
        return picks.in_proportion(score, draw)

    def fit(self, rows: Tensor, crashed: Tensor, weight: Tensor) -> float:
        """See ``FearSelector.fit``."""
        for head in self.heads:
            head.fit_rows(rows, crashed, weight)
        return super().fit(rows, crashed, weight)

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """See ``FearSelector.learn``."""
        return super().learn(interactions, rollout) | self.rnd.learn(interactions, rollout)

    def check(self) -> None:
        """See ``GoalSelector.check``."""
        for head in (self.fear, *self.heads):
            head.check()
        self.rnd.check()
