"""The picture of docs/particle.md: safety against score, of every method and of the three that the hypotheses test.

    python -m reproduction.particle_picture FOLDER docs/images

Crashes per interaction under the worst attacker over the score relative to Uniform's; means over policies and over the
variants, Directional and Absolute, which count equally, with 95 % bootstrap intervals.
"""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deimos.study import stats
from deimos.study.data import Data, Style
from deimos.study.figures import WIDTH, print_size, subplots
from deimos.study.stats import Array, Interval
from reproduction.figures import STYLE
from reproduction.hypotheses import CHOOSING, TESTING, VARIANTS, samples
from reproduction.measures import ATTACKED, SCORE, Evidence

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAME = "particle"
BLOCKS = (("seeds 10 to 29", TESTING), ("every method: seeds 0 to 9", CHOOSING))
Point = tuple[Interval, Interval]
"""Score relative to Uniform's, and crashes per interaction [%]."""


def points(evidence: Evidence, methods: Iterable[str]) -> dict[str, Point]:
    """Positions of the methods that have policies in both variants."""
    unit = {name: values.mean() for name, values in samples(evidence, SCORE, "uniform").items()}
    found = {}
    for method in methods:
        score, rate = (samples(evidence, measure, method) for measure in (SCORE, ATTACKED))
        if unit and score and rate:
            beside = [score[name] / unit[name] for name in VARIANTS]
            found[method] = _mean(beside), _mean([100 * rate[name] for name in VARIANTS])
    return found


def _mean(populations: list[Array]) -> Interval:
    return stats.bootstrap(populations, lambda *x: np.mean([each.mean(axis=-1) for each in x], axis=0))


def draw(data: Data) -> "Figure":
    """Draw a row for each method: above, those with fresh seeds; below, all on the seeds that chose among them."""
    evidence = Evidence.of(data, renamed=False)
    names = [name for name in data.style.order if name in evidence.methods]
    blocks = [(title, points(evidence.only(seeds), names)) for title, seeds in BLOCKS]
    heights = [max(len(found), 1) + 0.6 for _, found in blocks]
    figure, axes = subplots(2, 2, (WIDTH, 1.2 + 0.165 * sum(heights)), sharex="col", height_ratios=heights)
    for panels, (title, found) in zip(axes, blocks, strict=True):
        for panel, which in zip(panels, (1, 0), strict=True):
            _rows(panel, data.style, {name: point[which] for name, point in found.items()})
        panels[0].set_title(title, loc="left")
        panels[1].tick_params(axis="y", labelleft=False)
    axes[1, 0].set_xlim(left=0)
    axes[1, 0].set_xlabel("crashes per interaction\nunder the worst attacker [%]")
    axes[1, 1].set_xlabel("score under uniform goals,\nUniform = 1")
    return figure


def _rows(axes: "Axes", style: Style, found: dict[str, Interval]) -> None:
    """Means with their intervals, relative to Uniform's."""
    for row, (name, value) in enumerate(found.items()):
        axes.plot([value.low, value.high], [row, row], color=style.colours[name], linewidth=1.4)
        axes.plot(
            value.estimate, row, marker=style.marker(name), color=style.colours[name], markersize=5,
            markeredgecolor="black", markeredgewidth=0.4,
        )  # fmt: skip
    if "uniform" in found:
        axes.axvline(found["uniform"].estimate, color="black", linewidth=0.6, linestyle=":", zorder=0)
    axes.set_yticks(range(len(found)), found)
    axes.set_ylim(len(found) - 0.4, -0.6)
    axes.grid(axis="x", alpha=0.3)


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    import matplotlib

    with print_size(), matplotlib.rc_context({"svg.hashsalt": NAME}):  # the same file from the same data
        draw(Data.read(options.folder, STYLE)).savefig(options.out / f"{NAME}.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
