"""The figures of a study, as PNG and SVG, for print and the colour-blind.

Every method has one colour and one marker throughout: those of the data's ``Style``.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.stats import sem

from deimos.study import stats
from deimos.study.data import Data, Style, Where
from deimos.study.document import Picture
from deimos.study.stats import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CAVEAT = "Curves of different methods are not comparable: each crashes under its own goals."
BOXES = "every point is a policy; boxes are quartiles, whiskers 1.5 times their range. Weak adversaries are left out."
PROFILES = "share of the policies that crash more often than x, with pointwise 95 % bands."
DPI = 130
WINDOW = 0.05  # of the training, for the rolling mean
GOALS = ("naive", "adversary")

Figures = dict[str, tuple[str, "Figure | None"]]
"""Captions and figures by their names; ``None`` for a figure that there are no data for."""


def of_environment(data: Data, environment: str) -> Figures:
    """The figures of one environment."""
    text = f"Training in {environment}: rolling means, mean over seeds with standard error. {CAVEAT}"
    figures: Figures = {f"training-{environment}": (text, training(data, environment))}
    for period in data.periods(environment):
        place, ending = f"{environment}, T = {period}", f"{environment}-T{period}"
        figures[f"evaluation-{ending}"] = (f"{place}: {BOXES}", boxes(data, environment, period))
        figures[f"profile-{ending}"] = (f"{place}: {PROFILES}", profiles(data, environment, period))
    return figures


def write(figures: Figures, folder: Path) -> list[Picture]:
    """Write figures, each as PNG and SVG, and return those that there are data for as blocks of a page."""
    import matplotlib

    pictures = []
    for name, (caption, figure) in figures.items():
        if figure is not None:
            figure.savefig(folder / f"{name}.png", dpi=DPI)
            with matplotlib.rc_context({"svg.hashsalt": name}):  # the same file from the same data
                figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
            pictures.append(Picture(name, caption))
    return pictures


def subplots(rows: int, columns: int, size: tuple[float, float], **more: Any) -> "tuple[Figure, Any]":
    """A figure that belongs to nobody else, unlike pyplot's, of width and height ``size`` [inch], and its axes.

    The axes have shape (rows, columns); ``more`` is for ``Figure.subplots``.
    """
    from matplotlib.figure import Figure

    figure = Figure(size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **more)


def boxes(data: Data, environment: str, period: int) -> "Figure":
    """Box-and-whisker plots of crashes and rewards, Naive and Adversary side by side."""
    methods = data.methods(environment)
    figure, axes = subplots(2, 2, (2.6 + 0.62 * len(methods), 6.4), sharex=True, sharey="row")
    for column, goals in enumerate(GOALS):
        where = Where(environment, goals, period)
        axes[0, column].set_title(goals.capitalize())
        for row, metric in enumerate(("crashes", "reward")):
            _boxes(axes[row, column], data.style, {name: data.sample(where, name, metric) for name in methods})
        axes[1, column].set_xticks(range(len(methods)), methods, rotation=45, ha="right")
    axes[0, 0].set_ylabel("crashes")
    axes[1, 0].set_ylabel("mean reward per transition")
    logarithmic(axes[0, 0])
    return figure


def _boxes(axes: "Axes", style: Style, samples: Mapping[str, Array]) -> None:
    first = next(iter(style.panels))
    for i, (name, values) in enumerate(samples.items()):
        if len(values) == 0:
            continue
        drawn = axes.boxplot(
            [values], positions=[i], widths=0.62, patch_artist=True, showfliers=False,
            medianprops={"color": "white" if _is_dark(style.colours[name]) else "black", "linewidth": 1.8},
        )  # fmt: skip
        hatch = None if style.panel(name) == first else "//"
        drawn["boxes"][0].set(facecolor=style.colours[name], alpha=0.85, hatch=hatch)
        place = i + 0.4 * (np.arange(len(values)) * 0.618034 % 1.0 - 0.5)  # spread, but not in the order of the seeds
        axes.plot(
            place, values, linestyle="", marker="o", markersize=3.2, color="white",
            markeredgecolor="black", markeredgewidth=0.6, zorder=3,
        )  # fmt: skip
    axes.grid(axis="y", alpha=0.3)


def logarithmic(axes: "Axes") -> None:
    """Crashes from 0 to many: linear up to 10, logarithmic above. After all is drawn, which the limits depend on."""
    axes.set_yscale("symlog", linthresh=10)
    axes.autoscale_view()
    axes.set_ylim(bottom=-1)


def training(data: Data, environment: str) -> "Figure | None":
    """Crashes and rewards during training, a column for each panel of methods."""
    found = [name for name in data.methods(environment) if data.curves(environment, name)]
    if not found:
        return None
    figure, axes = _panels(data.style, sharey="row")
    for top, bottom, title in zip(*axes, data.style.panels, strict=True):
        own = [name for name in found if data.style.panel(name) == title]
        names = [name for name in found if name == data.style.everywhere and name not in own] + own
        for panel, column in ((top, "crashes_per_1000"), (bottom, "reward")):
            panel.grid(alpha=0.3)
            for name in names:
                _curve(panel, data, environment, name, column)
        top.set_title(title)
        bottom.set_xlabel("parallel steps")
        if names:
            top.legend(frameon=False, ncols=2, fontsize=9)
        top.set_yscale("symlog", linthresh=0.1)
        top.set_ylim(bottom=0)
    axes[0, 0].set_ylabel("crashes per 1000 transitions")
    axes[1, 0].set_ylabel("mean reward per transition")
    figure.suptitle(CAVEAT, fontsize=9)
    return figure


def profiles(data: Data, environment: str, period: int) -> "Figure | None":
    """Performance profiles: share of the policies whose crashes per 1000 transitions exceed a threshold."""
    figure, axes = _panels(data.style, sharey="all")
    thresholds = np.concatenate([[0.0], np.geomspace(1e-3, 1e2, 120)])
    for row, goals in enumerate(GOALS):
        for panel, title in zip(axes[row], data.style.panels, strict=True):
            for name in data.methods(environment):
                values = data.sample(Where(environment, goals, period), name, "crashes_per_1000")
                if data.style.panel(name) == title and len(values) >= 2:
                    share, *band = stats.performance_profile([values], thresholds, resamples=2000)
                    _line(panel, data.style, name, thresholds, share, band, every=12, alpha=0.1, step="post")
            panel.set_xscale("symlog", linthresh=1e-3)
            panel.grid(alpha=0.3)
            panel.set_title(f"{title}, against the {goals.capitalize()}")
            if panel.lines:
                panel.legend(frameon=False, fontsize=8, ncols=2)
    for panel in axes[1]:
        panel.set_xlabel("crashes per 1000 transitions")
    for panel in axes[:, 0]:
        panel.set_ylabel("share of policies above")
    return figure if any(panel.lines for panel in axes.flat) else None


def _panels(style: Style, sharey: str) -> "tuple[Figure, Any]":
    """Two rows of as many axes as there are panels of methods."""
    count = len(style.panels)
    return subplots(2, count, (1.5 + 4.75 * count, 6.6), sharex=True, sharey=sharey)


def _curve(axes: "Axes", data: Data, environment: str, name: str, column: str) -> None:
    """Mean over seeds with its standard error, smoothed by a rolling mean."""
    curves, steps = data.curves(environment, name, column), data.curves(environment, name, "env_steps")
    length = min(map(len, curves))
    window = max(1, round(WINDOW * length))
    smooth = np.stack([_rolling(curve[:length], window) for curve in curves])
    mean = smooth.mean(axis=0)
    error = sem(smooth) if len(curves) > 1 else 0.0
    band = mean - error, mean + error
    _line(axes, data.style, name, steps[0][:length], mean, band, every=max(1, length // 8), alpha=0.18)


def _line(
    axes: "Axes", style: Style, name: str, x: Array, y: Array, band: Sequence[Array],
    *, every: int, alpha: float, step: Literal["post"] | None = None,
) -> None:  # fmt: skip
    """A method's line with its band of that opacity, and a marker at ``every`` so many points."""
    axes.plot(
        x, y, drawstyle=step and f"steps-{step}", color=style.colours[name], linewidth=1.6, label=name,
        marker=style.marker(name), markersize=4.5, markevery=every, markeredgecolor="black", markeredgewidth=0.4,
    )  # fmt: skip
    low, high = band
    axes.fill_between(x, low, high, step=step, color=style.colours[name], alpha=alpha, linewidth=0)


def _rolling(x: Array, window: int) -> Array:
    """Mean of the last ``window`` values; of fewer at the start."""
    return np.convolve(x, np.ones(window))[: len(x)] / np.minimum(np.arange(1, len(x) + 1), window)


def _is_dark(code: str) -> bool:
    red, green, blue = (int(code[i : i + 2], 16) for i in (1, 3, 5))
    return 0.299 * red + 0.587 * green + 0.114 * blue < 110
