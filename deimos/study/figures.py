"""The figures of a study: the thesis's, and those that its argument needs. PNG and SVG, for print and the colour-blind.

Every method has one colour and one marker or hatch throughout: the Directors by rising p from yellow to blue,
the others from Okabe and Ito's palette.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deimos.run.folder import RunError
from deimos.study import stats
from deimos.study.claim_custom import ACHIEVED
from deimos.study.data import DIRECTOR_METHODS, Curve, Data, Where
from deimos.study.stats import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CAVEAT = "Curves of different methods do not compare: each crashes under its own goals."
DPI = 130
WINDOW = 0.05  # of the training, for the rolling mean
_DIRECTOR_COLOURS = ("#fde333", "#b6c24a", "#6fa76b", "#3c8a7c", "#2e6b85", "#3a4a80", "#2d1e5f")
_COLOURS = dict(zip(DIRECTOR_METHODS, _DIRECTOR_COLOURS, strict=True)) | {
    "uniform": "#000000", "rnd": "#D55E00", "vds": "#CC79A7", "cl": "#56B4E9", "vds+p75": "#009E73",
    "learnability": "#E69F00",
}  # fmt: skip
_OTHERS = ("#7f7f7f", "#0072B2", "#a6761d", "#666666", "#1b9e77", "#e7298a")
_MARKERS = "ovs^D<P>X*hpdH8"
_GOALS = ("naive", "adversary")


def draw_all(data: Data, folder: Path) -> dict[str, str]:
    """Draw every figure that there are data for, each as PNG and SVG.

    Args:
        data: The results.
        folder: Where to write.

    Returns:
        Captions by the figures' names, in the order of the report.

    Raises:
        RunError: If one cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    figures: dict[str, str] = {}

    def draw(name: str, caption: str, make: "Callable[[], Figure | None]") -> None:
        figure = make()
        if figure is not None:
            _save(figure, folder, name)
            figures[name] = caption

    for environment in data.environments:
        if any(data.curves(environment, name) for name in data.methods(environment)):
            caption = f"Training in {environment}: rolling means, mean over seeds with standard error (as Figures 4.4, "
            draw(f"training-{environment}", f"{caption}A.1 and A.2). {CAVEAT}", partial(training, data, environment))
        for period in data.periods(environment):
            place, ending, make = (
                f"{environment}, T = {period}",
                f"{environment}-T{period}",
                (data, environment, period),
            )
            draw(
                f"evaluation-{ending}",
                f"{place}: every point is a policy; boxes are quartiles, whiskers 1.5 times "
                "their range (as Figures 4.5 to 4.11). Weak adversaries are left out.",
                partial(boxes, *make),
            )
            draw(
                f"profile-{ending}",
                f"{place}: share of the policies that crash more often than x, with pointwise 95 % bands.",
                partial(profiles, *make),
            )
            draw(
                f"dose-{ending}",
                f"{place}: crashes over the percentile of fear that a method's goals have on average; medians with "
                "quartiles, and the parabola of claim C25.",
                partial(dose_response, *make),
            )
    return figures


def boxes(data: Data, environment: str, period: int) -> "Figure":
    """Box-and-whisker plots of crashes and rewards, Naive and Adversary side by side."""
    import matplotlib.pyplot as plt

    methods = data.methods(environment)
    figure, axes = plt.subplots(
        2, 2, figsize=(2.6 + 0.62 * len(methods), 6.4), sharex=True, sharey="row", layout="constrained"
    )
    for column, goals in enumerate(_GOALS):
        where = Where(environment, goals, period)
        axes[0, column].set_title(f"against the {goals.capitalize()}")
        for row, (metric, label) in enumerate((("crashes", "crashes"), ("reward", "mean reward per transition"))):
            samples = [data.sample(where, name, metric) for name in methods]
            _boxes(axes[row, column], methods, samples)
            if column == 0:
                axes[row, column].set_ylabel(label)
        axes[1, column].set_xticks(range(len(methods)), methods, rotation=45, ha="right")
    _logarithmic(axes[0, 0])
    return figure


def _boxes(axes: "Axes", methods: Sequence[str], samples: Sequence[Array]) -> None:
    for i, (name, values) in enumerate(zip(methods, samples, strict=True)):
        if len(values) == 0:
            continue
        drawn = axes.boxplot(
            [values], positions=[i], widths=0.62, patch_artist=True, showfliers=False,
            medianprops={"color": "white" if _is_dark(name) else "black", "linewidth": 1.8},
        )  # fmt: skip
        drawn["boxes"][0].set(facecolor=colour(name), alpha=0.85, hatch=None if name in DIRECTOR_METHODS else "//")
        axes.plot(
            i + _jitter(len(values)), values, linestyle="", marker="o", markersize=3.2, color="white",
            markeredgecolor="black", markeredgewidth=0.6, zorder=3,
        )  # fmt: skip
    axes.grid(axis="y", alpha=0.3)


def _jitter(count: int) -> Array:
    """Sideways places for some points: evenly spread, in an order that does not follow the seeds."""
    return np.asarray((np.arange(count) * 0.618034 % 1.0 - 0.5) * 0.4, np.float64)


def _logarithmic(axes: "Axes") -> None:
    """Crashes from 0 to many: linear up to 10, logarithmic above. After all is drawn, which the limits depend on."""
    axes.set_yscale("symlog", linthresh=10)
    axes.autoscale_view()
    axes.set_ylim(bottom=-1)


def training(data: Data, environment: str) -> "Figure":
    """Crashes and rewards during training: the Directors on the left, one of them with the baselines on the right."""
    import matplotlib.pyplot as plt

    found = [name for name in data.methods(environment) if data.curves(environment, name)]
    directors = [name for name in found if name in DIRECTOR_METHODS]
    shown = next((name for name in ("p25", "p50", "p75", *directors) if name in directors), None)
    others = ([shown] if shown else []) + [name for name in found if name not in DIRECTOR_METHODS]
    figure, axes = plt.subplots(2, 2, figsize=(11, 6.6), sharex=True, sharey="row", layout="constrained")
    for column, (title, names) in enumerate((("Directors", directors), ("baselines", others))):
        axes[0, column].set_title(title)
        for name in names:
            for row, number in enumerate((lambda c: c.crashes, lambda c: c.reward)):
                _curve(axes[row, column], name, data.curves(environment, name), number)
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


def _curve(axes: "Axes", name: str, curves: Sequence[Curve], number: Callable[[Curve], Array]) -> None:
    """Mean over seeds with its standard error, smoothed by a rolling mean."""
    length = min(len(curve.env_steps) for curve in curves)
    values = np.stack([number(curve)[:length] for curve in curves])
    window = max(1, round(WINDOW * length))
    smooth = np.stack([_rolling(row, window) for row in values])
    x = curves[0].env_steps[:length]
    mean = smooth.mean(axis=0)
    axes.plot(
        x, mean, color=colour(name), linewidth=1.6, label=name, marker=marker(name), markersize=4.5,
        markevery=max(1, length // 8), markeredgecolor="black", markeredgewidth=0.4,
    )  # fmt: skip
    if len(curves) > 1:
        error = smooth.std(axis=0, ddof=1) / np.sqrt(len(curves))
        axes.fill_between(x, mean - error, mean + error, color=colour(name), alpha=0.18, linewidth=0)


def _rolling(x: Array, window: int) -> Array:
    """Mean of the last ``window`` values; of fewer at the start."""
    total = np.concatenate([[0.0], np.cumsum(x)])
    end = np.arange(1, len(x) + 1)
    begin = np.maximum(0, end - window)
    return (total[end] - total[begin]) / (end - begin)


def profiles(data: Data, environment: str, period: int) -> "Figure | None":
    """Performance profiles: share of the policies whose crashes per 1000 transitions exceed a threshold."""
    import matplotlib.pyplot as plt

    methods = data.methods(environment)
    groups = (
        ("Directors", [name for name in methods if name in DIRECTOR_METHODS]),
        ("baselines", [name for name in methods if name not in DIRECTOR_METHODS]),
    )
    figure, axes = plt.subplots(2, 2, figsize=(11, 6.6), sharex=True, sharey=True, layout="constrained")
    thresholds = np.concatenate([[0.0], np.geomspace(1e-3, 1e2, 120)])
    drawn = 0
    for row, goals in enumerate(_GOALS):
        for column, (title, names) in enumerate(groups):
            panel = axes[row, column]
            for name in names:
                values = data.sample(Where(environment, goals, period), name, "crashes_per_1000")
                if len(values) >= 2:
                    _profile(panel, name, values, thresholds)
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


def _profile(axes: "Axes", name: str, values: Array, thresholds: Array) -> None:
    share, low, high = stats.performance_profile([values], thresholds, resamples=2000)
    axes.step(
        thresholds, share, where="post", color=colour(name), linewidth=1.6, label=name, marker=marker(name),
        markersize=4.5, markevery=12, markeredgecolor="black", markeredgewidth=0.4,
    )  # fmt: skip
    axes.fill_between(thresholds, low, high, step="post", color=colour(name), alpha=0.1, linewidth=0)


def dose_response(data: Data, environment: str, period: int) -> "Figure | None":
    """Crashes over the achieved percentile of fear, Naive and Adversary side by side."""
    import matplotlib.pyplot as plt

    names = [name for name in data.methods(environment) if name in ACHIEVED]
    if len([name for name in names if name in DIRECTOR_METHODS]) < 3:
        return None
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained", sharey=True)
    for panel, goals in zip(axes, _GOALS, strict=True):
        where = Where(environment, goals, period)
        samples = {name: data.sample(where, name, "crashes") for name in names}
        for name, values in samples.items():
            if len(values):
                low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
                panel.errorbar(
                    ACHIEVED[name], middle, [[middle - low], [high - middle]], color="black", marker=marker(name),
                    markerfacecolor=colour(name), markersize=8, capsize=3, linewidth=1,
                )  # fmt: skip
        _parabola(panel, {n: x for n, x in samples.items() if n in DIRECTOR_METHODS and len(x)})
        panel.set_title(f"against the {goals.capitalize()}")
        panel.set_xlabel("achieved percentile of fear")
        panel.grid(alpha=0.3)
        shown = [name for name, values in samples.items() if len(values)]
        names_above = panel.secondary_xaxis("top")  # beside the markers they would cover each other
        names_above.set_xticks([ACHIEVED[name] for name in shown], shown, rotation=60, ha="left", fontsize=8)
    _logarithmic(axes[0])
    axes[0].set_ylabel("crashes")
    return figure


def _parabola(axes: "Axes", samples: dict[str, Array]) -> None:
    if len(samples) < 4:
        return
    x = np.concatenate([np.full(len(values), ACHIEVED[name]) for name, values in samples.items()])
    coefficients = np.polyfit(x, np.log1p(np.concatenate(list(samples.values()))), 2)
    line = np.linspace(0.5, 99.5, 100)
    axes.plot(line, np.expm1(np.polyval(coefficients, line)), color="grey", linewidth=1, linestyle="--", zorder=0)


def colour(method: str) -> str:
    """The colour of a method, the same in every figure."""
    return _COLOURS.get(method) or _OTHERS[sum(map(ord, method)) % len(_OTHERS)]


def marker(method: str) -> str:
    """The marker of a method, the same in every figure."""
    known = [*_COLOURS]
    return _MARKERS[(known.index(method) if method in known else sum(map(ord, method))) % len(_MARKERS)]


def _is_dark(method: str) -> bool:
    code = colour(method)
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
