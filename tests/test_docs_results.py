"""The numbers that the README and the page of the populations quote are those of the rows."""

from pathlib import Path

import numpy as np
import pytest

from deimos.study.results import CURVE_COLUMNS, RESULT_COLUMNS, read_table
from reproduction import hypotheses
from reproduction.hypotheses import CHOOSING, TESTING, VARIANTS, samples
from reproduction.measures import ATTACKED, SCORE, Evidence, under
from reproduction.particle_picture import points

HOME = Path(__file__).parent.parent
TABLES = sorted((HOME / "docs" / "results").glob("particle_[a-z]"))
PAGES = {name: " ".join((HOME / name).read_text(encoding="utf-8").split()) for name in ("README.md", "docs/particle.md")}


@pytest.fixture(scope="module")
def evidence():
    """All policies of the populations."""
    found = {
        name: [row for folder in TABLES for row in read_table(folder / f"{name}.csv", columns)]
        for name, columns in (("results", RESULT_COLUMNS), ("curves", CURVE_COLUMNS))
    }
    return Evidence(found["results"], found["curves"], renamed=False)


def quoted(page, *texts):
    """Assert that a page says each of some texts, wherever its lines break."""
    for text in texts:
        assert text in PAGES[page], f"{page} should say '{text}'"


def means(evidence, method):
    """Of a method's policies, both variants counting alike: rates [%] under uniform goals and attack."""
    return [
        100 * np.mean([values.mean() for values in samples(evidence, measure, method).values()])
        for measure in (under("naive"), ATTACKED)
    ]


def test_the_readme_quotes_the_fresh_seeds(evidence):
    """Its lines of result are means of seeds 10 to 29, and of RND's seeds 0 to 9."""
    fresh = evidence.only(TESTING)
    naive, attacked = means(fresh, "uniform")
    score, rate = points(fresh, ["p75"])["p75"]
    _, penalised = points(fresh, ["penalty-30"])["penalty-30"]
    novel_score, novel = points(evidence.only(CHOOSING), ["rnd"])["rnd"]
    policies = len({row["hash"] for own in evidence.rows.values() for row in own.values()})
    quoted(
        "README.md", f"{policies} policies, all of them counted",
        f"crash in {naive:.1f} % of these, but in {attacked:.0f} % of the worst attacker's",
        f"crash in {rate.estimate:.1f} %, at {score.estimate:.2f} of the score", f"do not help: {penalised.estimate:.0f} %",
        f"RND, which knows nothing of crashes, comes to {novel.estimate:.1f} % at {novel_score.estimate:.2f}",
    )  # fmt: skip
    assert rate.estimate < 0.6 * attacked  # "nearly halves"


def test_the_page_quotes_the_hypotheses(evidence):
    """What was chosen, effects with their intervals, p-values by Holm, and what could have been found."""
    first, second, third = hypotheses.primary(evidence)
    assert (first.text, second.text) == ("p75 is safer than uniform", "p75 is safer than penalty-30")
    assert [each.holds for each in (first, second, third)] == [True, False, True]
    fresh = evidence.only(TESTING)
    ratio = points(fresh, ["p75"])["p75"][0].estimate
    before, after = (means(fresh, name)[1] for name in ("uniform", "p75"))
    quoted(
        "docs/particle.md", f"from {before:.1f} to {after:.1f} %", f"at {ratio:.2f} of Uniform's score",
        *[f"{100 * each.effect.estimate:.1f} percentage points [{100 * each.effect.low:.1f}, {100 * each.effect.high:.1f}]"
          for each in (first, second)],
        *[f"{each.corrected:.1g} | {100 * each.detectable:.1f} |" for each in (first, second)],
        f"{third.corrected:.1g} | {100 * third.detectable:.2f} |",
    )  # fmt: skip
    scores = [np.mean([values.mean() for values in samples(fresh, SCORE, name).values()]) for name in ("p75", "penalty-30")]
    assert second.note.startswith("ratio of scores")
    assert scores[0] < 0.95 * scores[1]
    assert set(samples(fresh, SCORE, "p75")) == set(VARIANTS)
