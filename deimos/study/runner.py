"""Has an engine work on the open cells of a study, several at a time, and follows them by their files."""

import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field

from deimos.checks import RunError
from deimos.run.evaluation import read_evaluation
from deimos.run.folder import RunFolder
from deimos.study.engine import Engine
from deimos.study.folder import StudyFolder
from deimos.study.plan import Cell

ATTEMPTS = 2  # a cell that has failed so often is given up
POLL_SECONDS = 0.5
TAIL_BYTES = 400


@dataclass(frozen=True)
class Progress:
    """How far a study is."""

    total: int
    """Cells."""
    finished: int
    """Cells that have results."""
    failed: dict[str, str]
    """Cells that are given up, with how the last attempt ended."""
    running: dict[str, tuple[float, float]]
    """Cells that are being worked on, with the shares of training and of evaluation that are done."""
    share: float
    """Share of the study that is done, in [0, 1]; cells count alike."""
    seconds_left: float | None
    """Estimate from what was done so far [s]; ``None`` at the start."""


@dataclass
class Runner:
    """Works on the open cells of a study until none is left.

    A cell whose work fails is tried once more; then it is recorded as failed, and the rest go on.
    """

    study: StudyFolder
    """The study."""
    engine: Engine
    """What works on its cells."""
    workers: int
    """Cells at a time, at least 1."""
    seconds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """What training and everything else of a cell are expected to take [s]; by default the same for both."""
    _before: dict[str, tuple[float, float]] = field(default_factory=dict)  # shares of open cells that were done before
    _begun: set[str] = field(default_factory=set)  # cells begun here
    _active: set[str] = field(default_factory=set)
    _finished: set[str] = field(default_factory=set)  # digests
    _failed: dict[str, str] = field(default_factory=dict)
    _stopping: bool = False
    _killed: bool = False

    def run(self, report: Callable[[Progress], None], stopped: Callable[[], bool]) -> Progress:
        """Work until every cell is finished or given up, or until ``stopped()``; returns how far the study is then.

        Args:
            report: Called a few times per second.
            stopped: Called as often; true lets the running cells write their checkpoints and end.

        Raises:
            RunError: If another process works on the study.
        """
        with self.study.hold(), ThreadPoolExecutor(self.workers) as pool:
            cells = self.study.cells()
            self._finished = self.study.finished(cells)
            self._before = {cell.name: self._shares(cell) for cell in cells if cell.digest not in self._finished}
            begin = time.monotonic()
            jobs = [pool.submit(self._work, cell) for cell in cells if cell.digest not in self._finished]
            try:
                waiting = True
                while waiting:
                    waiting = bool(wait(jobs, POLL_SECONDS).not_done)
                    progress = self._progress(cells, time.monotonic() - begin)
                    report(progress)
                    if stopped() and not self._stopping:
                        self._stopping = True
                        self.engine.stop()
                for job in jobs:
                    job.result()  # raises what was raised there
                return progress
            finally:  # something is left here only after an error or a second Ctrl-C
                self._stopping = self._killed = True
                self.engine.kill()

    def _work(self, cell: Cell) -> None:
        """Have a cell worked on until it is finished or given up."""
        errors = self.study.failures(cell)
        while not self._stopping and len(errors) < ATTEMPTS:
            self._begun.add(cell.name)
            self._active.add(cell.name)
            error = self.engine.run(cell)
            self._active.discard(cell.name)
            if error is None and self.study.finished([cell]):
                self._finished.add(cell.digest)
                return
            if error is None and not self._stopping:
                time.sleep(2 * POLL_SECONDS)  # a signal to all processes may reach a worker before this one
            if self._killed or (error is None and self._stopping):
                return
            errors.append(error or "it ended without results")
            self.study.record_failure(cell, errors[-1])
        if len(errors) >= ATTEMPTS:
            self._failed[cell.name] = errors[-1]

    def _shares(self, cell: Cell) -> tuple[float, float]:
        """Shares done of a cell's training, by the end of its ``timing.csv``, and of its rows of evaluations."""
        run = self.study.cell_path(cell) / "run"
        rows = len(cell.goal_periods) * len({"naive", *cell.config.eval.attackers, *self.study.added(cell)})
        try:
            with (run / "timing.csv").open("rb") as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL_BYTES))
                trained = int(file.read().decode().split("\n")[-2].split(",")[0])  # of the last whole line
        except (OSError, IndexError, ValueError):
            trained = 0  # no line is whole yet
        try:
            evaluated = len(read_evaluation(RunFolder(run)))
        except RunError:
            evaluated = 0  # its worker reports what is wrong
        return min(1.0, trained / cell.config.iterations), min(1.0, evaluated / rows)

    def _progress(self, cells: list[Cell], seconds: float) -> Progress:
        running: dict[str, tuple[float, float]] = {}
        done = left = 0.0  # expected seconds
        counted = 0.0  # cells
        for cell in cells:
            takes = self.seconds.get(cell.name, (1.0, 1.0))
            now = before = self._before.get(cell.name, (1.0, 1.0))
            if cell.digest in self._finished or cell.name in self._failed:
                now = 1.0, 1.0
            elif cell.name in self._begun:
                now = self._shares(cell)
            if cell.name not in self._failed:
                done += sum(max(0.0, x - x0) * of for x, x0, of in zip(now, before, takes, strict=True))
            left += sum((1.0 - x) * of for x, of in zip(now, takes, strict=True))
            counted += sum(x * of for x, of in zip(now, takes, strict=True)) / sum(takes)
            if cell.name in self._active:
                running[cell.name] = now
        return Progress(
            total=len(cells), finished=len(self._finished), failed=dict(self._failed), running=running,
            share=counted / len(cells), seconds_left=left * seconds / done if done else None,
        )  # fmt: skip
