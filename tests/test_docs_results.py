"""The numbers that the README, the pages of the populations and their lab's tables have are those of the rows."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from deimos.study.results import CURVE_COLUMNS, RESULT_COLUMNS, read_table
from reproduction import beside, hypotheses, mechanism
from reproduction.hypotheses import CHOOSING, TESTING, VARIANTS, samples
from reproduction.legged_contrasts import ENGINES, NAIVE, PRIMARY, WORST, bases, contrast
from reproduction.measures import ATTACKED, DOSE, LEVEL, SCORE, Evidence, Place, under
from reproduction.particle_picture import points

HOME = Path(__file__).parent.parent
RESULTS = HOME / "docs" / "results"
README, PAGE, LEGGED, LEGGED_LAB = (
    " ".join((HOME / name).read_text(encoding="utf-8").split())
    for name in ("README.md", "docs/particle.md", "docs/legged.md", "docs/lab/robots.md")
)
STRONGER = ("search", "argmax-long", "q-fear")
LAB = (HOME / "docs" / "lab" / "results.md").read_text(encoding="utf-8").splitlines()


def read(pattern):
    """All policies of the tables in some folders of docs/results."""
    results, curves = (
        [row for folder in sorted(RESULTS.glob(pattern)) for row in read_table(folder / name, columns)]
        for name, columns in (("results.csv", RESULT_COLUMNS), ("curves.csv", CURVE_COLUMNS))
    )
    return Evidence(results, curves, renamed=False)


@pytest.fixture(scope="module")
def evidence():
    """All policies of the populations of Particle Gym."""
    return read("particle_[a-z]")


@pytest.fixture(scope="module")
def robots():
    """All policies of Quad and Quad+arm that branched off base policies."""
    return read("legged_*")


def rate(evidence, measure, method):
    """Mean crashes per interaction of a method's policies, both variants counting alike [%]."""
    return 100 * np.mean([values.mean() for values in samples(evidence, measure, method).values()])


def missing(text, page):
    """Those of some quotations that a page does not have."""
    return [each for each in text if each not in page]


def test_the_readme_quotes_the_rows(evidence):
    """Its lines of result are means of the seeds 10 to 29, RND's of the seeds 0 to 9."""
    fresh = evidence.only(TESTING)
    score, attacked = points(fresh, ["p75"])["p75"]
    novel_score, novel = points(evidence.only(CHOOSING), ["rnd"])["rnd"]
    policies = {row["hash"] for own in evidence.rows.values() for row in own.values()}
    uniform, penalty = rate(fresh, ATTACKED, "uniform"), rate(fresh, ATTACKED, "penalty-30")
    assert not missing([
        f"{len(policies)} policies, none left out",
        f"crash on {rate(fresh, under('naive'), 'uniform'):.1f} % of such goals, but on {uniform:.0f} % of the worst",
        f"crash on {attacked.estimate:.1f} % of the worst attacker's goals, at {score.estimate:.2f} of Uniform's score",
        f"shows no benefit ({penalty:.0f} %), nor does VDS, the thesis's strongest rival "
        f"({rate(fresh, ATTACKED, 'vds'):.0f} %)",
        f"reaches {novel.estimate:.1f} % at {novel_score.estimate:.2f} of the score",
    ], README)  # fmt: skip


def test_the_page_quotes_the_hypotheses(evidence):
    """What was chosen and tested, effects with intervals, p-values by Holm, and what could have been found."""
    answers = hypotheses.primary(evidence)
    assert [each.text for each in answers[:2]] == ["p75 is safer than uniform", "p75 is safer than penalty-30"]
    assert [each.holds for each in answers] == [True, False, True]
    fresh = evidence.only(TESTING)
    score, attacked = points(fresh, ["p75"])["p75"]
    percent = [(100 * each.effect.estimate, 100 * each.effect.low, 100 * each.effect.high) for each in answers]
    assert not missing([
        f"from {rate(fresh, ATTACKED, 'uniform'):.1f} to {attacked.estimate:.1f} %",
        f"at {score.estimate:.2f} of Uniform's score",
        *[f"{mean:.1f} points [{low:.1f}, {high:.1f}]" for mean, low, high in percent[:2]],
        *[f"| {each.corrected:.1g} | {100 * each.detectable:.1f} |" for each in answers[:2]],
        "{:.2f} points a percentile [{:.2f}, {:.2f}]".format(*percent[2]),
        f"| {answers[2].corrected:.1g} | {100 * answers[2].detectable:.2f} |",
        f"at {float(answers[1].note.split()[3]):.2f} of the score",
    ], PAGE)  # fmt: skip


def test_stronger_attackers_are_told(evidence):
    """What attackers with more data do to p75 and Uniform on the seeds that met them, in README and page."""
    search, longer, fear = (
        [f"{rate(evidence, under(name), own):.0f}" for own in ("p75", "uniform")] for name in STRONGER
    )
    pairs = [" and ".join(each) for each in (search, longer, fear)]
    assert not missing([
        f"crashes p75's policies on {search[0]} % of its goals and Uniform's on {search[1]} %",
        f"`argmax-long`, with more data, on {pairs[1]} %; `q-fear`, which looks beyond one goal, on {pairs[2]} %",
    ], README)  # fmt: skip
    assert not missing([
        f"`argmax-long` crashes p75 on {longer[0]} % of its goals, Uniform on {longer[1]}; `search` on {pairs[0]}, "
        f"`q-fear` on {pairs[2]}."
    ], PAGE)  # fmt: skip


def test_the_page_has_the_table_of_the_freeze(evidence):
    """Crashes under ``argmax`` and the score of p75 by how fear learnt, in both variants."""
    early = evidence.only(CHOOSING)
    for title, method in (("0.1.0's threshold", "p75-threshold"), ("literal", "p75-literal"), ("memory", "p75")):
        attacked, score = (samples(early, measure, method) for measure in (under("argmax"), SCORE))
        cells = [f"{100 * attacked[name].mean():.1f}, {score[name].mean():.2f}" for name in VARIANTS]
        assert f"| {title} | {' | '.join(cells)} |" in PAGE


def test_the_lab_has_the_tables_of_the_rows(evidence):
    """Hypotheses, every method on both sets of seeds, and all of them beside Uniform, line by line."""
    early, late = evidence.only(CHOOSING), evidence.only(TESTING)
    tables = [
        hypotheses.table(evidence), *[mechanism.table(each, name) for each in (early, late) for name in VARIANTS],
        mechanism.table(early, "relative"), *[beside.table(each) for each in (early, late)],
    ]  # fmt: skip
    assert not missing([line for table in tables for line in table], LAB)


def change(logs):
    """A mean difference of log rates with its interval, as a change of the rate in percent."""
    mean, low, high = (100 * math.expm1(x) for x in (logs.estimate, logs.low, logs.high))
    return f"{mean:+.0f} % [{low:.0f}, {high:.{0 if abs(high) >= 0.5 else 1}f}]"  # 0 would hide its sign


def test_the_page_of_robots_has_the_primary_contrasts(robots):
    """Each method beside Uniform at T2: score, both rates, and of the worst attacker's p and what would be found."""
    place = Place("quad", 100)
    for name in PRIMARY:
        score, naive, worst = (contrast(robots, place, name, "uniform", each) for each in (SCORE, NAIVE, WORST))
        assert all(each.bases == (1, 2, 3, 4, 5) for each in (score, naive, worst))
        mean = score.mean
        found = 100 * math.expm1(-worst.detectable)
        line = (
            f"| {name} | {mean.estimate:+.3f} [{mean.low:.3f}, {mean.high:.3f}] | {change(naive.mean)} | "
            f"{change(worst.mean)} | {worst.p:.2f} | {found:.0f} % |"
        )
        assert line in LEGGED
        for each in (score, naive, worst):
            assert f"| {' | '.join(each.row(judged=True).values())} |" in LEGGED_LAB


def test_the_readme_quotes_the_robots(robots):
    """Changes of the worst attacker's rate."""
    p75, both, penalty = (contrast(robots, Place("quad", 100), name, "uniform", WORST).mean for name in PRIMARY)
    ends = [change(each).partition("% ")[2] for each in (p75, both)]
    assert not missing([f"(change in falls: {' and '.join(ends)} %)", f"({change(penalty)})"], README)


def test_the_page_of_robots_has_what_is_exploratory(robots):
    """Uniform's falls before and after, the dose, the ground of the trainings, and what a penalty does at T10."""
    near, far = Place("quad", 100), Place("quad", 500)
    score, falls, attacked = (mean(measure, robots, near, "uniform") for measure in (SCORE, under("naive"), ATTACKED))
    before = next(row for row in bases()[1] if "mean" in row["base"])["crashes per interaction [%]"].split()[0]
    levels = [f"{mean(LEVEL, robots, near, name):.1f}" for name in ("uniform", "p75")]
    rate = contrast(robots, far, "penalty-30", "uniform", NAIVE).mean
    vds = change(contrast(robots, far, "vds", "uniform", WORST).mean)
    better = contrast(robots, far, "penalty-30", "uniform", SCORE).mean
    less = "{:.0f} % [{:.0f}, {:.0f}] less".format(
        *(-100 * math.expm1(x) for x in (rate.estimate, rate.high, rate.low))
    )
    assert not missing([
        f"| Uniform | {score:.3f} | {100 * falls:.1f} % | {100 * attacked:.1f} % |",
        f"from {before} to {100 * falls:.1f} %",
        f"the {mean(DOSE, robots, near, 'p75'):.0f}st percentile of fear",
        "in training is {} under Uniform, {} under p75".format(*levels),
        f"penalty-30 scores {interval(better)} more and falls {less} under uniform goals. Under attack VDS falls "
        f"{vds.removeprefix('+')} more",
    ], LEGGED)  # fmt: skip


def interval(mean, sign=1):
    """A mean difference of scores with its interval, or of its opposite."""
    low, high = sorted((sign * mean.low, sign * mean.high))
    return f"{sign * mean.estimate:.3f} [{low:.3f}, {high:.3f}]"


def test_the_page_of_robots_has_the_further_methods(robots):
    """Antagonist, p50 and the control of VDS's critic beside Uniform, on all five bases; VDS beside its control."""
    near, far = Place("quad", 100), Place("quad", 500)
    scores = {
        (name, place.period): contrast(robots, place, name, "uniform", SCORE)
        for name in ("coop", "antagonist", "p50", "uniform-ensemble") for place in (near, far)
    }  # fmt: skip
    assert all(each.bases == (1, 2, 3, 4, 5) for each in scores.values())
    coop, most = (
        [change(contrast(robots, near, name, "uniform", each).mean) for each in (NAIVE, WORST)]
        for name in ("coop", "antagonist")
    )
    low = 100 * math.expm1(contrast(robots, near, "antagonist", "uniform", NAIVE).mean.low)
    most[0] = most[0].replace("[0,", f"[{low:.1f},")  # 0 would hide its sign
    assert not missing([
        f"score {interval(scores['coop', 100].mean, -1)} and {interval(scores['antagonist', 100].mean, -1)} less and "
        f"fall {coop[0].removeprefix('+')} and {most[0].removeprefix('+')} more under uniform goals; under attack "
        f"{coop[1]} and {most[1]}",
        f"costs {interval(scores['uniform-ensemble', 100].mean, -1)} of score under uniform goals",
        f"p50 scores {interval(scores['p50', 500].mean)} more than Uniform "
        f"(at T2 {interval(scores['p50', 100].mean)})",
    ], LEGGED)  # fmt: skip
    beside = [
        contrast(robots, place, name, "uniform-ensemble", each).mean
        for place in (near, far) for name in ("vds", "vds+p75") for each in (SCORE, NAIVE, WORST)
    ]  # fmt: skip
    assert all(each.low < 0 < each.high for each in beside)  # "neither can be distinguished from that"


def test_the_lab_has_trainings_at_t10(robots):
    """p75 beside Uniform at T2 on two bases, and what became of the same bases when trained at T2."""
    long, short = (
        [contrast(robots.only([1, 2]), Place(name, 100), "p75", "uniform", each).differences for each in (SCORE, WORST)]
        for name in ("quad_long", "quad")
    )
    far = contrast(robots, Place("quad_long", 500), "p75", "uniform", WORST)
    less, more = 100 * np.expm1(np.array([long[1], short[1]]))
    assert not missing([
        "scores {:.3f} and {:.3f} less".format(*-long[0]),
        "falls {:.0f} and {:.0f} % less".format(*-less),
        "falls {:.0f} and {:.0f} % more".format(*more),
        "judged at T10: {:.0f} and {:.0f} %".format(*-100 * np.expm1(far.differences)),
        f"the {mean(DOSE, robots, Place('quad_long', 100), 'p75'):.0f}rd percentile of fear",
    ], LEGGED_LAB)  # fmt: skip


def test_the_lab_has_the_bases():
    """Score, falls and level of every base, and the spread between them."""
    lines = []
    for table in (each for each in bases() if isinstance(each, list)):
        for row in table:
            name, period, score, falls, _, *level = row.values()
            if period == "100" or "mean" in name:
                lines.append(f"| {' | '.join([name.rpartition('base_')[2], period, score, falls, *level])} |")
    assert len(lines) == 5 + 2 + 3 + 1
    assert not missing(lines, LEGGED_LAB)


def test_both_engines_are_told(robots):
    """p75 beside Uniform, base by base, on either engine: a table in the lab, the changes of falls on the page."""
    falls = []
    for name, title in ENGINES.items():
        score, rate = (contrast(robots.only([1, 2]), Place(name, 100), "p75", "uniform", x) for x in (SCORE, NAIVE))
        scores, logs = (", ".join(f"{x:+.3f}" for x in each.differences) for each in (score, rate))
        falls.append([100 * math.expm1(x) for x in rate.differences])
        assert f"| {title} | {scores} | {logs} |" in LEGGED_LAB
    native, judged, warp = ("{:+.0f} and {:+.0f} %".format(*each) for each in falls)
    assert (
        f"by {native} on MuJoCo's, {judged} with the same policies on mujoco-warp, {warp} with training there" in LEGGED
    )


def test_the_page_of_robots_counts_clauses():
    """What the report says of all clauses, and which hold."""
    report = (RESULTS / "robots" / "report.md").read_text(encoding="utf-8")
    (counts,) = re.findall(r"^Clauses: (12) holds, 0 does not hold, (\d+) undecided over", report, re.MULTILINE)
    (beyond,) = re.findall(r"For (\d+) of \d+ undecided there is no effect", report)
    held, undecided = map(int, counts)
    assert f"of {held + undecided} clauses twelve hold" in LEGGED
    assert f"{undecided} are undecided, {beyond} for want of bases" in LEGGED
    *extremes, last = re.findall(r"^\| quad, T = (\d+) \| ([^|]*) \|.* holds \|$", report, re.MULTILINE)
    worse = r"(crashes .*: (coop|antagonist) > .*|score .* > (coop|antagonist))"
    assert [clause for _, clause in extremes if not re.fullmatch(worse, clause)] == []
    assert last == ("500", "score that the attack costs: uniform, rnd, vds, cl > vds+p75")


def test_the_page_of_robots_has_the_arm(robots):
    """Means of three bases, how far they are apart, and how little three bases tell."""
    place, methods = Place("quad_arm", 100), ("uniform", "vds", "p50", "vds+p75")
    scores, hard = ([mean(measure, robots, place, name) for name in methods] for measure in (SCORE, ATTACKED))
    assert max(scores) - min(scores) < 0.005
    ours = contrast(robots, place, "vds+p75", "uniform", WORST)
    least, *_, most = sorted(-100 * np.expm1(ours.differences))
    ends = change(ours.mean).partition("% ")[2]
    assert not missing([
        "fall under {:.1f} % of the worst attacker's goals, VDS's under {:.1f}, p50's under {:.1f}, "
        "vds+p75's under {:.1f}".format(*(100 * x for x in hard)),
        f"less than Uniform, but by {least:.0f} to {most:.0f} %, interval {ends} %",
    ], LEGGED)  # fmt: skip


def test_the_page_of_robots_says_where_they_fall(robots):
    """Uniform's policies under uniform goals: the share of their falls on stairs, and of their goals."""
    counts = [
        (kind, *both)
        for row in robots.evaluations(Place("quad", 100), "naive", "uniform").values()
        for kind, both in row["crashes_by_kind"].items()
    ]
    falls, goals = (
        100 * sum(each[i] for each in counts if "stairs" in each[0]) / sum(each[i] for each in counts) for i in (1, 2)
    )
    assert f"{falls:.0f} % are on stairs, where {goals:.0f} % of goals are given" in LEGGED


def mean(measure, evidence, place, method):
    """The mean of a method's policies in a place."""
    return np.mean([*measure(evidence, place, method).values()])
