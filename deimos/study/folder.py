"""A study's folder: ``cells/NAME/`` for every cell, and the tables of an export or a merge.

A cell's folder holds ``cell.json`` (what it is), ``run/`` (its run folder), ``audits.json`` (what was measured late in
its training), ``fear.pt`` (its fear network, where it has one), ``result.json`` once it is finished, ``log.txt`` (what
its workers said) and ``failures.jsonl`` (how they died). ``attack.json`` has the attackers that were added later,
``scales.json`` the returns that make scores of 0 and 1, once for each task. ``settings/`` has the configuration of
every environment that a merge took rows of.
"""

import contextlib
import json
import math
import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

from deimos.checks import RunError, one_line
from deimos.files import first_line, open_file, read_bytes
from deimos.lock import hold
from deimos.run.config import from_dict, to_dict
from deimos.run.evaluation import Scale
from deimos.run.folder import RunFolder
from deimos.study.plan import Cell, read_cell
from deimos.study.results import Results, Row
from deimos.study.rounds import AttackRound

ATTACK, FEAR, SCALES = "attack.json", "fear.pt", "scales.json"


class StudyFolder:
    """See the module's docstring. Whatever reads it raises ``RunError`` if a file is broken or of another schema."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def results(self) -> Results:
        """The results so far."""
        return Results.read(self.path)

    def hold(self) -> AbstractContextManager[None]:
        """Hold the study as the only process that works on it; ``RunError`` if another one does, or machine may."""
        return hold(self.path / "lock", str(self.path), one_machine=True)

    def cell_path(self, cell: Cell) -> Path:
        """Folder of a cell."""
        return self.path / "cells" / cell.name

    def add(self, cells: Iterable[Cell]) -> None:
        """Add cells to the study; existing ones stay as they are."""
        for cell in cells:
            path = self.cell_path(cell)
            if not (path / "cell.json").exists():
                path.mkdir(parents=True, exist_ok=True)
                RunFolder(path).write_json("cell.json", cell.to_dict())

    def strays(self) -> list[str]:
        """Names of folders among the cells that do not say what cell they are."""
        return sorted(path.name for path in self.path.glob("cells/*") if not (path / "cell.json").exists())

    def rounds(self) -> list[AttackRound]:
        """The attackers that were added."""
        if not (self.path / ATTACK).exists():
            return []
        try:
            found = RunFolder(self.path).read_json(ATTACK)
            return [from_dict(AttackRound, each) for each in found]
        except (AttributeError, TypeError, ValueError) as error:
            raise RunError(f"{self.path / ATTACK} does not list attackers ({one_line(error)}).") from error

    def add_rounds(self, rounds: Iterable[AttackRound]) -> None:
        """Add attackers; those that were added already are not added twice."""
        known = self.rounds()
        if fresh := [each for each in dict.fromkeys(rounds) if each not in known]:
            RunFolder(self.path).write_json(ATTACK, [to_dict(each) for each in [*known, *fresh]])

    def added(self, cell: Cell) -> tuple[str, ...]:
        """The added attackers that a cell is to meet."""
        wanted = [each for each in self.rounds() if each.meets(cell)]
        return tuple(dict.fromkeys(name for each in wanted for name in each.attackers))

    def missing(self, cell: Cell, results: Results | None = None) -> dict[int, tuple[str, ...]]:
        """The added attackers that a finished cell has not met yet, by T; none where it has met all.

        ``results`` are those of the study, from a caller that asks for many cells.
        """
        if not (names := self.added(cell)):
            return {}
        left = _left(cell, names, results or Results.of_cell(self.cell_path(cell)))
        return _left(cell, names, self.results()) if left and results is None else left

    def scale(self, task: dict, compute: Callable[[], Scale]) -> Scale:
        """The scale of the score in a task: as an earlier cell found it, or computed and kept for the later ones."""
        folder = RunFolder(self.path)
        found = next((row for row in folder.read_rows(SCALES) if row.items() >= task.items()), None)
        if found is not None:
            low, high = (math.nan if found[end] is None else found[end] for end in ("low", "high"))
            return found["measure"], low, high
        scale = compute()
        row = task | dict(zip(("measure", "low", "high"), scale, strict=True))
        with folder.adding(SCALES):  # another worker may have added the same row
            folder.write_json(SCALES, [*(each for each in folder.read_rows(SCALES) if each != row), row])
        return scale

    def cells(self) -> list[Cell]:
        """All cells, seed by seed; see ``cell``."""
        found = [self.cell(path.parent.name) for path in sorted(self.path.glob("cells/*/cell.json"))]
        return sorted(found, key=lambda cell: cell.config.seed)

    def cell(self, name: str) -> Cell:
        """The cell of a name.

        If it has results, it is the cell that they belong to, so that its policy can be attacked by later versions too.

        Raises:
            RunError: If it cannot be read, or if it has no results and the same configuration is another cell today,
                because a default or what a method stands for has changed since.
        """
        path = self.path / "cells" / name / "cell.json"
        cell = read_cell(path)
        if cell.name != name and (rows := Results.of_cell(path.parent).rows):
            cell = _made_as(cell, rows[0])
        if cell.name != name:
            raise RunError(
                f"{path} was made by another version of Deimos, whose defaults or methods differ; continue with that "
                f"version, or begin a new study."
            )
        return cell

    def finished(self, cells: Iterable[Cell]) -> set[str]:
        """Digests of those of ``cells`` that have results, in their folders or in the study's tables."""
        cells = list(cells)
        there = {cell.digest for cell in cells if (self.cell_path(cell) / "result.json").exists()}
        others = {cell.digest for cell in cells} - there
        found = self.results() if others or (len(cells) > 1 and self.rounds()) else None
        if found is not None:
            there |= others & {row["hash"] for row in found.rows}
        return {cell.digest for cell in cells if cell.digest in there and not self.missing(cell, found)}

    def failures(self, cell: Cell) -> list[str]:
        """How a cell's workers have died so far, one line each."""
        path = self.cell_path(cell) / "failures.jsonl"
        found = []
        try:
            lines = read_bytes(path).splitlines() if path.exists() else []
        except OSError as error:
            raise RunError(f"{path} cannot be read ({first_line(error)}).") from error
        for line in lines:
            with contextlib.suppress(ValueError, KeyError, TypeError, RecursionError):  # a kill may leave half a line
                found.append(str(json.loads(line)["error"]))
        return found

    def record_failure(self, cell: Cell, error: str) -> None:
        """Record how a worker died; ``RunError`` with that if it cannot be written."""
        line = {"time": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "error": error}
        path = self.cell_path(cell) / "failures.jsonl"
        try:
            with open_file(path, "a") as file:
                file.write(json.dumps(line) + "\n")
        except OSError as full:
            raise RunError(
                f"{path} could not be written ({first_line(full)}); it was to say how the cell failed: {error}"
            ) from full

    def forget_failures(self) -> None:
        """Let every failed cell be tried again."""
        for path in self.path.glob("cells/*/failures.jsonl"):
            path.unlink(missing_ok=True)


def _left(cell: Cell, names: Iterable[str], results: Results) -> dict[int, tuple[str, ...]]:
    """Those of some attackers that a cell has not met according to some results, by T."""
    met = {(row["goal_period"], row["goals"]) for row in results.rows if row["hash"] == cell.digest}
    left = {period: tuple(name for name in names if (period, name) not in met) for period in cell.goal_periods}
    return {period: attackers for period, attackers in left.items() if attackers}


def _made_as(cell: Cell, row: Row) -> Cell:
    """A cell under the hashes of one of its rows, which another version, with other defaults, has given it."""
    made = replace(cell)
    columns = {"digest": "hash", "setting": "setting", "selector": "selector", "block": "block"}
    vars(made).update({name: row[column] or "" for name, column in columns.items()})  # the cached ones
    return made
