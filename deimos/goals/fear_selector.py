"""What every selector that ranks candidates by fear has in common."""

import abc
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import torch
from torch import Tensor

from deimos.checks import check_at_least, check_choice, check_range
from deimos.goals import picks
from deimos.goals.calibration import Calibration, evaluate
from deimos.goals.fear import Fear, FearConfig, auroc
from deimos.goals.interactions import Interactions
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig, Spaces, Transitions, uniform_proposal


@dataclass(frozen=True, kw_only=True)
class FearSelectorConfig(SelectorConfig):
    """A fear network scores uniform candidates; a rule picks one."""

    candidates: int = 100
    """N: uniform candidates per decision, at least 1."""
    probe: float = 0.0
    """Share of goals that are drawn uniformly whatever their fear, in [0, 1]: what unbiased calibration needs."""
    control: Literal["none", "shuffled", "state-blind"] = "none"
    """``shuffled`` hands every score to another candidate, which must equal Uniform; ``state-blind`` lets the
    network see goals only."""
    fear: FearConfig = field(default_factory=FearConfig)
    """The fear network."""

    def __post_init__(self) -> None:
        check_at_least("candidates", self.candidates, 1)
        check_range("probe", self.probe, 0.0, 1.0)
        check_choice("control", self.control, ["none", "shuffled", "state-blind"])


class FearSelector(GoalSelector):
    """Learns fear online and leaves the choice to ``choose``. Until it has seen both classes it is uniform."""

    config: FearSelectorConfig
    saved: ClassVar[tuple[str, ...]] = ("fear", "calibration", "_learnt_at")

    def __init__(self, config: FearSelectorConfig, spaces: Spaces, seed: int) -> None:
        self.config = config
        self.num_candidates = config.candidates
        self._learnt_at = 0  # step of the last call of learn
        self.fear = Fear(config.fear, spaces.state_dim, spaces.goal_dim, spaces.device, seed)
        self.calibration = Calibration()

    @abc.abstractmethod
    def choose(self, score: Tensor, draw: Tensor) -> Tensor:
        """Pick a candidate in every row.

        Args:
            score: Logits of the fear network, shape (B, N). Ranked as they are: sigmoids would tie at 1.
            draw: Uniform numbers in [0, 1), shape (B,).

        Returns:
            Indices in [0, N), int64, shape (B,).
        """

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``; scores are log odds before the temperature."""
        if not self.fear.fitted:
            return uniform_proposal(candidates, draws[:, 0])
        score = self.score(state, goal, candidates)
        ranked = _rolled(score, draws[:, 2]) if self.config.control == "shuffled" else score
        pick, probe = self.choose(ranked, draws[:, 0]), None
        if self.config.probe:
            probe = draws[:, 1] < self.config.probe
            pick = torch.where(probe, picks.uniformly(draws[:, 0], candidates.shape[1]), pick)
        # As a forecast it keeps the prior at issue time, whatever the crash rate is when it is evaluated.
        return Proposal(picks.take(candidates, pick), picks.take(score, pick) + self.calibration.prior, probe=probe)

    def score(self, state: Tensor, goal: Tensor, candidates: Tensor) -> Tensor:
        """Logits of the fear network for all candidates; see ``Fear.score``."""
        return self.fear.score(self._seen(state), goal, candidates)

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """Fit the fear network to the window; what has resolved since the last time evaluates it first."""
        window = interactions.resolved()
        recent = window.resolved > self._learnt_at
        self._learnt_at = interactions.now
        # Columns are taken one by one: a whole row of everything costs ten times what is needed here.
        known = window.score.isfinite()
        score, crashed = window.score[known], window.crashed[known]
        fair = known & window.probe if self.config.probe else known  # chosen goals are a biased sample
        fresh = fair & recent
        row = {
            "fear/auroc": auroc(window.score[fair], window.crashed[fair]),
            "fear/crash_rate": window.crashed[recent].float().mean().item(),
            "fear/resolved": float(recent.sum()),
            "fear/score": window.score[recent].nanmean().item(),
            "fear/temperature": self.calibration.temperature,
        }
        quality = evaluate(self.calibration.of_log_odds(window.score[fresh]), window.crashed[fresh])
        row |= {f"calibration/{name}": value for name, value in quality.items()}
        # The temperature is fitted to scores from before the network learnt from their outcomes.
        crashes = int(crashed.sum())
        if min(crashes, len(crashed) - crashes) >= self.config.fear.min_per_class:
            self.calibration.fit(score, crashed)
        row["fear/loss"] = self.fear.fit(replace(window, state=self._seen(window.state)))
        if self.fear.fitted:
            self.calibration.set_share(self.fear.share)
        return row

    def _seen(self, state: Tensor) -> Tensor:
        return torch.zeros_like(state) if self.config.control == "state-blind" else state

    def check(self) -> None:
        """See ``GoalSelector.check``."""
        self.fear.check()


def fear_selector(selector: GoalSelector) -> FearSelector | None:
    """The selector with a fear network in ``selector``: itself, or the first of its parts that is one."""
    if isinstance(selector, FearSelector):
        return selector
    found = (fear_selector(part) for part in selector.parts)
    return next((part for part in found if part is not None), None)


def _rolled(score: Tensor, draw: Tensor) -> Tensor:
    """Every row rolled by 0 to N - 1 places at random: whatever place is picked, any candidate may be there.

    With one place less, the most frightening candidate would never be the one that is picked for it.
    """
    count = score.shape[1]
    shift = picks.uniformly(draw, count)
    places = torch.arange(count, device=score.device)
    return score.gather(1, (places + shift.unsqueeze(1)) % count)
