"""A shield: refuses goals that a fear network considers too risky, at a threshold with a guarantee.

The threshold is that of split conformal prediction [1]_. Take crashes that the network has not learnt from, one from
each world; a *miss* is a goal that would crash the policy and is let through. With the k-th lowest score of n crashes
as the threshold, the miss rate is at most k / (n + 1) on average over calibrations: the *marginal* guarantee. Of a
single calibration the miss rate is, where scores do not tie, distributed as Beta(k, n + 1 - k), so a smaller k keeps it
below alpha with a given confidence: the *training-conditional* guarantee [2]_.

Both hold for goals that are exchangeable with those of the calibration, which are uniform, and for this policy in these
worlds. Goals chosen by what the shield does are not, and neither are goals in states that only a shielded policy gets
to. ``Shield.drift`` says when scores are no longer those of the calibration.

References:
    .. [1] Vovk, Gammerman and Shafer, *Algorithmic Learning in a Random World*, 2005, chapter 4.
    .. [2] Vovk, *Conditional Validity of Inductive Conformal Predictors*, ACML 2012, proposition 2a. arXiv:1209.2673
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from deimos.checks import check_at_least, check_choice, check_positive
from deimos.goals import picks

Mode = Literal["ignore", "project", "stop"]
MODES: tuple[Mode, ...] = ("ignore", "project", "stop")
Guarantee = Literal["marginal", "conditional"]
GUARANTEES: tuple[Guarantee, ...] = ("marginal", "conditional")
CONFIDENCE = 0.95  # of the training-conditional guarantee
SHRINKS = 10  # goals between the wanted one and the safe one, which is the last, that project looks at
SCORES = 1001  # of the calibration that are kept to detect a drift
DRIFTED = 1e-3  # chance of a false warning of drift, as if scores were independent, over all tests together

_log = logging.getLogger(__name__)


def _check_shape(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if not isinstance(value, Tensor):
        kind = f"{type(value).__module__}.{type(value).__qualname__}"
        raise ValueError(f"{name} must be a tensor, got {kind}; torch.from_numpy makes one of an array.")
    if value.shape != shape:  # broadcasting would make a goal of it anyway
        raise ValueError(f"{name} must have shape {shape}, got {tuple(value.shape)}.")


def rank(crashes: int, alpha: float, guarantee: Guarantee, confidence: float = CONFIDENCE) -> int:
    """Which of the lowest scores of some crashes is the threshold: k, or 0 where there are too few crashes.

    Args:
        crashes: Their number n, at least 0.
        alpha: Largest miss rate, in (0, 1).
        guarantee: ``marginal``: the largest k with k / (n + 1) <= alpha. ``conditional``: the largest k with
            P(Binomial(n, alpha) < k) <= 1 - confidence.
        confidence: Of the latter, in (0, 1).
    """
    if guarantee == "marginal":
        return math.floor(alpha * (crashes + 1) * (1 + 1e-12))  # 0.1 * 10 must not be 0.99...
    count = np.arange(crashes + 1)
    logs = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, crashes + 1)))])  # of the factorials
    masses = logs[-1] - logs - logs[::-1] + count * math.log(alpha) + (crashes - count) * math.log1p(-alpha)
    return int(np.searchsorted(np.cumsum(np.exp(masses)), 1.0 - confidence, side="right"))


def crashes_needed(alpha: float, guarantee: Guarantee, confidence: float = CONFIDENCE) -> int:
    """The fewest crashes that a threshold can be calibrated on; for the arguments see ``rank``."""
    if guarantee == "marginal":
        return math.ceil(1.0 / alpha * (1 - 1e-12)) - 1
    return math.ceil(math.log(1.0 - confidence) / math.log1p(-alpha))


def threshold(score: Tensor, alpha: float, guarantee: Guarantee, confidence: float = CONFIDENCE) -> float:
    """The score from which on goals are refused.

    Args:
        score: Scores of goals that ended in a crash, at issue and independent of each other, shape (n,).
        alpha: Largest share of such goals that may be let through, in (0, 1).
        guarantee: What is promised; see ``rank``.
        confidence: In (0, 1).

    Raises:
        ValueError: If alpha is out of range, or there are too few crashes; the message says how many it takes.
    """
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"alpha must be in (0, 1), got {alpha}.")
    check_choice("guarantee", guarantee, GUARANTEES)
    k = rank(len(score), alpha, guarantee, confidence)
    if k < 1:
        need = crashes_needed(alpha, guarantee, confidence)
        raise ValueError(f"alpha = {alpha:g} needs {need} crashes to calibrate on, got {len(score)}.")
    return score.double().sort().values[k - 1].item()


@dataclass(frozen=True)
class Shielded:
    """What a shield did with some goals."""

    goal: Tensor
    """Goals to pursue, shape (B, goal_dim)."""
    refused: Tensor
    """True where that is not the goal that was asked for, bool, shape (B,)."""
    score: Tensor
    """Fear of the goals that were asked for, shape (B,)."""


class Shield:
    """Lets goals of acceptable fear pass and replaces the others.

    Args:
        threshold: Goals with this score or a higher one are refused, finite; see ``threshold``.
        mode: What becomes of them. ``ignore``: the active goal stays. ``stop``: the safe goal. ``project``: the nearest
            goal of acceptable fear among the candidates and those between the wanted goal and the safe one; where none
            is acceptable, the safe goal.
        safe_goal: A goal without risk, such as zero speed, finite; ``None`` for components that stay as they are.
        goal_range: Half side of the box of goals along every component: the unit of distances, finite and positive.
        reference: Scores of the calibration's goals, in any order; empty to leave out the test for drift.
        window: Goals that are tested for drift together, at least 1.
    """

    def __init__(
        self, threshold: float, mode: Mode, safe_goal: Sequence[float | None], goal_range: Sequence[float],
        reference: Sequence[float] = (), window: int = 200,
    ) -> None:  # fmt: skip
        check_choice("mode", mode, MODES)
        check_at_least("window", window, 1)
        if len(safe_goal) != len(goal_range):
            raise ValueError(
                f"safe_goal must have {len(goal_range)} components as goal_range has, got {len(safe_goal)}."
            )
        if not math.isfinite(threshold):
            raise ValueError(f"threshold must be finite, or all goals pass, or none, got {threshold}.")
        if not all(value is None or math.isfinite(value) for value in safe_goal):
            raise ValueError(f"safe_goal must be finite, got {tuple(safe_goal)}.")
        for value in goal_range:
            check_positive("goal_range", value, finite=True)
        self.threshold, self.mode, self.window = threshold, mode, window
        self._fixed = torch.tensor([value is not None for value in safe_goal], dtype=torch.bool)
        self._safe = torch.tensor([value or 0.0 for value in safe_goal], dtype=torch.float32)
        self._range = torch.tensor(goal_range, dtype=torch.float32)
        self._reference = torch.tensor(reference, dtype=torch.float64).sort().values
        self._recent = torch.zeros(0, dtype=torch.float64)
        self._untested, self._tests, self._warned = 0, 0, False

    @classmethod
    def from_dict(
        cls, data: dict[str, Any] | None, mode: Mode | None = None, guarantee: Guarantee | None = None
    ) -> "Shield":
        """The shield that ``deimos shield`` has stored in a run or in an export.

        Args:
            data: The entry ``shield`` of ``deploy.json``; ``None`` in that of a run without a shield.
            mode: A mode other than the one that it was tried in.
            guarantee: The guarantee of a threshold other than the one that it was tried with.

        Raises:
            KeyError: If something is missing in it.
            ValueError: If there is no shield, or it was calibrated on too few crashes for the guarantee.
        """
        if data is None:
            raise ValueError("There is no shield: make one with deimos shield, then export the run again.")
        guarantee = guarantee or data["guarantee"]
        check_choice("guarantee", guarantee, GUARANTEES)
        if data["threshold"][guarantee] is None:
            raise ValueError(f"guarantee must not be {guarantee}: {data['crashes']} crashes are too few for it.")
        return cls(
            data["threshold"][guarantee],
            mode or data["mode"],
            data["safe_goal"],
            data["goal_range"],
            data["scores"],
        )

    @torch.no_grad()
    def choose(
        self, score: Callable[[Tensor], Tensor], goal: Tensor, wanted: Tensor, candidates: Tensor | None = None
    ) -> Shielded:
        """Decide on the next goals.

        Args:
            score: The fear network in the present states: gives logits, shape (B, N), of goals, shape (B, N, goal_dim).
            goal: Active goals, shape (B, goal_dim).
            wanted: The goals that are asked for, shape (B, goal_dim).
            candidates: Valid goals that ``project`` may take, shape (B, N, goal_dim); ``None`` for those on the way to
                the safe goal alone.

        Raises:
            ValueError: If something is not a tensor, or a shape does not fit.
        """
        count, dim = len(wanted), len(self._safe)
        _check_shape("wanted", wanted, (count, dim))
        _check_shape("goal", goal, (count, dim))
        if candidates is not None:
            _check_shape(
                "candidates", candidates, (count, candidates.shape[1] if len(candidates.shape) > 1 else 0, dim)
            )
        fear = score(wanted.unsqueeze(1))
        _check_shape("score of (B, 1) goals", fear, (count, 1))
        fear = fear.squeeze(1)
        self._watch(fear)
        refused = ~(fear < self.threshold)  # NaN is refused
        fixed, safe = self._fixed.to(goal.device), self._safe.to(goal)
        if self.mode == "ignore":
            other = goal
        elif self.mode == "stop":
            other = torch.where(fixed, safe, goal)
        else:
            other = self._nearest(score, goal, wanted, candidates)
        return Shielded(torch.where(refused.unsqueeze(1), other, wanted), refused, fear)

    def _nearest(
        self, score: Callable[[Tensor], Tensor], goal: Tensor, wanted: Tensor, candidates: Tensor | None
    ) -> Tensor:
        """The acceptable goals that are nearest to the wanted ones, shape (B, goal_dim); safe goals if none is."""
        fixed, safe = self._fixed.to(goal.device), self._safe.to(goal)
        share = torch.linspace(1.0, 0.0, SHRINKS + 1, dtype=goal.dtype, device=goal.device)[1:, None]
        tried = torch.where(fixed, safe + share * (wanted.unsqueeze(1) - safe), wanted.unsqueeze(1))
        if candidates is not None:
            tried = torch.cat([tried, candidates], dim=1)
        fear = score(tried)
        _check_shape("score of (B, N) goals", fear, tuple(tried.shape[:2]))
        away = ((tried - wanted.unsqueeze(1)) / self._range.to(goal)).square().sum(2)
        away = torch.where(fear < self.threshold, away, torch.inf)
        none = away.amin(1, keepdim=True).isinf()
        return torch.where(none, torch.where(fixed, safe, goal), picks.take(tried, away.argmin(1)))

    def _watch(self, fear: Tensor) -> None:
        """Keep the last scores, test each ``window`` of them, and warn once if they are not the calibration's."""
        if not len(self._reference):
            return
        self._recent = torch.cat([self._recent, fear.double().cpu()])[-self.window :]
        self._untested += len(fear)
        if self._untested < self.window:
            return
        self._untested, self._tests = 0, self._tests + 1
        # The levels of all tests sum to DRIFTED, however many there will be.
        if not self._warned and self.drift() < DRIFTED / (self._tests * (self._tests + 1)):
            self._warned = True
            _log.warning(
                "The scores of the last %d goals are not those of the calibration (p = %.2g): the guarantee does not "
                "hold here; calibrate on such goals.", self.window, self.drift(),
            )  # fmt: skip

    def drift(self) -> float:
        """p-value, in [0, 1], of the last ``window`` scores being drawn as the calibration's; 1 if none is known.

        It is computed as if scores were independent, from the largest distance D between the distribution functions:
        2 exp(-2 D^2 n m / (n + m)), the first term of Kolmogorov's series for two samples of n and m.
        """
        recent, reference = self._recent.sort().values, self._reference
        if not len(recent) or not len(reference):
            return 1.0
        n, m = len(recent), len(reference)
        places = torch.cat([recent, reference])
        ours, theirs = (torch.searchsorted(x, places, side="right").double() / len(x) for x in (recent, reference))
        distance = (ours - theirs).abs().max().item()
        return min(1.0, 2.0 * math.exp(-2.0 * distance**2 * n * m / (n + m)))
