"""Claims: findings on populations whose truth is known, Holm's correction, and what a verdict means."""

import math

import numpy as np
import pytest
from scipy import stats as scipy_stats

from deimos.checks import RunError
from deimos.study import stats
from deimos.study.data import Data, Where
from deimos.study.results import RESULT_COLUMNS, Results
from deimos.study.stats import Interval
from reproduction import claim_custom, claim_tests, claims, thesis
from reproduction.claim_list import CLAIMS
from reproduction.claims import Claim, Finding
from reproduction.thesis import ENVIRONMENTS, LEGGED_METHODS, PARTICLE_METHODS

POINTS = 40
BY_ID = {claim.id: claim for claim in CLAIMS}


def level(environment, method, goals, period):
    """Mean log crashes of a method: the same for all under Naive, two more under the Adversary."""
    return 5.0 + 2.0 * (goals == "adversary")


def population(seeds=10, environments=ENVIRONMENTS, level=level, spread=0.5, methods=None):
    """Rows and curves of every method everywhere, with log crashes that are normal around a level."""
    rng = np.random.default_rng(0)
    blank = {str: None, tuple: (), dict: {}, list: []}
    empty = {name: blank.get(kind, math.nan) for name, kind in RESULT_COLUMNS.items()}
    rows, lines = [], []
    for environment in environments:
        legged = environment.startswith("quad")
        for method in methods or (LEGGED_METHODS if legged else PARTICLE_METHODS):
            for seed in range(seeds):
                key = {
                    "environment": environment, "method": method, "seed": seed, "setting": environment,
                    "selector": method,
                }  # fmt: skip
                for period in (100, 500) if legged else (100,):
                    for goals in ("naive", "adversary"):
                        crashes = int(np.exp(rng.normal(level(environment, method, goals, period), spread)))
                        rows.append(empty | key | {
                            "goals": goals, "goal_period": period, "worlds": 2000, "steps": 2000, "crashes": crashes,
                            "crashes_per_1000": crashes / 4000, "crash_rate": crashes / 40_000,
                            "reward": rng.normal(0.8, 0.01), "score": rng.normal(0.8, 0.02),
                            "weak_adversary": False if goals == "adversary" else None, "fps": rng.normal(3e5, 1e3),
                            "num_envs": 2000, "env_steps": 2000, "trained_period": 100, "device": "cpu",
                            "versions": "v",
                        })  # fmt: skip
                crashes = 5 * np.exp(-np.arange(POINTS) / 20 + rng.normal(0, 0.2, POINTS))
                lines.append(key | {
                    "env_steps": tuple(24.0 * np.arange(1, POINTS + 1)), "reward": (0.7,) * POINTS,
                    "crashes_per_1000": tuple(crashes), "selected_fraction": tuple(rng.normal(0.98, 0.001, POINTS)),
                })  # fmt: skip
    return Results(rows, lines)


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    """Bootstrap little: no test here looks at the ends of an interval."""
    monkeypatch.setattr(stats, "RESAMPLES", 200)


@pytest.fixture(scope="module")
def alike():
    """Twenty seeds of everything, where no method differs from another."""
    return Data(population(20))


def finding(p_for, p_against, detectable=0.7, required=True):
    """A finding with these p-values, whose smallest effect of interest is 0.75."""
    return Finding(
        what="x", where="y", effect="z", interval=Interval(0, 0, 0), p_for=p_for, p_against=p_against,
        detectable=lambda alpha: detectable, wanted=0.75, n=(10, 10), required=required,
    )  # fmt: skip


def test_all_claims_are_there():
    """There are 32, numbered in order, each with its words, its environments and its test."""
    assert [claim.id for claim in CLAIMS] == [f"C{i}" for i in range(1, 33)]
    for claim in CLAIMS:
        assert set(claim.environments) <= set(ENVIRONMENTS)
        assert claim.text.endswith(".")
        assert claim.test


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.id)
def test_complete_data_give_every_planned_test(alike, claim):
    """With every method in every environment a claim makes exactly the tests that were planned."""
    outcome = claims.test(claim, alike)
    assert (outcome.made, outcome.missing, outcome.in_part) == (claim.planned, (), False)
    for assessed in outcome.assessed:
        assert 0.0 <= assessed.p <= 1.0
        assert assessed.detectable >= 0.0
        assert not math.isnan(assessed.finding.interval.estimate)


def test_only_some_methods_are_left():
    """Data of the thesis's methods are those that a study without the others would have, curves and claims too."""
    with_more = Data(population(4, ["relative"], methods=[*PARTICLE_METHODS, "learnability"]))
    left = with_more.only(PARTICLE_METHODS)
    assert "learnability" in with_more.methods("relative")
    assert set(left.methods("relative")) == set(PARTICLE_METHODS)
    assert left.curves("relative", "learnability") == []
    assert len(left.sample(Where("relative", "naive", 100), "learnability", "crashes")) == 0
    claim = next(claim for claim in CLAIMS if claim.id == "C11")
    assert claims.test(claim, left).made == claim.planned < claims.test(claim, with_more).made


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.id)
def test_no_data_is_not_testable(claim):
    """Where no environment of a claim was run, it is not testable, and says where data are missing."""
    outcome = claims.test(claim, Data(population(3, ["elsewhere"])))
    assert (outcome.verdict, outcome.assessed, outcome.missing) == ("not testable", [], claim.environments)


@pytest.mark.parametrize(
    ("p_for", "p_against", "detectable", "verdict"),
    [
        (0.01, 1, 0.9, "supported"),
        (1, 0.01, 0.9, "contradicted"),
        (0.3, 1, 0.7, "undecided"),
        (0.3, 1, 0.8, "underpowered"),
    ],
)
def test_verdict_of_one_finding(p_for, p_against, detectable, verdict):
    """A miss is undecided only if the test could have found the smallest effect of interest."""
    (assessed,) = claims.assess([finding(p_for, p_against, detectable)])
    assert (assessed.verdict, assessed.p) == (verdict, min(p_for, p_against))


@pytest.mark.parametrize(("how", "alone", "together"), [("all", "supported", "contradicted"),
                                                        ("any", "contradicted", "supported")])  # fmt: skip
def test_only_what_one_finding_decides_is_corrected(how, alone, together):
    """What needs every test of a claim takes p-values as they are; what one of them decides corrects them by Holm."""
    of = {"supported": (0.03, 1), "contradicted": (1, 0.03)}
    pair = [finding(*of[alone])] * 2
    assert [(each.verdict, each.p) for each in claims.assess(pair, how)] == [(alone, 0.03)] * 2
    assert claims.combined(claims.assess(pair, how), how, 2) == alone
    pair = [finding(*of[together])] * 2
    assert [(each.verdict, each.p) for each in claims.assess(pair, how)] == [("undecided", 0.06)] * 2
    assert claims.combined(claims.assess(pair, how), how, 2) == "undecided"


def test_effects_are_detectable_at_the_stricter_level():
    """The minimum detectable effect is that at the level of Holm's first step."""
    levels = []
    spy = finding(1, 1)
    object.__setattr__(spy, "detectable", lambda alpha: levels.append(alpha) or 1.0)
    claims.assess([spy, spy])
    assert levels == [0.025, 0.025]


def test_verdict_of_a_claim():
    """All required findings must support a claim and one contradicts it; where one is enough, only all contradict."""
    yes, no, open_one = finding(1e-6, 1), finding(1, 1e-6), finding(0.5, 1)
    for findings, every, one in (
        ([yes, yes], "supported", "supported"),
        ([yes, no], "contradicted", "supported"),
        ([yes, open_one], "undecided", "supported"),
        ([no, open_one], "contradicted", "undecided"),
        ([no, no], "contradicted", "contradicted"),
        ([yes, finding(0.5, 1, 0.9)], "underpowered", "supported"),
        ([finding(1, 1, required=False)], "not testable", "not testable"),
        ([yes, finding(1, 1, required=False)], "supported", "supported"),
        ([yes, finding(1, 1e-6, required=False)], "contradicted", "supported"),
    ):
        assert claims.combined(claims.assess(findings)) == every
        assert claims.combined(claims.assess(findings, "any"), "any") == one
    assert claims.combined(claims.assess([no, no], "any"), "any", planned=3) == "undecided"


def test_eight_seeds_can_support_a_claim_of_ten_tests():
    """Signed ranks of 8 pairs reach p = 1 / 128 and no less: enough for a claim that needs all of its ten tests."""
    rising = claim_tests.paired_more("", "here", np.arange(1.0, 9.0), np.zeros(8))
    assert rising[0].p_for == 2 / 2**8
    assert claims.combined(claims.assess(rising * 10), planned=10) == "supported"


def test_planted_effects_are_found():
    """Populations in which the thesis is right support its claims, and those in which it is wrong contradict them."""

    def right(environment, method, goals, period):
        if goals == "naive":
            return 5.0 + 2 * (method == "rnd")
        return {"p25": 5.0, "uniform": 7.0, "vds": 7.0, "p10": 6.5, "p50": 6.5}.get(method, 8.0)

    data = Data(population(20, ["directional", "absolute"], right, 0.3))
    attacked = claims.test(BY_ID["C7"], data)
    by_method = {each.finding.what.split(":")[0]: each.verdict for each in attacked.assessed}
    assert by_method["p25"] != "supported"  # it crashes no more under attack here
    assert {verdict for name, verdict in by_method.items() if name not in ("p25", "rnd")} == {"supported"}
    safest = claims.test(BY_ID["C15"], data)
    crashes = [each.verdict for each in safest.assessed if each.finding.what.startswith("crashes")]
    assert crashes == ["supported"] * 7
    assert claims.test(BY_ID["C1"], data).verdict != "supported"  # all train alike
    assert [each.verdict for each in claims.test(BY_ID["C11"], data).assessed] == []
    swapped = Data(population(20, ["directional"], lambda e, m, g, t: 7.0 if m == "p25" else 5.0, 0.3))
    assert claims.test(BY_ID["C15"], swapped).verdict == "contradicted"


def test_weak_adversaries_stay_out():
    """A row that is marked weak is in no sample, but counted."""
    results = population(5, ["directional"], methods=["uniform"])
    rows = results.rows
    rows[1]["weak_adversary"] = True
    data = Data(results)
    assert data.weak == [rows[1]]
    assert len(data.sample(Where("directional", "adversary", 100), "uniform", "crashes")) == 4
    assert data.seeds(Where("directional", "adversary", 100), ["uniform"]) == [1, 2, 3, 4]
    naive, attacked = claim_tests.both(data, "directional", 100, "uniform", "crashes")
    assert len(naive) == len(attacked) == 4


def test_argmax_is_the_thesis_adversary():
    """What evaluations call argmax is what claims and figures call the Adversary; other attackers are themselves."""
    results = population(5, ["directional"], methods=["uniform"])
    before = Data(results).sample(Where("directional", "adversary", 100), "uniform", "crashes")
    for row in results.rows:
        row["goals"] = {"adversary": "argmax"}.get(row["goals"], row["goals"])
    results.rows += [row | {"goals": "scripted", "crashes": 9} for row in results.rows if row["goals"] == "naive"]
    data = Data(results)
    assert data.sample(Where("directional", "adversary", 100), "uniform", "crashes").tolist() == before.tolist()
    assert data.sample(Where("directional", "scripted", 100), "uniform", "crashes").tolist() == [9.0] * 5


def test_best_p_needs_twenty_seeds():
    """With fewer than twenty seeds the headline cannot be split and is not testable."""
    for seeds, verdict in ((19, {"not testable"}), (20, set(claims.VERDICTS) - {"not testable"})):
        assert claims.test(BY_ID["C28"], Data(population(seeds, ["relative"]))).verdict in verdict


def table_of(results, number):
    """Rows of evaluations, or training curves."""
    return (results.rows, results.curves)[number]


@pytest.mark.parametrize("table", [0, 1])
def test_what_cannot_be_compared_is_not_mixed(table):
    """Another setting in an environment or another selector of a method is refused, in either table."""
    for column, message in (
        ("setting", "environment 'relative' were run with 2 different settings"),
        ("selector", r"'coop' stands for 2 different selectors in environment 'relative' \(coop, other\)"),
    ):
        tables = population(3, ["relative"])
        table_of(tables, table)[0][column] = "other"
        with pytest.raises(RunError, match=message):
            Data(tables)


@pytest.mark.parametrize(("table", "ending"), [(0, ", goals naive, goal_period 100"), (1, "")])
def test_policy_counts_once(table, ending):
    """A second row of the same policy is refused: it does not take the place of the first."""
    tables = population(3, ["relative"])
    rows = table_of(tables, table)
    rows.append(rows[0] | {"hash": "another"})
    with pytest.raises(RunError, match=f"two rows of environment relative, method coop, seed 0{ending};"):
        Data(tables)


def test_paired_test_is_wilcoxons():
    """Its p-value is SciPy's on the pairs, for the side that the signed ranks lean to."""
    rng = np.random.default_rng(1)
    y = rng.normal(size=12)
    x = y + rng.normal(0.8, 1, size=12)
    (found,) = claim_tests.paired_more("", "here", x, y)
    (mirrored,) = claim_tests.paired_more("", "here", y, x)
    assert found.p_for == mirrored.p_against == scipy_stats.wilcoxon(x, y).pvalue
    assert found.p_against == mirrored.p_for == 1.0
    assert claim_tests.paired_more("", "here", x, x)[0].p_for == 1.0


@pytest.mark.parametrize(("pairs", "still", "alpha"), [(5, 0, 0.05), (6, 0, 0.05), (6, 1, 0.05), (8, 0, 0.005)])
def test_paired_test_that_cannot_reject_detects_nothing(pairs, still, alpha):
    """No effect is detectable exactly where even pairs that all moved the same way are not significant."""
    moved = np.concatenate([np.arange(1.0, 1.0 + pairs - still), np.zeros(still)])
    (found,) = claim_tests.paired_more("", "here", moved, np.zeros(pairs))
    assert math.isinf(found.detectable(alpha)) == (found.p_for >= alpha)


def test_one_sample_test_is_students():
    """Above and below its limit it gives SciPy's two-sided p-value."""
    x = np.random.default_rng(2).normal(1, 1, size=9)
    p = scipy_stats.ttest_1samp(x, 0.2).pvalue
    (found,) = claim_tests.positive("", "here", "", x, 1.0, at=0.2)
    assert (min(found.p_for, found.p_against), max(found.p_for, found.p_against)) == (pytest.approx(p), 1.0)
    assert claim_tests.positive("", "here", "", np.ones(4), 1.0)[0].p_for == 0.0


def test_policies_are_the_unit_of_nearly_no_crashes():
    """Of five policies one crashes 1000 times in 4 10^6 steps and one 4 times: three of five are below the limit."""
    results = population(5, ["relative"], methods=["vds"])
    rows = results.rows
    for row, crashes in zip([row for row in rows if row["goals"] == "naive"], (0, 3, 4, 1000, 3), strict=True):
        row["crashes"] = crashes
    (found,) = claim_custom.nearly_none(Data(results), "relative")
    assert found.interval.estimate == 0.6
    assert (found.interval.low, found.interval.high) == pytest.approx((0.1466, 0.9473), abs=1e-4)
    assert found.p_for == pytest.approx(16 / 32)  # 3, 4 or 5 heads of 5
    assert found.p_against == pytest.approx(26 / 32)  # 3 or fewer
    assert math.isinf(found.detectable(1 / 32))
    assert found.detectable(0.05) == pytest.approx(0.8 ** (1 / 5))  # all five must be below it


@pytest.mark.parametrize(("worlds", "tested"), [(200, False), (690, False), (700, True), (1500, True)])
def test_short_evaluation_does_not_show_nearly_no_crashes(worlds, tested):
    """Where a policy at the limit is most probably without a crash, C11 has no data; else those without one count."""
    results = population(4, ["relative"], methods=["vds"])
    rows = results.rows
    for row in rows:
        row |= {"crashes": row["seed"] % 2, "worlds": worlds, "steps": 1000}  # 1 is below 1.5, and yet too many
    outcome = claims.test(BY_ID["C11"], Data(results))
    assert [each.finding.interval.estimate for each in outcome.assessed] == [0.5] * tested
    assert outcome.missing == (() if tested else ("relative",))
    assert (outcome.verdict == "not testable") != tested


def test_mean_ranks_are_of_whole_policies():
    """Ranks are meaned over the evaluations that all methods have; a policy that lacks one of them does not count."""
    results = population(4, ["relative"], methods=["rnd", "vds"])
    rows = results.rows
    for row in rows:
        row["crashes"] = 10 * row["seed"] + (row["method"] == "rnd") + 100 * (row["goals"] == "adversary")
    rows[1]["weak_adversary"] = True  # rnd's first policy
    theirs, own = claim_custom._mean_ranks(Data(results), "relative", "rnd", "vds")
    assert (own.tolist(), theirs.tolist()) == ([1, 2, 4, 6], [3, 5, 7])
    for row in rows:
        row["weak_adversary"] = row["goals"] == "adversary" and row["method"] == "rnd"
    theirs, own = claim_custom._mean_ranks(Data(results), "relative", "rnd", "vds")
    assert (own.tolist(), theirs.tolist()) == ([1, 3, 5, 7], [2, 4, 6, 8])


def test_vertex_of_a_known_parabola():
    """Log crashes on an exact parabola have their vertex where it is."""
    samples = {
        name: np.full(4, 3.0 + 0.002 * (place - 62.0) ** 2)
        for name, place in thesis.ACHIEVED.items()
        if name != "uniform"
    }
    interval, slopes, places = claim_custom.vertex(samples, 50)
    assert (interval.estimate, interval.low, interval.high) == pytest.approx((62.0, 62.0, 62.0))
    assert places == pytest.approx(62.0)
    assert slopes[0] == pytest.approx(50 * 0.004 * (0.5 - 62))
    assert slopes[1] == pytest.approx(50 * 0.004 * (99.5 - 62))
    assert thesis.ACHIEVED["p25"] == 62.5
    assert thesis.ACHIEVED["p90"] == 95.0


@pytest.mark.parametrize(("shape", "p_for", "p_against", "verdict"), [
    (lambda x: x**2, 2 / 1001, 1.0, "supported"),  # falls, then rises, in each of 1000 resamples
    (lambda x: -(x**2), 1.0, 4 / 1001, "contradicted"),  # twice as much: either end would contradict
    (lambda x: x, 1.0, 4 / 1001, "contradicted"),
    (lambda x: -x, 1.0, 4 / 1001, "contradicted"),
], ids=["hump", "upside down", "rising", "falling"])  # fmt: skip
def test_lowest_point_is_inside_a_planted_hump_only(monkeypatch, shape, p_for, p_against, verdict):
    """Populations on a curve give the p-values of slopes that have their sign in every resample."""
    monkeypatch.setattr(stats, "RESAMPLES", 1000)
    place = {name: (x - 50) / 50 for name, x in thesis.ACHIEVED.items()}

    def level(environment, method, goals, period):
        return 8.0 + 2.0 * shape(place.get(method, 0.0))

    data = Data(population(4, ["directional"], level, 0.01))
    inside = [f for f in claim_custom.hump(data, "directional") if f.what == "the lowest point lies inside"]
    assert [(f.p_for, f.p_against) for f in inside] == [(pytest.approx(p_for), pytest.approx(p_against))] * 2
    assert claims.test(BY_ID["C25"], data).verdict == verdict


def test_eta_squared_is_the_anova_share():
    """It is the sum of squares between the groups over the total one."""
    groups = [np.array([1.0, 2, 3]), np.array([4.0, 6]), np.array([0.0, 0, 1])]
    values = np.concatenate(groups)
    between = sum(len(g) * (g.mean() - values.mean()) ** 2 for g in groups)
    expected = between / ((values - values.mean()) ** 2).sum()
    assert claim_custom._eta_squared(*groups) == pytest.approx(expected)
    assert claim_custom._eta_squared(np.ones(3), np.ones(2)) == 0.0


def test_energy_distance_is_its_definition():
    """It is 2 E|X - Y| - E|X - X'| - E|Y - Y'| on scaled columns; equal populations are not told apart, others are."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(8, 2)), rng.normal([5.0, 0.0], size=(7, 2))
    scale = np.concatenate([x, y]).std(axis=0)
    a, b = x / scale, y / scale

    def apart(u, v):
        return np.mean([np.linalg.norm(p - q) for p in u for q in v])

    distance, p = claim_custom.energy_test(x, y)
    assert distance == pytest.approx(2 * apart(a, b) - apart(a, a) - apart(b, b))
    assert p < 0.005
    assert claim_custom.energy_test(x, x + 1e-9)[1] > 0.9


def test_claim_in_part():
    """A claim whose tests could be made only for some methods holds only in part."""
    data = Data(population(10, ["directional"], methods=["uniform", "p25", "coop"]))
    outcome = claims.test(BY_ID["C14"], data)
    assert 0 < outcome.made < BY_ID["C14"].planned
    assert outcome.in_part
    assert isinstance(outcome.claim, Claim)
