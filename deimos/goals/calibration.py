"""From a fear network's logits to probabilities, and how good these are."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from deimos.nn.graphs import Mirrored
from deimos.nn.stateful import Stateful

TEMPERATURES = (0.1, 10.0)  # range of a temperature; outside, the scores are not logits of anything
BINS = 15


class Calibration(Stateful):
    """Turns logits of a class-balanced classifier into probabilities.

    Where crashes and survivals each have a total weight of 1/2, the odds that a classifier learns are (1 - pi) / pi
    times the true ones, with pi the share of crashes; adding log(pi / (1 - pi)) to the logit undoes that exactly [1]_.
    What remains is over- or underconfidence, which one temperature on held-out data corrects [2]_.

    Args:
        device: Where the logits are.

    References:
        .. [1] Elkan, *The Foundations of Cost-Sensitive Learning*, IJCAI 2001, theorem 2.
        .. [2] Guo et al., *On Calibration of Modern Neural Networks*, ICML 2017, section 4.2. arXiv:1706.04599
    """

    saved = ("prior", "temperature")
    prior = Mirrored("_prior")
    """log(pi / (1 - pi))."""
    temperature = Mirrored("_temperature")
    """What corrected logits are divided by, in ``TEMPERATURES``."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._prior, self._temperature = torch.zeros(2, dtype=torch.float64, device=device)
        self.prior, self.temperature = 0.0, 1.0

    def log_odds(self, score: Tensor) -> Tensor:
        """Log odds of a crash before the temperature, of logits of the class-balanced classifier."""
        return score + self._prior

    def probability(self, score: Tensor) -> Tensor:
        """Probability of a crash, in (0, 1), of logits of the class-balanced classifier."""
        return self.of_log_odds(self.log_odds(score))

    def of_log_odds(self, log_odds: Tensor) -> Tensor:
        """Probability of a crash where the prior, perhaps an earlier one, has been added already."""
        return torch.sigmoid(log_odds / self._temperature)

    def set_share(self, share: float) -> None:
        """Set the share of crashes in the world, in (0, 1)."""
        self.prior = math.log(share / (1.0 - share))

    def fit(self, log_odds: Tensor, crashed: Tensor, steps: int = 3) -> None:
        """Move the temperature towards the lowest log-loss on interactions that the network has not learnt from.

        The loss is convex in 1 / temperature, so Newton's method from the last one tracks it.

        Args:
            log_odds: Logits and prior as they were at issue, shape (n,).
            crashed: Their outcomes, True for a crash, bool, shape (n,); both classes.
            steps: Newton steps, at least 1.
        """
        z, y = log_odds.double(), crashed.double()
        inverse = torch.tensor(1.0 / self.temperature, dtype=torch.float64, device=z.device)
        for _ in range(steps):
            p = torch.sigmoid(inverse * z)
            slope = ((p - y) * z).mean()
            curvature = (p * (1 - p) * z * z).mean() + 1e-6
            # Far from the optimum the loss is flat: no step may change the temperature more than twofold.
            inverse = (inverse - slope / curvature).clamp(min=0.5 * inverse, max=2.0 * inverse)
        low, high = TEMPERATURES
        self.temperature = min(max(1.0 / inverse.item(), low), high)


@dataclass(frozen=True)
class Reliability:
    """A reliability curve: equally many predictions per bin, in rising order."""

    predicted: Tensor
    """Mean prediction of every bin, shape (bins,)."""
    observed: Tensor
    """Share of crashes in every bin, shape (bins,)."""
    count: Tensor
    """Predictions in every bin, int64, shape (bins,)."""


def reliability(probability: Tensor, crashed: Tensor, bins: int = BINS) -> Reliability:
    """Predicted against observed crash rates.

    Bins have equal mass: where crashes are rare, nearly all predictions would share one bin of equal width.

    Args:
        probability: Predictions in [0, 1], shape (n,), n at least 1.
        crashed: Their outcomes, True for a crash, bool, shape (n,).
        bins: Number of bins; fewer where there are fewer predictions.

    Returns:
        Tensors on the CPU: a GPU would sum bins in no fixed order.
    """
    n, probability, crashed = len(probability), probability.cpu(), crashed.cpu()
    bins = min(bins, n)
    order = probability.argsort()
    index = torch.arange(n, device="cpu") * bins // n
    count = torch.bincount(index, minlength=bins)
    predicted = torch.bincount(index, probability[order].double(), minlength=bins) / count
    observed = torch.bincount(index, crashed[order].double(), minlength=bins) / count
    return Reliability(predicted, observed, count)


def evaluate(probability: Tensor, crashed: Tensor) -> dict[str, float]:
    """How good predicted probabilities are.

    Args:
        probability: Predictions in [0, 1], shape (n,).
        crashed: Their outcomes, True for a crash, bool, shape (n,).

    Returns:
        ``brier``, the mean squared error, and its parts over equal-mass bins [1]_: ``reliability`` (0 is
        perfect), ``resolution`` (more is better) and ``uncertainty``; brier = reliability - resolution +
        uncertainty up to the spread within bins. ``ece``, the expected calibration error over the same bins;
        ``log_loss_skill``, 1 - loss / (loss of predicting the base rate): 0 knows nothing, 1 everything.
        ``top_decile_gap``: predicted minus observed rate where the predictions are highest, which is what a
        gate at run time sees. NaN where there is nothing to evaluate, for the skill also where a class is empty.

    References:
        .. [1] Murphy, *A New Vector Partition of the Probability Score*, J. Appl. Meteorology 12, 1973.
    """
    names = ("brier", "reliability", "resolution", "uncertainty", "ece", "log_loss_skill", "top_decile_gap")
    if len(probability) == 0:
        return dict.fromkeys(names, math.nan)
    p, crashed = probability.double().cpu(), crashed.cpu()
    y = crashed.double()
    curve = reliability(p, crashed)
    top = p.topk(max(1, len(p) // 10)).indices
    scalars = torch.stack([
        y.mean(), (p - y).square().mean(), nn.functional.binary_cross_entropy(p, y), p[top].mean() - y[top].mean()
    ])  # fmt: skip
    rate, brier, loss, gap = scalars.tolist()
    bins = [each.tolist() for each in (curve.predicted, curve.observed, curve.count.double() / len(p))]
    base = -sum(q * math.log(q) for q in (rate, 1 - rate) if q > 0)
    gaps = [(share, predicted - observed, observed - rate) for predicted, observed, share in zip(*bins, strict=True)]
    values = (
        brier,
        math.fsum(share * off**2 for share, off, _ in gaps),
        math.fsum(share * apart**2 for share, _, apart in gaps),
        rate * (1 - rate),
        math.fsum(share * abs(off) for share, off, _ in gaps),
        1 - loss / base if base > 0 else math.nan,
        gap,
    )
    return dict(zip(names, values, strict=True))
