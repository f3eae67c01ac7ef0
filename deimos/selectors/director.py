"""The Director: draws goals from above a percentile of fear (thesis, 3.3 and 3.4)."""

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from deimos.checks import check_at_least, check_choice, check_range
from deimos.fear import Fear, FearConfig, auroc
from deimos.interactions import Interactions
from deimos.rollout import Rollout
from deimos.selector import GoalSelector, Proposal, SelectorConfig, Spaces


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """A fear network ranks uniform candidates; the goal is drawn from the frightening end of the ranking."""

    percentile: float = 25.0
    """p, in [0, 100]: the share of candidates that is discarded as too easy [%]. 0 is Uniform, 100 argmax."""
    rule: Literal["percentile", "argmin", "argmax"] = "percentile"
    """Draw above the percentile, or take the least (Coop) or the most (Antagonist) frightening goal."""
    candidates: int = 100
    """N: uniform candidates per decision, at least 1."""
    fear: FearConfig = field(default_factory=FearConfig)
    """The fear network."""

    def __post_init__(self) -> None:
        check_range("percentile", self.percentile, 0.0, 100.0)
        check_choice("rule", self.rule, ["percentile", "argmin", "argmax"])
        check_at_least("candidates", self.candidates, 1)

    def build(self, spaces: Spaces, seed: int) -> "Director":
        """See ``SelectorConfig.build``."""
        return Director(self, spaces, seed)


class Director(GoalSelector):
    """See ``Config``. Until its fear network has seen both classes it is uniform."""

    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        self.config = config
        self.num_candidates = config.candidates
        self._learnt_at = 0  # step of the last call of learn
        self.fear = Fear(config.fear, spaces.state_dim, spaces.goal_dim, spaces.device, seed)

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``. Scores are logits: sigmoids would tie at 1."""
        if self.fear.fitted:
            score = self.fear.score(state, goal, candidates)
            pick = pick_by_rule(score, draws[:, 0], self.config.rule, self.config.percentile)
            chosen_score = score.gather(1, pick.unsqueeze(1)).squeeze(1)
        else:
            pick = (draws[:, 0] * candidates.shape[1]).long().clamp(max=candidates.shape[1] - 1)
            chosen_score = torch.full_like(draws[:, 0], torch.nan)
        chosen = candidates.gather(1, pick.view(-1, 1, 1).expand(-1, 1, candidates.shape[2])).squeeze(1)
        return Proposal(chosen, chosen_score, torch.ones_like(pick, dtype=torch.bool))

    def learn(self, interactions: Interactions, rollout: Rollout | None) -> dict[str, float]:
        """Fit the fear network to the window; the scores at issue are judged first."""
        window = interactions.resolved()
        recent = window.resolved > self._learnt_at
        self._learnt_at = interactions.now
        judged = window.score.isfinite()
        return {
            "fear/auroc": auroc(window.score[judged], window.crashed[judged]),
            "fear/crash_share": window.crashed[recent].float().mean().item(),
            "fear/resolved": float(recent.sum()),
            "fear/score": window.score[recent].nanmean().item(),
            "fear/loss": self.fear.fit(window),
        }

    def check(self) -> None:
        """See ``GoalSelector.check``."""
        self.fear.check()

    def state_dict(self) -> dict:
        """See ``GoalSelector.state_dict``."""
        return {"fear": self.fear.state_dict(), "learnt_at": self._learnt_at}

    def load_state_dict(self, state: dict) -> None:
        """See ``GoalSelector.load_state_dict``."""
        self.fear.load_state_dict(state["fear"])
        self._learnt_at = state["learnt_at"]


def pick_by_rule(score: Tensor, draw: Tensor, rule: str, percentile: float) -> Tensor:
    """Index of the candidate that a rule picks in each row.

    Exactly k = max(1, N - floor(p N / 100)) candidates are kept, also where scores tie at the edge.
    So p = 0 keeps all, whatever the scores, and picks the very goal that Uniform picks.

    Args:
        score: Scores, shape (B, N).
        draw: Uniform numbers in [0, 1), shape (B,).
        rule: ``percentile``, ``argmin`` or ``argmax``.
        percentile: p, in [0, 100].

    Returns:
        Indices in [0, N), int64, shape (B,).
    """
    if rule == "argmin":
        return score.argmin(dim=1)
    if rule == "argmax":
        return score.argmax(dim=1)
    count = score.shape[1]
    kept = max(1, count - int(percentile * count / 100))
    pick = (draw * kept).long().clamp(max=kept - 1)
    if kept == count:
        return pick
    return score.topk(kept, dim=1).indices.gather(1, pick.unsqueeze(1)).squeeze(1)
