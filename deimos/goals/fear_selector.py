"""What every selector that ranks candidates by fear has in common."""

import abc
import logging
import math
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from deimos.checks import check_at_least, check_choice, check_range
from deimos.goals import picks
from deimos.goals.calibration import Calibration, evaluate
from deimos.goals.crash_memory import CrashMemory
from deimos.goals.fear import Fear, FearConfig, auroc
from deimos.goals.interactions import Interactions, Resolved
from deimos.goals.selector import (
    Delegate,
    GoalSelector,
    Proposal,
    SelectorConfig,
    Spaces,
    Transitions,
    uniform_proposal,
)
from deimos.nn.ranks import largest

LEAST = 32  # crashes and survivals that a temperature is fitted to

_log = logging.getLogger(__name__)


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
    memory: int = 512
    """Crashes that are remembered with survivals of the same time, at least 0, so that learning continues when crashes
    have become rare. 0 is the thesis's literal method: a fit learns from the interactions resolved in the last 2 T
    steps, and is left out if they lack a class."""
    fear: FearConfig = field(default_factory=FearConfig)
    """The fear network."""
    former: ClassVar[dict[str, Any]] = {"gate": False}
    """Fields of earlier versions, with the only value that is still supported."""

    def __post_init__(self) -> None:
        check_at_least("candidates", self.candidates, 1)
        check_range("probe", self.probe, 0.0, 1.0)
        check_at_least("memory", self.memory, 0)
        check_choice("control", self.control, ["none", "shuffled", "state-blind"])


@dataclass(frozen=True)
class FearEstimate:
    """How much a fear network fears some goals, and how far it can be trusted."""

    probability: Tensor
    """Calibrated probability that the policy crashes within T steps, in (0, 1), shape (B,); of a selector that is not
    ``is_calibrated``, its fear on that scale."""
    auroc: float
    """How often it ranked a crash of the last 2 T steps above a survival when they were issued, in [0, 1]; 0.5 is
    chance, NaN where a class is empty."""
    age: int
    """Rollouts since it last learnt; 0 if it learns in every one."""


class FearSelector(GoalSelector):
    """Learns fear online and leaves the choice to ``choose``. Until it has seen both classes it is uniform."""

    config: FearSelectorConfig
    dense = True
    inputs_per_row: ClassVar[int] = 1
    """Inputs of the network in a row of ``rows``."""
    is_calibrated: ClassVar[bool] = True
    """Whether ``calibration`` turns a score into the probability of a crash within T steps."""
    saved: ClassVar[tuple[str, ...]] = (
        "fear", "memory", "calibration", "_learnt_at", "_age", "_auroc", "_issued",
    )  # fmt: skip
    unknown: ClassVar[tuple[str, ...]] = ("_auroc",)

    def __init__(self, config: FearSelectorConfig, spaces: Spaces, seed: int) -> None:
        self.config = config
        self.num_candidates = config.candidates
        self._learnt_at = 0  # step of the last call of learn
        self.fear = Fear(config.fear, spaces.state_dim, spaces.goal_dim, spaces.device, seed)
        self.calibration = Calibration(spaces.device)
        self.memory: CrashMemory | None = None
        """The crashes that fear is learnt from; ``None`` for those of the last 2 T steps alone."""
        if config.memory:
            inputs = spaces.state_dim + 2 * spaces.goal_dim
            extra = (self.inputs_per_row - 1) * inputs
            self.memory = CrashMemory(config.memory, spaces.goal_period, inputs, spaces.device, seed, extra)
        self._age = -1  # rollouts since the last fit, -1 before the first
        self._auroc = math.nan  # on the outcomes of the last 2 T steps, by the scores at issue
        # Goals since the last call of learn.
        self._issued = torch.zeros((), dtype=torch.int64, device=spaces.device)
        self._said = False  # whether the log says that there is no fear yet

    def graph_key(self) -> Hashable:
        """See ``GoalSelector.graph_key``."""
        return self.fear.fitted

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
        pick, probe = self.choose(self.ranking(state, goal, candidates, score, draws), draws[:, 0]), None
        if self.config.probe:
            probe = draws[:, 1] < self.config.probe
            pick = torch.where(probe, picks.uniformly(draws[:, 0], candidates.shape[1]), pick)
        # As a forecast it keeps the prior at issue time, whatever the crash rate is when it is evaluated.
        picked = picks.take(score, pick)
        forecast, percentile = self.calibration.log_odds(picked), picks.percentile(score, picked)
        return Proposal(picks.take(candidates, pick), forecast, probe=probe, percentile=percentile)

    def issued(
        self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, chosen: Proposal,
        where: Tensor | None = None,
    ) -> None:  # fmt: skip
        """See ``GoalSelector.issued``."""
        self._issued += len(rows) if where is None else where.sum()

    def ranking(self, state: Tensor, goal: Tensor, candidates: Tensor, score: Tensor, draws: Tensor) -> Tensor:
        """What ``choose`` goes by, shape (B, N): the logits of fear, ``score``, unless a subclass has something better.

        The other arguments are those of ``propose``.
        """
        return _rolled(score, draws[:, 2]) if self.config.control == "shuffled" else score

    def score(self, state: Tensor, goal: Tensor, candidates: Tensor) -> Tensor:
        """Logits of the fear network for all candidates; see ``Fear.score``."""
        return self.fear.score(self._seen(state), goal, candidates)

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """Fit the fear network to the window, after evaluating it on what has resolved since the last call."""
        (issued,) = largest(int(self._issued))
        self._issued.zero_()
        chosen = float(self.fear.fitted) if issued else math.nan  # it has not changed since the last time
        window = interactions.resolved()
        recent = window.resolved > self._learnt_at
        self._learnt_at = interactions.now
        # Columns are taken one by one: a whole row of everything costs ten times what is needed here.
        known = window.score.isfinite()
        score, crashed = window.score[known], window.crashed[known]
        fair = known & window.probe if self.config.probe else known  # chosen goals are a biased sample
        fresh = fair & recent
        self._auroc = auroc(window.score[fair], window.crashed[fair])
        row = {
            "fear/auroc": self._auroc,
            "fear/crash_rate": window.crashed[recent].float().mean().item(),
            "fear/resolved": float(recent.sum()),
            "fear/score": window.score[recent].nanmean().item(),
            "fear/temperature": self.calibration.temperature,
            "fear/chosen": chosen,
        }
        quality = evaluate(self.calibration.of_log_odds(window.score[fresh]), window.crashed[fresh])
        row |= {f"calibration/{name}": value for name, value in quality.items()}
        # The temperature is fitted to scores from before the network learnt from their outcomes.
        crashes = int(crashed.sum())
        if min(crashes, len(crashed) - crashes) >= LEAST:
            self.calibration.fit(score, crashed)
        loss = self._fit(window, interactions)
        if not math.isnan(loss):
            self._age = 0
        elif self.fear.fitted:
            self._age += 1
        else:
            self._say_why(window)
        share = (int(window.crashed.sum()) + 0.5) / (len(window) + 1.0)  # never certain, even without a recent crash
        self.calibration.set_share(share)
        return row | {"fear/loss": loss, "fear/age": float(self._age) if self.fear.fitted else math.nan}

    def _fit(self, window: Resolved, interactions: Interactions) -> float:
        """Learn from the memory or, without one, from the window; returns the loss, NaN where nothing was learnt."""
        rows = self.rows(window, interactions)
        if self.memory is None:
            return self.fit(rows, window.crashed, torch.ones_like(rows[:, 0]))
        self.memory.store(rows, window, interactions.now, interactions.kept_since())
        rows, crashed, weight = self.memory.sample(rows, window)
        return self.fit(rows, crashed, weight)

    def rows(self, window: Resolved, interactions: Interactions) -> Tensor:
        """What to learn from each interaction of the window, shape (n, inputs_per_row * inputs of the network)."""
        return torch.cat([self._seen(window.state), window.goal, window.next_goal], dim=1).float()

    def fit(self, rows: Tensor, crashed: Tensor, weight: Tensor) -> float:
        """Learn from rows, of the window or remembered; see ``Fear.fit_rows``."""
        return self.fear.fit_rows(rows, crashed, weight)

    def _say_why(self, window: Resolved) -> None:
        """Log once why goals are still uniform."""
        if self._said:
            return
        self._said = True
        least, crashes = self.config.fear.min_per_class, int(window.crashed.sum())
        _log.info(
            "Goals are uniform until the fear network has seen crashes (%d) and as many survivals; "
            "the last 2 T steps had %d and %d.", least, crashes, len(window) - crashes,
        )  # fmt: skip

    def estimate(self, state: Tensor, goal: Tensor, new_goal: Tensor) -> FearEstimate:
        """The fear of given goals, and how far it can be trusted.

        Args:
            state: States, shape (B, state_dim).
            goal: Active goals, shape (B, goal_dim).
            new_goal: Goals to evaluate, shape (B, goal_dim).

        Raises:
            RuntimeError: If the network has not learnt anything yet.
        """
        if not self.fear.fitted:
            raise RuntimeError("The fear network has learnt nothing yet: it must see crashes and survivals first.")
        score = self.score(state, goal, new_goal.unsqueeze(1)).squeeze(1)
        return FearEstimate(self.calibration.probability(score), self._auroc, self._age)

    def _seen(self, state: Tensor) -> Tensor:
        return torch.zeros_like(state) if self.config.control == "state-blind" else state

    def check(self) -> None:
        """See ``GoalSelector.check``."""
        self.fear.check()


def fear_selector(selector: GoalSelector) -> FearSelector | None:
    """The selector with a fear network in ``selector``: itself, or its current part, or the first of its parts."""
    if isinstance(selector, FearSelector):
        return selector
    chooser = (selector.current,) if isinstance(selector, Delegate) else ()
    found = (fear_selector(part) for part in (*chooser, *selector.parts))
    return next((part for part in found if part is not None), None)


def _rolled(score: Tensor, draw: Tensor) -> Tensor:
    """Every row rolled by 0 to N - 1 places at random: whatever place is picked, any candidate may be there.

    Without the roll by 0 places, the most frightening candidate would never be picked for its own score.
    """
    count = score.shape[1]
    shift = picks.uniformly(draw, count)
    places = torch.arange(count, device=score.device)
    return score.gather(1, (places + shift.unsqueeze(1)) % count)
