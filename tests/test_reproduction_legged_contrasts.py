"""Methods in pairs: a small study whose seeds branch off runs of their own, and rows whose effects are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats as scipy_stats

from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.evaluation import EvalConfig
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle
from deimos.study import cell as worker
from deimos.study import outcomes as study_outcomes
from deimos.study import plan, stats
from deimos.study import report as study_report
from deimos.study.data import Data, Where, delivered_dose
from deimos.study.folder import StudyFolder
from deimos.study.report import outcomes
from deimos.study.results import Results, merge
from reproduction import claim_tests, deviations, legged_bases, legged_contrasts, legged_figures, report
from reproduction.figures import figures
from reproduction.measures import DOSE, SCORE, Evidence, Place

QUAD = Place("quad", 100)
BASES = 3
METHODS = ("uniform", "p75", "vds+p75", "penalty-30")
CONFIG = TrainConfig(  # particles that stand for robots: what is tested knows no environment
    env=particle.Config(goal_period=100, max_speed=40.0), method="uniform", evaluation=False, seed=9, num_envs=16,
    ppo=PPOConfig(num_steps=8, hidden=(8,)), env_steps=16, device="cpu", threads=1,
    eval=EvalConfig(worlds=8, steps=200, adversary_steps=200, attackers=("scripted",)),
)  # fmt: skip


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    """Resample little."""
    monkeypatch.setattr(claim_tests, "RESAMPLES", 100)
    monkeypatch.setattr(stats, "RESAMPLES", 200)


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """The exported tables of a study of four methods that branch off three bases, in pairs."""
    root = tmp_path_factory.mktemp("pairs")
    for base in range(1, BASES + 1):
        trainer, folder = training.start(replace(CONFIG, seed=base), root / f"base_{base}")
        training.train(trainer, folder)
    table = {"name": "quad", "branch_from": f"{root}/base_{{seed}}", "goal_periods": [100]}
    study = StudyFolder(root / "study")
    described = {"seeds": f"1-{BASES}", "methods": list(METHODS), "audit_worlds": 0, "environment": [table]}
    study.add(plan.expand(described))
    for each in study.cells():
        assert worker.run(study, each)
    merge(root / "merged", [study.path])
    return root / "merged"


def simulated(effects, spread=0.02, bases=5, environment="quad", periods=(100,)):
    """Rows of methods on bases that differ by 0.1 in score and by 1 in log rate, with effects (score, log rate)."""
    rng, rows = np.random.default_rng(3), []
    for base in range(1, bases + 1):
        for name, (score, rate) in effects.items():
            for period in periods:
                for goals in ("naive", "argmax"):
                    crashes = 10_000 * math.exp(-3.0 - base + rate + rng.normal(0.0, 10 * spread))
                    rows.append({
                        "environment": environment, "method": name, "seed": base, "goals": goals, "goal_period": period,
                        "score": 0.3 + 0.1 * base + score + rng.normal(0.0, spread), "interactions": 10_000,
                        "interaction_crashes": round(crashes), "crash_rate": round(crashes) / 10_000,
                        "worst": round(crashes) / 5_000, "worst_interactions": 5_000, "block": f"base {base}",
                    })  # fmt: skip
    return Evidence(rows)


NO_EFFECT = {"uniform": (0.0, 0.0), "p75": (0.0, 0.0), "vds+p75": (0.0, 0.0), "penalty-30": (0.0, 0.0)}


def test_a_planted_effect_is_found_on_five_bases():
    """A method that scores higher and crashes less on every base has the smallest p that five signs can have."""
    evidence = simulated(NO_EFFECT | {"p75": (0.1, -1.5)})
    found = legged_contrasts.contrasts(evidence, QUAD, ["p75"])
    assert [each.measure for each in found] == list(legged_contrasts.OUTCOMES)
    for each, effect in zip(found, (0.1, -1.5, -1.5), strict=True):
        assert each.p == 1 / 32
        assert each.mean.low <= effect <= each.mean.high
        assert abs(effect) > each.detectable > 0
        low, high = scipy_stats.ttest_1samp(each.differences, 0.0).confidence_interval(0.95)
        assert (each.mean.low, each.mean.high) == pytest.approx((low, high))


def test_a_worse_method_is_not_called_better():
    """The test is one-sided: where every base says the opposite, p is 1."""
    found = legged_contrasts.contrasts(simulated(NO_EFFECT | {"p75": (-0.1, 1.5)}), QUAD, ["p75"])
    assert [each.p for each in found] == [1.0, 1.0, 1.0]


def test_a_planted_absence_is_no_effect():
    """Where methods are the same but for noise, three contrasts in three outcomes reach no p of 1/32 in this draw."""
    found = legged_contrasts.contrasts(simulated(NO_EFFECT), QUAD, legged_contrasts.PRIMARY)
    assert len(found) == 9
    assert min(each.p for each in found) > 0.05
    assert all(each.mean.low < 0 < each.mean.high for each in found)


def test_only_bases_of_both_are_pairs():
    """Bases that one method lacks take no part, and one base alone is no contrast."""
    rows = [row for own in simulated(NO_EFFECT).rows.values() for row in own.values()]
    few = Evidence([row for row in rows if row["method"] == "uniform" or row["seed"] in (2, 4)])
    found = legged_contrasts.contrasts(few, QUAD, ["p75"])
    assert {each.bases for each in found} == {(2, 4)}
    assert all(each.p >= 1 / 4 and 0 < each.detectable < math.inf for each in found)
    one = Evidence([row for row in rows if row["method"] == "uniform" or row["seed"] == 2])
    assert legged_contrasts.contrasts(one, QUAD, ["p75"]) == []


def test_log_rates_count_crashes():
    """They are log(crashes + 1/2) - log(interactions + 1), without a crash too; the worst is made of its counts."""
    evidence = simulated({"uniform": (0.0, -99.0)}, bases=1)
    assert legged_contrasts.NAIVE(evidence, QUAD, "uniform") == {1: pytest.approx(math.log(0.5 / 10_001))}
    evidence.evaluations(QUAD, "naive", "uniform")[1].update(worst=0.25, worst_interactions=200)
    assert legged_contrasts.WORST(evidence, QUAD, "uniform") == {1: pytest.approx(math.log(50.5 / 201))}
    evidence.evaluations(QUAD, "naive", "uniform")[1].update(worst=math.nan, worst_interactions=math.nan)
    assert legged_contrasts.WORST(evidence, QUAD, "uniform") == {}


def test_tables_say_what_is_judged_and_what_is_estimated(tmp_path, monkeypatch):
    """Primary contrasts of Quad at T2 have p-values; those of Quad+arm have none; engines are compared base by base."""
    monkeypatch.setattr(legged_contrasts, "bases", lambda: [])
    quad, warp, arm = (
        simulated(NO_EFFECT | {"p75": (0.1, -1.5), "vds": (0.0, 0.0)}, environment=name, bases=bases)
        for name, bases in (("quad", 5), ("quad_warp", 2), ("quad_arm", 3))
    )
    rows = [row for each in (quad, warp, arm) for own in each.rows.values() for row in own.values()]
    found = legged_contrasts.blocks(Evidence(rows))
    titles = [block for block in found if isinstance(block, str) and block.startswith("#")]
    assert titles == [
        "## Methods in pairs, base by base", "### Quad at T2: primary contrasts", "### Quad at T2: exploratory",
        "### Quad at T2, trained and evaluated on mujoco-warp: estimates", "### Quad+arm at T2: estimates",
        "### p75 - uniform on both engines, at T2", "### Not run",
    ]  # fmt: skip
    primary, exploratory, _, estimates, engines, lacking = [block for block in found if isinstance(block, list)]
    assert [row["contrast"] for row in primary[::3]] == [f"{name} - uniform" for name in legged_contrasts.PRIMARY]
    assert {row["p (better)"] for row in primary[:3]} == {f"{1 / 32:.3g}"}
    assert [row["contrast"] for row in exploratory[::3]] == ["vds - uniform", "vds+p75 - vds"]
    assert all("p (better)" not in row for row in estimates)
    assert [row["base"] for row in engines] == ["1", "2", "3", "4", "5"] * 2
    assert [row["mujoco-warp"] == "-" for row in engines[:5]] == [False, False, True, True, True]
    assert engines[0]["native"] == primary[0]["of every base"].split(", ")[0]
    assert {"robot": "quad", "not run": "coop", "would take [core-hours]": "1.7"}.items() <= next(
        row for row in lacking if row["not run"] == "coop"
    ).items()
    assert {row["not run"] for row in lacking}.isdisjoint({"uniform", "p75", "vds", "vds+p75", "penalty-30"})
    claims = {(row["robot"], row["not run"]): row["claims that speak of it"] for row in lacking}
    assert (claims["quad", "T10"], claims["quad_arm", "T10"]) == ("C19", "C22, C23")
    assert not any("C31" in text.split(", ") for text in claims.values())  # speed is not measured by a run
    assert "C35" in claims["quad", "p25"].split(", ")
    assert not any("C35" in text.split(", ") for (robot, _), text in claims.items() if robot == "quad_arm")  # no stairs
    assert claims["quad", legged_contrasts.WITH_PARTICLE] == "C18"
    assert "C18" not in claims["quad", "rnd"].split(", ")


def test_studies_without_bases_have_no_such_section():
    """Where seeds began with nothing in common there is nothing to pair."""
    rows = [{**row, "block": ""} for own in simulated(NO_EFFECT).rows.values() for row in own.values()]
    assert legged_contrasts.blocks(Evidence(rows)) == []


def test_bases_are_told_with_their_spread(tmp_path):
    """Every base that was judged has a row for each T, and all of them their mean and deviation."""
    assert legged_contrasts.bases(tmp_path) == []
    for robot, level in (("quad", 4), ("quad_arm", 0)):
        for index, score in enumerate((0.5, 0.7)):
            home = tmp_path / legged_bases.base_name(robot, index)
            folder = legged_contrasts.RunFolder.create(home)
            folder.write_json("evaluation.json", [
                {"goal_period": period, "score": score, "crash_rate": 0.01, "interaction_crashes": 5,
                 "interactions": 500} for period in (100, 500)
            ])  # fmt: skip
            folder.append_csv("progress.csv", {"iteration": 1, "level": level and level + index})
    title, rows, arm, on_flat = legged_contrasts.bases(tmp_path)
    assert (title, arm) == ("### The bases of quad", "### The bases of quad_arm")
    assert not any("level at the end of training" in row for row in on_flat)  # flat ground has none
    assert [(row["base"], row["T"]) for row in rows] == [
        (name, period) for period in ("100", "500")
        for name in ("quad_base_1", "quad_base_2", "mean ± standard deviation")
    ]  # fmt: skip
    assert rows[2]["score"] == "0.6 ± 0.14"
    assert [row["level at the end of training"] for row in rows[:2]] == ["4", "5"]


def test_contrasts_without_bases_that_do_not_walk(tmp_path):
    """Where a base's score at T2 is low, the primary contrasts stand a second time without it; otherwise not."""
    evidence = simulated(NO_EFFECT)
    assert legged_contrasts._of_walkers(evidence, tmp_path) == []
    some = legged_contrasts.RunFolder.create(tmp_path / "some" / legged_bases.base_name("quad", 1))
    some.write_json("evaluation.json", [{"goal_period": 100, "score": 0.7}])
    assert legged_contrasts._of_walkers(evidence, tmp_path / "some") == []
    for base in range(5):
        folder = legged_contrasts.RunFolder.create(tmp_path / legged_bases.base_name("quad", base))
        scores = {100: 0.7 if base else 0.1, 500: 0.0}
        folder.write_json("evaluation.json", [{"goal_period": t, "score": score} for t, score in scores.items()])
    title, rows = legged_contrasts._of_walkers(evidence, tmp_path)
    assert title == "### The same without bases whose score at T2 is below 0.3"
    assert {row["bases"] for row in rows} == {"4"}
    assert rows[0]["of every base"] == ", ".join(
        legged_contrasts.contrasts(evidence, QUAD, ["p75"])[0].row(judged=True)["of every base"].split(", ")[1:]
    )
    folder = legged_contrasts.RunFolder(tmp_path / legged_bases.base_name("quad", 0))
    folder.write_json("evaluation.json", [{"goal_period": 100, "score": 0.31}])
    assert legged_contrasts._of_walkers(evidence, tmp_path) == []


def test_trainings_are_told_base_by_base(tables):
    """What goals did to a method's own training stands in a table, with a dash for what the task does not have."""
    data = Data.read(tables)
    for row in data.curve_rows:
        row["level"] = {"p75": (4.0, 4.5), "uniform": (0.0, 0.0)}.get(row["method"], ())
    p75, _, uniform, _ = legged_contrasts._trainings(Evidence.of(data))[2]
    assert p75["mean level of the ground in training"] == ", ".join(["4.25"] * BASES)
    assert uniform["mean level of the ground in training"] == "-"  # flat ground has no levels
    rows = legged_contrasts._trainings(Evidence.of(Data.read(tables)))[2]
    assert [row["method"] for row in rows] == sorted(METHODS)
    for row in rows:
        assert row["mean level of the ground in training"] == "-"
        assert len(row["explained variance of the critic in training"].split(", ")) == BASES


def test_one_dose_of_a_method_that_hands_over(tables):
    """Tables, figures and clauses have one dose: that of the half under the Director; what ends unranked has none."""
    data = Data.read(tables)
    for row in data.curve_rows:
        half = len(row["env_steps"]) // 2
        own = {"vds+p75": (50.0, math.nan, *[80.0] * half), "uniform": (50.0, math.nan)}
        row["goal_percentile"] = own.get(row["method"], (75.0,))
    _, text, rows, *_ = outcomes(data, "quad", 100)
    shown = {row["method"]: row["delivered dose"] for row in rows}
    assert shown == {"uniform": "not recorded", "p75": "75.0", "vds+p75": "80.0", "penalty-30": "75.0"}
    assert "The dose of vds+p75 is that of the last part" in text
    told = DOSE(Evidence.of(data), QUAD, "vds+p75")
    assert told == data.delivered("quad", "vds+p75") == dict.fromkeys(range(1, BASES + 1), 80.0)
    assert math.isnan(delivered_dose(np.array([50.0, math.nan])))


def test_policies_judged_again_have_no_trainings_of_their_own(tables):
    """Where the policies are another environment's, its trainings and doses are not drawn a second time."""
    found = Results.read(tables)
    again = [row | {"environment": "quad_on_warp"} for row in found.rows if row["method"] in METHODS[:2]]
    lines = [row | {"environment": "quad_on_warp"} for row in found.curves if row["method"] in METHODS[:2]]
    data = Data(Results(found.rows + again, found.curves + lines))
    assert [data.trained_in(name) for name in data.environments] == ["quad", "quad"]
    drawn = {name: {each.split("-")[0] for each in figures(data, name)} for name in data.environments}
    assert drawn["quad"] - drawn["quad_on_warp"] == {"training", "dose"}
    assert "evaluation" in drawn["quad_on_warp"]
    assert {row["environment"] for row in legged_contrasts._trainings(Evidence.of(data))[2]} == {"quad"}


def test_deviations_are_those_of_what_was_run():
    """Robots are not told Particle Gym's settings, nor it theirs; both are where both are."""
    found = {names: str(deviations.blocks(names)) for names in (("relative",), ("quad_on_warp",), ("relative", "quad"))}
    for words, there in (("1500 steps of 2000 worlds", (True, False, True)), ("Isaac Gym", (False, True, True))):
        assert tuple(words in text for text in found.values()) == there


def test_pairs_are_told_no_power_of_rank_sums(tables):
    """What 10 or 30 policies a side would show is nothing that pairs hang on; other populations have it."""
    data = Data.read(tables)
    assert not any("rank-sum" in text for text in study_report.limits(data))
    for row in data.rows:
        row["block"] = ""
    assert any("rank-sum" in text for text in study_report.limits(data))


def test_a_study_of_branches_gives_its_tables(tables, capsys, monkeypatch):
    """The command prints the contrasts of real rows: every base of the study in every outcome."""
    monkeypatch.setattr("sys.argv", ["legged_contrasts", str(tables)])
    legged_contrasts.main()
    out = capsys.readouterr().out
    assert "### Quad at T2: primary contrasts" in out
    for name in METHODS[1:]:
        for outcome in ("score (Naive)", "log rate (Naive)", "log rate (worst)"):
            assert f"| {name} - uniform | {outcome} | {BASES} |" in out


def test_report_has_pairs_claims_and_pictures(tables, tmp_path):
    """The report of such a study judges clauses in pairs, has the section and the figures with their origin."""
    report.write(tables, tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "| ppo.hidden | 8 |" in text  # the merge has kept the settings
    undecided = text.count("| undecided |")  # of three bases everything is an estimate
    assert f"For {undecided} of {undecided} undecided there is no effect that so few policies show in 80 %." in text
    assert "inf" not in text.split()
    for words in ("Figure 4.8 in pairs", "Figure A.1 in pairs", legged_figures.ORIGIN, "## Methods in pairs",
                  "### Not run", "score (Naive): uniform > penalty-30"):  # fmt: skip
        assert words in text, words
    for name in ("evaluation-quad-T100", "differences-quad-T100", "training-quad"):
        assert (tmp_path / "figures" / f"{name}.png").stat().st_size > 10_000


def test_tables_of_every_study_compare_in_pairs(tables):
    """How often a method is safer than Uniform is counted over seeds where they began with the same policy."""
    data = Data.read(tables)
    (_, _, rows, *_) = outcomes(data, "quad", 100)
    shown = {row["method"]: row["P(safer than uniform)"] for row in rows}
    uniform, p75 = (data.sample(Where("quad", "naive", 100), name, "worst") for name in ("uniform", "p75"))
    assert shown["p75"].startswith(f"{(np.sign(uniform - p75) + 1).mean() / 2:.2f} [")
    assert shown["uniform"] == "-"


def test_pictures_show_every_policy(tables):
    """A line for each base holds the values of the rows, method by method; a bar is their mean."""
    data = Data.read(tables)
    figure = legged_figures.pairs(data, "quad", 100)
    score = figure.axes[3]
    hard = Where("quad", "adversary", 100)
    assert figure.axes[1].get_title() == "under the Adversary"
    nobody = study_outcomes.NOBODY in [text.get_text() for text in figure.axes[1].texts]
    assert nobody == (len(data.sample(hard, "p75", "crash_rate")) == 0)
    lines = [line for line in score.lines if len(line.get_xdata()) == len(METHODS)]
    shown = np.array([line.get_ydata() for line in lines])
    evidence = Evidence.of(data)
    order = ["uniform", *sorted({*METHODS} - {"uniform"})]
    expected = [list(SCORE(evidence, QUAD, name).values()) for name in order]
    assert [label.get_text() for label in score.get_xticklabels()] == order
    np.testing.assert_allclose(shown.T, expected)
    bars = [line.get_ydata()[0] for line in score.lines if line.get_color() == "black"]
    np.testing.assert_allclose(bars, np.mean(expected, axis=1))
    curves = legged_figures.training(data, "quad").axes
    own = {len(panel.lines) for panel in curves if panel.get_visible()}
    assert own == {BASES, 2 * BASES}  # Uniform's own panels, and those with Uniform in grey behind


@pytest.mark.parametrize("crashes", [(2.2, 4.5), (0.3, 0.5), (0.15, 1.6), (0.25, 6.0), (0.02, 40.0)])
def test_axes_of_trainings_have_numbers(tables, crashes):
    """However narrow the range of the crashes is, the axis has two numbers or more."""
    data = Data.read(tables)
    for row in data.curve_rows:
        row["crashes_per_1000"] = tuple(np.geomspace(*crashes, len(row["env_steps"])))
    for panel in legged_figures.training(data, "quad").axes[: len(METHODS)]:
        low, high = panel.get_ylim()
        shown = [tick for tick in panel.get_yticks() if low <= tick <= high]
        assert len(shown) >= 2
        middle = math.sqrt(max(low, legged_figures.LINEAR) * high)
        assert min(shown) < middle  # in the lower half too, which linear steps leave empty


def test_pictures_say_where_nobody_attacked(tables):
    """Panels of attacks say so where there were none, and scores over the dose keep their numbers."""
    found = Results.read(tables)
    rows = [row for row in found.rows if row["goals"] == "naive"]
    alone = Results(rows, [row | {"goal_percentile": (50.0,) * len(row["env_steps"])} for row in found.curves])
    alone.find_worst()
    data = Data(alone)
    pictures = study_outcomes.dose(data, "quad", 100), study_outcomes.profiles(data, "quad", 100)
    said = [[text.get_text() for panel in figure.axes for text in panel.texts] for figure in pictures]
    assert [texts.count(study_outcomes.NOBODY) for texts in said] == [1, len(data.style.panels)]
    score = pictures[0].axes[0]
    assert len(score.get_yticks()) > 1
    assert score.yaxis.get_tick_params()["labelleft"]
