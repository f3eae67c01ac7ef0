"""Statistics of populations of runs. The unit is one trained policy; robots and episodes are not replicates.

Samples are float arrays of shape (n,), one value per policy, n at least 2, without NaN; ``ValueError`` otherwise. Every
interval is two-sided, at ``LEVEL`` unless stated; every bootstrap draws ``resamples`` (``None``: ``RESAMPLES``) with
its ``seed``.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

Array = NDArray[np.float64]
Statistic = Callable[..., Array]
"""Of one array per sample, each of shape (..., n_i), gives an array of shape (...)."""

RESAMPLES = 10_000
LEVEL = 0.95
ENDS = ((1 - LEVEL) / 2, (1 + LEVEL) / 2)
POWER = 0.8


@dataclass(frozen=True)
class Interval:
    """An estimate with its interval, which has NaN as its ends where there is none; formats as its numbers do."""

    estimate: float
    """Estimate from the samples themselves."""
    low: float
    """Lower end."""
    high: float
    """Upper end."""

    def __format__(self, form: str) -> str:
        if math.isnan(self.low):
            return format(self.estimate, form)
        return f"{self.estimate:{form}} [{self.low:{form}}, {self.high:{form}}]"


def iqm(x: Array) -> Array:
    """Interquartile mean along the last axis: the mean without the lowest and the highest quarter [1]_.

    A quarter is rounded down to whole values.

    References:
        .. [1] Agarwal et al., *Deep Reinforcement Learning at the Edge of the Statistical Precipice*,
           NeurIPS 2021. arXiv:2108.13264
    """
    return stats.trim_mean(x, 0.25, axis=-1)


iqr: Statistic = partial(stats.iqr, axis=-1)
"""Range between the quartiles along the last axis, by linear interpolation of the order statistics."""


def cvar(x: Array, share: float = 0.2) -> Array:
    """Mean of the highest ``share`` of the values along the last axis; the boundary value counts by its fraction [1]_.

    As an estimate of a population's tail, ``share`` in (0, 1] of it, it is too low in small samples.

    References:
        .. [1] Rockafellar and Uryasev, *Conditional value-at-risk for general loss distributions*,
           Journal of Banking & Finance 26, 2002, proposition 8.
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share must be in (0, 1], got {share}.")
    weight = np.clip(share * x.shape[-1] - np.arange(x.shape[-1]), 0.0, 1.0)
    return -np.sort(-x, axis=-1) @ weight / weight.sum()


def distribution(
    samples: Sequence[Array], statistic: Statistic, *, resamples: int | None = None, seed: int = 0, paired: bool = False
) -> Array:
    """A statistic of resamples that are drawn from every sample with replacement, shape (resamples,).

    This is the stratified bootstrap, with one sample per stratum (method or task). ``paired`` samples have the same
    length, and their values are drawn together.
    """
    with np.errstate(invalid="ignore"):  # from scipy's own interval, which is not used, where a value is infinite
        return stats.bootstrap(
            [_checked(x) for x in samples], lambda *x, axis: statistic(*x), vectorized=True,
            n_resamples=resamples or RESAMPLES, method="percentile", rng=np.random.default_rng(seed), paired=paired,
        ).bootstrap_distribution  # fmt: skip


def bootstrap(
    samples: Sequence[Array], statistic: Statistic, *, resamples: int | None = None, seed: int = 0,
    paired: bool = False, level: float = LEVEL,
) -> Interval:  # fmt: skip
    """Percentile interval of a statistic by the stratified bootstrap, at ``level``; see ``distribution``."""
    values = distribution(samples, statistic, resamples=resamples, seed=seed, paired=paired)
    return Interval(float(statistic(*map(_checked, samples))), *_ends(values, level))


def bootstrap_t(x: Array, *, resamples: int | None = None, seed: int = 0) -> Interval:
    """Interval of the mean by the studentised bootstrap [1]_, the one for small and skewed samples.

    References:
        .. [1] Efron and Tibshirani, *An Introduction to the Bootstrap*, 1993, section 12.5.
    """
    x = _checked(x)
    mean, error = float(x.mean()), float(stats.sem(x))
    if _constant(x):
        return Interval(mean, mean, mean)

    def student(draws: Array) -> Array:
        away = draws.mean(axis=-1) - mean
        errors = np.where(_constant(draws), 0.0, stats.sem(draws, axis=-1))
        with np.errstate(divide="ignore", invalid="ignore"):  # infinite where all drawn values are the same
            return np.where(away == 0.0, 0.0, away / errors)

    low, high = _ends(distribution([x], student, resamples=resamples, seed=seed))
    return Interval(mean, mean - high * error, mean - low * error)


def student(x: Array) -> Interval:
    """Student's interval of the mean: exact for normal samples, and the one for a handful of differences of pairs."""
    x = _checked(x)
    mean, error = float(x.mean()), float(stats.sem(x))
    if _constant(x):
        return Interval(mean, mean, mean)
    return Interval(mean, *map(float, stats.t.interval(LEVEL, len(x) - 1, mean, error)))


def share(holds: NDArray[np.bool_]) -> Interval:
    """Share of the policies that something holds for, with its exact interval [1]_.

    The bootstrap has no interval where it holds for all or for none.

    Args:
        holds: One truth value per policy, shape (n,), n at least 1.

    References:
        .. [1] Clopper and Pearson, *The Use of Confidence or Fiducial Limits*, Biometrika 26, 1934.
    """
    if not len(holds):
        raise ValueError("holds must have a value for one policy or more, got none.")
    found = stats.binomtest(int(holds.sum()), len(holds))
    interval = found.proportion_ci(LEVEL)
    return Interval(float(found.statistic), float(interval.low), float(interval.high))


def share_of_pairs(x: Array, y: Array) -> Interval:
    """P(X > Y) of values that belong together, ties counting half, with the exact interval of ``share``.

    Ties count as lost at its lower end and as won at its upper one.
    """
    x, y = _checked(x), _checked(y)
    if len(x) != len(y):
        raise ValueError(f"x and y must be of the same policies, got {len(x)} and {len(y)} values.")
    lost, won = share(x > y), share(x >= y)
    return Interval((lost.estimate + won.estimate) / 2, lost.low, won.high)


def probability_of_improvement(
    pairs: Sequence[tuple[Array, Array]], *, resamples: int | None = None, seed: int = 0
) -> Interval:
    """P(X > Y), ties counting half, averaged over tasks, each with a pair: U / (n m) of Mann and Whitney [1]_.

    References:
        .. [1] Agarwal et al., arXiv:2108.13264, section 4.3.
    """
    if not pairs:
        raise ValueError("pairs must hold the samples of one task or more, got none.")
    rng, resamples = np.random.default_rng(seed), resamples or RESAMPLES
    estimate, values = 0.0, np.zeros(resamples)
    for x, y in pairs:
        x, y = _checked(x), _checked(y)
        wins = (x[:, None] > y) + 0.5 * (x[:, None] == y)
        estimate += wins.mean() / len(pairs)
        drawn = [_drawn(len(z), resamples, rng) for z in (x, y)]
        values += np.einsum("ri,ij,rj->r", drawn[0], wins, drawn[1], optimize=True) / len(pairs)
    return Interval(float(estimate), *_ends(values))


def performance_profile(
    samples: Sequence[Array], thresholds: Array, *, resamples: int | None = None, seed: int = 0
) -> tuple[Array, Array, Array]:
    """Share of runs above each threshold, averaged over tasks, with its pointwise band [1]_.

    Thresholds, share, lower and upper end have shape (k,); there is a sample for each task.

    References:
        .. [1] Agarwal et al., arXiv:2108.13264, section 4.2.
    """
    if not samples:
        raise ValueError("samples must hold that of one task or more, got none.")
    rng, resamples = np.random.default_rng(seed), resamples or RESAMPLES
    above = [_checked(x)[:, None] > thresholds for x in samples]
    values = sum(_drawn(len(x), resamples, rng) @ x / len(samples) for x in above)
    low, high = np.quantile(values, ENDS, axis=0)
    return np.mean([x.mean(axis=0) for x in above], axis=0), low, high


def _drawn(n: int, resamples: int, rng: np.random.Generator) -> Array:
    """Share that each of n values has in every resample of them, shape (resamples, n)."""
    return rng.multinomial(n, np.full(n, 1 / n), size=resamples) / n


def detectable_probability(n: int, m: int, alpha: float = 0.05) -> float:
    """Smallest P(X > Y) above 1/2 that the rank-sum test finds with a power of 80 % (Noether's formula [1]_).

    Infinite where the samples are so small that no order of their values is significant.

    References:
        .. [1] Noether, *Sample Size Determination for Some Common Nonparametric Tests*, JASA 82, 1987.
    """
    if 2 / math.comb(n + m, n) > alpha:
        return math.inf
    z = stats.norm.ppf(1 - alpha / 2) + stats.norm.ppf(POWER)
    return min(1.0, 0.5 + float(z) * math.sqrt((n + m) / (12 * n * m)))


def detectable_share(n: int, alpha: float = 0.05) -> float:
    """Smallest share above 1/2 that the two-sided sign test finds with a power of 80 %.

    Infinite where even n of n is not significant.
    """
    enough = [count for count in range(n) if 2 * stats.binom.cdf(count, n, 0.5) <= alpha]
    return 1 - float(stats.beta.ppf(1 - POWER, enough[-1] + 1, n - enough[-1])) if enough else math.inf


def detectable_mean(x: Array) -> float:
    """Smallest mean that ``student`` tells from 0 with a power of 80 %, in normal samples of ``x``'s size and spread.

    By the noncentral t distribution [1]_.

    References:
        .. [1] Cohen, *Statistical Power Analysis for the Behavioral Sciences*, 2nd ed., 1988, chapter 2.
    """
    x = _checked(x)
    n = len(x)
    critical = float(stats.t.ppf(ENDS[1], n - 1))

    def lacking(effect: float) -> float:
        return POWER - float(stats.nct.sf(critical, n - 1, effect * math.sqrt(n)))

    return optimize.brentq(lacking, 0.0, 20.0) * float(x.std(ddof=1))


def _ends(values: Array, level: float = LEVEL) -> tuple[float, float]:
    """Ends of the percentile interval; infinite values count, and there is nothing between two of them."""
    ends = (1 - level) / 2, (1 + level) / 2
    low, high = np.quantile(values, ends, method="linear" if np.isfinite(values).all() else "nearest")
    return float(low), float(high)


def _constant(x: Array) -> Array:
    """Whether all values along the last axis are equal: rounding leaves equal values a standard error above 0."""
    return x.max(axis=-1) == x.min(axis=-1)


def _checked(x: Array) -> Array:
    x = np.asarray(x, float)
    if x.ndim != 1 or len(x) < 2:
        raise ValueError(f"A sample must hold two values or more along one axis, got shape {x.shape}.")
    if np.isnan(x).any():
        raise ValueError("A sample must not hold NaN.")
    return x
