"""The figure that a run ends with."""

from pathlib import Path
from typing import TYPE_CHECKING

from deimos.run_folder import RunError, RunFolder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, ORANGE = "#0072B2", "#D55E00"  # of Okabe and Ito's palette, told apart by the colour-blind


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
    path = folder.path / "summary.png"
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
        color=[BLUE, ORANGE], width=0.5,
    )  # fmt: skip
    notes = [f"{row['crashes_per_1000']:.3g}" + _score_note(row) for row in evaluated]
    axes.bar_label(bars, notes, padding=3)
    axes.margins(y=0.25)
    axes.set_title(
        f"T = {evaluated[0]['goal_period']}, {evaluated[0]['worlds']} worlds x {evaluated[0]['steps']} steps", size=9
    )


def _score_note(row: dict) -> str:
    return "" if row["score"] is None else f"\nscore {row['score']:.2f}"
