"""The figures of a run."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

from deimos.goals.calibration import reliability
from deimos.run.folder import RunError, RunFolder

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
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = folder.read_csv("progress.csv")
    figure, axes = plt.subplots(2, 2, figsize=(9, 6), layout="constrained")
    _curve(axes[0, 0], rows, "reward", "mean reward per transition", BLUE)
    _curve(axes[0, 1], rows, "crashes_per_1000", "crashes per 1000 transitions", ORANGE)
    if rows and "fear/auroc" in rows[0]:
        _curve(axes[1, 0], rows, "fear/auroc", "AUROC of fear at issue", BLUE)
        axes[1, 0].axhline(0.5, color="grey", linewidth=0.8, linestyle=":")
        axes[1, 0].set_ylim(0.3, 1.02)
    else:
        _curve(axes[1, 0], rows, "explained_variance", "explained variance of the values", BLUE)
    _bars(axes[1, 1], evaluated)
    figure.suptitle(title)
    return _save(figure, folder.path / "summary.png")


def draw_calibration(folder: RunFolder, judged: "dict[str, tuple[Tensor, Tensor]]") -> Path:
    """Draw ``calibration.png``: predicted against observed crash rates, with the predictions' histogram below.

    Args:
        folder: The run.
        judged: By kind of goals: probabilities, shape (n,), and what became of them, bool, shape (n,).

    Raises:
        RunError: If it cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from scipy.stats import binomtest

    figure, (curves, histogram) = plt.subplots(
        2, 1, figsize=(6, 7), height_ratios=[3, 1], sharex=True, layout="constrained"
    )
    curves.plot([0, 1], [0, 1], color="grey", linewidth=0.8, linestyle=":")
    for (name, (probability, crashed)), colour, marker in zip(judged.items(), (ORANGE, BLUE), "so", strict=False):
        bins = reliability(probability, crashed)
        crashes = (bins.observed * bins.count).round().long().tolist()
        spans = [
            binomtest(k, n).proportion_ci(method="wilson") for k, n in zip(crashes, bins.count.tolist(), strict=True)
        ]
        error = [
            [max(0.0, y - span.low) for y, span in zip(bins.observed.tolist(), spans, strict=True)],
            [max(0.0, span.high - y) for y, span in zip(bins.observed.tolist(), spans, strict=True)],
        ]
        curves.errorbar(
            bins.predicted.tolist(), bins.observed.tolist(), error, color=colour, marker=marker, markersize=4,
            linewidth=1.2, capsize=2, label=f"{name} goals, {len(probability)} interactions",
        )  # fmt: skip
        histogram.hist(probability.tolist(), bins=40, range=(0, 1), color=colour, histtype="step", linewidth=1.4)
    curves.set_ylabel("observed crash rate, 95 % interval")
    curves.legend(frameon=False)
    histogram.set_yscale("log")
    histogram.set_ylabel("interactions")
    histogram.set_xlabel("predicted probability of a crash")
    return _save(figure, folder.path / "calibration.png")


def _save(figure: "Figure", path: Path) -> Path:
    import matplotlib.pyplot as plt

    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise RunError(f"{path} could not be written ({error.strerror}).") from error
    finally:
        plt.close(figure)
    return path


def _curve(axes: "Axes", rows: list[dict[str, str]], column: str, label: str, colour: str) -> None:
    points = [(int(row["env_steps"]), float(row[column])) for row in rows if row[column]]
    axes.plot([x for x, _ in points], [y for _, y in points], color=colour, linewidth=1.4)
    axes.set_xlabel("parallel steps")
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)


def _bars(axes: "Axes", evaluated: list[dict]) -> None:
    """Crashes per 1000 transitions of one evaluation, with the score written above."""
    axes.set_ylabel("crashes per 1000 transitions")
    if not evaluated:
        axes.text(0.5, 0.5, "not evaluated", ha="center", va="center", transform=axes.transAxes, color="grey")
        axes.set_axis_off()
        return
    bars = axes.bar(
        [row["goals"].capitalize() for row in evaluated], [row["crashes_per_1000"] for row in evaluated],
        color=[BLUE, ORANGE, GREEN][: len(evaluated)], width=0.5,
    )  # fmt: skip
    notes = [f"{row['crashes_per_1000']:.3g}" + _score_note(row) for row in evaluated]
    axes.bar_label(bars, notes, padding=3)
    axes.margins(y=0.25)
    axes.set_title(
        f"T = {evaluated[0]['goal_period']}, {evaluated[0]['worlds']} worlds x {evaluated[0]['steps']} steps", size=9
    )


def _score_note(row: dict) -> str:
    """Empty where the environment has no reference policy: NaN as it is evaluated, None as it is read from a file."""
    score = row["score"]
    return "" if score is None or math.isnan(score) else f"\nscore {score:.2f}"
