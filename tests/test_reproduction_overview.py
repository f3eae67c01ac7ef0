"""The first page of the report: clauses by environment as dots with intervals."""

import itertools
import math

import pytest

from deimos.study.stats import Interval
from reproduction import overview
from reproduction.claims import Claim, Clause, Finding, Outcome, Result
from reproduction.measures import Place


def finding(estimate, low, high, nothing=0.5, p_for=1.0, p_against=1.0, within=None):
    """What a test found, of an effect where ``nothing`` is no difference."""
    return Finding(effect="x", interval=Interval(estimate, low, high), no_difference=nothing, p_for=p_for,
                   p_against=p_against, detectable=0.9, n={"a": 3}, equivalent_within=within)  # fmt: skip


def outcome(name, **found):
    """A claim with findings by environment."""
    clause = Clause(line=1, words="x", test=None, environments=tuple(found))
    results = tuple(
        Result(clause, Place(environment, 100), each) for environment, findings in found.items() for each in findings
    )
    return Outcome(Claim(name, f"What {name} says.", (clause,)), results)


@pytest.mark.parametrize(
    ("nothing", "values"),
    [(0.5, {0.0: -1, 0.5: 0, 0.75: 0.5, 1.0: 1}), (1.0, {1 / 8: -1, 1.0: 0, 8**0.5: 0.5, 100.0: 1, 0.0: -1}),
     (0.0, {-0.25: -0.25, 0.0: 0, 7.0: 1, -math.inf: -1})],
)  # fmt: skip
def test_effects_share_an_axis(nothing, values):
    """No difference is at 0, whatever the effect; the ends are P of 0 and 1, ratios of 1/8 and 8, differences of 1."""
    for value, place in values.items():
        assert overview.standard(finding(value, 0, 1, nothing), value) == pytest.approx(place)


def test_every_clause_is_a_dot_in_its_environment():
    """A column for each environment with data holds its clauses with their intervals, in the colour of the verdict."""
    claims = [
        outcome("C1", directional=[finding(0.9, 0.6, 1.0, p_for=0.01), finding(0.2, 0.1, 0.3, p_against=0.01)],
                absolute=[finding(0.5, 0.25, 0.75)]),
        outcome("C2"), outcome("C3", absolute=[finding(1.0, 0.5, 2.0, nothing=1.0, within=2.0)]),
        outcome("C9", directional=[finding(-2.0, math.nan, math.nan, nothing=0.0)]),
    ]  # fmt: skip
    figure = overview.draw(claims, ["absolute", "directional", "quad"])
    names, absolute, directional = figure.axes
    assert [text.get_text().split()[0] for text in names.texts] == ["C1", "C3", "C9"]  # C2 has no data
    assert [panel.get_title() for panel in (absolute, directional)] == ["absolute", "directional"]

    def drawn(panel):
        lines = [line for line in panel.lines if len(line.get_xdata()) == 1]
        return [(round(float(line.get_xdata()[0]), 3), line.get_color(), line.get_marker()) for line in lines]

    grey, blue, orange = (overview.LOOKS[verdict][0] for verdict in ("undecided", "holds", "does not hold"))
    assert drawn(absolute) == [(0.0, grey, "o"), (0.0, grey, overview.ALIKE)]
    assert drawn(directional) == [(0.8, blue, "o"), (-0.6, orange, "X"), (-1.0, grey, "o")]
    ends = [line.get_xdata() for line in directional.lines if line.get_color() in (blue, orange, grey)]
    assert [list(x) for x in ends if len(x) == 2] == [pytest.approx([0.2, 1.0]), pytest.approx([-0.8, -0.4])]
    assert overview.draw([outcome("C2")], ["absolute"]) is None


def test_the_page_is_one_page():
    """However many clauses there are, the figure is no higher than a printed page, and no claim runs into the next."""
    many = [outcome(f"C{i}", absolute=[finding(0.6, 0.4, 0.8)] * 8) for i in range(37)]
    figure = overview.draw(many, ["absolute"])
    assert figure.get_size_inches()[1] < 10.5
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in figure.axes[0].texts]
    assert all(above.y0 >= below.y1 for above, below in itertools.pairwise(boxes))
