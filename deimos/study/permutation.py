"""Tests of populations by permutation: exact where the populations are equal, and close to it where they are not.

A sample is a float array of shape (..., n), one value per trained policy; leading axes hold many studies at once, each
tested by itself. Except in blocks, every statistic is divided by its own standard error before it is compared with
those of relabelled samples, so that the level also holds, asymptotically, where populations differ in what is not
tested [1]_.

References:
    .. [1] Chung and Romano, *Exact and Asymptotically Robust Permutation Tests*, Annals of Statistics 41, 2013.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from deimos.study.stats import POWER, Array, Statistic

Pairs = Sequence[tuple[int, int]]
"""Pairs of indices of samples: the first one is claimed to have more."""
Kind = Literal["superiority", "mean", "spread"]
"""What is compared, averaged over pairs: P(X > Y), ties counting half; means; or the logarithm of Gini's mean
difference between the values of a sample."""

Labels = NDArray[np.int_]

PERMUTATIONS = 1999
_VALUES_AT_ONCE = 4_000_000  # in an array of a block of studies and permutations
_KERNELS: dict[str, Callable[[Array], Array]] = {
    "superiority": lambda difference: np.sign(difference) / 2, "mean": lambda difference: difference, "spread": np.abs,
}  # fmt: skip


def superiority(pairs: Pairs) -> Statistic:
    """P(X > Y), ties counting half, averaged over pairs of samples."""

    def statistic(*samples: Array) -> Array:
        wins = [np.sign(samples[a][..., :, None] - samples[b][..., None, :]).mean(axis=(-2, -1)) for a, b in pairs]
        return 0.5 + np.mean(wins, axis=0) / 2

    return statistic


def superiority_in_blocks(pairs: Pairs) -> Statistic:
    """The same for samples whose i-th values belong together: how often the first has more, within their blocks."""

    def statistic(*samples: Array) -> Array:
        return 0.5 + np.mean([np.sign(samples[a] - samples[b]).mean(axis=-1) for a, b in pairs], axis=0) / 2

    return statistic


def log_spread_ratio(pairs: Pairs) -> Statistic:
    """Logarithm of the ratio of two samples' mean differences between their values (Gini's), averaged over pairs.

    0 where neither has a spread, infinite where one of the two has none.
    """

    def statistic(*samples: Array) -> Array:
        spreads = [np.abs(x[..., :, None] - x[..., None, :]).mean(axis=(-2, -1)) for x in samples]
        spreads = [x * n / (n - 1) for x, n in zip(spreads, (x.shape[-1] for x in samples), strict=True)]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = [np.where(spreads[a] == spreads[b], 0.0, np.log(spreads[a]) - np.log(spreads[b]))
                      for a, b in pairs]  # fmt: skip
            return np.mean(ratios, axis=0)

    return statistic


def p_values(
    samples: Sequence[Array], pairs: Pairs, kind: Kind, *, permutations: int | None = None, seed: int = 0
) -> tuple[Array, Array]:
    """One-sided p-values of the first sample of each pair having more than the second, and of its having less.

    The labels of all samples together are permuted. The samples' own order counts as one permutation, so that the test
    is exact where all of them come from one population.

    Args:
        samples: Each of shape (..., n_i) with the same leading axes, n_i at least 2.
        pairs: The differences of each are averaged.
        kind: What is compared. For ``spread``, the medians of the samples are subtracted first.
        permutations: How many random ones; ``None``: ``PERMUTATIONS``.
        seed: Of the permutations.

    Returns:
        Small where the first ones have more, and small where they have less, each of shape (...).

    Raises:
        ValueError: If a sample has fewer than two values, or one that is not finite.
    """
    _check(samples)
    if kind == "spread":
        samples = [x - np.median(x, axis=-1, keepdims=True) for x in samples]
    sizes = np.array([x.shape[-1] for x in samples])
    pooled = np.concatenate(samples, axis=-1)
    shape, values = pooled.shape[:-1], pooled.reshape(-1, pooled.shape[-1])
    values = values / np.maximum(np.abs(values).max(axis=1, keepdims=True), 1e-300)  # for bounds on rounding errors
    labels = np.tile(np.repeat(np.arange(len(sizes)), sizes), ((permutations or PERMUTATIONS) + 1, 1))
    labels[1:] = np.random.default_rng(seed).permuted(labels[1:], axis=1)
    found = np.empty((len(values), len(labels)))
    for studies, drawn in _blocks(*found.shape, values.shape[-1]):
        found[studies, drawn] = _studentized(values[studies], labels[drawn], sizes, pairs, kind)
    slack = 1e-9 * (1 + np.abs(found[:, :1]))  # the same value, summed in another order
    more, less = (found >= found[:, :1] - slack).mean(axis=1), (found <= found[:, :1] + slack).mean(axis=1)
    return more.reshape(shape), less.reshape(shape)


def p_values_in_blocks(
    samples: Sequence[Array], statistic: Statistic, *, permutations: int | None = None, seed: int = 0
) -> tuple[float, float]:
    """One-sided p-values of a statistic being as large as it is, and as small, of samples that are compared in blocks.

    The i-th values of all samples are a block (policies that began with the same one), and labels are permuted within
    blocks alone: of two samples, the signs of their differences are flipped. Where there are not more such orders than
    ``permutations`` the p-values are exact.

    Args:
        samples: At least two, each of shape (n,).
        statistic: Of the samples; the larger, the more has what is claimed to have more.
        permutations: How many random ones at most; ``None``: ``PERMUTATIONS``.
        seed: Of the permutations.

    Raises:
        ValueError: If samples have fewer than two values, different numbers of them, or one that is not finite.
    """
    _check(samples)
    if len({len(x) for x in samples}) > 1:
        raise ValueError(f"samples must be of the same blocks, got {', '.join(str(len(x)) for x in samples)} values.")
    more, less = (
        stats.permutation_test(
            samples, lambda *x, axis: statistic(*x), permutation_type="samples", vectorized=True,
            n_resamples=permutations or PERMUTATIONS, alternative=side, rng=np.random.default_rng(seed),
        ).pvalue
        for side in ("greater", "less")
    )  # fmt: skip
    return float(more), float(less)


@lru_cache
def detectable_spread(n: int, m: int, alpha: float = 0.05) -> float:
    """Smallest ratio of standard deviations of normal samples that the two-sided test finds with a power of 80 %.

    Simulated, to some 5 %; with five policies a side to some 12 %. Infinite where a ratio of 100 is not found.
    """
    # With few policies, power rises slowly with the ratio: losses from few permutations or studies would shift it.
    cost = (n + m) ** 2
    studies = min(1000, max(400, 100_000 // cost))
    permutations = min(PERMUTATIONS, max(199, 200_000 // cost))
    x, y = (np.random.default_rng(i).normal(size=(studies, k)) for i, k in enumerate((n, m)))

    def lacking(log_ratio: float) -> float:
        found, _ = p_values([math.exp(log_ratio) * x, y], [(0, 1)], "spread", permutations=permutations)
        return POWER - float((2 * found <= alpha).mean())

    top = math.log(100)
    return math.inf if lacking(top) > 0 else math.exp(optimize.bisect(lacking, 0.0, top, xtol=0.03))


def _check(samples: Sequence[Array]) -> None:
    """Refuse what no order could be compared with, so that each would look more extreme than all others."""
    if min(x.shape[-1] for x in samples) < 2:
        sizes = ", ".join(str(x.shape[-1]) for x in samples)
        raise ValueError(f"A sample must hold two values or more, got samples of {sizes}.")
    if not all(np.isfinite(x).all() for x in samples):
        raise ValueError("A sample must hold finite values; leave out policies whose value is not known.")


def _blocks(studies: int, permutations: int, number: int) -> Iterator[tuple[slice, slice]]:
    drawn = max(1, _VALUES_AT_ONCE // number**2)
    own = max(1, _VALUES_AT_ONCE // (number * min(drawn, permutations)))
    for start in range(0, permutations, drawn):
        for first in range(0, studies, own):
            yield slice(first, first + own), slice(start, start + drawn)


def _studentized(values: Array, labels: Labels, sizes: Labels, pairs: Pairs, kind: Kind) -> Array:
    """The statistic of every study and permutation over its standard error, shape (studies, permutations).

    All kinds are U-statistics: means of a kernel over pairs of policies. A policy's part is the mean of the kernel over
    its partners, and the variance of these parts within every sample is that of the statistic (Hoeffding's; for
    P(X > Y) it is DeLong's).
    """
    groups, weight = len(sizes), np.zeros((len(sizes), len(sizes)))
    for a, b in pairs:
        weight[a, b] += 1 / len(pairs)
    partners = np.diag(1 / (sizes - 1)) if kind == "spread" else (weight - weight.T) / sizes
    kernel = _KERNELS[kind](values[:, :, None] - values[:, None, :])  # (studies, i, j)
    shares = partners[labels[:, :, None], labels[:, None, :]]  # (permutations, i, j)
    part = np.matmul(kernel.transpose(1, 0, 2), shares.transpose(1, 2, 0))  # (i, studies, permutations)
    part, own = part.transpose(2, 1, 0), (labels[:, :, None] == np.arange(groups)).astype(float)
    mean = np.matmul(part, own) / sizes  # (permutations, studies, group)
    variance = np.maximum(np.matmul(part**2, own) - sizes * mean**2, 0.0) / (sizes * (sizes - 1))
    if kind != "spread":
        return _over(mean.sum(axis=-1).T / 2, variance.sum(axis=-1).T)
    sign = weight.sum(axis=1) - weight.sum(axis=0)
    gini = np.maximum(mean, 1e-12)
    return _over((sign * np.log(gini)).sum(axis=-1).T, (4 * sign**2 * variance / gini**2).sum(axis=-1).T)


def _over(estimate: Array, variance: Array) -> Array:
    """An estimate over its standard error; very large where there is an effect and no error."""
    return np.where(np.abs(estimate) < 1e-12, 0.0, estimate / np.sqrt(np.maximum(variance, 1e-20)))
