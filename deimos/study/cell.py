"""One cell of a study: ``run`` trains and evaluates it, in whatever process an engine calls it.

``python -m deimos.study.cell STUDY NAME`` is the worker of ``deimos.study.engine.LocalProcesses``: a byte on its
standard input asks it to stop, and when that input ends, its runner is gone and it ends at once.
"""

import os
import shutil
import sys
import threading
from collections.abc import Callable
from itertools import chain
from pathlib import Path

from deimos.checks import RunError, SimulationError, one_line
from deimos.run import training
from deimos.run.evaluation import evaluate_run
from deimos.run.folder import RunFolder
from deimos.sim.shared import one_stream
from deimos.study.folder import StudyFolder
from deimos.study.lock import hold
from deimos.study.plan import Cell
from deimos.study.results import result

STOPPED = 130
PATIENCE_SECONDS = 5.0  # a worker whose runner was killed needs a moment to see it


class _Interrupted(Exception):
    pass


def run(study: StudyFolder, cell: Cell, stopped: Callable[[], bool] = lambda: False) -> bool:
    """Train and evaluate a cell from wherever it stands, and write its ``result.json``.

    ``stopped`` is asked now and then; true ends the work early, with everything done so far kept. Returns whether the
    cell is finished.

    Raises:
        RunError: If another process works on it, a file cannot be read or written, or the run cannot begin.
        SimulationError: If a number is not finite.
    """

    def watch(stage: str, share: float) -> None:
        if stopped():
            raise _Interrupted

    home = study.cell_path(cell)
    with hold(home / "lock", f"Cell {cell.name}", patience=PATIENCE_SECONDS):
        path = home / "run"
        device = training.resolve_device(cell.config.device)
        with one_stream(device):
            if (path / "checkpoint.pt").exists():
                trainer, folder = training.resume(path)
            else:
                shutil.rmtree(path, ignore_errors=True)  # it was killed before its first checkpoint
                trainer, folder = training.start(cell.config, path, None)
            if not training.train(trainer, folder, stopped=stopped) or stopped():
                return False
            tasks = [cell.config.env.with_goal_period(period) for period in cell.goal_periods]
            try:
                rows = [evaluate_run(folder, task, cell.config.eval, device, watch, again=False) for task in tasks]
            except _Interrupted:
                return False
        RunFolder(home).write_json("result.json", result(cell, folder, chain.from_iterable(rows)))
        return True


def main(arguments: list[str], stopped: Callable[[], bool] = lambda: False) -> int:
    """Work on the cell that the arguments name; returns the exit code."""
    study, name = StudyFolder(Path(arguments[0])), arguments[1]
    try:
        return 0 if run(study, study.cell(name), stopped) else STOPPED
    except (RunError, SimulationError) as error:
        print(one_line(error), file=sys.stderr)
        return 2


def _listen(stop: threading.Event) -> None:
    """Set ``stop`` at the first byte of the standard input, and end this process where that ends."""
    while os.read(0, 1):  # not sys.stdin: a thread that waits in it would hold its lock when Python shuts down
        stop.set()
    os._exit(1)


if __name__ == "__main__":
    asked = threading.Event()
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    sys.exit(main(sys.argv[1:], asked.is_set))
