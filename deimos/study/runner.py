"""Runs the cells of a study: workers side by side, each a process of its own that holds the lease of its cell."""

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from deimos.study import lease
from deimos.study.cell import STOPPED
from deimos.study.folder import ATTEMPTS, StudyFolder
from deimos.study.plan import Cell

POLL_SECONDS = 0.5
RENEW_SECONDS = 5.0
LOOK_SECONDS = 2.0  # between two looks at the table, where other machines enter their cells
TAIL_BYTES = 400


@dataclass(frozen=True)
class Running:
    """A cell that is being worked on here."""

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
    """Cells whose results are in the table."""
    failed: dict[str, str]
    """Cells that are given up, with how the last attempt ended."""
    running: list[Running]
    """Cells that are being worked on here."""
    elsewhere: int
    """Cells that another runner holds."""
    seconds_left: float | None
    """Estimate from what was done here so far [s]; ``None`` before anything was."""


@dataclass
class _Worker:
    cell: Cell
    lease: lease.Lease
    process: subprocess.Popen
    began_at: int  # iterations that were done before
    lost: bool = False


@dataclass
class Runner:
    """Works on the open cells of a study until none is left.

    A worker that dies has its cell tried once more; then it is recorded as failed and the rest go on.
    """

    study: StudyFolder
    """The study."""
    workers: int
    """Cells at a time, at least 1."""
    _active: list[_Worker] = field(default_factory=list)
    _done: float = 0.0  # work of ended workers, in transitions
    _begin: float = 0.0
    _finished: set[str] = field(default_factory=set)
    _failed: dict[str, str] = field(default_factory=dict)
    _elsewhere: int = 0

    def run(self, report: Callable[[Progress], None], stopped: Callable[[], bool]) -> Progress:
        """Work until every cell is finished or given up, or until ``stopped()``.

        Args:
            report: Called a few times per second.
            stopped: Asked as often; true lets the workers write their checkpoints and end.

        Returns:
            Where the study stands then.
        """
        cells = self.study.cells()
        self._begin = renewed = time.monotonic()
        looked, asked = -math.inf, False
        try:
            while True:
                if self._reap(asked) or time.monotonic() - looked > LOOK_SECONDS:
                    self._look(cells)
                    looked = time.monotonic()
                    if not asked:
                        self._fill(cells)
                progress = self._progress(cells)
                report(progress)
                if not self._active and (asked or progress.finished + len(progress.failed) == len(cells)):
                    return progress
                if stopped() and not asked:
                    asked = True
                    self._signal(signal.SIGINT)
                if time.monotonic() - renewed > RENEW_SECONDS:
                    self._renew()
                    renewed = time.monotonic()
                time.sleep(POLL_SECONDS)
        finally:
            self._signal(signal.SIGKILL)  # nothing is left here but after an error or a second Ctrl-C
            for worker in self._active:
                worker.process.wait()
                worker.lease.release()

    def _look(self, cells: list[Cell]) -> None:
        """See what is finished, given up or held, here and on other machines."""
        self._finished = self.study.finished(cells)
        errors = {cell.name: self.study.failures(cell) for cell in cells if cell.digest not in self._finished}
        self._failed = {name: lines[-1] for name, lines in errors.items() if len(lines) >= ATTEMPTS}
        self._elsewhere = sum(lease.is_held(self.study.cell_path(cell)) for cell in self._waiting(cells))

    def _waiting(self, cells: list[Cell]) -> list[Cell]:
        """Cells that are neither finished, given up nor worked on here."""
        out = self._finished | {worker.cell.digest for worker in self._active}
        return [cell for cell in cells if cell.digest not in out and cell.name not in self._failed]

    def _fill(self, cells: list[Cell]) -> None:
        """Start workers while there is room and there are cells to claim."""
        for cell in self._waiting(cells):
            if len(self._active) >= self.workers:
                return
            if (claim := lease.take(self.study.cell_path(cell))) is None:
                continue
            if self.study.finished([cell]):  # by another runner, between the look and the claim
                claim.release()
                continue
            self._active.append(self._start(cell, claim))

    def _start(self, cell: Cell, claim: lease.Lease) -> _Worker:
        command = [sys.executable, "-m", "deimos.study.cell", str(self.study.path), cell.name, str(os.getpid())]
        threads = str(cell.config.threads or 1)
        with (self.study.cell_path(cell) / "log.txt").open("ab") as log:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                env=os.environ | {"OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads},
                start_new_session=True,  # Ctrl-C reaches the runner alone, which passes it on once
            )  # fmt: skip
        claim.name_holders([os.getpid(), process.pid])
        return _Worker(cell, claim, process, self._state(cell).iteration)

    def _reap(self, asked: bool) -> bool:
        """Take note of the workers that have ended; returns whether there was one."""
        ended = [worker for worker in self._active if worker.process.poll() is not None]
        for worker in ended:
            self._active.remove(worker)
            self._done += self._work(worker)
            code = worker.process.returncode
            finished = code == 0 and self.study.finished([worker.cell])
            if not (finished or worker.lost or (asked and code == STOPPED)):
                log = self.study.cell_path(worker.cell) / "log.txt"
                self.study.record_failure(worker.cell, _last_words(code, log))
            worker.lease.release()
        return bool(ended)

    def _renew(self) -> None:
        for worker in self._active:
            if not worker.lease.renew():  # this machine slept, and another one has taken over
                worker.lost = True
                worker.process.kill()

    def _signal(self, number: int) -> None:
        for worker in self._active:
            if worker.process.poll() is None:
                worker.process.send_signal(number)

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

    def _work(self, worker: _Worker) -> float:
        """Transitions that a worker has simulated in training."""
        config = worker.cell.config
        iterations = self._state(worker.cell).iteration - worker.began_at
        return max(0, iterations) * config.ppo.num_steps * config.num_envs

    def _progress(self, cells: list[Cell]) -> Progress:
        running = [self._state(worker.cell) for worker in self._active]
        waiting = self._waiting(cells)
        left = sum(float(cell.config.env_steps * cell.config.num_envs) for cell in waiting)
        for worker, state in zip(self._active, running, strict=True):
            config = worker.cell.config
            left += (state.iterations - state.iteration) * config.ppo.num_steps * config.num_envs
        done = self._done + sum(self._work(worker) for worker in self._active)
        seconds = time.monotonic() - self._begin
        return Progress(
            total=len(cells), finished=len(self._finished), failed=dict(self._failed), running=running,
            elsewhere=self._elsewhere, seconds_left=left * seconds / done if done else None,
        )  # fmt: skip


def _last_words(code: int, log: Path) -> str:
    """One line that says how a worker died."""
    if code < 0:
        name = signal.Signals(-code).name
        return f"killed by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1] if code not in (0, STOPPED) and lines else f"exit code {code} without results"
