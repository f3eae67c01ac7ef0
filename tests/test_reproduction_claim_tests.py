"""The kinds of tests that clauses are made of: against SciPy, formulas, and samples whose truth is known."""

import math

import numpy as np
import pytest
from scipy import stats as scipy_stats

from deimos.study import permutation, stats
from reproduction import claim_tests
from reproduction.claim_tests import Alike, Best, Highest, Matters, Mostly, Ordered, falling, versus
from reproduction.measures import ATTACKED, NAIVE, SCORE, Evidence, Place

HERE = Place("directional", 100)


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    """Resample and permute little: 199 permutations are enough for p-values of 2.5 %."""
    monkeypatch.setattr(claim_tests, "RESAMPLES", 100)
    monkeypatch.setattr(permutation, "PERMUTATIONS", 199)


def only(method_values, column="crash_rate", goals="naive", curves=()):
    """Evidence of an evaluation in which a column has these values, by method."""
    rows = [
        {"environment": "directional", "goal_period": 100, "goals": goals, "method": name, "seed": seed, column: value}
        for name, values in method_values.items() for seed, value in enumerate(values)
    ]  # fmt: skip
    return Evidence(rows, curves)


def test_ordered_averages_over_pairs():
    """Its effect is the mean P(X > Y) of the pairs that have enough policies; methods that lack them are missing."""
    data = only({"rnd": [3, 4, 5], "uniform": [1, 2, 3.5], "vds": [6, 7, 8], "p25": [1, 2]})
    found = Ordered(NAIVE, versus(["rnd"], ["uniform", "vds", "p25"])).find(data, HERE)
    assert found.interval.estimate == pytest.approx((8 / 9 + 0) / 2)
    assert found.n == {"rnd": 3, "uniform": 3, "vds": 3}
    assert found.detectable == stats.detectable_probability(3, 6)
    assert Ordered(NAIVE, (("rnd", "p25"),)).find(data, HERE) is None
    assert found.p_for == pytest.approx(1.0, abs=0.5)
    assert "rnd > uniform, vds, p25" in str(Ordered(NAIVE, versus(["rnd"], ["uniform", "vds", "p25"])))


def test_order_is_jonckheeres():
    """All pairs of an order are compared, the earlier with the later."""
    assert falling(["a", "b", "c"]) == (("a", "b"), ("a", "c"), ("b", "c"))
    assert str(Ordered(SCORE, falling(["a", "b", "c"]))) == "score (Naive): a > b > c"


def test_alike_names_the_smallest_ratio():
    """Two methods of ten policies each, within 3 % of another, are alike within a ratio a little above that."""
    rates = 0.1 * np.exp(np.linspace(-0.03, 0.03, 10))
    data = only({"vds": rates, "uniform": rates, "p90": 3 * rates})
    found = Alike(NAIVE, "vds", "uniform").find(data, HERE)
    assert found.verdict == "holds"
    assert 1.0 < found.equivalent_within < 1.06
    assert found.interval.estimate == pytest.approx(1.0)
    assert found.no_difference == 1.0
    far = Alike(NAIVE, "p90", "uniform").find(data, HERE)
    assert far.verdict == "does not hold"
    assert 3.0 < far.equivalent_within < 3.2
    assert far.interval.low == pytest.approx(3.0, rel=0.06)
    assert Alike(NAIVE, "uniform", "p90", at_most=True).find(data, HERE).verdict == "holds"
    assert Alike(NAIVE, "p90", "uniform", at_most=True).find(data, HERE).verdict == "does not hold"


def test_alike_is_settled_within_one_and_a_half():
    """Tight populations 1.4 apart are settled, 1.6 apart they are not; scores are by differences of 0.05."""
    rates = 0.1 * np.exp(np.linspace(-0.01, 0.01, 12))
    data = only({"uniform": rates, "p10": 1.4 * rates, "p25": 1.6 * rates})
    found = {name: Alike(NAIVE, name, "uniform").find(data, HERE).verdict for name in ("p10", "p25")}
    assert found == {"p10": "holds", "p25": "does not hold"}
    scores = np.linspace(0.79, 0.81, 12)
    data = only({"uniform": scores, "p10": scores + 0.03, "p25": scores + 0.08}, "score")
    near, far = (Alike(SCORE, name, "uniform").find(data, HERE) for name in ("p10", "p25"))
    assert (near.verdict, far.verdict, near.no_difference) == ("holds", "does not hold", 0.0)
    assert 0.03 < near.equivalent_within < 0.05


def test_few_policies_are_never_alike():
    """Three equal policies a side cannot be told from others: no ratio is named, and nothing is settled."""
    found = Alike(NAIVE, "vds", "uniform").find(only({"vds": [0.1] * 3, "uniform": [0.2, 0.1, 0.05]}), HERE)
    assert found.verdict == "undecided"
    assert found.equivalent_within > 1.5


def test_mostly_is_the_sign_test():
    """Nine of ten policies above 0 have the two-sided p-value of SciPy's binomial test; those at 0 drop out of it."""
    data = only({"vds": [1.0] * 9 + [-1.0], "rnd": [0.0] * 4}, "score")
    found = Mostly(SCORE, ("vds",)).find(data, HERE)
    assert found.p_for == pytest.approx(scipy_stats.binomtest(9, 10).pvalue)
    assert (found.p_against, found.interval.estimate) == (1.0, 0.9)
    assert (found.interval.low, found.interval.high) == pytest.approx(scipy_stats.binomtest(9, 10).proportion_ci())
    still = Mostly(SCORE, ("rnd",)).find(data, HERE)
    assert (still.p_for, still.p_against, still.interval.estimate) == (1.0, 1.0, 0.5)
    both = Mostly(SCORE, ("vds", "rnd", "p25")).find(data, HERE)
    assert both.n == {"vds": 10, "rnd": 4}


def test_detectable_share_has_the_promised_power():
    """A share that large keeps to the sign test's bound in 80 % of all samples; of five nothing is found."""
    share = stats.detectable_share(10)
    assert scipy_stats.binom(10, share).sf(8) == pytest.approx(0.8)  # 9 of 10 is p = 0.02, 8 of 10 is 0.11
    assert stats.detectable_share(5) == math.inf


def test_detectable_margins_have_the_promised_power():
    """Equal populations are found alike within the margin that is named in 80 %, where one side or both are tested."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, 600, 30))
    values = {"vds": rng.normal(size=30), "uniform": rng.normal(size=30)}
    for at_most in (False, True):
        margin = Alike(SCORE, "vds", "uniform", at_most).find(only(values, "score"), HERE).detectable
        _, lower = permutation.p_values([x, y + margin], [(0, 1)], "superiority", permutations=199)
        higher, _ = permutation.p_values([x, y - margin], [(0, 1)], "superiority", permutations=199)
        p = lower if at_most else np.maximum(lower, higher)
        # The margin comes from the spread of one study of 30 a side, which is known to some 15 %.
        assert (p <= 0.05).mean() == pytest.approx(0.8, abs=0.08)


def test_highest_counts_orders():
    """Its p-value is the share of all orders that have as many on top: Rosenbaum's, against each of the others."""
    test = Highest(SCORE, "antagonist", ("p25", "rnd"))
    assert claim_tests._on_top(5, 7, 3) == pytest.approx(math.comb(5, 3) / math.comb(12, 3))
    values = np.arange(10.0)
    found = test.find(only({"antagonist": values + 5.5, "p25": values, "rnd": values - 1}, "score"), HERE)
    assert found.p_for == pytest.approx(2 * math.comb(10, 6) / math.comb(20, 6))
    assert (found.p_against, found.interval.estimate) == (1.0, 6.0)
    behind = test.find(only({"antagonist": values - 5.5, "p25": values, "rnd": values - 9}, "score"), HERE)
    assert behind.p_against == pytest.approx(min(1.0, 2 * 2 * math.comb(10, 6) / math.comb(20, 6)))
    assert (behind.p_for, behind.interval.estimate) == (1.0, -6.0)
    assert behind.detectable == 5  # of ten, five on top are p = 0.033, four are 0.087


def test_omega_squared_is_hays():
    """It is (SSB - (k - 1) MSW) / (SST + MSW), and 0 where nothing varies."""
    groups = [np.array([1.0, 2, 3]), np.array([4.0, 6]), np.array([0.0, 0, 1])]
    values = np.concatenate(groups)
    between = sum(len(g) * (g.mean() - values.mean()) ** 2 for g in groups)
    total = ((values - values.mean()) ** 2).sum()
    error = (total - between) / (len(values) - 3)
    assert claim_tests.omega_squared(values, [3, 2, 3]) == pytest.approx((between - 2 * error) / (total + error))
    assert claim_tests.omega_squared(np.ones(5), [2, 3]) == 0.0


def test_best_is_chosen_and_tested_on_different_seeds():
    """What is best on every other seed is tested on the rest, even where it is the worst there."""
    rates = {"p10": [0.1, 0.9] * 5, "p25": [0.5, 0.2] * 5, "uniform": [0.3, 0.3] * 5, "vds": [0.4, 0.1] * 5}
    rates = {name: np.array(x) + 0.001 * np.arange(10) for name, x in rates.items()}
    test = Best(NAIVE, ("p10", "p25"), ("uniform", "vds"), lambda best, rival: Ordered(NAIVE, ((best, rival),)))
    found = test.find(only(rates), HERE)
    assert (found.chosen, found.interval.estimate, found.n) == ("p10 against uniform", 1.0, {"p10": 5, "uniform": 5})
    assert found.verdict == "holds"
    assert test.find(only({name: x[:4] for name, x in rates.items()}), HERE) is None


def in_blocks(method_values, column="crash_rate", **more):
    """The evidence of ``only`` where the policies of a seed began with the same one."""
    found = only(method_values, column, **more)
    rows = [row | {"block": f"base {row['seed']}"} for own in found.rows.values() for row in own.values()]
    return Evidence(rows)


BASE = 10.0 ** -np.arange(1.0, 7.0)  # six bases, of which each crashes ten times as often as the next


def test_policies_are_compared_within_their_bases():
    """A method that is better on each of six bases is better, though bases differ by much more; apart nothing shows."""
    values = {"vds": 1.2 * BASE, "uniform": BASE, "rnd": 1.1 * BASE[:5]}
    test = Ordered(NAIVE, (("vds", "uniform"),))
    found, apart = test.find(in_blocks(values), HERE), test.find(only(values), HERE)
    assert (found.interval.estimate, found.p_for, found.verdict) == (1.0, 2 / 64, "holds")
    assert apart.verdict == "undecided"
    three = Ordered(NAIVE, versus(["vds", "rnd"], ["uniform"])).find(in_blocks(values), HERE)
    assert three.n == {"vds": 5, "uniform": 5, "rnd": 5}  # the bases that all of them have
    begun = in_blocks(values | {"cl": 0.9 * BASE[:3]})
    three = Ordered(NAIVE, versus(["vds", "rnd", "cl"], ["uniform"])).find(begun, HERE)
    assert three.n == {"vds": 5, "uniform": 5, "rnd": 5}  # what has not finished takes no bases from what has
    assert Ordered(NAIVE, (("cl", "uniform"),)).find(begun, HERE).n == {"cl": 3, "uniform": 3}


def test_five_bases_cannot_order_two_methods():
    """Five signs of five are p = 1/16 on both sides: the clause is undecided, and says that nothing would be found."""
    found = Ordered(NAIVE, (("vds", "uniform"),)).find(in_blocks({"vds": 2 * BASE[:5], "uniform": BASE[:5]}), HERE)
    assert (found.p_for, found.verdict, found.detectable) == (2 / 32, "undecided", math.inf)
    assert (found.interval.low, found.interval.high) == (pytest.approx(0.025 ** (1 / 5)), 1.0)  # Clopper and Pearson
    groups = Ordered(NAIVE, versus(["rnd", "vds"], ["uniform"]))
    values = {"vds": 2 * BASE[:5], "rnd": 2.1 * BASE[:5], "uniform": BASE[:5]}
    assert groups.find(in_blocks(values), HERE).verdict == "holds"  # of three in five blocks there are 6^5 orders
    assert math.isfinite(groups.find(in_blocks(values), HERE).detectable)


def test_bases_widen_no_spread_and_hide_no_equivalence():
    """Within blocks methods are alike whose bases differ, and a method is wider whose policies move apart on them."""
    base = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    near = in_blocks({"vds": 1.05 * base, "uniform": base})
    found = Alike(NAIVE, "vds", "uniform").find(near, HERE)
    assert (found.verdict, found.interval.estimate) == ("holds", pytest.approx(1.05, rel=1e-3))
    assert Alike(NAIVE, "vds", "uniform").find(only({"vds": 1.05 * base, "uniform": base}), HERE).verdict == "undecided"
    wide = in_blocks({"vds": 0.5 + 3 * (BASE - BASE.mean()), "uniform": 0.5 + (BASE - BASE.mean())})
    spread = Ordered(NAIVE, (("vds", "uniform"),), spread=True).find(wide, HERE)
    assert spread.interval.estimate == pytest.approx(3.0)
    assert spread.p_for < spread.p_against


def test_no_equivalence_where_its_opposite_is_out_of_reach():
    """Of five bases neither the same nor other scores give a verdict that two methods are alike; of six both do."""
    test, one_sided = Alike(SCORE, "vds", "uniform"), Alike(SCORE, "vds", "uniform", at_most=True)
    for bases, verdicts in ((5, ("undecided", "undecided")), (6, ("holds", "does not hold"))):
        score = 0.1 * np.arange(bases)
        near, far = (in_blocks({"vds": score + shift, "uniform": score}, "score") for shift in (0.0, 0.6))
        assert tuple(test.find(each, HERE).verdict for each in (near, far)) == verdicts
        assert test.find(near, HERE).reachable == (0.5**bases, 2 * 0.5**bases)
        assert math.isinf(test.find(near, HERE).detectable) == (bases == 5)
        # Of one side five bases are enough both ways.
        assert [one_sided.find(each, HERE).verdict for each in (near, far)] == ["holds", "does not hold"]
    assert test.find(only({"vds": score, "uniform": score}, "score"), HERE).reachable == (0.0, 0.0)


def test_verdicts_on_bases_are_seldom_wrong():
    """Of studies in which two methods differ on no base but by noise, at most one in twenty has a verdict."""
    rng, wrong, studies = np.random.default_rng(5), 0, 200
    for _ in range(studies):
        base = rng.normal(0.0, 3.0, 8)
        values = {name: np.exp(base + rng.normal(0.0, 0.2, 8)) for name in ("vds", "uniform")}
        wrong += Ordered(NAIVE, (("vds", "uniform"),)).find(in_blocks(values), HERE).verdict != "undecided"
    # The count of 200 at 5 % is 10 on average; four standard deviations above.
    assert wrong <= 10 + 4 * math.sqrt(200 * 0.05 * 0.95)


def test_a_base_counts_once_in_a_sign_test():
    """Policies of several methods from one base are one vote, by their mean."""
    data = in_blocks({"p25": [1.0] * 6, "p75": [-0.5] * 6, "p90": [2.0] * 3}, "score")
    found = Mostly(SCORE, ("p25", "p75", "p90")).find(data, HERE)
    assert found.p_for == pytest.approx(scipy_stats.binomtest(6, 6).pvalue)
    assert found.n == {"p25": 6, "p75": 6, "p90": 3}


def test_bases_are_exchanged_as_a_whole():
    """Whether more hangs on the method is asked of whole bases: of six there are 64 exchanges, not one per policy."""
    rng = np.random.default_rng(0)
    rows = []
    for goals, effect in (("naive", 0.0), ("argmax", 3.0)):
        values = {name: np.exp(effect * i + rng.normal(size=6)) for i, name in enumerate(("coop", "p25", "vds", "rnd"))}
        rows += [row for own in in_blocks(values, goals=goals).rows.values() for row in own.values()]
    test = Matters(ATTACKED, NAIVE, ("coop", "p25", "vds", "rnd"))
    paired = test.find(Evidence(rows), HERE)
    assert paired.interval.estimate > 0.3
    assert paired.p_for == 2 / 64  # all 64 of them
    assert (paired.verdict, math.isfinite(paired.detectable)) == ("holds", True)
    apart = test.find(Evidence([{**row, "block": ""} for row in rows]), HERE)
    assert apart.p_for <= paired.p_for
    five = test.find(Evidence(rows).only(range(1, 6)), HERE)
    assert (five.p_for, five.verdict, five.detectable) == (2 / 32, "undecided", math.inf)
