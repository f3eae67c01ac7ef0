"""Statistics of populations of runs. The unit is one trained policy; robots and episodes are no replicates.

Samples are float arrays, one value per policy. Every interval is two-sided; every bootstrap is seeded.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

Array = NDArray[np.float64]
Statistic = Callable[..., Array]
"""Of one array per sample, each of shape (..., n_i), gives an array of shape (...)."""

RESAMPLES = 10_000
LEVEL = 0.95
POWER = 0.8


@dataclass(frozen=True)
class Interval:
    """An estimate with its interval."""

    estimate: float
    """Of the samples themselves."""
    low: float
    """Lower end."""
    high: float
    """Upper end."""


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


def iqm(x: Array) -> Array:
    """Interquartile mean along the last axis: the mean without the lowest and the highest quarter [1]_.

    A quarter is rounded down to whole values.

    References:
        .. [1] Agarwal et al., *Deep Reinforcement Learning at the Edge of the Statistical Precipice*,
           NeurIPS 2021. arXiv:2108.13264
    """
    n = x.shape[-1]
    cut = n // 4
    return np.sort(x, axis=-1)[..., cut : n - cut].mean(axis=-1)


def iqr(x: Array) -> Array:
    """Range between the quartiles along the last axis, by linear interpolation of the order statistics."""
    low, high = np.quantile(x, [0.25, 0.75], axis=-1)
    return high - low


def cvar(x: Array, share: float = 0.2) -> Array:
    """Mean of the highest ``share`` of the values along the last axis; the boundary value counts by its fraction [1]_.

    As an estimate of a population's tail it is too low in small samples.

    Args:
        x: Values, shape (..., n); higher is worse.
        share: Share of the values that counts, in (0, 1].

    References:
        .. [1] Rockafellar and Uryasev, *Conditional value-at-risk for general loss distributions*,
           Journal of Banking & Finance 26, 2002, proposition 8.
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share must be in (0, 1], got {share}.")
    weight = np.clip(share * x.shape[-1] - np.arange(x.shape[-1]), 0.0, 1.0)
    return -np.sort(-x, axis=-1) @ weight / weight.sum()


def log_iqr_ratio(x: Array, y: Array) -> Array:
    """Logarithm of the ratio of two interquartile ranges; 0 where both are 0."""
    a, b = iqr(x), iqr(y)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(a == b, 0.0, np.log(a) - np.log(b))


def resample(samples: Sequence[Array], resamples: int, seed: int) -> list[Array]:
    """Draw from every sample with replacement, each as often as it has values (the stratified bootstrap).

    Returns:
        One array of shape (resamples, n_i) per sample.
    """
    rng = np.random.default_rng(seed)
    return [x[rng.integers(len(x), size=(resamples, len(x)))] for x in samples]


def bootstrap(
    samples: Sequence[Array], statistic: Statistic, *, resamples: int = RESAMPLES, seed: int = 0, level: float = LEVEL
) -> Interval:
    """Percentile interval of a statistic by the stratified bootstrap.

    Args:
        samples: One array per stratum (method or task).
        statistic: Vectorised over leading axes.
        resamples: Number of bootstrap resamples.
        seed: Of the resampling.
        level: Of the interval, in (0, 1).
    """
    samples = [_checked(x) for x in samples]
    values = statistic(*resample(samples, resamples, seed))
    low, high = _quantiles(values, level)
    return Interval(float(statistic(*samples)), low, high)


def bca(x: Array, statistic: Statistic, *, resamples: int = RESAMPLES, seed: int = 0, level: float = LEVEL) -> Interval:
    """Bias-corrected and accelerated bootstrap interval of a statistic of one sample [1]_.

    References:
        .. [1] Efron and Tibshirani, *An Introduction to the Bootstrap*, 1993, equations 14.9 to 14.15.
    """
    x = _checked(x)
    estimate = float(statistic(x))
    if np.ptp(x) == 0.0:
        return Interval(estimate, estimate, estimate)
    values = statistic(resample([x], resamples, seed)[0])
    below = ((values < estimate).mean() + (values <= estimate).mean()) / 2  # ties count half
    bias = stats.norm.ppf(np.clip(below, 0.5 / resamples, 1 - 0.5 / resamples))
    n = len(x)
    left_out = statistic(np.broadcast_to(x, (n, n))[~np.eye(n, dtype=bool)].reshape(n, n - 1))
    away = left_out.mean() - left_out
    spread = (away**2).sum()
    acceleration = (away**3).sum() / (6 * spread**1.5) if spread > 0 else 0.0
    z = bias + stats.norm.ppf([(1 - level) / 2, (1 + level) / 2])
    shares = stats.norm.cdf(bias + z / (1 - acceleration * z))
    low, high = np.quantile(values, shares)
    return Interval(estimate, float(low), float(high))


def bootstrap_t(x: Array, *, resamples: int = RESAMPLES, seed: int = 0, level: float = LEVEL) -> Interval:
    """Interval of the mean by the studentised bootstrap [1]_, the one for small and skewed samples.

    References:
        .. [1] Efron and Tibshirani, *An Introduction to the Bootstrap*, 1993, section 12.5.
    """
    x = _checked(x)
    mean, error = x.mean(), x.std(ddof=1) / math.sqrt(len(x))
    if error == 0.0:
        return Interval(float(mean), float(mean), float(mean))
    draws = resample([x], resamples, seed)[0]
    away = draws.mean(axis=-1) - mean
    errors = draws.std(axis=-1, ddof=1) / math.sqrt(len(x))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(away == 0.0, 0.0, away / errors)  # infinite where all drawn values are the same
    low, high = _quantiles(t, level)
    return Interval(float(mean), float(mean - high * error), float(mean - low * error))


def probability_of_improvement(
    pairs: Sequence[tuple[Array, Array]], *, resamples: int = RESAMPLES, seed: int = 0, level: float = LEVEL
) -> Interval:
    """P(X > Y), ties counting half, averaged over tasks: U / (n m) of Mann and Whitney [1]_.

    Args:
        pairs: X and Y of every task.
        resamples: Number of bootstrap resamples of all samples.
        seed: Of the resampling.
        level: Of the interval, in (0, 1).

    References:
        .. [1] Agarwal et al., arXiv:2108.13264, section 4.3.
    """
    rng = np.random.default_rng(seed)
    estimate, values = 0.0, np.zeros(resamples)
    for x, y in pairs:
        x, y = _checked(x), _checked(y)
        wins = (x[:, None] > y) + 0.5 * (x[:, None] == y)
        estimate += wins.mean() / len(pairs)
        counts = [rng.multinomial(len(z), np.full(len(z), 1 / len(z)), size=resamples) / len(z) for z in (x, y)]
        values += np.einsum("ri,ij,rj->r", counts[0], wins, counts[1], optimize=True) / len(pairs)
    low, high = _quantiles(values, level)
    return Interval(float(estimate), low, high)


def performance_profile(
    samples: Sequence[Array], thresholds: Array, *, resamples: int = RESAMPLES, seed: int = 0, level: float = LEVEL
) -> tuple[Array, Array, Array]:
    """Share of runs above each threshold, averaged over tasks, with its pointwise band [1]_.

    Args:
        samples: One array per task.
        thresholds: Shape (k,).
        resamples: Number of bootstrap resamples.
        seed: Of the resampling.
        level: Of the band, in (0, 1).

    Returns:
        Share, lower and upper end, each of shape (k,).

    References:
        .. [1] Agarwal et al., arXiv:2108.13264, section 4.2.
    """
    samples = [_checked(x) for x in samples]
    share = np.mean([(x[:, None] > thresholds).mean(axis=0) for x in samples], axis=0)
    rng = np.random.default_rng(seed)
    values = np.zeros((resamples, len(thresholds)))
    for x in samples:
        counts = rng.multinomial(len(x), np.full(len(x), 1 / len(x)), size=resamples) / len(x)
        values += counts @ (x[:, None] > thresholds) / len(samples)
    low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return share, low, high


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
    distances = [np.abs(z - np.median(z)) for z in (_checked(x), _checked(y))]
    if all(np.ptp(distance) == 0.0 for distance in distances):
        return 1.0 if distances[0][0] == distances[1][0] else 0.0
    return float(stats.f_oneway(*distances).pvalue)


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
    difference, error, freedom = _welch(x, y)
    if error == 0.0:
        inside = abs(difference) < margin
        return Equivalence(difference, difference, difference, float(not inside), float(inside))
    t = stats.t(freedom)
    half = t.ppf(1 - alpha) * error
    lower, upper = t.sf((difference + margin) / error), t.cdf((difference - margin) / error)
    outside = 2 * min(t.cdf((difference + margin) / error), t.sf((difference - margin) / error))
    return Equivalence(
        difference, difference - half, difference + half, float(max(lower, upper)), float(min(1.0, outside))
    )


def detectable_probability(n: int, m: int, alpha: float = 0.05) -> float:
    """Smallest P(X > Y) above 1/2 that the rank-sum test finds with a power of 80 % (Noether's formula [1]_).

    Infinite where the samples are so small that no order of their values is significant.

    References:
        .. [1] Noether, *Sample Size Determination for Some Common Nonparametric Tests*, JASA 82, 1987.
    """
    if 2 / math.comb(n + m, n) >= alpha:
        return math.inf
    z = stats.norm.ppf(1 - alpha / 2) + stats.norm.ppf(POWER)
    return min(1.0, 0.5 + float(z) * math.sqrt((n + m) / (12 * n * m)))


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
    _, error, freedom = _welch(x, y)
    if error == 0.0:
        return 0.0
    t = stats.t(freedom)
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
    x, y = (np.sort(rng.normal(size=(populations, k)), axis=1) for k in (n, m))
    a, b = (np.abs(z - np.median(z, axis=1, keepdims=True)) for z in (x, y))
    bound = stats.f(1, n + m - 2).isf(alpha)

    def power(ratio: float) -> float:
        wide = ratio * a
        within = ((wide - wide.mean(1, keepdims=True)) ** 2).sum(1) + ((b - b.mean(1, keepdims=True)) ** 2).sum(1)
        between = n * m / (n + m) * (wide.mean(1) - b.mean(1)) ** 2
        return float((between / within * (n + m - 2) > bound).mean())

    low, high = 1.0, 100.0
    if power(high) < POWER:
        return high
    while high / low > 1.005:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if power(middle) >= POWER else (middle, high)
    return high


def _welch(x: Array, y: Array) -> tuple[float, float, float]:
    """Difference in means, its standard error, and the degrees of freedom of Welch and Satterthwaite."""
    x, y = _checked(x), _checked(y)
    a, b = x.var(ddof=1) / len(x), y.var(ddof=1) / len(y)
    freedom = (a + b) ** 2 / (a**2 / (len(x) - 1) + b**2 / (len(y) - 1)) if a + b > 0 else math.inf
    return float(x.mean() - y.mean()), math.sqrt(a + b), float(freedom)


def _quantiles(values: Array, level: float) -> tuple[float, float]:
    """Ends of the percentile interval; infinite values count."""
    finite = bool(np.isfinite(values).all())  # there is nothing between two infinities
    ends = [(1 - level) / 2, (1 + level) / 2]
    low, high = np.quantile(values, ends) if finite else np.quantile(values, ends, method="nearest")
    return float(low), float(high)


def _checked(x: Array) -> Array:
    x = np.asarray(x, float)
    if x.ndim != 1 or len(x) < 2:
        raise ValueError(f"A sample must hold two values or more along one axis, got shape {x.shape}.")
    if np.isnan(x).any():
        raise ValueError("A sample must not hold NaN.")
    return x
