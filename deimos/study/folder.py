"""A study's folder: ``cells/NAME/`` for every cell, and the tables of an export or a merge.

A cell's folder holds ``cell.json`` (what it is), ``run/`` (its run folder), ``result.json`` once it is finished,
``log.txt`` (what its workers said) and ``failures.jsonl`` (how they died).
"""

import json
import time
from collections.abc import Iterable
from contextlib import AbstractContextManager
from pathlib import Path

from deimos.checks import RunError
from deimos.run.folder import RunFolder
from deimos.study.lock import hold
from deimos.study.plan import Cell, read_cell
from deimos.study.results import Results


class StudyFolder:
    """See the module's docstring. Whatever reads it raises ``RunError`` if a file is broken or of another schema."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def results(self) -> Results:
        """The results that there are."""
        return Results.read(self.path)

    def hold(self) -> AbstractContextManager[None]:
        """Hold the study as the only process that works on it; ``RunError`` if another does, or machine may."""
        return hold(self.path / "lock", str(self.path), one_machine=True)

    def cell_path(self, cell: Cell) -> Path:
        """Folder of a cell."""
        return self.path / "cells" / cell.name

    def add(self, cells: Iterable[Cell]) -> None:
        """Add cells to the study; those that are there already stay as they are."""
        for cell in cells:
            path = self.cell_path(cell)
            if not (path / "cell.json").exists():
                path.mkdir(parents=True, exist_ok=True)
                RunFolder(path).write_json("cell.json", cell.to_dict())

    def cells(self) -> list[Cell]:
        """All cells, seed by seed; see ``cell``."""
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
                f"{path} was made by another version of Deimos, whose defaults or methods differ; continue with that "
                f"version, or begin a new study."
            )
        return cell

    def finished(self, cells: Iterable[Cell]) -> set[str]:
        """Digests of those of ``cells`` that have results, in their folders or in the study's tables."""
        there = {cell.digest for cell in cells if (self.cell_path(cell) / "result.json").exists()}
        others = {cell.digest for cell in cells} - there
        return there | (others & {row["hash"] for row in self.results().rows} if others else set())

    def failures(self, cell: Cell) -> list[str]:
        """How a cell's workers have died so far, one line each."""
        path = self.cell_path(cell) / "failures.jsonl"
        lines = path.read_text().splitlines() if path.exists() else []
        return [json.loads(line)["error"] for line in lines if line.endswith("}")]

    def record_failure(self, cell: Cell, error: str) -> None:
        """Write down how a worker died."""
        line = {"time": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "error": error}
        with (self.cell_path(cell) / "failures.jsonl").open("a") as file:
            file.write(json.dumps(line) + "\n")

    def forget_failures(self) -> None:
        """Let every failed cell be tried again."""
        for path in self.path.glob("cells/*/failures.jsonl"):
            path.unlink(missing_ok=True)
