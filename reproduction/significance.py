"""The tests of the claims, and the smallest effect that each of them can find. The unit is one trained policy."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import optimize, stats

from deimos.study.stats import POWER, Array, iqr


@dataclass(frozen=True)
class Equivalence:
    """Two one-sided tests of a difference in means."""

    difference: float
    """Mean of the first sample minus that of the second."""
    low: float
    """Lower end of the interval of level 1 - 2 alpha: inside the margins means equivalent."""
    high: float
    """Upper end of it."""
    p_same: float
    """p-value of the difference lying outside the margins: small means equivalent."""
    p_other: float
    """p-value of the difference lying within the margins: small means different by more than them."""


def log_iqr_ratio(x: Array, y: Array) -> Array:
    """Logarithm of the ratio of two interquartile ranges; 0 where both are 0."""
    a, b = iqr(x), iqr(y)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(a == b, 0.0, np.log(a) - np.log(b))


def mann_whitney(x: Array, y: Array) -> float:
    """Two-sided p-value of the rank-sum test; exact for small samples without ties."""
    if np.ptp(np.concatenate([x, y])) == 0.0:
        return 1.0
    return float(stats.mannwhitneyu(x, y, alternative="two-sided").pvalue)


def rosenbaum(x: Array, y: Array) -> float:
    """One-sided p-value of x reaching higher than y: by how many values of x lie above all of y [1]_.

    Exact without ties; values that are equal to the highest of y do not count.

    References:
        .. [1] Rosenbaum, *Tables for a Nonparametric Test of Location*, Annals of Mathematical Statistics 25, 1954.
    """
    return _on_top(len(x), len(y), int((x > y.max()).sum()))


def _on_top(n: int, m: int, count: int) -> float:
    """Probability that the ``count`` highest of n + m exchangeable values are all of the n."""
    return math.comb(n, count) / math.comb(n + m, count)


def brown_forsythe(x: Array, y: Array) -> float:
    """p-value of equal spread: an F test on the distances from the medians [1]_.

    References:
        .. [1] Brown and Forsythe, *Robust Tests for the Equality of Variances*, JASA 69, 1974.
    """
    spreads = [np.ptp(np.abs(z - np.median(z))) for z in (x, y)]
    if not any(spreads):  # all values lie at one distance from their median, 0 for instance
        return 1.0 if np.abs(x - np.median(x))[0] == np.abs(y - np.median(y))[0] else 0.0
    return float(stats.levene(x, y, center="median").pvalue)


def holm(p: Sequence[float]) -> Array:
    """p-values adjusted for testing all of them, by Holm's step-down rule [1]_.

    References:
        .. [1] Holm, *A Simple Sequentially Rejective Multiple Test Procedure*, Scand. J. Statistics 6, 1979.
    """
    values = np.asarray(p, float)
    order = np.argsort(values, kind="stable")
    steps = np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(steps, 1.0)
    return adjusted


def equivalence(x: Array, y: Array, margin: float, *, alpha: float = 0.05) -> Equivalence:
    """Whether two means differ by less than a margin: Schuirmann's two one-sided tests, as Welch's t [1]_.

    Args:
        x: First sample, at least 2 values.
        y: Second sample, at least 2 values.
        margin: Largest difference that does not matter, positive.
        alpha: Level of each of the one-sided tests.

    References:
        .. [1] Schuirmann, *A comparison of the two one-sided tests procedure and the power approach*,
           J. Pharmacokinetics and Biopharmaceutics 15, 1987.
    """
    if not margin > 0.0:
        raise ValueError(f"margin must be positive, got {margin}.")
    difference = float(np.mean(x) - np.mean(y))
    if np.ptp(x) == np.ptp(y) == 0.0:
        inside = abs(difference) < margin
        return Equivalence(difference, difference, difference, float(not inside), float(inside))
    low, high = stats.ttest_ind(x, y, equal_var=False).confidence_interval(1 - 2 * alpha)

    def welch(shift: float, alternative: str) -> float:
        return float(stats.ttest_ind(x - shift, y, equal_var=False, alternative=alternative).pvalue)

    same = max(welch(-margin, "greater"), welch(margin, "less"))
    other = min(1.0, 2 * min(welch(-margin, "less"), welch(margin, "greater")))
    return Equivalence(difference, float(low), float(high), same, other)


@lru_cache
def detectable_reach(n: int, m: int, alpha: float = 0.05) -> float:
    """Smallest P(X > Y) above 1/2 that ``rosenbaum`` finds with a power of 80 %, where F_X is a power of F_Y [1]_.

    Infinite where even all of x above all of y is not significant.

    References:
        .. [1] Lehmann, *The Power of Rank Tests*, Annals of Mathematical Statistics 24, 1953, section 3.
    """
    enough = [count for count in range(n + 1) if _on_top(n, m, count) < alpha]
    if not enough:
        return math.inf
    # With F_X = F_Y^k the share of X below the highest of y is Beta(m / k, 1), and P(X > Y) is k / (k + 1).
    found = optimize.brentq(lambda z: stats.betabinom.sf(enough[0] - 1, n, 1, m * math.exp(-z)) - POWER, -10, 30)
    return 1 / (1 + math.exp(-found))


@lru_cache
def detectable_sign(n: int, alpha: float = 0.05) -> float:
    """Smallest distance from 1/2 of a share that the exact one-sided sign test finds with a power of 80 %.

    Infinite where even n of n is not significant.
    """
    enough = [count for count in range(n) if stats.binom.cdf(count, n, 0.5) < alpha]
    if not enough:
        return math.inf
    return 0.5 - float(stats.beta.ppf(1 - POWER, enough[-1] + 1, n - enough[-1]))


def detectable_margin(x: Array, y: Array, alpha: float = 0.05) -> float:
    """Smallest margin within which ``equivalence`` finds two equal means of this spread with a power of 80 %."""
    error = math.sqrt(x.var(ddof=1) / len(x) + y.var(ddof=1) / len(y))
    if error == 0.0:
        return 0.0
    t = stats.t(stats.ttest_ind(x, y, equal_var=False).df)
    return float((t.ppf(1 - alpha) + t.ppf(1 - (1 - POWER) / 2)) * error)


def detectable_mean(x: Array, alpha: float = 0.05) -> float:
    """Smallest mean that a two-sided t test tells from 0 with a power of 80 %, at this spread."""
    t = stats.t(len(x) - 1)
    return float((t.ppf(1 - alpha / 2) + t.ppf(POWER)) * x.std(ddof=1) / math.sqrt(len(x)))


@lru_cache
def detectable_spread(n: int, m: int, alpha: float = 0.05, populations: int = 4000) -> float:
    """Smallest ratio of standard deviations that Brown and Forsythe's test finds with a power of 80 %.

    Simulated on normal samples, to 0.5 %; at most 100.
    """
    rng = np.random.default_rng(0)
    x, y = (rng.normal(size=(populations, k)) for k in (n, m))

    def power(ratio: float) -> float:
        return float((stats.levene(ratio * x, y, center="median", axis=1).pvalue < alpha).mean())

    low, high = 1.0, 100.0
    if power(high) < POWER:
        return high
    while high / low > 1.005:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if power(middle) >= POWER else (middle, high)
    return high
