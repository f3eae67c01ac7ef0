"""The thesis's figures of robots in pairs: a line for each base policy that the methods branched off."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from deimos.study import outcomes
from deimos.study.data import Data, Where
from deimos.study.figures import CAVEAT, RATES, WIDTH, WINDOW, Figures, as_rates, instead, rolling, subplots
from reproduction.legged_contrasts import NAIVE, OUTCOMES, REFERENCE, WORST, contrasts
from reproduction.measures import SCORE, Evidence, Place

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NUMBERS = {("quad", 100): "4.8", ("quad", 500): "4.9", ("quad_arm", 100): "4.10", ("quad_arm", 500): "4.11"}
"""The thesis's figures of evaluations, by robot and T [steps]."""
CURVES = {"quad": "A.1", "quad_arm": "A.2"}
"""Those of training."""
ORIGIN = "Fine-tuned from common base policies, 12 M of the thesis's 295 M transitions."
"""The note in every caption on robots."""
PAIRS = (
    "every line is a base, every dot the policy of a method that branched off it; bars are means over bases, of "
    "crashes themselves and not of their logarithms, which contrasts compare."
)
DIFFERENCES = (
    "differences from Uniform. Every dot is a base; bars are 95 % t intervals of the mean. To the right is more: of "
    "scores better, of rates worse. A log rate is that of crashes per interaction."
)
TRAINING = "every line is a base, in grey Uniform's of the same bases; rolling means."
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9")  # Okabe and Ito's
_MARKERS = "osD^vP"
_COLUMNS = 5
_MOST_TICKS = 6
LINEAR = 0.1  # crashes per 1000 transitions below which an axis is linear


def figures(data: Data, environment: str) -> Figures:
    """The figures of an environment whose methods branched off common bases, replacing those of every study."""
    found: Figures = {}
    for period in data.periods(environment):
        number, place = NUMBERS.get((environment, period)), f"{environment}, T = {period}"
        title = f"Figure {number} in pairs, {place}" if number else place
        found |= {
            f"evaluation-{environment}-T{period}": (f"{title}: {PAIRS}", pairs(data, environment, period)),
            f"differences-{environment}-T{period}": (
                f"{place}: {DIFFERENCES}", differences(data, environment, period)
            ),
        }  # fmt: skip
    if data.trained_in(environment) != environment:
        return found
    title = f"Figure {CURVES[environment]} in pairs, {environment}" if environment in CURVES else environment
    found[f"training-{environment}"] = (f"{title}: {TRAINING} {CAVEAT}", training(data, environment))
    return found


def bases(data: Data, environment: str) -> list[int]:
    """Numbers of the bases that at least one method branched off."""
    return sorted({row["seed"] for row in data.rows if row["environment"] == environment})


def _methods(data: Data, environment: str) -> list[str]:
    """Methods of an environment in order, with the one that all are compared with first."""
    return sorted(data.methods(environment), key=lambda name: name != REFERENCE)


def pairs(data: Data, environment: str, period: int) -> "Figure":
    """Crashes per interaction and score of every policy, without and with attackers, a line for each base."""
    easy, hard = Where(environment, "naive", period), Where(environment, "adversary", period)
    worst = outcomes.attacked(data, environment, period)
    methods, numbers = _methods(data, environment), bases(data, environment)
    figure, axes = subplots(2, 3, (WIDTH, 5.0), sharey="row")
    for panel, where, metric, title in (
        (axes[0, 0], easy, "crash_rate", "uniform goals"), (axes[0, 1], hard, "crash_rate", "the Adversary"),
        (axes[0, 2], worst.where, worst.metric, "the worst attacker"),
        (axes[1, 0], easy, "score", "uniform goals"), (axes[1, 1], hard, "score", "the Adversary"),
    ):  # fmt: skip
        unit = 1 if metric == "score" else 100
        values = np.full((len(numbers), len(methods)), np.nan)
        for i, base in enumerate(numbers):
            for j, name in enumerate(methods):
                values[i, j] = unit * next(iter(data.sample(where, name, metric, [base])), np.nan)
        _lines(panel, values)
        panel.set_title(f"under {title}")
        panel.grid(axis="y", alpha=0.3)
        panel.set_xticks(range(len(methods)), methods, rotation=45, ha="right", rotation_mode="anchor")
        panel.set_xlim(-0.5, len(methods) - 0.5)
    rates = [x for panel in axes[0] for line in panel.lines for x in line.get_ydata()]
    as_rates(axes[0, 0], "y", "crashes per interaction [%]", rates)
    axes[1, 0].set_ylabel("score")
    axes[1, 2].set_axis_off()
    _legend(figure, numbers)
    return figure


def _lines(axes: "Axes", values: np.ndarray) -> None:
    """Draw a line for each base through its methods, and a bar at each method's mean; shape (bases, methods)."""
    if np.isnan(values).all():
        instead(axes, outcomes.NOBODY)
    for i, own in enumerate(values):
        known = np.flatnonzero(~np.isnan(own))
        axes.plot(known, own[known], color=_COLOURS[i % 6], marker=_MARKERS[i % 6], markersize=4, linewidth=0.9)
    for j, own in enumerate(values.T):
        if not np.isnan(own).all():
            axes.plot([j - 0.25, j + 0.25], [np.nanmean(own)] * 2, color="black", linewidth=1.6, zorder=3)


def differences(data: Data, environment: str, period: int) -> "Figure | None":
    """Differences of every method from Uniform, base by base, in score and log rates."""
    evidence, place = Evidence.of(data), Place(environment, period)
    names = [name for name in data.methods(environment) if name != REFERENCE]
    found = contrasts(evidence, place, names)
    if not found:
        return None
    measures = [measure for measure in OUTCOMES if any(each.measure is measure for each in found)]
    numbers = bases(data, environment)
    figure, axes = subplots(1, len(measures), (WIDTH, 1.2 + 0.3 * len(names)), sharey=True)
    titles = {SCORE: "score, uniform goals", NAIVE: "log rate, uniform goals", WORST: "log rate, worst attacker"}
    for panel, measure in zip(axes[0], measures, strict=True):
        for each in (each for each in found if each.measure is measure):
            row = names.index(each.method)
            for base, value in zip(each.bases, each.differences, strict=True):
                i = numbers.index(base)
                panel.plot(value, row - 0.18, marker=_MARKERS[i % 6], color=_COLOURS[i % 6], markersize=3.6)
            panel.plot([each.mean.low, each.mean.high], [row + 0.15] * 2, color="black", linewidth=1)
            panel.plot(each.mean.estimate, row + 0.15, marker="|", color="black", markersize=7)
        panel.axvline(0.0, color="black", linewidth=0.8, linestyle=":")
        panel.grid(axis="x", alpha=0.3)
        panel.set_title(titles[measure])
        panel.set_xlabel("difference from Uniform")
    axes[0, 0].set_yticks(range(len(names)), names)
    axes[0, 0].set_ylim(len(names) - 0.4, -0.6)
    _legend(figure, numbers)
    return figure


def training(data: Data, environment: str) -> "Figure | None":
    """Crashes and reward during training, a panel for each method, a line for each base."""
    from matplotlib.ticker import MaxNLocator

    methods = [name for name in _methods(data, environment) if data.curves(environment, name)]
    if not methods:
        return None
    columns = min(_COLUMNS, len(methods))
    rows = -(-len(methods) // columns)
    figure, axes = subplots(2 * rows, columns, (WIDTH, 0.6 + 2.6 * rows), sharex=True)
    for panel in axes.flat:
        panel.set_visible(False)
    for index, name in enumerate(methods):
        top, bottom = axes[2 * (index // columns) : 2 * (index // columns) + 2, index % columns]
        for panel, column in ((top, "crashes_per_1000"), (bottom, "reward")):
            panel.set_visible(True)
            if name != REFERENCE:
                _curves(panel, data, environment, REFERENCE, column, ("#bbbbbb",))
            _curves(panel, data, environment, name, column, _COLOURS)
            panel.grid(alpha=0.3)
        top.set_title(name)
        top.set_yscale("symlog", linthresh=LINEAR)
        top.yaxis.set_major_formatter("{x:g}")
        if index + columns >= len(methods):  # nothing below
            bottom.tick_params(labelbottom=True)
            bottom.set_xlabel("steps of every world")
    for which, label in enumerate(("crashes per 1000\ntransitions", "mean reward\nper transition")):
        _share_limits(axes[which::2], label)
    for panel in axes[::2].flat:
        low, high = panel.get_ylim()
        shown = [x for x in RATES if max(low, LINEAR) <= x <= high]
        if len(shown) < 2:
            panel.yaxis.set_major_locator(MaxNLocator(4))
        elif len(shown) <= _MOST_TICKS:  # of more, powers of ten are enough
            panel.set_yticks(shown)
    _legend(figure, bases(data, environment))
    return figure


def _curves(axes: "Axes", data: Data, environment: str, method: str, column: str, colours: Sequence[str]) -> None:
    """The curves of a method, smoothed by a rolling mean."""
    steps = data.curves_by_seed(environment, method, "env_steps")
    numbers = bases(data, environment)
    for base, values in data.curves_by_seed(environment, method, column).items():
        window = max(1, round(WINDOW * len(values)))
        colour = colours[numbers.index(base) % len(colours)]
        axes.plot(steps[base][: len(values)], rolling(values, window), color=colour, linewidth=0.9)


def _share_limits(panels: "np.ndarray", label: str) -> None:
    """One axis for all panels of an outcome; only the first of a row has its numbers."""
    shown = [panel for panel in panels.flat if panel.get_visible()]
    low, high = zip(*(panel.get_ylim() for panel in shown), strict=True)
    for panel in shown:
        panel.set_ylim(min(low), max(high))
        first = panel in panels[:, 0]
        panel.tick_params(labelleft=first)
        panel.set_ylabel(label if first else "")


def _legend(figure: "Figure", numbers: Sequence[int]) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=_COLOURS[i % 6], marker=_MARKERS[i % 6], markersize=4, linewidth=0.9, label=f"base {base}")
        for i, base in enumerate(numbers)
    ]
    figure.legend(handles=handles, frameon=False, loc="outside lower center", ncols=6)
