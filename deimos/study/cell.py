"""A worker of a study: the process that trains and judges one cell.

``python -m deimos.study.cell STUDY NAME RUNNER`` goes on from the cell's last checkpoint. It ends at once
when the process RUNNER, which holds the cell's lease, is gone, and exits with 130 after SIGINT.
"""

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import torch

from deimos.checks import SimulationError
from deimos.learn.policy import load_policy
from deimos.run import training
from deimos.run.evaluation import evaluate, weights_hash
from deimos.run.folder import RunError, RunFolder
from deimos.sim.shared import one_stream
from deimos.study.folder import StudyFolder, curve_row, result_rows
from deimos.study.plan import Cell

STOPPED = 130
WATCH_SECONDS = 0.2


class _Interrupted(Exception):
    pass


def work(study: StudyFolder, cell: Cell, stopped: Callable[[], bool]) -> bool:
    """Train, evaluate and enter a cell into the study's tables, from wherever it stands.

    Args:
        study: The study.
        cell: One of its cells.
        stopped: Asked now and then; true ends the work early, with everything done so far kept.

    Returns:
        Whether the cell is finished.

    Raises:
        RunError: If a file cannot be read or written, or the run cannot begin.
        SimulationError: If a number is not finite.
    """
    path = study.cell_path(cell) / "run"
    device = training.resolve_device(cell.config.device)
    with one_stream(device):
        if (path / "checkpoint.pt").exists():
            trainer, run = training.resume(path)
        else:
            shutil.rmtree(path, ignore_errors=True)  # it was killed before its first checkpoint
            trainer, run = training.start(cell.config, path, None)
        if not training.train(trainer, run, stopped=stopped) or stopped():
            return False
        try:
            rows = _evaluated(run, cell, device, stopped)
        except _Interrupted:
            return False
    study.curves.append([curve_row(cell, run)])
    study.results.append(result_rows(cell, run, rows))
    return True


def _evaluated(run: RunFolder, cell: Cell, device: torch.device, stopped: Callable[[], bool]) -> list[dict]:
    """The rows of all evaluations of a cell; those that the run folder has are not made again."""

    def check(stage: str, share: float) -> None:
        if stopped():
            raise _Interrupted

    policy = load_policy(run.path, str(device))
    weights = weights_hash(policy.actor)
    config = cell.config.eval
    rows = run.read_json("evaluation.json") if (run.path / "evaluation.json").exists() else []
    for period in cell.goal_periods:
        key = {"goal_period": period, "seed": config.seed, "worlds": config.worlds, "steps": config.steps}
        if any(row["goals"] == "adversary" and row.items() >= (key | {"weights": weights}).items() for row in rows):
            continue
        fresh = evaluate(policy.scaled, cell.config.env.with_goal_period(period), config, device, check)
        rows = [*rows, *[row | {"weights": weights} for row in fresh]]
        run.write_json("evaluation.json", rows)
    return [row for row in rows if row["weights"] == weights]


def _watch(runner: int) -> None:
    """End this process as soon as its runner is gone: another one may take over the cell then."""
    while os.getppid() == runner:
        time.sleep(WATCH_SECONDS)
    os._exit(1)


def main(arguments: list[str]) -> int:
    """Run the worker; returns the exit code."""
    study, name, runner = StudyFolder(Path(arguments[0])), arguments[1], int(arguments[2])
    threading.Thread(target=_watch, args=(runner,), daemon=True).start()
    asked: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: asked.append(number))
    try:
        return 0 if work(study, study.cell(name), lambda: bool(asked)) else STOPPED
    except (RunError, SimulationError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
