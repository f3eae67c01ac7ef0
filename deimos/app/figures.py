"""The figures of a run."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deimos.files import write_whole
from deimos.goals.calibration import reliability
from deimos.run.folder import RunFolder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from torch import Tensor

BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"  # of Okabe and Ito's palette, told apart by the colour-blind


def draw_summary(folder: RunFolder, title: str, evaluated: list[dict]) -> Path:
    """Draw ``summary.png``: reward, crashes and fear AUROC over training, and Naive beside Adversary.

    Args:
        folder: The run.
        title: Above it all.
        evaluated: The rows of one evaluation, or none.

    Raises:
        RunError: If it cannot be written.
    """
    from matplotlib.figure import Figure

    rows = folder.read_csv("progress.csv")
    figure = Figure(figsize=(9, 6), layout="constrained")
    (reward, crashes), (quality, bars) = figure.subplots(2, 2)
    _curve(reward, rows, "reward", "mean reward per transition", BLUE)
    _curve(crashes, rows, "crashes_per_1000", "crashes per 1000 transitions", ORANGE)
    if rows and "fear/auroc" in rows[0]:
        _curve(quality, rows, "fear/auroc", "AUROC of fear when the goal was issued", BLUE)
        quality.axhline(0.5, color="grey", linewidth=0.8, linestyle=":")
        quality.set_ylim(0.3, 1.02)
    else:
        _curve(quality, rows, "explained_variance", "explained variance of the values", BLUE)
    _bars(bars, evaluated)
    figure.suptitle(title)
    return _save(figure, folder.path / "summary.png")


def wilson(share: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the 95 % intervals of proportions, by Wilson's score (1927), each of the arguments' shape."""
    z = 1.959964  # of the normal distribution, two-sided
    middle, spread = share + z * z / (2 * count), z * np.sqrt(share * (1 - share) / count + (z / (2 * count)) ** 2)
    return (middle - spread) / (1 + z * z / count), (middle + spread) / (1 + z * z / count)


def draw_calibration(folder: RunFolder, audited: "dict[str, tuple[Tensor, Tensor]]") -> Path:
    """Draw ``calibration.png``: predicted against observed crash rates, with the predictions' histogram below.

    Args:
        folder: The run.
        audited: By kind of goals: probabilities, shape (n,), and whether the goal ended in a crash, bool, shape (n,).

    Raises:
        RunError: If it cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 7), layout="constrained")
    curves, histogram = figure.subplots(2, 1, height_ratios=[3, 1], sharex=True)
    curves.plot([0, 1], [0, 1], color="grey", linewidth=0.8, linestyle=":")
    for (name, (probability, crashed)), colour, marker in zip(audited.items(), (ORANGE, BLUE), "so", strict=False):
        bins = reliability(probability, crashed)
        low, high = wilson(bins.observed.numpy(), bins.count.numpy())
        observed = bins.observed.numpy()
        curves.errorbar(
            bins.predicted.numpy(), observed, np.clip([observed - low, high - observed], 0.0, None), color=colour,
            marker=marker, markersize=4, linewidth=1.2, capsize=2,
            label=f"{name} goals, {len(probability)} interactions",
        )  # fmt: skip
        histogram.hist(probability.tolist(), bins=40, range=(0, 1), color=colour, histtype="step", linewidth=1.4)
    curves.set_ylabel("observed crash rate, 95 % interval")
    curves.legend(frameon=False)
    histogram.set_yscale("log")
    histogram.set_ylabel("interactions")
    histogram.set_xlabel("predicted probability of a crash")
    return _save(figure, folder.path / "calibration.png")


def _save(figure: "Figure", path: Path) -> Path:
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=120))
    return path


def _curve(axes: "Axes", rows: list[dict[str, str]], column: str, label: str, colour: str) -> None:
    points = [(int(row["env_steps"]), float(row[column])) for row in rows if row[column]]
    axes.plot([x for x, _ in points], [y for _, y in points], color=colour, linewidth=1.4)
    axes.set_xlabel("parallel steps")
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)


def _bars(axes: "Axes", evaluated: list[dict]) -> None:
    """Crashes per 1000 transitions of one evaluation, with the score written above where there is one."""
    axes.set_ylabel("crashes per 1000 transitions")
    if not evaluated:
        axes.text(0.5, 0.5, "not evaluated", ha="center", va="center", transform=axes.transAxes, color="grey")
        axes.set_axis_off()
        return
    names, heights = zip(*[(row["goals"].capitalize(), row["crashes_per_1000"]) for row in evaluated], strict=True)
    bars = axes.bar(names, heights, color=[BLUE, ORANGE, GREEN][: len(names)], width=0.5)
    # Without a reference policy the score is NaN as it is evaluated, and None as it is read from a file.
    scores = [math.nan if row["score"] is None else row["score"] for row in evaluated]
    notes = ["" if math.isnan(score) else f"\nscore {score:.2f}" for score in scores]
    axes.bar_label(bars, [f"{height:.3g}{note}" for height, note in zip(heights, notes, strict=True)], padding=3)
    axes.margins(y=0.25)
    shape = "T = {goal_period}, {worlds} worlds x {steps} steps".format_map(evaluated[0])
    axes.set_title(shape, size=9)
