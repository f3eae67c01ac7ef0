"""Two processes at once on one run, and disks that are full: one of them writes, and nothing is lost."""

import dataclasses
import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import deimos
from deimos import files
from deimos.checks import RunError
from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.evaluation import EvalConfig, evaluate_run, read_evaluation
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle

HOME = Path(deimos.__file__).resolve().parent.parent
CPU = torch.device("cpu")
CONFIG = TrainConfig(
    env=particle.Config(goal_period=8), method="uniform", ppo=PPOConfig(hidden=(8,), num_steps=8, minibatches=2),
    eval=EvalConfig(worlds=4, steps=16, attackers=()), evaluation=False, num_envs=16, env_steps=8 * 24, device="cpu",
    threads=1,
)  # fmt: skip

# Everything is loaded before both are let go, or the first would have ended by then.
COMMAND = """
import sys
import deimos.app.train, deimos.app.evaluate
from deimos.app import cli
print("ready", flush=True)
sys.stdin.readline()
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    """A run that was stopped early."""
    trainer, folder = training.start(CONFIG, tmp_path_factory.mktemp("races") / "half")
    training.train(trainer, folder, stopped=lambda: trainer.iteration == 3)
    return folder.path


@pytest.fixture(scope="module")
def whole(half, tmp_path_factory):
    """What becomes of it where one process resumes it."""
    path = shutil.copytree(half, tmp_path_factory.mktemp("races") / "whole")
    training.train(*training.resume(path))
    return path


def at_once(*commands):
    """Let commands begin at the same moment; gives their exit codes and what they said."""
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", COMMAND, *map(str, command)], cwd=HOME, stdin=subprocess.PIPE, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(HOME)},
        )
        for command in commands
    ]  # fmt: skip
    for process in processes:
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        process.stdin.write("go\n")
        process.stdin.flush()
    said = [process.communicate(timeout=300)[1] for process in processes]
    return [process.returncode for process in processes], said


def test_two_resumes_at_once_write_every_row_once(half, whole, tmp_path):
    """Whichever of two processes comes first trains; the other is told so in a line, and nothing is written twice."""
    path = shutil.copytree(half, tmp_path / "run")
    codes, said = at_once(*[["train", "--resume", path]] * 2)
    assert 0 in codes
    for code, text in zip(codes, said, strict=True):
        if code:  # else it came when the other had ended
            (line,) = text.splitlines()
            assert code == 2
            assert line.startswith(f"deimos: {path} is being worked on by process ")
    for name in ("progress.csv", "policy.pt", "checkpoint.pt"):
        assert (path / name).read_bytes() == (whole / name).read_bytes()


def test_two_evaluations_at_once_are_both_kept(half, tmp_path):
    """Rows of two processes that evaluate a run at the same time are there afterwards, none twice."""
    path = shutil.copytree(half, tmp_path / "run")
    commands = [["evaluate", path, "--worlds", worlds, "--steps", 16, "--device", "cpu"] for worlds in (4, 6)]
    codes, said = at_once(*commands)
    assert codes == [0, 0], said
    assert sorted(row["worlds"] for row in read_evaluation(RunFolder(path))) == [4, 6]


def test_every_file_survives_a_full_disk(half, tmp_path, monkeypatch):
    """Whatever a run writes at the end of a full disk, one line names it, and what was there is untouched."""
    folder = RunFolder(shutil.copytree(half, tmp_path / "run"))
    evaluate_run(folder, CONFIG.env, CONFIG.eval, CPU)
    trainer, _ = training.resume(folder.path)
    opened = files.open_file

    monkeypatch.setattr(files, "open_file", lambda path, mode="rb", **text: _full(opened, path, mode, text))
    monkeypatch.setattr("deimos.run.folder.open_file", lambda path, mode="rb", **text: _full(opened, path, mode, text))
    before = {path.name: path.read_bytes() for path in folder.path.iterdir()}
    writes = {
        "checkpoint.pt": lambda: training.save(trainer, folder),
        "config.json": lambda: training.resume(folder.path, CONFIG.env_steps + 8),
        "evaluation.json": lambda: evaluate_run(folder, CONFIG.env, dataclasses.replace(CONFIG.eval, worlds=6), CPU),
        "progress.csv": lambda: training.train(trainer, folder),
        "timing.csv": lambda: folder.append_csv("timing.csv", {"iteration": 99}),
    }
    for name, write in writes.items():
        with pytest.raises(RunError, match=rf"{name} could not be written \(No space left on device\)"):
            write()
    after = {path.name: path.read_bytes() for path in folder.path.iterdir() if path.name in before}
    assert {name: after[name] for name in before if name != "lock"} == {
        name: data for name, data in before.items() if name != "lock"
    }
    assert not list(folder.path.glob("*.partial"))


def _full(opened, path, mode, text):
    """A file on a disk that has no room left; a lock has its block already."""
    file = opened(path, mode, **text)
    if mode[0] in "axw" and not path.name.endswith("lock"):
        file.close()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    return file
