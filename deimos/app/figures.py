"""The figures of a run."""

from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deimos.app.console import number
from deimos.app.findings import conditions, heading, percent, wilson
from deimos.files import write_whole
from deimos.goals.calibration import reliability
from deimos.run.evaluation import SETTINGS, read_evaluation
from deimos.run.folder import RunFolder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from torch import Tensor

BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"  # of Okabe and Ito's palette, distinct for the colour-blind
ATTACKED = (ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9", "#F0E442")
VALUES = ("explained_variance", "critic: explained variance\nof the values", BLUE)
FEAR = ("fear/auroc", "fear network: how well it ranked\nthe goals' crashes (AUROC)", BLUE)
CURVES = (
    ("reward", "reward per step", BLUE),
    ("crashes_per_1000", "crashes per 1000 steps", ORANGE),
    VALUES,
    FEAR,
)
"""Columns of ``progress.csv`` that are drawn, what they are called, and their colours."""
MARKED = 3  # points; a line through fewer is hard to see
BAR = 0.42  # largest width of a bar with the gap next to it; evaluations are 1 apart
MOST_EVALUATIONS = 4
EVALUATION = "evaluation"


def draw_summary(folder: RunFolder, title: str, weights: str) -> None:
    """Draw ``summary.png``: reward, crashes and the learners' quality over training, and what the evaluations found.

    There is no panel for numbers that the folder does not have, and no picture if it has none at all.

    Args:
        folder: The run.
        title: Above it all.
        weights: ``weights_hash`` of the policy as it is now. Evaluations from before further training are left out.

    Raises:
        RunError: If it cannot be written.
    """
    from matplotlib.figure import Figure

    rows = folder.read_csv("progress.csv")
    evaluated = [row for row in read_evaluation(folder) if row["weights"] == weights]
    curves = [curve for curve in CURVES if any(row.get(curve[0]) for row in rows)]
    if curves[-1:] == [FEAR]:
        curves.remove(VALUES)
    panels = [curve[0] for curve in curves]
    places = [*([panels] if panels else []), *([[EVALUATION] * max(1, len(panels))] if evaluated else [])]
    if not places:
        return
    figure = Figure(figsize=(11, 3.3 * len(places) + 0.3), layout="constrained")
    axes: dict[str, Axes] = figure.subplot_mosaic(places)  # type: ignore[arg-type]
    for column, label, colour in curves:
        _curve(axes[column], rows, column, label, colour)
    if evaluated:
        _bars(axes[EVALUATION], evaluated)
    figure.suptitle(title)
    _save(figure, folder.path / "summary.png")


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
    curves.plot([0, 1], [0, 1], color="grey", linewidth=0.8, linestyle=":", label="calibrated")
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


def draw_tradeoff(folder: RunFolder, found: dict) -> Path:
    """Draw ``shield.png``: crashes over refused goals, for several thresholds of a shield and of the baselines.

    Args:
        folder: The run.
        found: What ``deimos.run.shield.shield_run`` gives.

    Raises:
        RunError: If it cannot be written.
    """
    from matplotlib.figure import Figure

    unshielded = {row["goals"]: row for row in found["trials"] if row["shield"] == "no shield"}
    names = list(dict.fromkeys(row["goals"] for row in found["tradeoff"])) or ["naive"]
    figure = Figure(figsize=(5.5 * len(names), 4.4), layout="constrained")
    for axes, goals in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        rows = [row for row in found["tradeoff"] if row["goals"] == goals]
        axes.axhline(100 * unshielded[goals]["crash_rate"], color="grey", linestyle=":", label="no shield")
        shields = dict.fromkeys(row["shield"] for row in rows)
        for shield, colour, marker in zip(shields, (BLUE, *ATTACKED), "os^", strict=False):
            own = [row for row in rows if row["shield"] == shield]
            # How many of the uniform goals a user would lose, also where an attacker chooses.
            cost = [
                100 * row["refused"] for row in found["tradeoff"] if (row["shield"], row["goals"]) == (shield, "naive")
            ]
            axes.plot(
                cost, [100 * row["crash_rate"] for row in own], color=colour, marker=marker, markersize=4, label=shield
            )
            if shield == "shield":
                for x, row in zip(cost, own, strict=True):
                    axes.annotate(
                        f"{row['alpha']:g}",
                        (x, 100 * row["crash_rate"]),
                        (3, 4),
                        textcoords="offset points",
                        fontsize=8,
                    )
        axes.set_title(" ".join(heading(goals)))
        axes.set_xlabel("uniform goals refused [%]")
        axes.set_ylabel("goals that ended in a crash [%]")
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return _save(figure, folder.path / "shield.png")


def _save(figure: "Figure", path: Path) -> Path:
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=120))
    return path


def _curve(axes: "Axes", rows: list[dict[str, str]], column: str, label: str, colour: str) -> None:
    points = [(int(row["env_steps"]), float(row[column])) for row in rows if row[column]]
    axes.plot(*zip(*points, strict=True), color=colour, linewidth=1.4, marker="o" if len(points) < MARKED else None)
    axes.set_xlabel("training: steps of every world")
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)
    if column == FEAR[0]:
        axes.axhline(0.5, color="grey", linewidth=0.8, linestyle=":", label="chance")
        axes.set_ylim(0.0, 1.02)
        axes.legend(frameon=False, loc="lower right")


def _bars(axes: "Axes", rows: list[dict]) -> None:
    """Shares of goals that ended in a crash, with the score where there is one: large evaluations first."""
    groups: dict[tuple, list[dict]] = {}
    for row in sorted(rows, key=lambda row: -row["worlds"] * row["steps"]):
        alike = tuple(row.get(name) for name in ("worlds", "steps", "goal_period", "seed", *SETTINGS))
        groups.setdefault(alike, []).append(row)
    shown = list(groups.values())[:MOST_EVALUATIONS]
    width = min(BAR, 0.9 / max(map(len, shown)))
    attackers = dict.fromkeys(row["goals"] for group in shown for row in group if row["goals"] != "naive")
    colours = {"naive": BLUE} | dict(zip(attackers, cycle(ATTACKED), strict=False))
    for place, group in enumerate(shown):
        for i, row in enumerate(group):
            known = row["crash_rate"] is not None
            bar = axes.bar(
                place + (i - (len(group) - 1) / 2) * width, 100 * row["crash_rate"] if known else 0.0, 0.9 * width,
                color=colours[row["goals"]], label=" ".join(heading(row["goals"])),
            )  # fmt: skip
            # Without a reference policy there is no score.
            score = "" if row["score"] is None else f"\nscore {number(row['score'], 2)}"
            axes.bar_label(bar, [percent(row["crash_rate"]) + score], padding=2, fontsize=9)
    labels = [conditions(group[0]).replace(", ", ",\n") for group in shown]
    axes.set_xticks(range(len(shown)), labels, fontsize=9)
    axes.set_xlim(-0.7, len(shown) - 0.3)
    axes.set_ylabel("evaluation: goals that\nended in a crash [%]")
    axes.margins(y=0.3)
    handles, names = axes.get_legend_handles_labels()
    legend = dict(zip(names, handles, strict=True))
    axes.legend(legend.values(), legend.keys(), frameon=False, fontsize=9, loc="upper center", ncols=len(legend))
