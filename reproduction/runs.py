"""Runs that the commands here train and evaluate; after an interruption the same command continues."""

import shutil
from pathlib import Path

import torch

from deimos.run import training
from deimos.run.evaluation import evaluate_run
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.shared import one_stream


def finished(config: TrainConfig, path: Path, init_from: Path | None = None) -> tuple[RunFolder, list[dict]]:
    """Train and evaluate a run on the CPU, from its current state.

    Args:
        config: The run; if it has already started, the stored configuration counts.
        path: Its folder.
        init_from: Folder of a run whose networks it starts from.

    Returns:
        The folder, and the rows of its evaluation: none where ``config.evaluation`` is false.
    """
    with one_stream(torch.device("cpu")):
        if (path / "checkpoint.pt").exists():
            trainer, folder = training.resume(path)
        else:
            shutil.rmtree(path, ignore_errors=True)  # it was killed before its first checkpoint
            trainer, folder = training.start(config, path, init_from)
        if trainer.iteration < trainer.config.iterations:
            training.train(trainer, folder)
        if not config.evaluation:
            return folder, []
        return folder, evaluate_run(folder, config.env, config.eval, torch.device("cpu"), again=False)
