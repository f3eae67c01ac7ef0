"""The numbers that the README, the pages of the populations and their lab's tables have are those of the rows."""

import math
from pathlib import Path

import numpy as np
import pytest

from deimos.study.results import CURVE_COLUMNS, RESULT_COLUMNS, read_table
from reproduction import beside, hypotheses, mechanism
from reproduction.hypotheses import CHOOSING, TESTING, VARIANTS, samples
from reproduction.legged_contrasts import NAIVE, PRIMARY, WORST, contrast
from reproduction.measures import ATTACKED, LEVEL, RISK, SCORE, Evidence, Place, under
from reproduction.particle_picture import points

HOME = Path(__file__).parent.parent
RESULTS = HOME / "docs" / "results"
README, PAGE, LEGGED = (
    " ".join((HOME / name).read_text(encoding="utf-8").split())
    for name in ("README.md", "docs/particle.md", "docs/legged.md")
)
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
        f"{len(policies)} policies, all of them counted",
        f"crash in {rate(fresh, under('naive'), 'uniform'):.1f} % of these, but in {uniform:.0f} % of the worst",
        f"crash in {attacked.estimate:.1f} %, at {score.estimate:.2f} of the score",
        f"does not help: {penalty:.0f} %",
        f"comes to {novel.estimate:.1f} % at {novel_score.estimate:.2f}",
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


def test_the_page_has_the_table_of_the_freeze(evidence):
    """Crashes under ``argmax`` and the score of p75 by how fear learnt, in both variants."""
    early = evidence.only(CHOOSING)
    for title, method in (("its threshold today", "p75-threshold"), ("literal", "p75-literal"), ("memory", "p75")):
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
    return f"{mean:+.0f} % [{low:.0f}, {high:.0f}]"


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


def test_the_readme_quotes_the_robots(robots):
    """Changes of the worst attacker's rate."""
    p75, both, penalty = (contrast(robots, Place("quad", 100), name, "uniform", WORST).mean for name in PRIMARY)
    ends = [change(each).partition("% ")[2] for each in (p75, both)]
    assert not missing([f"worst attacker ({' and '.join(ends)} %)", f"({change(penalty)})"], README)


def test_the_page_of_robots_has_what_is_exploratory(robots):
    """How often Uniform's policies fall, what ground p75 trained on, and what a penalty does at T10."""
    near, far = Place("quad", 100), Place("quad", 500)
    falls, attacked = (100 * mean(measure, robots, near, "uniform") for measure in (under("naive"), ATTACKED))
    p75, uniform = (mean(LEVEL, robots, near, name) for name in ("p75", "uniform"))
    score, rate = (contrast(robots, far, "penalty-30", "uniform", each).mean for each in (SCORE, NAIVE))
    lower, *ends = (-100 * math.expm1(x) for x in (rate.estimate, rate.high, rate.low))
    assert not missing([
        f"fall in {falls:.1f} % of uniform goals and {attacked:.1f} % of the worst attacker's",
        f"train at a mean level of {p75:.1f}, under Uniform at {uniform:.1f}",
        f"{lower:.0f} % [{ends[0]:.0f}, {ends[1]:.0f}] fewer falls under uniform goals",
        f"a score {score.estimate:.3f} [{score.low:.3f}, {score.high:.3f}] higher",
    ], LEGGED)  # fmt: skip
    assert min(contrast(robots, far, "vds", "uniform", WORST).differences) > 0
    risks = RISK(robots, near, "p75").values()
    assert len(risks) == 5
    assert min(risks) > 0


def test_the_page_of_robots_says_where_they_fall(robots):
    """Uniform's policies under uniform goals: the share of their falls on stairs, and rates on easy and hard ground."""
    counts = [
        (*place.split(), *both)
        for row in robots.evaluations(Place("quad", 100), "naive", "uniform").values()
        for place, both in row["crashes_by_kind"].items()
    ]
    stairs = sum(falls for kind, _, falls, _ in counts if "stairs" in kind) / sum(falls for *_, falls, _ in counts)
    low, high = (
        100 * np.divide(*np.sum([both for _, level, *both in counts if level in levels], axis=0))
        for levels in ("01", "89")
    )
    assert not missing([
        f"{100 * stairs:.0f} % are on stairs",
        f"from the two lowest levels of ground to the two highest they rise from {low:.1f} to {high:.1f} %",
    ], LEGGED)  # fmt: skip


def mean(measure, evidence, place, method):
    """The mean of a method's policies in a place."""
    return np.mean([*measure(evidence, place, method).values()])
