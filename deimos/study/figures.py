"""The figures of a study, as PNG and SVG, for print and the colour-blind.

Every method has one colour and one marker throughout: those of the data's ``Style``.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from deimos.run.folder import RunError
from deimos.study import stats
from deimos.study.data import Curve, Data, Style, Where
from deimos.study.stats import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CAVEAT = "Curves of different methods are not comparable: each crashes under its own goals."
DPI = 130
WINDOW = 0.05  # of the training, for the rolling mean
GOALS = ("naive", "adversary")


Figures = dict[str, tuple[str, Callable[[], "Figure | None"]]]
"""Of every figure by its name: the caption, and what makes it or finds that there are no data for it."""


def of_environment(data: Data, environment: str) -> Figures:
    """The figures of one environment."""
    figures: Figures = {}
    if any(data.curves(environment, name) for name in data.methods(environment)):
        figures[f"training-{environment}"] = (
            f"Training in {environment}: rolling means, mean over seeds with standard error. {CAVEAT}",
            partial(training, data, environment),
        )
    for period in data.periods(environment):
        place, ending = f"{environment}, T = {period}", f"{environment}-T{period}"
        figures[f"evaluation-{ending}"] = (
            f"{place}: every point is a policy; boxes are quartiles, whiskers 1.5 times their range. Weak adversaries "
            "are left out.",
            partial(boxes, data, environment, period),
        )
        figures[f"profile-{ending}"] = (
            f"{place}: share of the policies that crash more often than x, with pointwise 95 % bands.",
            partial(profiles, data, environment, period),
        )
    return figures


def draw(figures: Figures, folder: Path) -> dict[str, str]:
    """Draw figures, each as PNG and SVG.

    Returns:
        Captions of those that there are data for, by their names.

    Raises:
        RunError: If one cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    captions = {}
    for name, (caption, make) in figures.items():
        figure = make()
        if figure is not None:
            _save(figure, folder, name)
            captions[name] = caption
    return captions


def boxes(data: Data, environment: str, period: int) -> "Figure":
    """Box-and-whisker plots of crashes and rewards, Naive and Adversary side by side."""
    import matplotlib.pyplot as plt

    methods = data.methods(environment)
    figure, axes = plt.subplots(
        2, 2, figsize=(2.6 + 0.62 * len(methods), 6.4), sharex=True, sharey="row", layout="constrained"
    )
    for column, goals in enumerate(GOALS):
        where = Where(environment, goals, period)
        axes[0, column].set_title(f"against the {goals.capitalize()}")
        for row, (metric, label) in enumerate((("crashes", "crashes"), ("reward", "mean reward per transition"))):
            _boxes(axes[row, column], data.style, {name: data.sample(where, name, metric) for name in methods})
            if column == 0:
                axes[row, column].set_ylabel(label)
        axes[1, column].set_xticks(range(len(methods)), methods, rotation=45, ha="right")
    logarithmic(axes[0, 0])
    return figure


def _boxes(axes: "Axes", style: Style, samples: Mapping[str, Array]) -> None:
    first = next(iter(style.panels))
    for i, (name, values) in enumerate(samples.items()):
        if len(values) == 0:
            continue
        drawn = axes.boxplot(
            [values], positions=[i], widths=0.62, patch_artist=True, showfliers=False,
            medianprops={"color": "white" if _is_dark(style.colour(name)) else "black", "linewidth": 1.8},
        )  # fmt: skip
        hatch = None if style.panel(name) == first else "//"
        drawn["boxes"][0].set(facecolor=style.colour(name), alpha=0.85, hatch=hatch)
        axes.plot(
            i + _jitter(len(values)), values, linestyle="", marker="o", markersize=3.2, color="white",
            markeredgecolor="black", markeredgewidth=0.6, zorder=3,
        )  # fmt: skip
    axes.grid(axis="y", alpha=0.3)


def _jitter(count: int) -> Array:
    """Sideways places for some points: evenly spread, in an order that does not follow the seeds."""
    return np.asarray((np.arange(count) * 0.618034 % 1.0 - 0.5) * 0.4, np.float64)


def logarithmic(axes: "Axes") -> None:
    """Crashes from 0 to many: linear up to 10, logarithmic above. After all is drawn, which the limits depend on."""
    axes.set_yscale("symlog", linthresh=10)
    axes.autoscale_view()
    axes.set_ylim(bottom=-1)


def training(data: Data, environment: str) -> "Figure":
    """Crashes and rewards during training, a column for each panel of methods."""
    found = [name for name in data.methods(environment) if data.curves(environment, name)]
    figure, axes = _panels(data.style, sharey="row")
    for column, title in enumerate(data.style.panels):
        own = [name for name in found if data.style.panel(name) == title]
        names = [name for name in found if name == data.style.everywhere and name not in own] + own
        axes[0, column].set_title(title)
        for name in names:
            for row, number in enumerate((lambda c: c.crashes, lambda c: c.reward)):
                _curve(axes[row, column], data.style, name, data.curves(environment, name), number)
        axes[1, column].set_xlabel("parallel steps")
        if names:
            axes[0, column].legend(frameon=False, ncols=2, fontsize=9)
        for row in range(2):
            axes[row, column].grid(alpha=0.3)
        axes[0, column].set_yscale("symlog", linthresh=0.1)
        axes[0, column].set_ylim(bottom=0)
    axes[0, 0].set_ylabel("crashes per 1000 transitions")
    axes[1, 0].set_ylabel("mean reward per transition")
    figure.suptitle(CAVEAT, fontsize=9)
    return figure


def _panels(style: Style, sharey: Literal["row", "all"]) -> "tuple[Figure, Any]":
    """Two rows of as many axes as there are panels of methods."""
    import matplotlib.pyplot as plt

    count = len(style.panels)
    size = (1.5 + 4.75 * count, 6.6)
    return plt.subplots(2, count, figsize=size, sharex=True, sharey=sharey, squeeze=False, layout="constrained")


def _curve(axes: "Axes", style: Style, name: str, curves: Sequence[Curve], number: Callable[[Curve], Array]) -> None:
    """Mean over seeds with its standard error, smoothed by a rolling mean."""
    length = min(len(curve.env_steps) for curve in curves)
    values = np.stack([number(curve)[:length] for curve in curves])
    window = max(1, round(WINDOW * length))
    smooth = np.stack([_rolling(row, window) for row in values])
    x = curves[0].env_steps[:length]
    mean = smooth.mean(axis=0)
    axes.plot(
        x, mean, color=style.colour(name), linewidth=1.6, label=name, marker=style.marker(name), markersize=4.5,
        markevery=max(1, length // 8), markeredgecolor="black", markeredgewidth=0.4,
    )  # fmt: skip
    if len(curves) > 1:
        error = smooth.std(axis=0, ddof=1) / np.sqrt(len(curves))
        axes.fill_between(x, mean - error, mean + error, color=style.colour(name), alpha=0.18, linewidth=0)


def _rolling(x: Array, window: int) -> Array:
    """Mean of the last ``window`` values; of fewer at the start."""
    total = np.concatenate([[0.0], np.cumsum(x)])
    end = np.arange(1, len(x) + 1)
    begin = np.maximum(0, end - window)
    return (total[end] - total[begin]) / (end - begin)


def profiles(data: Data, environment: str, period: int) -> "Figure | None":
    """Performance profiles: share of the policies whose crashes per 1000 transitions exceed a threshold."""
    import matplotlib.pyplot as plt

    figure, axes = _panels(data.style, sharey="all")
    thresholds = np.concatenate([[0.0], np.geomspace(1e-3, 1e2, 120)])
    drawn = 0
    for row, goals in enumerate(GOALS):
        for column, title in enumerate(data.style.panels):
            panel = axes[row, column]
            for name in data.methods(environment):
                values = data.sample(Where(environment, goals, period), name, "crashes_per_1000")
                if data.style.panel(name) == title and len(values) >= 2:
                    _profile(panel, data.style, name, values, thresholds)
                    drawn += 1
            panel.set_xscale("symlog", linthresh=1e-3)
            panel.grid(alpha=0.3)
            panel.set_title(f"{title}, against the {goals.capitalize()}")
            if panel.get_legend_handles_labels()[0]:
                panel.legend(frameon=False, fontsize=8, ncols=2)
    for panel in axes[1]:
        panel.set_xlabel("crashes per 1000 transitions")
    for panel in axes[:, 0]:
        panel.set_ylabel("share of policies above")
    if drawn:
        return figure
    plt.close(figure)
    return None


def _profile(axes: "Axes", style: Style, name: str, values: Array, thresholds: Array) -> None:
    share, low, high = stats.performance_profile([values], thresholds, resamples=2000)
    axes.step(
        thresholds, share, where="post", color=style.colour(name), linewidth=1.6, label=name, marker=style.marker(name),
        markersize=4.5, markevery=12, markeredgecolor="black", markeredgewidth=0.4,
    )  # fmt: skip
    axes.fill_between(thresholds, low, high, step="post", color=style.colour(name), alpha=0.1, linewidth=0)


def _is_dark(code: str) -> bool:
    red, green, blue = (int(code[i : i + 2], 16) for i in (1, 3, 5))
    return 0.299 * red + 0.587 * green + 0.114 * blue < 110


def _save(figure: "Figure", folder: Path, name: str) -> None:
    import matplotlib.pyplot as plt

    try:
        figure.savefig(folder / f"{name}.png", dpi=DPI)
        with plt.rc_context({"svg.hashsalt": name}):  # the same file from the same data
            figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
    except OSError as error:
        raise RunError(f"{folder / name} could not be written ({error.strerror}).") from error
    finally:
        plt.close(figure)
