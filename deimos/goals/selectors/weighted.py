"""The importance-weighted Director: frightening goals for the sampling, uniform goals for the objective.

Source: off-environment reinforcement learning (Ciosek and Whiteson, *OFFER*, AAAI 2017) and grounded curricula (Jiang
et al., *SAMPLR*, NeurIPS 2022, arXiv:2207.05219). Hypothesis: what a Director costs in performance is that it trains on
other goals than those that count; weights give that back, and the crashes that it collects stay.

The weights correct which goal is met in a state, not which states are met.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from deimos.checks import check_range
from deimos.goals import picks
from deimos.goals.fear import auroc
from deimos.goals.fear_selector import FearSelector, FearSelectorConfig
from deimos.goals.interactions import Interactions
from deimos.goals.selector import Proposal, Spaces, Transitions
from deimos.nn.ranks import sum_over_ranks


@dataclass(frozen=True, kw_only=True)
class Config(FearSelectorConfig):
    """Goals by q = mix u + (1 - mix) top-k, with u uniform over candidates; transitions weigh (u / q)^alpha."""

    percentile: float = 75.0
    """p, in [0, 100]: the share of candidates that the top-k leaves out [%]."""
    mix: float = 0.25
    """Share of uniform goals, in (0, 1]; no weight is above 1 / mix."""
    alpha: float = 0.5
    """0 for weights of 1, a Director with a share of uniform goals; 1 for those that make goals uniform in
    expectation. In [0, 1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("percentile", self.percentile, 0.0, 100.0)
        check_range("mix", self.mix, 1e-3, 1.0)
        check_range("alpha", self.alpha, 0.0, 1.0)
        if self.control == "shuffled":
            raise ValueError("control must be none or state-blind where goals are weighed, got 'shuffled'.")

    def build(self, spaces: Spaces, seed: int) -> "Weighted":
        """See ``SelectorConfig.build``."""
        return Weighted(self, spaces, seed)


class Weighted(FearSelector):
    """See ``Config``. An interaction's note says whether its goal was a uniform one (1) or from the top (2)."""

    config: Config
    saved = (*FearSelector.saved, "_sums")

    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        super().__init__(config, spaces, seed)
        # Of the goals since the last call of learn: how many, their weights, and the squares of these.
        self._sums = torch.zeros(3, dtype=torch.float64, device=spaces.device)

    def choose(self, score: Tensor, draw: Tensor) -> Tensor:
        """See ``FearSelector.choose``."""
        mix = self.config.mix  # one number decides both which kind of goal it is and which goal
        anything = picks.uniformly(draw / mix, score.shape[1])
        if mix == 1.0:
            return anything
        top = picks.above_percentile(score, ((draw - mix) / (1.0 - mix)).clamp(min=0.0), self.config.percentile)
        return torch.where(draw < mix, anything, top)

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        chosen = super().propose(rows, state, goal, candidates, draws)
        weight = torch.ones_like(draws[:, 0])
        top = torch.zeros_like(weight, dtype=torch.bool)
        if self.fear.fitted:
            assert chosen.percentile is not None
            count = candidates.shape[1]
            kept = picks.kept_above(self.config.percentile, count)
            mix = self.config.probe + (1.0 - self.config.probe) * self.config.mix
            inside = chosen.percentile > 100.0 * (1.0 - kept / count)
            weight = (mix + (1.0 - mix) * inside.float() * (count / kept)) ** -self.config.alpha
            top = draws[:, 0] >= self.config.mix
            if chosen.probe is not None:
                top &= ~chosen.probe
        return replace(chosen, weight=weight, note=1 + top.long())

    def issued(
        self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, chosen: Proposal,
        where: Tensor | None = None,
    ) -> None:  # fmt: skip
        """See ``GoalSelector.issued``."""
        super().issued(rows, state, goal, candidates, chosen, where)
        assert chosen.weight is not None
        powers = torch.stack([torch.ones_like(chosen.weight), chosen.weight, chosen.weight.square()]).double()
        self._sums += (powers if where is None else powers.masked_fill(~where, 0.0)).sum(1)

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """See ``FearSelector.learn``; adds the effective sample size, as a share, and the shift of the states."""
        count, total, squares = sum_over_ranks(self._sums).tolist()
        self._sums.zero_()
        return super().learn(interactions, rollout) | {
            "weighted/effective_share": total**2 / (count * squares) if count else math.nan,
            "weighted/state_shift": _state_shift(interactions),
        }


def _state_shift(interactions: Interactions) -> float:
    """How well a state tells whether the goal that led to it was a uniform one or from the top.

    Returns:
        AUROC, on the worlds of odd number, of a linear discriminant that is fitted on those of even number; 0.5 where
        they are alike, NaN where there are too few interactions to tell.
    """
    done = interactions.resolved()
    done = done.where(interactions.followed(done))
    state, top, even = interactions.latest_state[done.env].double(), done.note == 2, done.env % 2 == 0
    sides = [state[even & own] for own in (top, ~top)]
    if min(len(side) for side in sides) < 2:
        return math.nan
    means = [side.mean(0) for side in sides]
    centred = [side - mean for side, mean in zip(sides, means, strict=True)]
    within = centred[0].t() @ centred[0] / len(centred[0]) + centred[1].t() @ centred[1] / len(centred[1])
    ridge = 1e-3 * within.diagonal().mean() + 1e-12
    within.diagonal().add_(ridge)
    return auroc((state @ torch.linalg.solve(within, means[0] - means[1]))[~even], top[~even])
