"""Claims: clauses on populations whose truth is known, what a verdict means, and what is read from a study."""

import math

import numpy as np
import pytest

from deimos.checks import RunError
from deimos.goals.methods import method as method_named
from deimos.study import permutation
from deimos.study.data import Data, Where
from deimos.study.results import RESULT_COLUMNS, Results
from deimos.study.stats import Interval
from reproduction import claim_tests, claims, lines, measures
from reproduction.claim_list import CLAIMS
from reproduction.claim_tests import Matters, Ordered
from reproduction.claims import Claim, Clause, Finding, holm
from reproduction.measures import ATTACKED, GAIN, LATE, NAIVE, PENALTIES, Evidence, Place
from reproduction.thesis import ENVIRONMENTS, LEGGED_METHODS, PARTICLE_METHODS

POINTS = 40
BY_ID = {claim.id: claim for claim in CLAIMS}
HERE = Place("directional", 100)


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
        for method in methods or (*(LEGGED_METHODS if legged else PARTICLE_METHODS), *PENALTIES):
            for seed in range(seeds):
                key = {
                    "environment": environment, "method": method, "seed": seed, "setting": environment,
                    "selector": method, "code": "a",
                }  # fmt: skip
                for period in (100, 500) if legged else (100,):
                    for goals in ("naive", "adversary"):
                        crashes = int(np.exp(rng.normal(level(environment, method, goals, period), spread)))
                        rows.append(empty | key | {
                            "goals": goals, "goal_period": period, "worlds": 2000, "steps": 2000, "crashes": crashes,
                            "crashes_per_1000": crashes / 4000, "crash_rate": min(1.0, crashes / 40_000),
                            "reward": rng.normal(0.8, 0.01), "score": rng.normal(0.8, 0.02),
                            "weak_adversary": False if goals == "adversary" else None, "fps": rng.normal(3e5, 1e3),
                            "num_envs": 2000, "env_steps": 2000, "trained_period": 100, "device": "cpu",
                            "versions": "v",
                        })  # fmt: skip
                crashes = 5 * np.exp(-np.arange(POINTS) / 20 + rng.normal(0, 0.2, POINTS))
                lines.append(key | {
                    "env_steps": tuple(24.0 * np.arange(1, POINTS + 1)), "reward": (0.7,) * POINTS,
                    "crashes_per_1000": tuple(crashes), "selected_fraction": tuple(rng.normal(0.98, 0.001, POINTS)),
                    "goal_map": tuple(rng.integers(1, 9, 144)), "speed": rng.normal(1.0, 0.1),
                    "risk": tuple(rng.uniform(0.4, 0.9, 5)), "goal_percentile": (50.0,) * POINTS,
                })  # fmt: skip
    return Results(rows, lines)


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    """Resample and permute little: 199 permutations are enough for p-values of 2.5 %."""
    monkeypatch.setattr(claim_tests, "RESAMPLES", 100)
    monkeypatch.setattr(permutation, "PERMUTATIONS", 199)


def evidence(results, **more):
    """That of some results."""
    return Evidence(results.rows, results.curves, **more)


@pytest.fixture(scope="module")
def alike():
    """Eight seeds of everything, where no method differs from another, and rounds of Table 4.1."""
    rng = np.random.default_rng(3)
    rounds = [{"seconds": {place: {name: rng.uniform(1, 2) for name in ("uniform", "p25", "rnd", "vds", "cl")}
                           for place in ENVIRONMENTS}} for _ in range(8)]  # fmt: skip
    return evidence(population(8), speeds=rounds)


def finding(p_for, p_against):
    """A finding with these p-values."""
    return Finding(
        effect="z", interval=Interval(0, 0, 0), no_difference=0.0, p_for=p_for, p_against=p_against, detectable=1.0,
        n={"uniform": 10},
    )  # fmt: skip


class Told:
    """A test that finds what it is told, wherever it is asked."""

    methods = ("uniform", "p25")

    def __init__(self, *found):
        self.found = list(found)

    def find(self, evidence, place):
        """What is next."""
        return self.found.pop(0)


def claim_of(*found, **more):
    """A claim whose clauses find these p-values, in one environment; ``None`` for one without data."""
    tests = [Told(None if each is None else finding(*each)) for each in found]
    return Claim("C0", "It is so.", tuple(Clause(1, "so", each, ("relative",)) for each in tests), **more)


def test_few_bases_give_estimates_without_verdicts():
    """Where policies branched off fewer than five bases the effect is told, and neither verdict."""
    rows = [
        {"environment": "relative", "goal_period": 100, "goals": "naive", "method": name, "seed": seed,
         "crash_rate": 0.01 * (1 + seed + 20 * place), "block": f"base {seed}"}
        for place, name in enumerate(("uniform", "p25", "p50", "p75")) for seed in range(6)
    ]  # fmt: skip
    test = Ordered(NAIVE, (("p25", "uniform"), ("p50", "uniform"), ("p75", "uniform")))
    claim = Claim("C0", "It is so.", (Clause(1, "so", test, ("relative",)),))
    found = {}
    for bases in (4, 5):
        own = Evidence([row for row in rows if row["seed"] < bases])
        (found[bases],) = claims.test(claim, own).results
    assert (found[5].verdict, found[5].finding.interval.estimate) == ("holds", 1.0)
    few = found[4].finding
    assert (few.verdict, few.interval.estimate, few.detectable) == ("undecided", 1.0, math.inf)


def test_all_claims_are_there():
    """There are 37, numbered in order, each with its words and clauses, whose methods exist."""
    assert [claim.id for claim in CLAIMS] == [f"C{i}" for i in range(1, 38)]
    for claim in CLAIMS:
        assert claim.text.endswith(".")
        assert claim.clauses
        for clause in claim.clauses:
            assert set(clause.environments) <= set(ENVIRONMENTS)
            assert clause.text
            assert bool(clause.line) == bool(clause.words) == (claim.id != "C37")
            for name in clause.test.methods:
                assert method_named(name.partition(" @ ")[0])


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.id)
def test_complete_data_decide_every_clause(alike, claim):
    """With every method in every environment each clause has a finding in each of its places, with all its methods."""
    outcome = claims.test(claim, alike)
    everywhere = sum(len(clause.places(alike)) for clause in claim.clauses)
    unsafe = claim.id == "C12"  # no policy of these crashes in 1 % of its interactions
    assert len(outcome.results) == everywhere - unsafe
    assert len(outcome.without_data) == unsafe
    for each in outcome.results:
        assert 0.0 <= each.finding.p_for <= 1.0
        assert 0.0 <= each.finding.p_against <= 1.0
        assert each.finding.detectable > 0.0
        assert not math.isnan(each.finding.interval.estimate)
        assert not [name for name in each.missing if name in LEGGED_METHODS and name != "cl"]


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.id)
def test_no_data_is_no_verdict(claim):
    """Where no environment of a claim was run, nothing is said of any clause."""
    outcome = claims.test(claim, evidence(population(3, ["elsewhere"], methods=["uniform"])))
    assert (outcome.line, outcome.results, outcome.without_data) == ("no data", (), claim.clauses)


@pytest.mark.parametrize(
    ("p_for", "p_against", "verdict"),
    [(0.05, 1, "holds"), (1, 0.05, "does not hold"), (0.06, 0.06, "undecided")],
)
def test_verdict_goes_either_way(p_for, p_against, verdict):
    """A p-value of at most 5 % decides, on either side alike."""
    assert finding(p_for, p_against).verdict == verdict


def test_line_of_a_claim_counts_clauses(alike):
    """It says how many of them hold, how many do not and how many are undecided; those without data do not count."""
    outcome = claims.test(claim_of((0.01, 1), (0.01, 1), (1, 0.01), (0.5, 1), None), alike)
    assert outcome.line == "2 of 4 clauses hold; 1 does not, 1 undecided"
    assert outcome.results[0].missing == ("p25",)
    assert len(outcome.without_data) == 1
    assert outcome.within("absolute").line == "no data"
    assert outcome.within("relative").line == outcome.line
    assert claims.test(claim_of((1, 1)), alike).line == "0 of 1 clauses hold; 1 undecided"
    assert claims.test(claim_of((0.01, 1)), alike).line == "1 of 1 clause holds"


def test_what_one_clause_decides_is_corrected(alike):
    """Where one clause is enough, p-values for it are those of Holm's rule; those against it stay as they are."""
    pair = [(0.03, 1), (1, 0.03)]
    assert claims.test(claim_of(*pair), alike).line == "1 of 2 clauses holds; 1 does not"
    outcome = claims.test(claim_of(*pair, one_is_enough=True), alike)
    assert outcome.line == "0 of 2 clauses hold (one is enough); 1 does not, 1 undecided"
    assert [each.finding.p_for for each in outcome.results] == [0.06, 1.0]


def test_holm_on_the_textbook_example():
    """Holm's procedure on 0.01, 0.04, 0.03, 0.005 multiplies by 4, 3, 2, 1 and never falls."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []


def test_planted_effects_are_found():
    """Populations in which the thesis is right make its clauses hold, and those in which it is wrong the opposite."""

    def right(environment, method, goals, period):
        if goals == "naive":
            return 5.0
        return {"p25": 5.0, "uniform": 7.0, "vds": 7.0, "p10": 6.5, "p50": 6.5}.get(method, 8.0)

    data = evidence(population(20, ["directional", "absolute"], right, 0.3))
    verdicts = {each.clause.test.methods: each.verdict for each in claims.test(BY_ID["C7"], data).results}
    assert verdicts.pop(("p25",)) == "undecided"  # it crashes no more under attack here
    assert set(verdicts.values()) == {"holds"}
    crashes = [each for each in claims.test(BY_ID["C15"], data).results
               if isinstance(each.clause.test, Ordered) and not each.clause.test.spread]  # fmt: skip
    assert [each.verdict for each in crashes] == ["holds"] * 4
    wrong = evidence(population(20, ["directional"], lambda e, m, g, t: 7.0 if m == "p25" else 5.0, 0.3))
    found = [each.verdict for each in claims.test(BY_ID["C15"], wrong).results if each.clause in
             [other.clause for other in crashes]]  # fmt: skip
    assert found == ["does not hold"] * 4


@pytest.mark.parametrize(("attacked", "naive", "verdict"), [(3.0, 0.0, "holds"), (0.0, 3.0, "does not hold")])
def test_matters_more_where_methods_differ(attacked, naive, verdict):
    """Methods that differ in one measure alone matter more there."""

    def level(environment, method, goals, period):
        place = PARTICLE_METHODS.index(method) / 9 - 0.5
        return 6.0 + place * (attacked if goals == "adversary" else naive)

    data = evidence(population(10, ["directional"], level, methods=PARTICLE_METHODS))
    assert Matters(ATTACKED, NAIVE, PARTICLE_METHODS).find(data, HERE).verdict == verdict


def test_weak_adversaries_count():
    """A policy whose Adversary found nothing to learn from is in every sample like any other."""
    results = population(5, ["directional"], methods=["uniform"])
    for row in results.rows:
        row["weak_adversary"] = row["goals"] == "adversary"
    data = Evidence.of(Data(results))
    assert [len(measure(data, HERE, "uniform")) for measure in (NAIVE, ATTACKED, GAIN)] == [5, 5, 5]


def test_literal_directors_are_the_thesis():
    """Where an environment has methods that learn fear as the thesis does, they are what names mean, unless told."""
    results = population(4, ["directional"], methods=["uniform", "p25", "p25-literal", "p50"])
    elsewhere = population(4, ["quad"], methods=["p25"])
    rates = {row["method"]: row["crash_rate"] for row in results.rows if row["seed"] == 3 and row["goals"] == "naive"}
    both = Results(results.rows + elsewhere.rows, results.curves + elsewhere.curves)
    data, as_named = evidence(both), evidence(both, renamed=False)
    assert data.methods == ["p25", "p50", "uniform"]
    assert as_named.methods == ["p25", "p25-literal", "p50", "uniform"]
    assert len(NAIVE(data, Place("quad", 100), "p25")) == len(LATE(data, Place("quad", 100), "p25")) == 4
    assert NAIVE(data, HERE, "p25")[3] == rates["p25-literal"]
    assert NAIVE(data.only([3]), HERE, "p25") == {3: rates["p25-literal"]}
    assert NAIVE(as_named, HERE, "p25")[3] == rates["p25"]


def test_attack_is_the_worst_where_rows_have_it():
    """Safety under attack is the worst attacker's column, and in rows of 0.1.0 the Adversary's rate."""
    results = population(4, ["directional"], methods=["uniform"])
    adversary = ATTACKED(evidence(results), HERE, "uniform")
    assert adversary == {row["seed"]: row["crash_rate"] for row in results.rows if row["goals"] == "adversary"}
    for row in results.rows:
        row |= {"worst": 0.1 * row["seed"], "goals": row["goals"].replace("adversary", "argmax")}
    assert ATTACKED(evidence(results), HERE, "uniform") == pytest.approx({0: 0.0, 1: 0.1, 2: 0.2, 3: 0.3})


def test_measures_of_other_places():
    """``p75 @ 500`` are its policies at another T, and ``rnd @ particle`` all of Particle Gym's."""
    results = population(3, methods=["rnd"])
    data = evidence(results)
    here, later = (NAIVE(data, Place("quad", period), "rnd") for period in (100, 500))
    assert NAIVE(data, Place("quad", 100), "rnd @ 500") == later != here
    assert len(NAIVE(data, Place("quad", 100), "rnd @ particle")) == 9


def test_measures_of_curves():
    """A curve's last tenth, its fall over training and in its last fifth are those of a known one."""
    crashes = tuple(np.concatenate([np.full(20, 5.0), np.full(60, 1.0), np.linspace(2.0, 1.0, 20)]))
    curve = {"environment": "directional", "method": "p25", "seed": 0, "crashes_per_1000": crashes,
             "goal_map": tuple(np.eye(12).flatten()), "risk": (math.nan, 0.9, 0.7), "speed": 3.0}  # fmt: skip
    data = Evidence([], [curve])
    value = {name: getattr(measures, name)(data, HERE, "p25") for name in
             ("LATE", "FALL", "LATE_FALL", "HALFWAY", "DIVERSITY", "RISK", "MOTION")}  # fmt: skip
    assert value["LATE"][0] == pytest.approx(np.mean(crashes[-10:]))
    assert value["FALL"][0] == pytest.approx(math.log1p(5000) - math.log1p(1500))
    assert value["LATE_FALL"][0] == pytest.approx(math.log(2), rel=0.02)  # of the logarithm of a straight line
    assert value["HALFWAY"][0] == pytest.approx(math.log1p(5000) - math.log1p(1000) - math.log(10))
    assert (value["DIVERSITY"][0], value["MOTION"][0]) == (0.0, 3.0)
    assert value["RISK"][0] == pytest.approx(0.3)
    uniform = Evidence([], [curve | {"goal_map": (1,) * 144}])
    assert measures.DIVERSITY(uniform, HERE, "p25")[0] == pytest.approx(1.0)
    assert measures.DIVERSITY(Evidence([], [replace_map(curve)]), HERE, "p25") == {}


def test_branches_have_no_beginning():
    """What became of a training since its beginning is not asked of one that branched off a policy."""
    curve = {"environment": "quad", "method": "vds", "seed": 1, "crashes_per_1000": tuple(np.linspace(5.0, 0.1, 40))}
    alone, branch = Evidence([], [curve]), Evidence([], [curve | {"block": "base 1"}])
    place = Place("quad", 100)
    for measure in (measures.HALFWAY, measures.FALL):
        assert (len(measure(alone, place, "vds")), measure(branch, place, "vds")) == (1, {})
    assert measures.LATE(branch, place, "vds") == measures.LATE(alone, place, "vds") != {}


def replace_map(curve):
    """The same curve of a training without a map."""
    return {name: value for name, value in curve.items() if name != "goal_map"}


@pytest.mark.parametrize(("worlds", "known"), [(200, False), (690, False), (700, True), (1500, True)])
def test_short_evaluation_does_not_show_nearly_no_crashes(worlds, known):
    """Where a policy at the limit is most probably without a crash, C11 has no data; else those without one count."""
    results = population(4, ["relative"], methods=["vds"])
    for row in results.rows:
        row |= {"crashes": row["seed"] % 2, "worlds": worlds, "steps": 1000}  # 1 is below 1.5, and yet too many
    outcome = claims.test(BY_ID["C11"], evidence(results))
    assert [each.finding.interval.estimate for each in outcome.results] == [0.5] * known


@pytest.mark.parametrize("worlds", [505, 2000])
def test_policies_at_the_limit_are_not_nearly_without_crashes(worlds):
    """Of policies with one crash in 10^6 steps at most half count as having fewer, with a thirtieth most do."""
    limit = worlds * 2000 * measures.NEARLY_NONE

    def share(mean):
        rows = [{"environment": "relative", "goal_period": 100, "goals": "naive", "method": "vds", "seed": seed,
                 "worlds": worlds, "steps": 2000, "crashes": crashes}
                for seed, crashes in enumerate(np.random.default_rng(0).poisson(mean, 2000))]  # fmt: skip
        numbers = measures.FEW_CRASHES(Evidence(rows), Place("relative", 100), "vds")
        return np.mean(np.array([*numbers.values()]) > 0)

    assert share(limit) <= 0.5 + 4 * math.sqrt(0.25 / 2000)
    assert share(limit / 30) > 0.9


def test_safe_and_unsafe_policies_are_told_apart():
    """C12 looks at policies that crash in less than 1 % of their interactions, and at the others."""
    rates = {"naive": [0.001, 0.002, 0.003, 0.2, 0.3, 0.4], "argmax": [0.1, 0.1, 0.1, 0.1, 0.1, 0.1]}
    rows = [{"environment": "relative", "goal_period": 100, "goals": goals, "method": "p25", "seed": seed,
             "crash_rate": rate} for goals, own in rates.items() for seed, rate in enumerate(own)]  # fmt: skip
    outcome = claims.test(BY_ID["C12"], Evidence(rows))
    assert [(each.finding.n, each.finding.interval.estimate) for each in outcome.results] == [({"p25": 3}, 1.0)] * 2


def test_training_counts_once(alike):
    """What is said of training has one result in an environment that was evaluated at two T, and else there are two."""
    found = {claim: [str(each.place) for each in claims.test(BY_ID[claim], alike).results if each.clause.line in
                     (505, 662) and each.place.environment == "quad"] for claim in ("C24", "C29")}  # fmt: skip
    assert found == {"C24": ["quad, T = 100", "quad, T = 500"], "C29": ["quad, T = 100"]}


def test_lines_are_checked(tmp_path, monkeypatch, capsys):
    """The command names the clauses whose words are not in their line, and only those."""
    text = [""] * 800
    for claim in CLAIMS:
        for clause in claim.clauses:
            text[clause.line - 1] += f" {clause.words}  " if clause.line else ""
    assert lines.wrong(text) == []
    text[549] = "something else"
    assert lines.wrong(text) == ["C1: line 550 does not say 'RND does not lend itself well'"]
    file = tmp_path / "thesis.txt"
    file.write_text("\n".join(text))
    monkeypatch.setattr("sys.argv", ["lines", str(file)])
    assert lines.main() == 1
    assert capsys.readouterr().out.startswith("C1: line 550")


def test_only_some_methods_are_left():
    """Data of the thesis's methods are those that a study without the others would have, curves too."""
    with_more = Data(population(4, ["relative"], methods=[*PARTICLE_METHODS, "learnability"]))
    left = with_more.only(PARTICLE_METHODS)
    assert "learnability" in with_more.methods("relative")
    assert set(left.methods("relative")) == set(PARTICLE_METHODS)
    assert left.curves("relative", "learnability") == []
    assert {row["method"] for row in left.curve_rows} == set(PARTICLE_METHODS)
    assert len(left.sample(Where("relative", "naive", 100), "learnability", "crashes")) == 0


def test_argmax_is_the_thesis_adversary():
    """What evaluations call argmax is what claims and figures call the Adversary; other attackers are themselves."""
    results = population(5, ["directional"], methods=["uniform"])
    before = Data(results).sample(Where("directional", "adversary", 100), "uniform", "crashes")
    for row in results.rows:
        row["goals"] = {"adversary": "argmax"}.get(row["goals"], row["goals"])
    results.rows += [row | {"goals": "scripted", "crashes": 9} for row in results.rows if row["goals"] == "naive"]
    data = Data(results)
    assert data.goals == ["naive", "adversary", "scripted"]
    assert data.sample(Where("directional", "adversary", 100), "uniform", "crashes").tolist() == before.tolist()
    assert data.sample(Where("directional", "scripted", 100), "uniform", "crashes").tolist() == [9.0] * 5


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
