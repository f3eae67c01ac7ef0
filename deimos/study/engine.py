"""Where the cells of a study are worked on: an interface, and processes of this machine."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, Protocol

import deimos
from deimos.study.cell import STOPPED
from deimos.study.folder import StudyFolder
from deimos.study.plan import Cell


class Engine(Protocol):
    """Works on cells; ``run`` is called from one thread for each cell that is worked on at a time."""

    def run(self, cell: Cell) -> str | None:
        """Work on a cell, from wherever it is, until it is finished, was stopped or has failed.

        Returns ``None``, or one line on how the work has failed; a cell without a result has then failed too.
        """

    def stop(self) -> None:
        """Let all running cells write their checkpoints and end; from now on ``run`` begins nothing."""

    def kill(self) -> None:
        """End everything that runs, at once; from now on ``run`` begins nothing."""


class LocalProcesses:
    """An engine that starts a process for each cell; each ends when this process does."""

    def __init__(self, study: StudyFolder) -> None:
        self._study = study
        self._lock = threading.Lock()
        self._running: dict[subprocess.Popen, Any] = {}  # processes, with the standard input that each listens to
        self._stopping = False

    def run(self, cell: Cell) -> str | None:
        """See ``Engine.run``."""
        path = self._study.cell_path(cell) / "log.txt"
        with self._lock, path.open("ab") as log:
            if self._stopping:
                return None
            threads = str(cell.config.threads or 1)
            process = subprocess.Popen(
                [sys.executable, *_apart(), "-m", "deimos.study.cell", str(self._study.path), cell.name],
                stdin=subprocess.PIPE, stdout=log, stderr=log, bufsize=0,
                env={"OMP_WAIT_POLICY": "passive"}  # threads that wait sleep: other cells use the cores too
                | os.environ | {"OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads},
                start_new_session=True,  # Ctrl-C reaches the runner alone, which passes it on once
            )  # fmt: skip
            self._running[process] = process.stdin
        code = process.wait()
        with self._lock:
            self._running.pop(process).close()
        return None if code in (0, STOPPED) else last_words(code, path)

    def stop(self) -> None:
        """See ``Engine.stop``."""
        with self._lock:
            self._stopping = True
            for pipe in self._running.values():
                with contextlib.suppress(BrokenPipeError):  # it has just ended
                    pipe.write(b".")

    def kill(self) -> None:
        """See ``Engine.kill``."""
        with self._lock:
            self._stopping = True
            for process in self._running:
                process.kill()


def _apart() -> list[str]:
    """Options of Python by which a module of the working directory stands in for no other one, as in a command.

    None in the folder of an installation's sources, from which they may be imported. Plug-ins are found there all the
    same (``deimos.study.source.import_plugins``).
    """
    return [] if Path(deimos.__file__).resolve().parent.parent == Path.cwd() else ["-P"]


def last_words(code: int, log: Path) -> str:
    """One line that says how a worker died, by its exit code (negative for a signal) and what it wrote."""
    if code < 0:
        name = signal.Signals(-code).name
        return f"killed by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")
    said = log.read_text(errors="replace").strip()
    return said.splitlines()[-1].strip() if said else f"exit code {code} without results"
