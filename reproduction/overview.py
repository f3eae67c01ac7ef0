"""The first page of the report: every clause of the thesis's claims in every environment, a dot with its interval."""

import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

from deimos.study.figures import WIDTH, subplots
from reproduction.claims import VERDICTS, Finding, Outcome, Verdict

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LOOKS: dict[Verdict, tuple[str, str, str]] = {  # colour, filling and marker
    "holds": ("#0072B2", "#0072B2", "o"), "does not hold": ("#D55E00", "#D55E00", "X"),
    "undecided": ("#777777", "white", "o"),
}  # fmt: skip
ALIKE = "s"
"""Marker of an equivalence, whatever its verdict."""
CAPTION = (
    "The thesis's claims, clause by clause. A dot is the effect that a clause speaks of, with its interval, beside the "
    "line of no difference: to the right the clause is true in these policies, to the left its opposite. A square is a "
    "clause that two methods are alike, which holds where its interval keeps to the line. Ends of the axis: P(X > Y) "
    "of 0 and 1; ratios of 1/8 and 8; differences of -1 and 1. What lies beyond is drawn at the end. Numbers, lines of "
    "the thesis, and the smallest effects that would have been found are in the tables below."
)
LARGEST_RATIO = 8.0
PAGE = 9.4  # [inch] of an A4 page that the rows may take
LEAST_ROWS = 2.4  # dot heights that a claim's text needs
LETTERS = 62  # in a line of a claim's text


def standard(finding: Finding, value: float) -> float:
    """Position of an effect on the axis of the figure, where 0 is no difference, in [-1, 1].

    Args:
        finding: Its value for no difference is used: 1/2 for a probability, 1 for a ratio, 0 for a difference.
        value: The effect or an end of its interval.
    """
    match finding.no_difference:
        case 0.5:
            place = 2.0 * value - 1.0
        case 1.0:
            place = math.log(value) / math.log(LARGEST_RATIO) if value > 0 else -1.0
        case nothing:
            place = value - nothing
    return min(1.0, max(-1.0, place))


def draw(outcomes: Sequence[Outcome], environments: Sequence[str]) -> "Figure | None":
    """A row for each claim, a column for each environment, a dot for each clause.

    Args:
        outcomes: Outcomes of the claims; those without data have no row.
        environments: In order.
    """
    tested = [each for each in outcomes if each.results]
    if not tested:
        return None
    shown = [name for name in environments if any(each.within(name).results for each in tested)]
    heights = [max(LEAST_ROWS, *(len(each.within(name).results) + 0.6 for name in shown)) for each in tested]
    inch = min(0.085, PAGE / sum(heights))
    figure, axes = subplots(
        1, len(shown) + 1, (WIDTH, 0.7 + inch * sum(heights)), sharey=True,
        width_ratios=[2.6 / WIDTH * (len(shown) + 1), *[1] * len(shown)],
    )  # fmt: skip
    size = max(3.0, min(6.5, 72 * inch * LEAST_ROWS / 2.6))
    top = 0.0
    for each, height in zip(tested, heights, strict=True):
        _name(axes[0, 0], each, top, height, size)
        for panel, name in zip(axes[0, 1:], shown, strict=True):
            _dots(panel, each.within(name), top, height, 36 * inch)
        top += height
    axes[0, 0].set_ylim(top, 0)
    axes[0, 0].set_axis_off()
    for panel, name in zip(axes[0, 1:], shown, strict=True):
        _frame(panel, name)
    _legend(figure)
    return figure


def _name(axes: "Axes", outcome: Outcome, top: float, height: float, size: float) -> None:
    lines = textwrap.wrap(f"{outcome.claim.id}  {outcome.claim.text}", LETTERS, max_lines=2, placeholder=" ...")
    axes.text(
        0.0, top + height / 2, "\n".join(lines), va="center", fontsize=size, transform=axes.get_yaxis_transform(),
        linespacing=1.05,
    )  # fmt: skip


def _dots(axes: "Axes", outcome: Outcome, top: float, height: float, size: float) -> None:
    axes.axhline(top, color="#dddddd", linewidth=0.5, zorder=0)
    start = top + (height - len(outcome.results) + 1) / 2
    for i, each in enumerate(outcome.results):
        colour, filling, marker = LOOKS[each.verdict]
        marker = marker if each.finding.equivalent_within is None else ALIKE
        interval = each.finding.interval
        place, *ends = (standard(each.finding, value) for value in (interval.estimate, interval.low, interval.high))
        if not any(map(math.isnan, (interval.low, interval.high))):
            axes.plot(ends, [start + i] * 2, color=colour, linewidth=max(0.4, size / 4), solid_capstyle="butt")
        axes.plot(
            place, start + i, marker=marker, color=colour, markerfacecolor=filling, markersize=size,
            markeredgewidth=max(0.3, size / 6), clip_on=False,
        )  # fmt: skip


def _frame(axes: "Axes", name: str) -> None:
    axes.axvline(0.0, color="black", linewidth=0.8, zorder=0)
    axes.set_xlim(-1.08, 1.08)
    axes.set_xticks([-1, 1], ["opposite", "as claimed"])
    for label, align in zip(axes.get_xticklabels(), ("left", "right"), strict=True):
        label.set_horizontalalignment(align)
    axes.tick_params(axis="y", left=False, labelleft=False)
    axes.spines["left"].set_visible(False)
    axes.set_title(name)


def _legend(figure: "Figure") -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], marker=marker, color=colour, markerfacecolor=filling, markersize=5, linewidth=1, label=verdict)
        for verdict, (colour, filling, marker) in LOOKS.items()
    ]
    alike = Line2D([], [], marker=ALIKE, color="black", markerfacecolor="white", markersize=5, linewidth=1,
                   label="of two that are alike")  # fmt: skip
    figure.legend(handles=[*handles, alike], loc="outside upper center", ncols=len(VERDICTS) + 1, frameon=False)
