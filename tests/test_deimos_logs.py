"""What a run shows while it trains: every iteration once, also after a kill."""

import hashlib
import inspect
import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from deimos.checks import RunError
from deimos.learn.ppo import PPOConfig
from deimos.run import clips, training
from deimos.run.config import to_dict
from deimos.run.folder import VIDEOS, RunFolder
from deimos.run.trainer import TrainConfig

STEPS, SAVED, KILLED, END = 8, 3, 5, 9  # of a rollout; iterations of the last checkpoint, of the kill and in all
FILMED = [2, 4, 6, 8]  # iterations with a video
CONFIG = TrainConfig(
    num_envs=8, env_steps=STEPS * END, device="cpu", threads=1, evaluation=False, video_every=2,
    ppo=PPOConfig(num_steps=STEPS, hidden=(4,), epochs=1),
)  # fmt: skip


def render(run, policy, clip):
    """Make a clip, in place of the process that would render it: the hash of the policy that it shows."""
    clip.write_bytes(b"GIF89a" + hashlib.sha256(policy.read_bytes()).digest())


KILLED_RUN = f"""
import hashlib, json, os, signal, sys, time
from pathlib import Path
from deimos.run import clips
from tensorboard.summary.writer.record_writer import RecordWriter
from deimos.run import training
from deimos.run.config import from_dict
from deimos.run.trainer import TrainConfig

{inspect.getsource(render)}
clips.render = render
killed, delay = int(sys.argv[3]), 0.0
save, write = training.save, RecordWriter.write
training.CHECKPOINT_SECONDS = -1.0

def write_late(self, data):
    time.sleep(delay)  # a disk that is slow: events wait in the writer's queue
    write(self, data)

def kill(iteration):
    if iteration == killed:
        os.kill(os.getpid(), signal.SIGKILL)

def save_and_die(trainer, folder):
    save(trainer, folder)
    kill(trainer.iteration)

def report(row, fps):
    global delay
    if row["iteration"] == {SAVED} - 1 == killed - 1:
        delay = 0.1
    if row["iteration"] > {SAVED}:
        training.CHECKPOINT_SECONDS = 1e9
        kill(row["iteration"])

training.save, RecordWriter.write = save_and_die, write_late
config = from_dict(TrainConfig, json.loads(sys.argv[2]))
training.train(*training.start(config, Path(sys.argv[1])), report)
"""


@pytest.mark.parametrize("killed", [SAVED, KILLED])
def test_tensorboard_has_every_iteration_once(killed, tmp_path, monkeypatch):
    """A run that was killed at once after a checkpoint, or later, and resumed has neither gap nor double step."""
    monkeypatch.setattr(clips, "render", render)
    path, whole = tmp_path / "run", tmp_path / "whole"
    training.train(*training.start(replace(CONFIG, log=()), whole))
    arguments = [sys.executable, "-c", KILLED_RUN, str(path), json.dumps(to_dict(CONFIG)), str(killed)]
    assert subprocess.run(arguments, stderr=subprocess.DEVNULL).returncode == -signal.SIGKILL
    assert [int(row["iteration"]) for row in RunFolder(path).read_csv("progress.csv")] == [*range(1, killed + 1)]
    trainer, folder = training.resume(path)
    assert trainer.iteration == SAVED
    assert training.train(trainer, folder)
    board = EventAccumulator(str(path)).Reload()
    rows = RunFolder(path).read_csv("progress.csv")
    for name in ("reward", "crashes", "fps"):
        assert [event.step for event in board.Scalars(name)] == [*range(1, END + 1)]
    assert [event.value for event in board.Scalars("reward")] == pytest.approx([float(row["reward"]) for row in rows])
    shown = {event.step: event.encoded_image_string for event in board.Images("policy")}
    assert [event.step for event in board.Images("policy")] == FILMED
    assert shown == {number: clip.read_bytes() for number, clip in RunFolder(whole).of_iterations(VIDEOS).items()}


class FakeWandb:
    """Weights & Biases as far as runs use it; offline a file for each process, online one history by identity."""

    Error = type("Error", (Exception,), {})

    Video = staticmethod(lambda path: Path(path).read_bytes().hex())

    def __init__(self, offline):
        self.offline, self.history, self.files, self.began = offline, [], 0, []

    @staticmethod
    def Settings(**settings):
        """Take any settings."""
        return settings

    def init(self, *, id, dir, resume, config, **more):
        """Begin or resume a run."""
        assert resume == "allow"
        self.began.append((id, config["seed"]))
        self.files += 1
        if self.offline:
            file = Path(dir) / "wandb" / f"offline-run-{self.files}-{id}" / "history"
            file.parent.mkdir(parents=True)
            history = []
        else:
            file, history = None, self.history

        def log(row, step, commit):
            assert commit
            if not history or step > history[-1]["step"]:  # others are dropped
                history.append(row | {"step": step})
            if file:
                file.write_text(json.dumps(history))

        step = history[-1]["step"] + 1 if history else 0
        return SimpleNamespace(log=log, step=step, finish=lambda: None)


class Lost(Exception):
    """A run was cut."""


@pytest.mark.parametrize("offline", [True, False])
def test_wandb_has_every_iteration_once(offline, tmp_path, monkeypatch):
    """A cut and resumed run has neither gap nor double step, offline nor online, whatever had been sent by then."""
    wandb = FakeWandb(offline)
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    monkeypatch.setattr(clips, "render", render)
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", -1.0)
    path = tmp_path / "run"

    def report(row, fps):
        if row["iteration"] == SAVED + 1:
            monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 1e9)
        if row["iteration"] == KILLED:
            raise Lost

    with pytest.raises(Lost):
        training.train(*training.start(replace(CONFIG, log=("wandb",)), path), report)
    del wandb.history[1:]  # what had not been sent
    assert training.train(*training.resume(path))
    if offline:
        (file,) = path.glob("wandb/offline-run-*/history")
        wandb.history = json.loads(file.read_text())
    assert [row["step"] for row in wandb.history] == [*range(1, END + 1)]
    rows = RunFolder(path).read_csv("progress.csv")
    assert [row["reward"] for row in wandb.history] == [float(row["reward"]) for row in rows]
    assert all(row["fps"] > 0 for row in wandb.history)
    shown = {row["step"]: bytes.fromhex(row["policy"]) for row in wandb.history if "policy" in row}
    assert shown == {number: clip.read_bytes() for number, clip in RunFolder(path).of_iterations(VIDEOS).items()}
    assert list(shown) == FILMED
    identity = RunFolder(path).read_json("wandb.json")["id"]
    assert wandb.began == [(identity, CONFIG.seed)] * 2
    assert not [*path.glob("events.out.tfevents.*")]


def test_wandb_without_a_login_is_said_in_one_line(tmp_path, monkeypatch):
    """Where Weights & Biases cannot be reached, the way out is said, and the checkpoint is whole."""
    wandb = FakeWandb(offline=False)

    def refuse(**options):
        raise wandb.Error("No API key\nconfigured")

    wandb.init = refuse
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    trainer, folder = training.start(replace(CONFIG, log=("wandb",)), tmp_path / "run")
    with pytest.raises(RunError, match=r"\(No API key configured\); log in .*WANDB_MODE=offline"):
        training.train(trainer, folder)
    assert training.load_checkpoint(folder)["iteration"] == 0


@pytest.mark.parametrize("stored", [{"id": "b/../../.."}, {"id": "*"}, {}, [], {"id": 7}])
def test_an_identity_is_no_path(stored, tmp_path, monkeypatch):
    """A file that names something else than a run of Weights & Biases is refused before anything is deleted."""
    monkeypatch.setitem(sys.modules, "wandb", FakeWandb(offline=True))
    trainer, folder = training.start(replace(CONFIG, log=("wandb",)), tmp_path / "run")
    (folder.path / "wandb" / "offline-run-a-b").mkdir(parents=True)
    folder.write_json("wandb.json", stored)
    with pytest.raises(RunError, match=r"wandb.json must hold an id of 16 hexadecimal digits, got"):
        training.train(trainer, folder)
    assert (folder.path / "wandb" / "offline-run-a-b").is_dir()


def test_logs_are_known_by_their_names(tmp_path):
    """No log is a choice, one that is not there is refused, and a run without logs leaves no file of them."""
    with pytest.raises(ValueError, match="log must be one of tensorboard, wandb, got 'paper'"):
        TrainConfig(log=("tensorboard", "paper"))
    trainer, folder = training.start(replace(CONFIG, log=(), video_every=0), tmp_path / "run")
    training.train(trainer, folder)
    assert training.read_config(folder).log == ()
    assert not [*folder.path.glob("events.out.tfevents.*")]
