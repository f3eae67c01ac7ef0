"""The figures of a study, as PNG and SVG, for print and the colour-blind.

Every method has one colour and one marker throughout: those of the data's ``Style``. What the rows of an older version
do not hold is named in the place of its panel.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from deimos.files import file_name
from deimos.study.data import Data, Style
from deimos.study.document import Block, Picture
from deimos.study.stats import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CAVEAT = "Curves of different methods are not comparable: each crashes under its own goals."
TRAINING = (
    "medians over seeds with quartiles, of rolling means. Strips: the share of rollouts after which fear did not "
    "learn, from none (white) to all (dark); methods without a fear network have no strip."
)
DPI = 200
WIDTH = 7.2  # [inch]: the text of an A4 page, at which every figure can be read
ROW = 0.16  # [inch]: of a name in a legend
RATES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200)
"""Ticks of a logarithmic axis of rates [% of interactions, or per 1000 transitions]."""
DECADES = (0, 0.01, 0.1, 1, 10, 100)
FEW_DECADES = 200  # the largest ratio of an axis's ends at which all of these fit
WINDOW = 0.05  # of the training, for the rolling mean
PRINT: dict[Any, Any] = {
    "font.size": 8, "axes.titlesize": 8.5, "axes.labelsize": 8, "xtick.labelsize": 7.5, "ytick.labelsize": 7.5,
    "legend.fontsize": 7.5, "figure.titlesize": 8.5, "axes.spines.top": False, "axes.spines.right": False,
    "text.parse_math": False,  # a dollar in a name is a dollar
}  # fmt: skip

Figures = dict[str, tuple[str, "Figure | None"]]
"""Captions and figures by their names; ``None`` for a figure without data."""


def print_size() -> AbstractContextManager[None]:
    """A context in which figures get the font sizes of a printed page."""
    import matplotlib

    return matplotlib.rc_context(PRINT)


def write(figures: Figures, folder: Path) -> list[Block]:
    """Write figures, each as PNG and SVG, and return them as blocks of a page, with a text in place of missing ones."""
    import matplotlib

    blocks: list[Block] = []
    for title, (caption, figure) in figures.items():
        name = file_name(title)
        if figure is None:
            blocks.append(f"There are no data for this figure: {caption}")
            continue
        figure.savefig(folder / f"{name}.png", dpi=DPI)
        with matplotlib.rc_context({"svg.hashsalt": name}):  # the same file from the same data
            figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        blocks.append(Picture(name, caption))
    return blocks


def subplots(rows: int, columns: int, size: tuple[float, float], **more: Any) -> "tuple[Figure, Any]":
    """A figure outside pyplot's global state, of width and height ``size`` [inch], and its axes.

    The axes have shape (rows, columns); ``more`` is for ``Figure.subplots``.
    """
    from matplotlib.figure import Figure

    figure = Figure(size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **more)


def instead(axes: "Axes", text: str) -> None:
    """Write in the place of a panel why it is empty."""
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes, color="#555555")
    axes.tick_params(axis="y", left=False, labelleft=False)  # of these axes alone, where others share their ticks


def as_rates(axes: "Axes", which: Literal["x", "y"], label: str, rates: Iterable[float] = ()) -> None:
    """An axis of shares in percent, from none to all: linear up to 0.01 %, logarithmic above.

    Where the rates that it shows are given [%] and none is in the linear part, it ends with them: empty decades would
    hide the differences between policies.
    """
    axis = axes.xaxis if which == "x" else axes.yaxis
    getattr(axes, f"set_{which}scale")("symlog", linthresh=0.01, linscale=0.5)
    low, high = -0.002, 150.0
    ticks: Sequence[float] = DECADES
    shown = [rate for rate in rates if not math.isnan(rate)]
    if shown and min(shown) >= RATES[0]:
        low, high = max(x for x in RATES if x <= min(shown)), min(x for x in RATES if x > max(shown))
        ticks = RATES if high <= FEW_DECADES * low else ticks
    axis.set_ticks(ticks, [f"{x:g}" for x in ticks])
    getattr(axes, f"set_{which}lim")(low, high)
    axis.set_ticks([], minor=True)
    axis.set_label_text(label)


def training(data: Data, environment: str) -> "Figure | None":
    """Crashes and rewards during training, a column for each panel of methods, and where fear did not learn."""
    found = [name for name in data.methods(environment) if data.curves(environment, name)]
    if not found:
        return None
    of_panel = {title: [name for name in found if data.style.panel(name) == title] for title in data.style.panels}
    own = {title: names for title, names in of_panel.items() if names}
    titles = [*own]
    most = max(map(len, own.values()))
    known = any(unfitted(data, environment, name) is not None for name in found)
    figure, axes = subplots(
        3, len(titles), (WIDTH, 4.4 + 0.13 * most), sharex=True, sharey="row", height_ratios=[1, 1, 0.12 + 0.07 * most]
    )
    for (top, bottom, strip), title in zip(axes.T, titles, strict=True):
        more = [name for name in found if name == data.style.everywhere and name not in own[title]]
        for panel, column in ((top, "crashes_per_1000"), (bottom, "reward")):
            panel.grid(alpha=0.3)
            for name in more + own[title]:
                _curve(panel, data, environment, name, column)
        top.set_title(title)
        strip.set_xlabel("steps of every world")
        top.set_yscale("symlog", linthresh=0.1)
        top.set_ylim(bottom=0)
        top.yaxis.set_major_formatter("{x:g}")
        _strips(strip, data, environment, own[title], known, most)
    axes[0, 0].set_ylabel("crashes per 1000\ntransitions")
    axes[1, 0].set_ylabel("mean reward\nper transition")
    legend(figure, data.style, found, "below")
    return figure


def unfitted(data: Data, environment: str, method: str) -> Array | None:
    """Share of rollouts after which fear did not learn, over policies, in every stretch of the training, shape (k,).

    ``None`` where that was not recorded, or for a method without a fear network.
    """
    curves = data.curves(environment, method, "fear_fitted")
    length = min(map(len, curves), default=0)
    return 1.0 - np.mean([curve[:length] for curve in curves], axis=0) if length else None


def _strips(axes: "Axes", data: Data, environment: str, names: Sequence[str], known: bool, rows: int) -> None:
    """A strip for each method with a fear network, dark where the networks of its policies did not learn.

    ``known`` says whether that was recorded for any method; there is room for ``rows`` strips, as in the other panels.
    """
    found = {name: shares for name in names if (shares := unfitted(data, environment, name)) is not None}
    if not found:
        instead(axes, "no fear network here" if known else "where fear did not learn:\nnot recorded")
        return
    for row, (name, shares) in enumerate(found.items()):
        steps = data.curves(environment, name, "env_steps")[0][: len(shares)]
        edges = np.concatenate([[0.0], steps])
        axes.pcolormesh(edges, [row - 0.4, row + 0.4], shares[None], cmap="Greys", vmin=0, vmax=1.2, rasterized=True)
        axes.text(1.01, row, name, transform=axes.get_yaxis_transform(), va="center", fontsize=6.5)
    axes.set_ylim(rows - 0.4, -0.6)
    axes.set_yticks([])
    axes.set_ylabel("fear did\nnot learn")


def _curve(axes: "Axes", data: Data, environment: str, name: str, column: str) -> None:
    """Median over seeds with quartiles, smoothed by a rolling mean."""
    curves, steps = data.curves(environment, name, column), data.curves(environment, name, "env_steps")
    length = min(map(len, curves))
    window = max(1, round(WINDOW * length))
    low, middle, high = np.quantile([rolling(curve[:length], window) for curve in curves], [0.25, 0.5, 0.75], axis=0)
    line(axes, data.style, name, steps[0][:length], middle, (low, high), every=max(1, length // 8), alpha=0.18)


def line(
    axes: "Axes", style: Style, name: str, x: Array, y: Array, band: Sequence[Array],
    *, every: int, alpha: float, step: Literal["post"] | None = None,
) -> None:  # fmt: skip
    """A method's line with its band of opacity ``alpha``, and a marker every ``every`` points."""
    axes.plot(
        x, y, drawstyle=step and f"steps-{step}", color=style.colours[name], linewidth=1.3, label=name,
        marker=style.marker(name), markersize=3.6, markevery=every, markeredgecolor="black", markeredgewidth=0.4,
    )  # fmt: skip
    low, high = band
    axes.fill_between(x, low, high, step=step, color=style.colours[name], alpha=alpha, linewidth=0)


def legend(
    figure: "Figure", style: Style, methods: Mapping[str, Any] | Sequence[str], place: Literal["beside", "below"]
) -> None:
    """A legend of the methods, outside the axes; ``beside`` them, it makes the figure at least as high as itself."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], linestyle="", marker=style.marker(name), markersize=5, color=style.colours[name],
               markeredgecolor="black", markeredgewidth=0.4, label=name)
        for name in methods
    ]  # fmt: skip
    widest = 0.45 + 0.055 * max(map(len, methods), default=0)  # [inch]: of a handle, and of each letter
    columns = max(1, int(WIDTH / widest))
    where: dict[str, Any] = {"loc": "outside lower center", "ncols": columns}
    if place == "beside":
        where = {"loc": "outside right center"}
        figure.set_figheight(max(figure.get_figheight(), ROW * (len(handles) + 2)))
    figure.legend(handles=handles, frameon=False, **where)


def rolling(x: Array, window: int) -> Array:
    """Mean of the last ``window`` values; of fewer at the start."""
    return np.convolve(x, np.ones(window))[: len(x)] / np.minimum(np.arange(1, len(x) + 1), window)
