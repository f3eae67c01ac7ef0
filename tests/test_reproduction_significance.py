"""The tests of the claims against SciPy, formulas and simulations, and how often intervals contain the truth."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats as scipy_stats

from deimos.study import stats
from reproduction import coverage, significance

RNG = np.random.default_rng(7)
X = RNG.lognormal(size=12)
Y = RNG.lognormal(0.8, 0.5, size=9)


def test_log_iqr_ratio_knows_no_spread():
    """Two populations without spread have the ratio 1, and one without has an infinite or zero one, silently."""
    flat = np.ones(5)
    assert significance.log_iqr_ratio(3 * X, X) == pytest.approx(math.log(3))
    assert significance.log_iqr_ratio(flat, flat) == 0.0
    assert significance.log_iqr_ratio(X, flat) == math.inf
    assert significance.log_iqr_ratio(flat, X) == -math.inf
    assert stats.bootstrap([X, flat], significance.log_iqr_ratio).low == math.inf


def test_brown_forsythe_is_scipys():
    """It is Levene's test on the distances from the medians; constant populations are handled."""
    assert significance.brown_forsythe(X, Y) == pytest.approx(
        scipy_stats.levene(X, Y, center="median").pvalue, rel=1e-12
    )
    assert significance.brown_forsythe(np.ones(4), np.full(4, 7.0)) == 1.0
    assert significance.brown_forsythe(np.array([0.0, 0, 2, 2]), np.ones(4)) == 0.0


def test_holm_on_the_textbook_example():
    """Holm's procedure on 0.01, 0.04, 0.03, 0.005 multiplies by 4, 3, 2, 1 and never falls."""
    assert significance.holm([0.01, 0.04, 0.03, 0.005]).tolist() == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert significance.holm([0.6, 0.7]).tolist() == [1.0, 1.0]


def test_equivalence_is_two_one_sided_welch_tests():
    """The p-value is the larger of SciPy's two one-sided Welch tests, and the 90 % interval tells the same."""
    for margin in (0.2, 1.0, 3.0):
        found = significance.equivalence(X, Y, margin)
        lower = scipy_stats.ttest_ind(X + margin, Y, equal_var=False, alternative="greater").pvalue
        upper = scipy_stats.ttest_ind(X - margin, Y, equal_var=False, alternative="less").pvalue
        assert found.p_same == pytest.approx(max(lower, upper), rel=1e-9)
        assert (found.p_same < 0.05) == (-margin < found.low and found.high < margin)
    far = significance.equivalence(X + 50, Y, 1.0)
    assert far.p_same > 0.999
    assert far.p_other < 1e-6
    with pytest.raises(ValueError, match="margin must be positive, got 0"):
        significance.equivalence(X, Y, 0.0)


def test_equivalence_of_constant_samples_is_exact():
    """Without spread the difference itself decides."""
    assert significance.equivalence(np.ones(3), np.full(3, 1.5), 1.0).p_same == 0.0
    assert significance.equivalence(np.ones(3), np.full(3, 2.5), 1.0).p_other == 0.0


def test_rosenbaum_counts_orders():
    """Its p-value is the share of all orders of the pooled values that have as many on top; ties do not count."""
    values = np.arange(7.0)
    for x in ([6, 5, 4], [6, 5, 0], [6, 2, 1], [3, 2, 1]):
        own = np.array(x, float)
        others = np.setdiff1d(values, own)
        above = (own > others.max()).sum()
        orders = [(set(each) >= set(range(7 - above, 7))) for each in itertools.combinations(range(7), 3)]
        assert significance.rosenbaum(own, others) == pytest.approx(np.mean(orders))
    assert significance.rosenbaum(np.array([5.0, 5, 1]), np.array([5.0, 0, 0])) == 1.0


@pytest.mark.parametrize("alpha", [0.05, 0.005])
def test_detectable_reach_has_the_promised_power(alpha):
    """Samples whose distribution is a power of the other's, at the P that is named, are told apart in 80 %."""
    p = significance.detectable_reach(10, 8, alpha)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(size=(4000, 10)) ** ((1 - p) / p), rng.uniform(size=(4000, 8))
    assert (x[:, :, None] > y[:, None]).mean() == pytest.approx(p, abs=0.01)
    found = np.mean([significance.rosenbaum(a, b) < alpha for a, b in zip(x, y, strict=True)])
    assert found == pytest.approx(0.8, abs=0.02)  # 3 standard errors
    assert significance.detectable_reach(3, 3) == math.inf


def test_detectable_sign_has_the_promised_power():
    """A share of 1/2 minus the distance keeps to the sign test's bound in 80 %."""
    distance = significance.detectable_sign(10)
    assert scipy_stats.binom(10, 0.5 - distance).cdf(1) == pytest.approx(0.8)  # 2 of 10 is p = 0.055
    assert significance.detectable_sign(4) == math.inf


def test_detectable_margin_has_the_promised_power():
    """Two populations with equal means are found equivalent within that margin in 80 % of all samples."""
    rng = np.random.default_rng(4)
    found = []
    margin = (scipy_stats.t.ppf(0.95, 28) + scipy_stats.t.ppf(0.9, 28)) * math.sqrt(2 / 15)
    for _ in range(600):
        x, y = rng.normal(size=(2, 15))
        found.append(significance.equivalence(x, y, margin).p_same < 0.05)
    # The two tests' shared noise makes the formula a little too careful or too bold: 0.05 beside 4 standard errors.
    assert np.mean(found) == pytest.approx(0.8, abs=0.05 + 4 * math.sqrt(0.16 / 600))
    x, y = (np.arange(15.0) - 7) / np.arange(15.0).std(ddof=1), (np.arange(15.0) - 7) / np.arange(15.0).std(ddof=1)
    assert significance.detectable_margin(x, y) == pytest.approx(margin, rel=1e-6)


def test_coverage_of_the_intervals():
    """In 200 populations of 10, IQM, median and bootstrap-t cover as promised, and the percentile mean does not."""
    rows = {(row.statistic, row.interval): row for row in coverage.simulate(10, 200, 1000, seed=1)}
    error = 4 * math.sqrt(0.95 * 0.05 / 200)  # four standard errors of a coverage of 95 %
    for statistic in ("IQM", "median"):
        row = rows[statistic, "percentile"]
        assert 0.92 - error < min(row.normal, row.lognormal)
        assert max(row.normal, row.lognormal) < 0.97 + error
    assert rows["mean", "percentile"].lognormal < rows["mean", "bootstrap-t"].lognormal
    assert rows["mean", "bootstrap-t"].normal > 0.92 - error
    assert rows["ratio of IQRs", "percentile of the logarithm"].normal > 0.97


def test_detectable_spread_has_the_promised_power():
    """At the ratio that it names, SciPy's Brown-Forsythe test on fresh normal samples finds 80 %."""
    ratio = significance.detectable_spread(10, 10)
    rng = np.random.default_rng(3)
    x, y = ratio * rng.normal(size=(2000, 10)), rng.normal(size=(2000, 10))
    p = scipy_stats.levene(x, y, center="median", axis=1).pvalue
    # Both shares are binomial: standard errors of sqrt(0.16 / 4000) and sqrt(0.16 / 2000), four of them together.
    assert (p < 0.05).mean() == pytest.approx(0.8, abs=4 * math.sqrt(0.16 / 4000 + 0.16 / 2000))
