"""Has an engine work on the open cells of a study, several at a time, and follows them by their files."""

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field

from deimos.study.engine import Engine
from deimos.study.folder import StudyFolder
from deimos.study.plan import Cell

ATTEMPTS = 2  # a cell that has failed so often is given up
POLL_SECONDS = 0.5
TAIL_BYTES = 400


@dataclass(frozen=True)
class Progress:
    """Where a study stands."""

    total: int
    """Cells."""
    finished: int
    """Cells that have results."""
    failed: dict[str, str]
    """Cells that are given up, with how the last attempt ended."""
    running: dict[str, float]
    """Cells that are being worked on, with the share of their training that is done."""
    seconds_left: float | None
    """Estimate from what was done so far [s]; ``None`` before anything was."""


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
    _begun: dict[str, int] = field(default_factory=dict)  # cells begun here, with iterations that were done before
    _active: set[str] = field(default_factory=set)
    _finished: set[str] = field(default_factory=set)  # digests
    _failed: dict[str, str] = field(default_factory=dict)
    _stopping: bool = False
    _killed: bool = False

    def run(self, report: Callable[[Progress], None], stopped: Callable[[], bool]) -> Progress:
        """Work until every cell is finished or given up, or until ``stopped()``; returns where the study stands then.

        Args:
            report: Called a few times per second.
            stopped: Asked as often; true lets the running cells write their checkpoints and end.

        Raises:
            RunError: If another process works on the study.
        """
        with self.study.hold(), ThreadPoolExecutor(self.workers) as pool:
            cells = self.study.cells()
            self._finished = self.study.finished(cells)
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
            finally:  # nothing is left here but after an error or a second Ctrl-C
                self._stopping = self._killed = True
                self.engine.kill()

    def _work(self, cell: Cell) -> None:
        """Have a cell worked on until it is finished or given up."""
        errors = self.study.failures(cell)
        while not self._stopping and len(errors) < ATTEMPTS:
            self._begun.setdefault(cell.name, self._iterations(cell))
            self._active.add(cell.name)
            error = self.engine.run(cell)
            self._active.discard(cell.name)
            if error is None and self.study.finished([cell]):
                self._finished.add(cell.digest)
                return
            if self._killed or (error is None and self._stopping):
                return
            errors.append(error or "it ended without results")
            self.study.record_failure(cell, errors[-1])
        if len(errors) >= ATTEMPTS:
            self._failed[cell.name] = errors[-1]

    def _iterations(self, cell: Cell) -> int:
        """How many iterations of a cell's training are done, by the end of its ``timing.csv``."""
        try:
            with (self.study.cell_path(cell) / "run" / "timing.csv").open("rb") as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL_BYTES))
                return int(file.read().decode().split("\n")[-2].split(",")[0])  # of the last whole line
        except (OSError, IndexError, ValueError):
            return 0  # none is whole yet

    def _progress(self, cells: list[Cell], seconds: float) -> Progress:
        running: dict[str, float] = {}
        done = left = 0  # transitions
        for cell in cells:
            iterations = self._iterations(cell) if cell.name in self._begun else 0
            size = cell.config.ppo.num_steps * cell.config.num_envs
            done += size * max(0, iterations - self._begun.get(cell.name, iterations))
            if cell.digest not in self._finished and cell.name not in self._failed:
                left += size * (cell.config.iterations - iterations)
            if cell.name in self._active:
                running[cell.name] = iterations / cell.config.iterations
        return Progress(
            total=len(cells), finished=len(self._finished), failed=dict(self._failed), running=running,
            seconds_left=left * seconds / done if done else None,
        )  # fmt: skip
