"""Colours of the thesis's methods, and the figure of claim C25: outcomes over the delivered dose of fear."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from deimos.study import outcomes
from deimos.study.data import Data, Style, Where
from deimos.study.figures import WIDTH, Figures, as_rates, instead, legend, subplots
from deimos.study.outcomes import DOSE, of_environment
from deimos.study.results import Row
from reproduction import legged_figures
from reproduction.measures import LITERAL, PENALTIES
from reproduction.thesis import DIRECTOR_METHODS, ENVIRONMENTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHIFTED = (
    "On the right, Uniform policies under the Director's rules, from Coop to Antagonist, by a fear network trained on "
    "the finished policy and by exact fear from clones: what the shift of the goals does in itself."
)
_BASELINES = ("uniform", *PENALTIES, "rnd", "rnd-raw", "vds", "uniform-ensemble", "learnability", "cl")
_LITERAL = tuple(name + LITERAL for name in DIRECTOR_METHODS)
_CONTROLS = ("p25-threshold", "p75-threshold", "oracle", "swapped", "state-blind", "p75-penalty")
_DIRECTOR_COLOURS = ("#fde333", "#b6c24a", "#6fa76b", "#3c8a7c", "#2e6b85", "#3a4a80", "#2d1e5f")  # yellow to blue
_BY_FEAR = dict(zip(DIRECTOR_METHODS, _DIRECTOR_COLOURS, strict=True))
STYLE = Style(
    order=(*ENVIRONMENTS, *_LITERAL, *DIRECTOR_METHODS, *_CONTROLS, *_BASELINES),
    panels={
        "the thesis's Directors": _LITERAL, "crash memory, controls": (*DIRECTOR_METHODS, *_CONTROLS),
        "baselines": _BASELINES,
    },
    everywhere="uniform",
    colours=_BY_FEAR | {  # the others are from Okabe and Ito
        "uniform": "#000000", "rnd": "#D55E00", "vds": "#CC79A7", "cl": "#56B4E9", "vds+p75": "#009E73",
        "learnability": "#E69F00",
    } | dict(zip(_LITERAL, _DIRECTOR_COLOURS, strict=True)) | {
        "p25-threshold": _BY_FEAR["p25"], "p75-threshold": _BY_FEAR["p75"], "oracle": "#e7298a", "swapped": "#a6761d",
        "state-blind": "#66a61e", "p75-penalty": "#1f78b4", "rnd-raw": "#f4a582", "uniform-ensemble": "#b2abd2",
    } | dict(zip(PENALTIES, ("#7f7f7f", "#bfbfbf"), strict=True)),
)  # fmt: skip


def figures(data: Data, environment: str, shifted: Sequence[Row] = ()) -> Figures:
    """The figures of every study; next to the delivered dose, Uniform policies under shifted goals if there are rows.

    If methods branched off common bases, those of ``legged_figures`` replace boxes and bands.

    Args:
        data: Data of the study.
        environment: Its name.
        shifted: Rows of ``reproduction.shifted_goals``.
    """
    found = of_environment(data, environment)
    for period in data.periods(environment):
        own = [row for row in shifted if (row["environment"], row["goal_period"]) == (environment, period)]
        if own:
            text = f"{environment}, T = {period}: {DOSE} {SHIFTED}"
            found[f"dose-{environment}-T{period}"] = (text, dose_response(data, environment, period, own))
    if not data.paired(environment):
        return found
    found |= legged_figures.figures(data, environment)
    return {
        name: (f"{caption} {legged_figures.ORIGIN}", figure) for name, (caption, figure) in found.items()
        # A few policies have no profile; a setting's section needs no place for figures that it was not asked for.
        if figure is not None and not name.startswith("profile-")
    }  # fmt: skip


def dose_response(data: Data, environment: str, period: int, shifted: Sequence[Row]) -> "Figure":
    """The effect of shifted goals in training, under uniform goals, and their effect on a Uniform policy itself."""
    names = [name for name in data.methods(environment) if data.delivered(environment, name)]
    hard = outcomes.attacked(data, environment, period)
    figure, axes = subplots(2, 2, (WIDTH, 4.8), sharex=True, sharey="row")
    places = (Where(environment, "naive", period), "score"), (hard.where, hard.metric)
    for (left, right), (where, metric) in zip(axes, places, strict=True):
        if names:
            outcomes.over_dose(left, data, where, names, metric)
        else:
            instead(left, "delivered dose:\nnot recorded")
        _over_shift(right, shifted, "score" if metric == "score" else "crash_rate")
        for panel in (left, right):
            panel.grid(alpha=0.3)
    axes[0, 0].set_title("trained on shifted goals,\njudged on uniform goals and attacks")
    axes[0, 1].set_title("Uniform policies,\njudged on shifted goals")
    axes[0, 0].set_ylabel("score")
    as_rates(axes[1, 0], "y", "crashes per interaction [%]")
    axes[1, 0].set_xlabel("delivered dose in training:\nmean percentile of fear")
    axes[1, 1].set_xlabel("delivered dose in evaluation:\nmean percentile of fear")
    if names:
        legend(figure, data.style, names, "beside")
    return figure


def _over_shift(axes: "Axes", rows: Sequence[Row], metric: str) -> None:
    """Draw a line for each policy through the rules by rising percentile, by learnt fear and by exact fear."""
    unit = 1 if metric == "score" else 100
    for fear, colour, marker in (("learnt", "#000000", "o"), ("exact", "#D55E00", "^")):
        own = [row for row in rows if row["fear"] == fear]
        for i, seed in enumerate(sorted({row["seed"] for row in own})):
            points = sorted((row["percentile"], unit * row[metric]) for row in own if row["seed"] == seed)
            axes.plot(
                *np.array(points).T, color=colour, linewidth=0.8, marker=marker, markersize=3.5, alpha=0.7,
                label=None if i else f"{fear} fear",
            )  # fmt: skip
    axes.legend(frameon=False, loc="lower left" if metric == "score" else "upper left")
