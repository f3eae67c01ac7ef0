"""Statistics of populations: against published formulas, SciPy, rliable where it is there, and hand calculation."""

import math

import numpy as np
import pytest
from scipy import stats as scipy_stats

from deimos.study import stats

RNG = np.random.default_rng(7)
X = RNG.lognormal(size=12)
Y = RNG.lognormal(0.8, 0.5, size=9)


def resample(samples, resamples, seed):
    """What the bootstrap draws of some samples."""
    draws = []
    stats.distribution(samples, lambda *x: draws.append(x) or x[0].mean(axis=-1), resamples=resamples, seed=seed)
    return draws[0]


def test_iqm_drops_a_quarter_on_each_side():
    """Of ten values the two lowest and the two highest go, as in SciPy's trimmed mean, which rliable uses."""
    x = np.array([100.0, 1, 2, 3, 4, 5, 6, 7, 8, -50.0])
    assert stats.iqm(x) == np.mean([2, 3, 4, 5, 6, 7])
    for n in range(4, 20):
        values = np.random.default_rng(n).normal(size=n)
        assert stats.iqm(values) == pytest.approx(scipy_stats.trim_mean(values, 0.25), rel=1e-12)
    assert np.array_equal(stats.iqm(np.stack([x, 2 * x])), [stats.iqm(x), stats.iqm(2 * x)])


def test_iqr_is_numpys():
    """The quartiles are interpolated linearly, as SciPy's interquartile range does."""
    assert stats.iqr(X) == pytest.approx(scipy_stats.iqr(X))


def test_cvar_counts_the_boundary_by_its_fraction():
    """With 10 values and a share of 0.25 the third worst counts half: (10 + 9 + 8 / 2) / 2.5."""
    x = np.arange(1.0, 11.0)
    assert stats.cvar(x, 0.25) == pytest.approx((10 + 9 + 8 / 2) / 2.5)
    assert stats.cvar(x, 0.2) == pytest.approx(9.5)
    assert stats.cvar(x, 1.0) == pytest.approx(x.mean())
    assert stats.cvar(np.arange(1.0, 31.0), 0.2) == pytest.approx(np.mean([25, 26, 27, 28, 29, 30]))
    with pytest.raises(ValueError, match=r"share must be in \(0, 1\], got 0"):
        stats.cvar(x, 0.0)


def test_cvar_minimises_rockafellar_and_uryasevs_function():
    """CVaR is the least value over a of a + E[(x - a)+] / share, their defining property."""
    for share in (0.1, 0.23, 0.5):
        values = X + np.maximum(X[:, None] - X, 0).mean(axis=0) / share  # its minimum lies at a sample point
        assert stats.cvar(X, share) == pytest.approx(values.min(), rel=1e-12)


def test_bootstrap_of_the_mean_has_its_known_spread():
    """The bootstrap distribution of a mean has the variance s^2 (n - 1) / n^2, and two seeds differ, one does not."""
    draws = resample([X], 40_000, 0)[0].mean(axis=1)
    expected = X.std() / math.sqrt(len(X))
    # The standard deviation of 40 000 draws is known to 1 / sqrt(80 000), or 0.35 %; skewness adds a little.
    assert draws.std() == pytest.approx(expected, rel=0.02)
    one, again, other = (stats.bootstrap([X], stats.iqm, seed=seed) for seed in (1, 1, 2))
    assert one == again
    assert one != other


def test_share_of_pairs_has_an_exact_interval():
    """It is that of the wins; ties count half in the share, are lost at one end and won at the other."""
    x = np.array([3.0, 3.0, 3.0, 3.0, 1.0])
    found = stats.share_of_pairs(x, np.array([2.0, 2.0, 2.0, 3.0, 1.0]))
    low, high = (scipy_stats.binomtest(k, 5).proportion_ci(0.95) for k in (3, 5))
    assert (found.estimate, found.low, found.high) == (0.8, low.low, high.high)
    every = stats.share_of_pairs(x + 1, x)
    assert (every.estimate, every.low, every.high) == (1.0, pytest.approx(0.025 ** (1 / 5)), 1.0)


def test_share_has_an_exact_interval():
    """None of ten is at most 31 % with 97.5 % certainty, and 9 of 10 has SciPy's interval of Clopper and Pearson."""
    none = stats.share(np.zeros(10, bool))
    assert (none.estimate, none.low, none.high) == (0.0, 0.0, pytest.approx(1 - 0.025**0.1))
    most = stats.share(np.arange(10) > 0)
    assert (most.estimate, most.low, most.high) == (0.9, *scipy_stats.binomtest(9, 10).proportion_ci())


def test_bootstrap_resamples_within_strata():
    """Every resample keeps the size of each stratum, and takes values from that stratum alone."""
    draws = resample([X, Y + 100], 50, 3)
    assert [draw.shape for draw in draws] == [(50, 12), (50, 9)]
    assert np.isin(draws[0], X).all()
    assert np.isin(draws[1], Y + 100).all()


def test_bootstrap_t_is_students_interval_for_many_normal_values():
    """With many normal values the studentised bootstrap approaches Student's interval."""
    x = np.random.default_rng(0).normal(3.0, 2.0, size=400)
    found = stats.bootstrap_t(x)
    low, high = scipy_stats.t.interval(0.95, 399, loc=x.mean(), scale=x.std(ddof=1) / 20)
    assert found.low == pytest.approx(low, abs=0.02)  # a fifth of the standard error of 0.1
    assert found.high == pytest.approx(high, abs=0.02)


def test_bootstrap_t_leans_towards_the_long_tail():
    """Of a right-skewed sample the interval reaches farther up than down, as the exact one does."""
    found = stats.bootstrap_t(X)
    assert found.high - found.estimate > 1.2 * (found.estimate - found.low)


@pytest.mark.parametrize("interval", [stats.bootstrap_t, stats.student, lambda x: stats.bootstrap([x], stats.iqm)])
@pytest.mark.parametrize("value", [2.5, 0.1, 0.7])  # of which the last two have a standard error by rounding
def test_constant_sample_has_no_width(interval, value):
    """A population of equal values has a point as its interval, without a warning."""
    found = interval(np.full(6, value))
    assert found.estimate == found.low == found.high == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize("x", [[0.1, 0.2, 0.7], [12.345, 7.891, 3.21], [1.0, 2.0, 4.0]])
def test_bootstrap_t_of_three_has_no_ends(x):
    """One draw in nine is three times the same value, and has no standard error, whatever rounding leaves of it."""
    found = stats.bootstrap_t(np.array(x))
    assert (found.low, found.high) == (-math.inf, math.inf)


def test_probability_of_improvement_is_mann_whitneys():
    """It is U / (n m) with ties counted half, averaged over tasks."""
    x, y = np.array([1.0, 2, 2, 5]), np.array([2.0, 0, 4])
    # Wins of 1: 1; of each 2: 1 and a tie; of 5: 3.
    assert stats.probability_of_improvement([(x, y)]).estimate == pytest.approx((1 + 1.5 + 1.5 + 3) / 12)
    u = [scipy_stats.mannwhitneyu(a, b).statistic / (len(a) * len(b)) for a, b in ((X, Y), (x, y))]
    assert stats.probability_of_improvement([(X, Y), (x, y)]).estimate == pytest.approx(np.mean(u))
    assert stats.probability_of_improvement([(X, X + 100)]) == stats.Interval(0.0, 0.0, 0.0)


def test_probability_of_improvement_resamples_both_arms():
    """Its interval is that of drawing both samples anew and counting wins, done the slow way."""
    rng = np.random.default_rng(5)
    slow = [np.mean(rng.choice(X, len(X))[:, None] > rng.choice(Y, len(Y))) for _ in range(4000)]
    found = stats.probability_of_improvement([(X, Y)], resamples=20_000)
    # 5 standard errors of a 2.5 % quantile of 4000 draws: 5 * sqrt(0.025 * 0.975 / 4000) / density, 0.06 / sd there.
    assert found.low == pytest.approx(np.quantile(slow, 0.025), abs=0.25 * np.std(slow))
    assert found.high == pytest.approx(np.quantile(slow, 0.975), abs=0.25 * np.std(slow))


def test_performance_profile_counts_runs_above():
    """The profile is the share of runs above each threshold, averaged over tasks, inside its band."""
    share, low, high = stats.performance_profile(
        [np.array([1.0, 2, 3, 4]), np.array([2.0, 2])], np.array([0.0, 2, 3.5])
    )
    assert share.tolist() == [1.0, 0.25, 0.125]
    assert (low <= share).all()
    assert (share <= high).all()
    assert (low[0], high[0]) == (1.0, 1.0)


def test_detectable_probability_is_noethers():
    """Ten a side detect 0.86 and thirty 0.71 with a power of 80 %, by (z + z') / sqrt(12 n m / (n + m))."""
    z = 1.959964 + 0.841621
    assert stats.detectable_probability(10, 10) == pytest.approx(0.5 + z / math.sqrt(12 * 100 / 20), abs=1e-5)
    assert stats.detectable_probability(30, 30) == pytest.approx(0.7088, abs=1e-4)
    assert stats.detectable_probability(4, 4) == 1.0
    assert stats.detectable_probability(3, 3) == math.inf  # 3 above 3 is p = 0.1
    assert stats.detectable_probability(3, 3, alpha=0.1) == 1.0  # and 10 % are enough for 10 %


@pytest.mark.parametrize("n", [6, 7, 10, 20])
def test_detectable_share_has_the_promised_power(n):
    """At the share that it names, SciPy's two-sided sign test is significant upwards in 80 %."""
    enough = next(k for k in range(n + 1) if k > n / 2 and scipy_stats.binomtest(k, n).pvalue <= 0.05)
    power = scipy_stats.binom.sf(enough - 1, n, stats.detectable_share(n))
    assert power == pytest.approx(stats.POWER)
    assert stats.detectable_share(5) == math.inf  # five of five is p = 1/16


def test_what_has_no_sample_is_refused():
    """Nothing to count, no task, and pairs of different policies are errors that name the argument."""
    with pytest.raises(ValueError, match="holds must have a value"):
        stats.share(np.zeros(0, bool))
    with pytest.raises(ValueError, match="pairs must hold"):
        stats.probability_of_improvement([])
    with pytest.raises(ValueError, match="samples must hold"):
        stats.performance_profile([], np.zeros(1))
    with pytest.raises(ValueError, match="x and y must be of the same policies, got 12 and 9 values"):
        stats.share_of_pairs(X, Y)


@pytest.mark.parametrize("x", [np.array([1.0]), np.ones((2, 2)), np.array([1.0, math.nan])])
def test_bad_samples_are_refused(x):
    """A sample is two numbers or more along one axis."""
    with pytest.raises(ValueError, match="A sample must"):
        stats.bootstrap([x], stats.iqm)


def test_against_rliable():
    """IQM and probability of improvement are those of the library of their inventors."""
    metrics = pytest.importorskip("rliable.metrics", exc_type=ImportError)
    scores = np.stack([X, 2 * X], axis=1)  # runs x tasks
    assert stats.iqm(scores.ravel()) == pytest.approx(metrics.aggregate_iqm(scores))
    other = np.stack([Y, Y], axis=1)
    ours = stats.probability_of_improvement([(X, Y), (2 * X, Y)], resamples=10).estimate
    assert ours == pytest.approx(metrics.probability_of_improvement(scores, other))


def test_student_is_scipys_interval():
    """It is that of SciPy's t test of one sample; equal values have no width, and one value has no interval."""
    x = RNG.normal(0.3, 1.0, 5)
    low, high = scipy_stats.ttest_1samp(x, 0.0).confidence_interval(0.95)
    found = stats.student(x)
    assert (found.estimate, found.low, found.high) == pytest.approx((x.mean(), low, high))
    assert stats.student(np.ones(3)) == stats.Interval(1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="two values or more"):
        stats.student(np.ones(1))


@pytest.mark.parametrize("n", [3, 5, 10])
def test_detectable_mean_has_the_promised_power(n):
    """At the mean that it names, the t interval of fresh normal samples leaves out 0 in 80 %."""
    x = np.random.default_rng(1).normal(size=n)
    effect = stats.detectable_mean(x / x.std(ddof=1))  # of a standard deviation of 1
    fresh = np.random.default_rng(2).normal(effect, 1.0, (40_000, n))
    low, _ = scipy_stats.ttest_1samp(fresh, 0.0, axis=1).confidence_interval(0.95)
    # The share of 40 000 samples has a standard error of 0.2 %; four of them.
    assert (low > 0).mean() == pytest.approx(stats.POWER, abs=0.008)
    assert stats.detectable_mean(3 * x) == pytest.approx(3 * stats.detectable_mean(x))


def test_paired_resamples_draw_pairs():
    """Paired samples are drawn together: a difference that every pair has is in every resample."""
    found = stats.bootstrap([X, X - 2.0], lambda x, y: (x - y).mean(axis=-1), resamples=200, paired=True)
    assert (found.estimate, found.low, found.high) == pytest.approx((2.0, 2.0, 2.0))
    apart = stats.bootstrap([X, X - 2.0], lambda x, y: (x - y).mean(axis=-1), resamples=200)
    assert apart.high - apart.low > 0.5
