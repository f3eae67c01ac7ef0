"""Permutation tests of populations: against SciPy, every order of small samples, and simulated studies."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats as scipy_stats

from deimos.study import permutation, stats

RNG = np.random.default_rng(7)
X = RNG.normal(1.0, 1.0, size=9)
Y = RNG.normal(0.0, 2.0, size=7)
ONE = [(0, 1)]


def every_order(x, y, statistic):
    """Share of all ways to label the pooled values in which a statistic is at least as large as in the given one."""
    pooled, chosen = np.concatenate([x, y]), itertools.combinations(range(len(x) + len(y)), len(x))
    orders = ((pooled[list(own)], np.delete(pooled, list(own))) for own in chosen)
    return np.mean([statistic(*order) >= statistic(x, y) - 1e-12 for order in orders])


def test_superiority_is_mann_whitneys():
    """P(X > Y) is U / (n m), ties counting half; of several pairs it is their mean."""
    x, y = np.array([1.0, 2, 2, 5]), np.array([2.0, 0, 3])
    expected = scipy_stats.mannwhitneyu(x, y).statistic / 12
    assert permutation.superiority(ONE)(x, y) == pytest.approx(expected)
    pairs = [(0, 1), (0, 2)]
    mean = np.mean([permutation.superiority(ONE)(X, other) for other in (Y, Y + 1)])
    assert permutation.superiority(pairs)(X, Y, Y + 1) == pytest.approx(mean)


def test_spread_is_ginis_mean_difference():
    """Its ratio is that of the mean distances between values; without any spread it is 1, against none infinite."""
    gini = [np.mean([abs(a - b) for a, b in itertools.combinations(z, 2)]) for z in (X, Y)]
    assert permutation.log_spread_ratio(ONE)(X, Y) == pytest.approx(math.log(gini[0] / gini[1]))
    flat = np.ones(5)
    assert permutation.log_spread_ratio(ONE)(flat, flat) == 0.0
    assert permutation.log_spread_ratio(ONE)(X, flat) == math.inf
    assert stats.bootstrap([X, flat], permutation.log_spread_ratio(ONE)).low == math.inf


def brunner_munzel(x, y):
    """SciPy's statistic, positive where x is larger."""
    with np.errstate(divide="ignore", invalid="ignore"):  # samples that do not overlap
        return scipy_stats.brunnermunzel(y, x, distribution="normal").statistic


def welch(x, y):
    """Welch's statistic."""
    return scipy_stats.ttest_ind(x, y, equal_var=False).statistic


@pytest.mark.parametrize(("kind", "statistic"), [("superiority", brunner_munzel), ("mean", welch)])
def test_p_values_are_those_of_all_orders(kind, statistic):
    """They are the shares of relabelled samples with as large a Brunner-Munzel or Welch statistic."""
    x, y = X[:5], Y[:4]
    more, less = permutation.p_values([x, y], ONE, kind, permutations=4000)
    error = 4 * math.sqrt(0.25 / 4000)
    assert more == pytest.approx(every_order(x, y, statistic), abs=error)
    assert less == pytest.approx(every_order(x, y, lambda a, b: -statistic(a, b)), abs=error)


@pytest.mark.parametrize("kind", ["superiority", "mean", "spread"])
def test_studies_are_tested_by_themselves(monkeypatch, kind):
    """Many studies at once, in blocks, give each the p-values that it has alone."""
    x, y, z = (RNG.normal(size=(3, 2, n)) for n in (5, 6, 4))
    pairs = [(0, 1), (2, 1)]
    more, less = permutation.p_values([x, y, z], pairs, kind, permutations=99)
    monkeypatch.setattr(permutation, "_VALUES_AT_ONCE", 2000)
    for i, j in np.ndindex(3, 2):
        alone = permutation.p_values([x[i, j], y[i, j], z[i, j]], pairs, kind, permutations=99)
        assert alone == (pytest.approx(more[i, j]), pytest.approx(less[i, j]))


def test_separate_samples_have_the_smallest_p_value():
    """Where all of x lie above all of y no other order is as extreme; where all values are equal nothing is."""
    more, less = permutation.p_values([X + 100, Y], ONE, "superiority", permutations=999)
    assert (more, less) == (pytest.approx(1 / 1000, abs=0.002), 1.0)
    for kind in ("superiority", "mean", "spread"):
        assert permutation.p_values([np.ones(4), np.ones(5)], ONE, kind) == (1.0, 1.0)


@pytest.mark.parametrize("kind", ["superiority", "mean", "spread"])
def test_level_holds_where_populations_are_equal(kind):
    """Of 600 pairs of bimodal samples from one population at most 2.5 % are told apart on either side."""
    rng = np.random.default_rng(1)
    x, y = np.where(rng.random((2, 600, 8)) < 0.45, 0.0, rng.lognormal(size=(2, 600, 8)))
    if kind == "spread":  # the medians that are subtracted are not those of the population
        x, y = rng.lognormal(size=(2, 600, 12))
    found = permutation.p_values([x, y], ONE, kind, permutations=199)
    limit = 0.025 + 4 * math.sqrt(0.025 * 0.975 / 600)
    assert max((p <= 0.025).mean() for p in found) <= limit


def test_level_holds_where_only_the_spread_differs():
    """P(X > Y) = 1/2 between populations whose spread differs by a factor of five is not called a difference."""
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(600, 10)), 5 * rng.normal(size=(600, 10))
    more, less = permutation.p_values([x, y], ONE, "superiority", permutations=199)
    limit = 0.025 + 4 * math.sqrt(0.025 * 0.975 / 600)
    assert max((more <= 0.025).mean(), (less <= 0.025).mean()) <= limit


def test_spread_does_not_see_the_middle():
    """Samples that are shifted have the same p-values of their spread, and wider ones small ones."""
    x, y = RNG.normal(size=20), 4 * RNG.normal(size=20)
    shifted = permutation.p_values([x + 100, y], ONE, "spread", permutations=999)
    assert shifted == (pytest.approx(permutation.p_values([x, y], ONE, "spread", permutations=999)[0]), shifted[1])
    assert shifted[1] <= 0.01


def mean_difference(x, y):
    """The mean difference of two samples that belong together."""
    return (x - y).mean(axis=-1)


def test_blocks_of_two_are_sign_flips():
    """Of two samples in blocks every pattern of signs counts once: the p-value is that of all of them."""
    x, y = np.array([3.0, 1.0, 4.0, 1.0, 5.0]), np.array([1.0, 2.0, 1.0, 0.5, 2.0])
    signs = np.array(list(itertools.product([1, -1], repeat=5)))
    flipped = signs @ (x - y)
    expected = (flipped >= (x - y).sum() - 1e-12).mean(), (flipped <= (x - y).sum() + 1e-12).mean()
    assert permutation.p_values_in_blocks([x, y], mean_difference) == pytest.approx(expected)
    assert permutation.p_values_in_blocks([y + 9, y], mean_difference) == (1 / 32, 1.0)


def test_blocks_take_away_what_they_share():
    """A small difference in every pair is found however far apart the pairs are; without blocks it is not."""
    base = 10.0 * np.arange(8)
    samples = [base + 0.1, base]
    order = permutation.superiority_in_blocks([(0, 1)])
    more, less = permutation.p_values_in_blocks(samples, order)
    assert (more, less, order(*samples)) == (1 / 256, 1.0, 1.0)
    assert permutation.p_values(samples, [(0, 1)], "superiority")[0] > 0.3


def test_labels_are_permuted_within_blocks_alone():
    """Of three samples in two blocks there are 36 orders, and one of them has the first ahead in both, by most."""
    samples = [np.array([5.0, 50.0]), np.array([1.0, 20.0]), np.array([2.0, 10.0])]
    pairs = [(0, 1), (0, 2)]
    more, less = permutation.p_values_in_blocks(samples, permutation.superiority_in_blocks(pairs))
    assert (more, less) == pytest.approx((4 / 36, 1.0))  # the other two in either order, in either block


@pytest.mark.parametrize("kind", ["superiority", "mean", "spread"])
@pytest.mark.parametrize(
    ("x", "words"),
    [([1.0], "two values or more, got samples of 1, 7"), ([1.0, math.nan, 2.0], "finite"), ([1, math.inf], "finite")],
)
def test_samples_that_cannot_be_compared_are_refused(kind, x, words):
    """With a value that is not known, or a single one, no statistic is as large as the samples' own: p would be 0."""
    with pytest.raises(ValueError, match=words):
        permutation.p_values([np.array(x), Y], ONE, kind)


def test_blocks_that_cannot_be_compared_are_refused():
    """The same in blocks, which all samples must have."""
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match="finite"):
            permutation.p_values_in_blocks([np.array([1.0, bad]), np.zeros(2)], mean_difference)
    with pytest.raises(ValueError, match="samples must be of the same blocks, got 3, 2 values"):
        permutation.p_values_in_blocks([np.zeros(3), np.zeros(2)], mean_difference)
    with pytest.raises(ValueError, match="two values or more, got samples of 1, 1"):
        permutation.p_values_in_blocks([np.ones(1), np.zeros(1)], mean_difference)


@pytest.mark.parametrize("n", [5, 10])
def test_detectable_spread_has_the_promised_power(n):
    """At the ratio that it names, the test itself tells fresh normal samples apart in 80 %, also of five a side."""
    rng = np.random.default_rng(7)
    x, y = permutation.detectable_spread(n, n) * rng.normal(size=(1500, n)), rng.normal(size=(1500, n))
    more, _ = permutation.p_values([x, y], [(0, 1)], "spread", permutations=None if n == 5 else 499)
    # Three standard errors of 1500 fresh studies; of five a side power rises slowly, and 0.84 is a ratio of 33, not 26.
    assert (2 * more <= 0.05).mean() == pytest.approx(0.8, abs=3 * math.sqrt(0.16 / 1500))
