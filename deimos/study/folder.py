"""A study's folder: ``cells/NAME/`` for every cell, ``results.csv`` and ``curves.csv``.

A cell's folder holds ``cell.json`` (what it is), ``run/`` (its run folder), ``log.txt`` (what the worker
said), ``failures.jsonl`` (how it died) and its claims. Whether a cell is finished is what the table says.
"""

import contextlib
import json
import time
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

from deimos.run.folder import RunError, RunFolder
from deimos.study.plan import Cell, read_cell
from deimos.study.results import GrowingTable, curves, results

ATTEMPTS = 2  # a cell that failed so often is left alone


class StudyFolder:
    """See the module's docstring."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def results(self) -> GrowingTable:
        """One row per policy and evaluation."""
        return results(self.path)

    @property
    def curves(self) -> GrowingTable:
        """One row per training run."""
        return curves(self.path)

    def cell_path(self, cell: Cell) -> Path:
        """Folder of a cell."""
        return self.path / "cells" / cell.name

    def add(self, cells: Iterable[Cell]) -> None:
        """Add cells to the study; those that are there already stay as they are.

        Raises:
            RunError: If they cannot be written.
        """
        for cell in cells:
            path = self.cell_path(cell)
            if (path / "cell.json").exists():
                continue
            try:
                path.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise RunError(f"The study's folder {path} cannot be made ({error.strerror}).") from error
            RunFolder(path).write_json("cell.json", cell.to_dict())

    def cells(self) -> list[Cell]:
        """All cells, seed by seed.

        Raises:
            RunError: If one cannot be read, or is not what it was when it was made.
        """
        found = [self.cell(path.parent.name) for path in sorted(self.path.glob("cells/*/cell.json"))]
        return sorted(found, key=lambda cell: cell.config.seed)

    def cell(self, name: str) -> Cell:
        """The cell of a name.

        Raises:
            RunError: If it cannot be read, or if the same configuration is another cell today, because a default
                or what a method stands for has changed since.
        """
        path = self.path / "cells" / name / "cell.json"
        cell = read_cell(path)
        if cell.name != name:
            raise RunError(
                f"{path} was made by another version of Deimos, whose defaults or methods differ; go on with that "
                f"version, or begin a new study."
            )
        return cell

    def finished(self, cells: Iterable[Cell]) -> set[str]:
        """Digests of those of ``cells`` whose rows are all in the table."""
        rows: dict[str, set[tuple[str, int]]] = {}
        for row in self.results.read():
            rows.setdefault(row["hash"], set()).add((row["goals"], row["goal_period"]))
        return {cell.digest for cell in cells if evaluations(cell) <= rows.get(cell.digest, set())}

    def failures(self, cell: Cell) -> list[str]:
        """How a cell's workers have died so far, one line each."""
        try:
            lines = (self.cell_path(cell) / "failures.jsonl").read_text().splitlines()
        except FileNotFoundError:
            return []
        return [json.loads(line)["error"] for line in lines if line.endswith("}")]

    def record_failure(self, cell: Cell, error: str) -> None:
        """Write down how a worker died."""
        line = {"time": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "error": error}
        with (self.cell_path(cell) / "failures.jsonl").open("a") as file:
            file.write(json.dumps(line) + "\n")

    def forget_failures(self) -> None:
        """Let every failed cell be tried again."""
        for path in self.path.glob("cells/*/failures.jsonl"):
            with contextlib.suppress(FileNotFoundError):
                path.unlink()


def evaluations(cell: Cell) -> set[tuple[str, int]]:
    """Goals and T of the rows that a cell leaves in the table."""
    goals = ["naive", "adversary"] + (["oracle"] if cell.config.eval.oracle_worlds else [])
    return {(name, period) for name in goals for period in cell.goal_periods}


def result_rows(cell: Cell, run: RunFolder, evaluated: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of the table of evaluations that a finished run gives.

    Args:
        cell: The cell.
        run: Its run.
        evaluated: The rows of its evaluations.
    """
    stored = run.read_json("config.json")
    config = stored["config"]
    versions = stored["versions"]
    names = ("deimos", "commit", "python", "torch", "warp-lang", "numpy")
    shared = identity(cell) | {
        "env_steps": config["env_steps"],
        "trained_period": cell.config.env.goal_period,
        "fps": _median([float(row["fps"]) for row in run.read_csv("timing.csv")]),
        "device": config["device"],
        "versions": " ".join(f"{name}={versions[name]}" for name in names),
    }
    rows = [shared | row | {"eval_seed": row["seed"], "seed": cell.config.seed} for row in evaluated]
    # Where a goal is all of a piece, its tracking is the reward.
    return [row if len(row["tracking"]) > 1 else row | {"tracking": ()} for row in rows]


def curve_row(cell: Cell, run: RunFolder, points: int = 100) -> dict[str, Any]:
    """The row of the table of training curves: means over as many stretches of the training as ``points``, or fewer."""
    rows = run.read_csv("progress.csv")
    count = min(points, len(rows))
    bounds = [len(rows) * i // count for i in range(count + 1)]
    stretches = [rows[low:high] for low, high in pairwise(bounds)]
    means = {
        name: tuple(sum(float(row[name]) for row in stretch) / len(stretch) for stretch in stretches)
        for name in ("reward", "crashes_per_1000", "selected_share")
    }
    return identity(cell) | {"env_steps": tuple(float(stretch[-1]["env_steps"]) for stretch in stretches)} | means


def identity(cell: Cell) -> dict[str, Any]:
    """What a cell's rows in both tables begin with."""
    return {
        "environment": cell.environment, "method": cell.config.label, "seed": cell.config.seed,
        "hash": cell.digest, "setting": cell.setting, "selector": cell.selector, "num_envs": cell.config.num_envs,
    }  # fmt: skip


def _median(values: list[float]) -> float:
    middle = len(values) // 2
    values = sorted(values)
    return values[middle] if len(values) % 2 else (values[middle - 1] + values[middle]) / 2
