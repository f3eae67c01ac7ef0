"""How often the intervals of ``deimos.study.stats`` contain the truth, on simulated populations."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import integrate
from scipy import stats as scipy_stats

from deimos.study import permutation, stats
from deimos.study.stats import Array, Interval

LOGNORMAL_SIGMA = 1.0
POPULATIONS = ("normal", "lognormal", "bimodal")
NONE = 0.45  # of the bimodal populations
SPREAD = 2.0  # true ratio of the mean differences, and of the standard deviations of the normal populations


@dataclass(frozen=True)
class Coverage:
    """Share of simulated populations whose 95 % interval contains the truth."""

    statistic: str
    """The statistic."""
    interval: str
    """The interval."""
    normal: float
    """In normal populations."""
    lognormal: float
    """In populations whose logarithm is normal with a standard deviation of 1."""
    bimodal: float
    """In populations of which 45 % are 0 and the others lognormal."""


def simulate(n: int = 10, populations: int = 2000, resamples: int = 2000, seed: int = 0) -> list[Coverage]:
    """Measure the coverage of every kind of interval that the report prints.

    Args:
        n: Policies in a population.
        populations: How many are simulated.
        resamples: Bootstrap resamples of each.
        seed: Random seed.
    """
    spread = permutation.log_spread_ratio([(0, 1)])
    kinds: list[tuple[str, str, Callable[[Array, Array, int], Interval], Callable[[str], float]]] = [
        ("IQM", "percentile", lambda x, y, s: stats.bootstrap([x], stats.iqm, resamples=resamples, seed=s), _true_iqm),
        ("median", "percentile", lambda x, y, s: stats.bootstrap([x], _median, resamples=resamples, seed=s),
         lambda kind: float(_quantile(kind)(0.5))),
        ("mean", "percentile", lambda x, y, s: stats.bootstrap([x], _mean, resamples=resamples, seed=s), _true_mean),
        ("mean", "BCa", lambda x, y, s: _bca(x, resamples, s), _true_mean),
        ("mean", "bootstrap-t", lambda x, y, s: stats.bootstrap_t(x, resamples=resamples, seed=s), _true_mean),
        ("ratio of spreads", "percentile of the logarithm",
         lambda x, y, s: stats.bootstrap([SPREAD * x, y], spread, resamples=resamples, seed=s),
         lambda kind: math.log(SPREAD)),
        ("P(X > Y)", "percentile", lambda x, y, s: stats.probability_of_improvement(
            [(x, y)], resamples=resamples, seed=s), lambda kind: 0.5),
        ("share", "exact", lambda x, y, s: stats.share(x <= 0.0), lambda kind: float(_below(kind))),
    ]  # fmt: skip
    hits = {kind: np.zeros(len(kinds)) for kind in POPULATIONS}
    rng = np.random.default_rng(seed)
    for number in range(populations):
        share = rng.random((2, n))
        for kind in POPULATIONS:
            x, y = _quantile(kind)(share)
            for i, (_, _, interval, truth) in enumerate(kinds):
                found = interval(x, y, number)
                hits[kind][i] += found.low <= truth(kind) <= found.high
    shares = {kind: counts / populations for kind, counts in hits.items()}
    return [
        Coverage(name, how, *(float(shares[kind][i]) for kind in POPULATIONS))
        for i, (name, how, _, _) in enumerate(kinds)
    ]


def _bca(x: Array, resamples: int, seed: int) -> Interval:
    """The bias-corrected and accelerated interval of a mean, which the report does not use."""
    if not np.ptp(x):  # all policies are at 0: scipy would divide by 0
        return Interval(float(x[0]), float(x[0]), float(x[0]))
    found = scipy_stats.bootstrap(
        (x,), np.mean, n_resamples=resamples, method="BCa", vectorized=True, rng=np.random.default_rng(seed)
    )
    return Interval(float(x.mean()), *map(float, found.confidence_interval))


def _median(x: Array) -> Array:
    return np.median(x, axis=-1)


def _mean(x: Array) -> Array:
    return x.mean(axis=-1)


def _quantile(kind: str) -> Callable[[Array | float], Array]:
    """The quantile function of a population."""
    if kind == "normal":
        return scipy_stats.norm.ppf
    positive = scipy_stats.lognorm(LOGNORMAL_SIGMA).ppf
    if kind == "lognormal":
        return positive
    return lambda share: np.where(np.less(share, NONE), 0.0, positive(np.maximum(share - NONE, 0.0) / (1 - NONE)))


def _below(kind: str) -> float:
    """Share of a population that is not above 0."""
    return {"normal": 0.5, "lognormal": 0.0, "bimodal": NONE}[kind]


def _true_mean(kind: str) -> float:
    mean = math.exp(LOGNORMAL_SIGMA**2 / 2)
    return {"normal": 0.0, "lognormal": mean, "bimodal": (1 - NONE) * mean}[kind]


@lru_cache
def _true_iqm(kind: str) -> float:
    """Mean of a population between its quartiles."""
    points = [NONE] if kind == "bimodal" else None
    return 2 * integrate.quad(_quantile(kind), 0.25, 0.75, points=points)[0]
