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
SPREAD = 2.0  # true ratio of the mean differences, and of the standard deviations of the normal populations


@dataclass(frozen=True)
class Coverage:
    """Share of simulated populations whose 95 % interval contains the truth."""

    statistic: str
    """What is estimated."""
    interval: str
    """How."""
    normal: float
    """In normal populations."""
    lognormal: float
    """In populations whose logarithm is normal with a standard deviation of 1."""


def simulate(n: int = 10, populations: int = 2000, resamples: int = 2000, seed: int = 0) -> list[Coverage]:
    """Measure the coverage of every kind of interval that the report prints.

    Args:
        n: Policies in a population.
        populations: How many are simulated.
        resamples: Bootstrap resamples of each.
        seed: Of it all.
    """
    spread = permutation.log_spread_ratio([(0, 1)])
    kinds: list[tuple[str, str, Callable[[Array, Array, int], Interval], Callable[[str], float]]] = [
        ("IQM", "percentile", lambda x, y, s: stats.bootstrap([x], stats.iqm, resamples=resamples, seed=s), _true_iqm),
        ("median", "percentile", lambda x, y, s: stats.bootstrap([x], _median, resamples=resamples, seed=s),
         lambda kind: 0.0 if kind == "normal" else 1.0),
        ("mean", "percentile", lambda x, y, s: stats.bootstrap([x], _mean, resamples=resamples, seed=s), _true_mean),
        ("mean", "BCa", lambda x, y, s: _bca(x, resamples, s), _true_mean),
        ("mean", "bootstrap-t", lambda x, y, s: stats.bootstrap_t(x, resamples=resamples, seed=s), _true_mean),
        ("ratio of spreads", "percentile of the logarithm",
         lambda x, y, s: stats.bootstrap([SPREAD * x, y], spread, resamples=resamples, seed=s),
         lambda kind: math.log(SPREAD)),
        ("P(X > Y)", "percentile", lambda x, y, s: stats.probability_of_improvement(
            [(x, y)], resamples=resamples, seed=s), lambda kind: 0.5),
    ]  # fmt: skip
    hits = {kind: np.zeros(len(kinds)) for kind in ("normal", "lognormal")}
    rng = np.random.default_rng(seed)
    for number in range(populations):
        z = rng.normal(size=(2, n))
        for kind, (x, y) in {"normal": z, "lognormal": np.exp(LOGNORMAL_SIGMA * z)}.items():
            for i, (_, _, interval, truth) in enumerate(kinds):
                found = interval(x, y, number)
                hits[kind][i] += found.low <= truth(kind) <= found.high
    shares = {kind: counts / populations for kind, counts in hits.items()}
    return [
        Coverage(name, how, float(shares["normal"][i]), float(shares["lognormal"][i]))
        for i, (name, how, _, _) in enumerate(kinds)
    ]


def _bca(x: Array, resamples: int, seed: int) -> Interval:
    """The bias-corrected and accelerated interval of a mean, which the report does not use."""
    found = scipy_stats.bootstrap(
        (x,), np.mean, n_resamples=resamples, method="BCa", vectorized=True, rng=np.random.default_rng(seed)
    )
    return Interval(float(x.mean()), *map(float, found.confidence_interval))


def _median(x: Array) -> Array:
    return np.median(x, axis=-1)


def _mean(x: Array) -> Array:
    return x.mean(axis=-1)


def _true_mean(kind: str) -> float:
    return 0.0 if kind == "normal" else math.exp(LOGNORMAL_SIGMA**2 / 2)


@lru_cache
def _true_iqm(kind: str) -> float:
    """Mean of a population between its quartiles."""
    if kind == "normal":
        return 0.0
    quantile = scipy_stats.lognorm(LOGNORMAL_SIGMA).ppf
    return 2 * integrate.quad(quantile, 0.25, 0.75)[0]
