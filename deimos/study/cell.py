"""One cell of a study: ``run`` trains and evaluates it, in whatever process an engine calls it.

``python -m deimos.study.cell STUDY NAME`` is the worker of ``deimos.study.engine.LocalProcesses``: a byte on its
standard input, or SIGTERM, asks it to stop, and when that input ends, its runner is gone and it ends at once.
"""

import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from deimos.checks import RunError, SimulationError, one_line
from deimos.goals.fear_selector import fear_selector
from deimos.lock import hold
from deimos.run import training
from deimos.run.attack import attacker
from deimos.run.attackers.pooled import save_fear
from deimos.run.evaluation import Once, evaluate_run
from deimos.run.folder import RunFolder
from deimos.run.trainer import Trainer
from deimos.sim.shared import one_stream
from deimos.study.audits import Audits, speed
from deimos.study.folder import FEAR, StudyFolder
from deimos.study.plan import Cell
from deimos.study.results import evaluated, result
from deimos.study.source import check_sources, code

STOPPED = 130
PATIENCE_SECONDS = 5.0  # a worker whose runner was killed needs a moment to see it


class _Interrupted(Exception):
    pass


def run(study: StudyFolder, cell: Cell, stopped: Callable[[], bool] = lambda: False) -> bool:
    """Train and evaluate a cell from wherever it is, and write its ``result.json``.

    ``stopped`` is called now and then; true ends the work early, with everything done so far kept. Returns whether the
    cell is finished.

    Raises:
        RunError: If another process works on it, a file cannot be read or written, the run cannot begin, or the code is
            not that of the cell.
        SimulationError: If a number is not finite.
    """

    def watch(stage: str, share: float) -> None:
        if stopped():
            raise _Interrupted

    home = study.cell_path(cell)
    with hold(home / "lock", f"Cell {cell.name}", patience=PATIENCE_SECONDS):
        device = training.resolve_device(cell.config.device)
        try:
            with one_stream(device):
                if not (home / "result.json").exists():
                    check_sources(f"Cell {cell.name}", cell.sources, cell.plugins, cell.files)
                    if not _train(RunFolder(home), cell, device, stopped) or stopped():
                        return False
                    _finish(study, cell, device, watch)
                _attack(study, cell, device, watch)
        except _Interrupted:
            return False
        return True


def _train(home: RunFolder, cell: Cell, device: torch.device, stopped: Callable[[], bool]) -> bool:
    """Train to the end, with audits on the way, and keep the fear network; returns whether the end was reached."""
    path = home.path / "run"
    if (path / "checkpoint.pt").exists() and not (path / "config.json").exists():
        print(f"{path} holds no config.json; the cell starts again.", file=sys.stderr)
    if (path / "checkpoint.pt").exists() and (path / "config.json").exists():
        trainer, folder = training.resume(path)
    else:
        shutil.rmtree(path, ignore_errors=True)  # it was killed before its first checkpoint
        trainer, folder = training.start(cell.config, path, branch_from=cell.branch_from)
    audits = Audits(home, trainer.config, cell.audit_worlds)
    if not training.train(trainer, folder, lambda row, fps: audits.after(trainer), stopped):
        return False
    _keep_fear(home.path / FEAR, trainer)
    return True


def _keep_fear(path: Path, trainer: Trainer) -> None:
    """Keep the selector's fear network, if it has learnt, in a file that the attacker ``pooled`` reads."""
    afraid = fear_selector(trainer.loop.selector)
    if afraid is not None and afraid.fear.fitted:
        save_fear(path, afraid.fear, trainer.env, {})


def _finish(study: StudyFolder, cell: Cell, device: torch.device, watch: Callable[[str, float], None]) -> None:
    """Evaluate what was trained, and write ``result.json``."""
    home, config = RunFolder(study.cell_path(cell)), cell.config
    folder, once = RunFolder(home.path / "run"), _scales(study)
    tasks = [config.env.for_evaluation().with_goal_period(period) for period in cell.goal_periods]
    parts = [evaluate_run(folder, task, config.eval, device, watch, again=False, once=once) for task in tasks]
    audited: dict[str, Any] = Audits(home, config, cell.audit_worlds).row()
    if audited:
        audited["speed"] = speed(folder, config.env, config.eval.seed, device)
    home.write_json("result.json", result(cell, folder, [row for part in parts for row in part], audited))


def _scales(study: StudyFolder) -> Once:
    """The scales of scores that a study keeps for this code."""
    made_by = {"code": code().name}
    return lambda task, compute: study.scale(task | made_by, compute)


def _attack(study: StudyFolder, cell: Cell, device: torch.device, watch: Callable[[str, float], None]) -> None:
    """Evaluate a finished cell under the study's further attackers that it has not met, and add the rows."""
    home, made_by = RunFolder(study.cell_path(cell)), code().name
    for period, attackers in study.missing(cell).items():
        used = {*cell.config.env.files} | ({"pool"} if any(attacker(name).needs_pool for name in attackers) else set())
        wanted = {name: value for name, value in cell.sources.items() if name in used}
        files = {name: read for name, read in cell.files.items() if name in used}
        check_sources(f"Cell {cell.name}", wanted | {"code": made_by}, (), files)
        folder = RunFolder.open(home.path / "run")
        config = replace(cell.config.eval, attackers=attackers)
        task, once = cell.config.env.for_evaluation().with_goal_period(period), _scales(study)
        rows = evaluate_run(folder, task, config, device, watch, again=False, once=once)
        found = home.read_json("result.json")
        fresh = evaluated(cell, folder, [row for row in rows if row["goals"] in attackers], made_by)
        home.write_json("result.json", found | {"rows": found["rows"] + fresh})


def main(arguments: list[str], stopped: Callable[[], bool] = lambda: False) -> int:
    """Work on the cell that the arguments name; returns the exit code."""
    study, name = StudyFolder(Path(arguments[0])), arguments[1]
    try:
        return 0 if run(study, study.cell(name), stopped) else STOPPED
    except (RunError, SimulationError) as error:
        print(one_line(error), file=sys.stderr)
        return 2


def _listen(stop: threading.Event) -> None:
    """Set ``stop`` at the first byte of the standard input, and end this process when the input ends."""
    while os.read(0, 1):  # not sys.stdin: a thread that waits in it would hold its lock when Python shuts down
        stop.set()
    os._exit(1)


if __name__ == "__main__":
    asked = threading.Event()
    signal.signal(signal.SIGTERM, lambda number, frame: asked.set())  # clusters send it to all processes of a job
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    sys.exit(main(sys.argv[1:], asked.is_set))
