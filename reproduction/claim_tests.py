"""The predeclared tests that claims are made of. Each gives a finding, or nothing where its data are missing."""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats as scipy_stats

from deimos.study import stats
from deimos.study.data import Data, Where
from deimos.study.stats import Array, Interval
from reproduction import significance
from reproduction.claims import Finding

LEAST = 3  # policies in a sample, below which nothing is tested
PROBABILITY = 0.75  # smallest P(X > Y) of interest
SPREAD = 2.0  # smallest ratio of spreads of interest
FACTOR = 2.0  # crashes within this factor are equivalent
REWARD_SHARE = 0.05  # rewards within this share of Uniform's median are equivalent
STEPS = {"log_crashes": math.log(FACTOR)}


def more(data: Data, where: Where, metric: str, a: str, b: str) -> list[Finding]:
    """Policies of ``a`` have more of ``metric`` than those of ``b``: rank-sum test, P(a > b)."""
    return compare(f"{_name(metric)}: {a} > {b}", where, data.sample(where, a, metric), data.sample(where, b, metric))


def compare(what: str, where: Where | str, x: Array, y: Array) -> list[Finding]:
    """Values of one sample are larger than those of another: rank-sum test, P(x > y)."""
    if min(len(x), len(y)) < LEAST:
        return []
    interval = stats.probability_of_improvement([(x, y)])
    p = significance.mann_whitney(x, y)
    return [Finding(
        what=what, where=where, effect="P(x > y)", interval=interval,
        p_for=p if interval.estimate > 0.5 else 1.0, p_against=p if interval.estimate < 0.5 else 1.0,
        detectable=lambda alpha: stats.detectable_probability(len(x), len(y), alpha), wanted=PROBABILITY,
        n=(len(x), len(y)),
    )]  # fmt: skip


def same(data: Data, where: Where, metric: str, a: str, b: str) -> list[Finding]:
    """Policies of ``a`` and ``b`` are equivalent in ``metric``: two one-sided tests."""
    x, y = data.sample(where, a, metric), data.sample(where, b, metric)
    margin = STEPS.get(metric) or REWARD_SHARE * abs(_median(data.sample(where, "uniform", metric)))
    return alike(f"{_name(metric)}: {a} = {b}", where, x, y, margin)


def alike(what: str, where: Where | str, x: Array, y: Array, margin: float) -> list[Finding]:
    """The means of two samples differ by less than a margin: two one-sided tests."""
    if min(len(x), len(y)) < LEAST or not margin > 0:
        return []
    found = significance.equivalence(x, y, margin)
    return [Finding(
        what=what, where=where, effect=f"difference, 90 %, within {margin:.2g}",
        interval=Interval(found.difference, found.low, found.high), p_for=found.p_same, p_against=found.p_other,
        detectable=lambda alpha: significance.detectable_margin(x, y, alpha), wanted=margin, n=(len(x), len(y)),
    )]  # fmt: skip


def wider(data: Data, where: Where, metric: str, a: str, b: str) -> list[Finding]:
    """Policies of ``a`` vary more in ``metric`` than those of ``b``: Brown and Forsythe's test."""
    x, y = data.sample(where, a, metric), data.sample(where, b, metric)
    return spread(f"spread of {_name(metric)}: {a} > {b}", where, x, y)


def spread(what: str, where: Where | str, x: Array, y: Array) -> list[Finding]:
    """One sample varies more than another: Brown and Forsythe's test; the interval of the ratio only describes."""
    if min(len(x), len(y)) < LEAST:
        return []
    log_ratio = stats.bootstrap([x, y], significance.log_iqr_ratio)
    with np.errstate(over="ignore"):
        interval = Interval(*np.exp([log_ratio.estimate, log_ratio.low, log_ratio.high]).tolist())
    distance = [np.abs(z - np.median(z)).mean() for z in (x, y)]
    p = significance.brown_forsythe(x, y)
    return [Finding(
        what=what, where=where, effect="ratio of IQRs", interval=interval,
        p_for=p if distance[0] > distance[1] else 1.0, p_against=p if distance[0] < distance[1] else 1.0,
        detectable=lambda alpha: significance.detectable_spread(len(x), len(y), round(alpha, 6)), wanted=SPREAD,
        n=(len(x), len(y)),
    )]  # fmt: skip


def positive(what: str, where: Where | str, effect: str, x: Array, wanted: float, at: float = 0.0) -> list[Finding]:
    """The mean of a sample is above ``at``: one-sample t test, with the interval by the bootstrap-t."""
    if len(x) < LEAST:
        return []
    interval = stats.bootstrap_t(x)
    if np.ptp(x) == 0.0:
        p_for, p_against = float(x.mean() <= at), float(x.mean() >= at)
    else:
        p_for, p_against = (
            float(min(1.0, 2 * scipy_stats.ttest_1samp(x, at, alternative=way).pvalue)) for way in ("greater", "less")
        )
    return [Finding(
        what=what, where=where, effect=effect, interval=interval, p_for=p_for, p_against=p_against,
        detectable=lambda alpha: significance.detectable_mean(x, alpha), wanted=wanted, n=(len(x),),
    )]  # fmt: skip


def paired_more(what: str, where: Where | str, x: Array, y: Array) -> list[Finding]:
    """Each policy has more in the first sample than in the second: Wilcoxon's signed ranks on the pairs."""
    if len(x) < LEAST or len(x) != len(y):
        return []
    difference = x - y
    moved = difference[difference != 0]
    p = 1.0 if len(moved) == 0 else float(scipy_stats.wilcoxon(moved).pvalue)
    middle = stats.bootstrap([difference], lambda z: np.median(z, axis=-1))
    sign = np.sign(scipy_stats.rankdata(np.abs(moved)) @ np.sign(moved)) if len(moved) else 0.0
    return [Finding(
        what=what, where=where, effect="median log ratio", interval=middle,
        p_for=p if sign > 0 else 1.0, p_against=p if sign < 0 else 1.0,
        detectable=lambda alpha: _detectable_shift(difference, alpha), wanted=math.log(FACTOR), n=(len(x),),
    )]  # fmt: skip


def higher(what: str, where: Where | str, x: Array, y: Array) -> list[Finding]:
    """The highest value of both samples is one of ``x``'s: how many of one lie above all of the other (Rosenbaum)."""
    if min(len(x), len(y)) < LEAST:
        return []
    above = float((x > y.max()).sum() - (y > x.max()).sum())
    return [Finding(
        what=what, where=where, effect="policies above all of the other's (negative: the other's)",
        interval=Interval(above, math.nan, math.nan), p_for=significance.rosenbaum(x, y),
        p_against=significance.rosenbaum(y, x), wanted=PROBABILITY, n=(len(x), len(y)),
        detectable=lambda alpha: significance.detectable_reach(len(x), len(y), alpha),
    )]  # fmt: skip


def mostly(what: str, where: Where | str, holds: NDArray[np.bool_]) -> list[Finding]:
    """Something holds for most policies: exact sign test, with Clopper and Pearson's interval of the share."""
    if len(holds) < LEAST:
        return []
    n, count = len(holds), int(holds.sum())
    interval = scipy_stats.binomtest(count, n).proportion_ci(stats.LEVEL)
    return [Finding(
        what=what, where=where, effect="share of policies", interval=Interval(count / n, interval.low, interval.high),
        p_for=float(scipy_stats.binom.sf(count - 1, n, 0.5)), p_against=float(scipy_stats.binom.cdf(count, n, 0.5)),
        detectable=lambda alpha: 0.5 + significance.detectable_sign(n, alpha), wanted=PROBABILITY, n=(n,),
    )]  # fmt: skip


def resampled(
    what: str, where: Where | str, effect: str, samples: list[Array], statistic: stats.Statistic, wanted: float
) -> list[Finding]:
    """A statistic of several samples is positive: its bootstrap distribution."""
    if min((len(x) for x in samples), default=0) < LEAST:
        return []
    values = stats.distribution(samples, statistic)
    low, high = np.quantile(values, [0.025, 0.975])
    p_for, p_against = above_zero(values)
    return [Finding(
        what=what, where=where, effect=effect, interval=Interval(float(statistic(*samples)), float(low), float(high)),
        p_for=p_for, p_against=p_against, detectable=by_error(float(values.std())), wanted=wanted,
        n=tuple(len(x) for x in samples),
    )]  # fmt: skip


def above_zero(values: Array) -> tuple[float, float]:
    """Two-sided p-values for and against a statistic above 0, from its bootstrap distribution."""
    below, above = (((side * values <= 0).sum() + 1) / (len(values) + 1) for side in (1, -1))
    return float(min(1.0, 2 * below)), float(min(1.0, 2 * above))


def by_error(error: float) -> Callable[[float], float]:
    """Smallest effect that is found with a power of 80 %, from its standard error, as if it were normal."""
    power = scipy_stats.norm.ppf(stats.POWER)
    return lambda alpha: float((scipy_stats.norm.ppf(1 - alpha / 2) + power) * error)


def by_ranks(samples: Sequence[Array]) -> Callable[[float], float]:
    """Smallest P(x > y) that a rank-sum test of the smallest two samples finds; a guide where no formula is known."""
    n, m = sorted(map(len, samples))[:2]
    return lambda alpha: stats.detectable_probability(n, m, alpha)


def late_crashes(crashes: Array, share: float = 0.1) -> float:
    """log(1 + crashes per 10^6 transitions) over the last part of a training, from those per 1000."""
    return math.log1p(1000 * _tail(crashes, share).mean())


def change(crashes: Array, share: float = 0.2) -> float:
    """Change of log(1 + crashes per 10^6 transitions) from the first part of a training to the last."""
    count = len(_tail(crashes, share))
    return math.log1p(1000 * crashes[-count:].mean()) - math.log1p(1000 * crashes[:count].mean())


def final_slope(crashes: Array, share: float = 0.2) -> float:
    """Change of log(1 + crashes per 10^6 transitions) over the last part of a training, by a straight line."""
    y = np.log1p(1000 * _tail(crashes, share))
    return float(np.polyfit(np.linspace(0.0, 1.0, len(y)), y, 1)[0]) if len(y) > 1 else math.nan


def of_curves(
    data: Data, environment: str, method: str, number: Callable[[Array], float], column: str = "crashes_per_1000"
) -> Array:
    """A number of every training curve of a method."""
    values = np.array([number(curve) for curve in data.curves(environment, method, column)], float)
    return values[~np.isnan(values)]


def both(data: Data, environment: str, period: int, method: str, metric: str) -> tuple[Array, Array]:
    """A metric of the same policies under the Naive and under the Adversary, seed by seed."""
    naive, attacked = (Where(environment, goals, period) for goals in ("naive", "adversary"))
    seeds = sorted(set(data.seeds(naive, [method])) & set(data.seeds(attacked, [method])))
    return data.sample(naive, method, metric, seeds), data.sample(attacked, method, metric, seeds)


def _tail(values: Array, share: float) -> Array:
    return values[-max(1, round(share * len(values))) :]


def _median(x: Array) -> float:
    return float(np.median(x)) if len(x) else math.nan


def _name(metric: str) -> str:
    return "crashes" if metric == "log_crashes" else metric


def _detectable_shift(difference: Array, alpha: float) -> float:
    """Of the signed-rank test, by the t test and the least relative efficiency that the former can have, 0.864.

    Infinite where even n of n pairs that moved the same way are not significant.
    """
    if 2.0 ** (1 - np.count_nonzero(difference)) >= alpha:
        return math.inf
    return significance.detectable_mean(difference, alpha) / math.sqrt(0.864)
