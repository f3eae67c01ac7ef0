"""The numbers that the README, the page of the populations and their lab's tables have are those of the rows."""

from pathlib import Path

import numpy as np
import pytest

from deimos.study.results import CURVE_COLUMNS, RESULT_COLUMNS, read_table
from reproduction import beside, hypotheses, mechanism
from reproduction.hypotheses import CHOOSING, TESTING, VARIANTS, samples
from reproduction.measures import ATTACKED, SCORE, Evidence, under
from reproduction.particle_picture import points

HOME = Path(__file__).parent.parent
TABLES = sorted((HOME / "docs" / "results").glob("particle_[a-z]"))
README, PAGE = (
    " ".join((HOME / name).read_text(encoding="utf-8").split()) for name in ("README.md", "docs/particle.md")
)
LAB = (HOME / "docs" / "lab" / "results.md").read_text(encoding="utf-8").splitlines()


@pytest.fixture(scope="module")
def evidence():
    """All policies of the populations."""
    results, curves = (
        [row for folder in TABLES for row in read_table(folder / name, columns)]
        for name, columns in (("results.csv", RESULT_COLUMNS), ("curves.csv", CURVE_COLUMNS))
    )
    return Evidence(results, curves, renamed=False)


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
