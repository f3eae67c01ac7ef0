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
class Running:
    """A cell that is being worked on."""

    name: str
    """Its name."""
    iteration: int
    """Iterations of its training that are done."""
    iterations: int
    """Iterations in all."""
    fps: float
    """Transitions per second in the last iteration; 0 before the first."""


@dataclass(frozen=True)
class Progress:
    """Where a study stands."""

    total: int
    """Cells."""
    finished: int
    """Cells that have results."""
    failed: dict[str, str]
    """Cells that are given up, with how the last attempt ended."""
    running: list[Running]
    """Cells that are being worked on."""
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
    _active: dict[str, Cell] = field(default_factory=dict)
    _begun: dict[str, int] = field(default_factory=dict)  # iterations that cells had done before they were begun here
    _finished: set[str] = field(default_factory=set)  # digests
    _failed: dict[str, str] = field(default_factory=dict)  # names, with the last error
    _stopping: bool = False
    _killed: bool = False

    def run(self, report: Callable[[Progress], None], stopped: Callable[[], bool]) -> Progress:
        """Work until every cell is finished or given up, or until ``stopped()``.

        Args:
            report: Called a few times per second.
            stopped: Asked as often; true lets the running cells write their checkpoints and end.

        Returns:
            Where the study stands then.

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
                    report(self._progress(cells, time.monotonic() - begin))
                    if stopped() and not self._stopping:
                        self._stopping = True
                        self.engine.stop()
                for job in jobs:
                    job.result()  # raises what was raised there
                return self._progress(cells, time.monotonic() - begin)
            finally:  # nothing is left here but after an error or a second Ctrl-C
                self._stopping = self._killed = True
                self.engine.kill()

    def _work(self, cell: Cell) -> None:
        """Have a cell worked on until it is finished or given up."""
        errors = self.study.failures(cell)
        while not self._stopping and len(errors) < ATTEMPTS:
            self._begun.setdefault(cell.name, self._state(cell).iteration)
            self._active[cell.name] = cell
            error = self.engine.run(cell)
            del self._active[cell.name]
            if error is None and self.study.finished([cell]):
                self._finished.add(cell.digest)
                return
            if self._killed or (error is None and self._stopping):
                return
            errors.append(error or "it ended without results")
            self.study.record_failure(cell, errors[-1])
        if len(errors) >= ATTEMPTS:
            self._failed[cell.name] = errors[-1]

    def _state(self, cell: Cell) -> Running:
        """How far a cell's training is, by the end of its ``timing.csv``."""
        iteration, fps = 0, 0.0
        try:
            with (self.study.cell_path(cell) / "run" / "timing.csv").open("rb") as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL_BYTES))
                lines = file.read().decode().split("\n")
            values = lines[-2].split(",")  # the last whole line
            iteration, fps = int(values[0]), float(values[1])
        except (OSError, IndexError, ValueError):
            pass  # no iteration is whole yet
        return Running(cell.name, iteration, cell.config.iterations, fps)

    def _progress(self, cells: list[Cell], seconds: float) -> Progress:
        running = [self._state(cell) for cell in list(self._active.values())]
        done = left = 0.0  # transitions
        for cell in cells:
            iteration = self._state(cell).iteration if cell.name in self._begun else 0
            size = cell.config.ppo.num_steps * cell.config.num_envs
            done += size * max(0, iteration - self._begun.get(cell.name, iteration))
            if cell.digest not in self._finished and cell.name not in self._failed:
                left += size * (cell.config.iterations - iteration)
        return Progress(
            total=len(cells), finished=len(self._finished), failed=dict(self._failed), running=running,
            seconds_left=left * seconds / done if done else None,
        )  # fmt: skip
