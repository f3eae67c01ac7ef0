"""Clips of the policy while it learns: what they show, and a training that does not notice them."""

import subprocess
import sys
from dataclasses import replace

import pytest
from PIL import Image, ImageSequence

from deimos.learn.ppo import PPOConfig
from deimos.nn import ranks
from deimos.run import training
from deimos.run.clips import PATIENCE_SECONDS, Camera, clips, cut_clips
from deimos.run.film import FPS, SECONDS, SIZE
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig

CONFIG = TrainConfig(
    num_envs=8, env_steps=24, device="cpu", threads=1, evaluation=False, log=(),
    ppo=PPOConfig(num_steps=8, hidden=(4,), epochs=1),
)  # fmt: skip


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A run without clips."""
    trainer, folder = training.start(CONFIG, tmp_path_factory.mktemp("clips") / "plain")
    training.train(trainer, folder)
    return folder


def kept(folder):
    """What a run is known by."""
    return [(folder.path / name).read_bytes() for name in ("progress.csv", "policy.pt")]


def test_a_clip_shows_the_policy_and_changes_no_bit(plain, tmp_path):
    """Every so many iterations there is a clip of four seconds, and the run's numbers are those of one without."""
    trainer, folder = training.start(replace(CONFIG, video_every=2), tmp_path / "run")
    assert training.train(trainer, folder)
    assert kept(folder) == kept(plain)
    assert list(clips(folder)) == [2]
    with Image.open(clips(folder)[2]) as gif:
        frames = [frame.convert("RGB").tobytes() for frame in ImageSequence.Iterator(gif)]
        assert gif.size == SIZE
    assert len(frames) == SECONDS * FPS
    assert len(set(frames)) > 10


def test_a_run_goes_on_where_nothing_can_be_rendered(plain, tmp_path, monkeypatch, caplog):
    """Without an encoder there is one line that says why, no clip, and a whole run."""
    (tmp_path / "imageio_ffmpeg.py").write_text("raise ImportError('There is no ffmpeg here.')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    trainer, folder = training.start(replace(CONFIG, video_every=1), tmp_path / "run")
    assert training.train(trainer, folder)
    assert kept(folder) == kept(plain)
    assert not clips(folder)
    (said,) = [record.getMessage() for record in caplog.records if record.name == "deimos.run.clips"]
    assert said == "There will be no videos in the logs from iteration 1 on: There is no ffmpeg here."


def test_a_clip_that_cannot_be_kept_ends_the_clips(tmp_path, monkeypatch, caplog):
    """A policy that cannot be written, or a process that cannot be started, is one line and no clip."""
    camera = Camera(RunFolder(tmp_path), 1)

    def full(path):
        raise OSError(28, "No space left on device")

    assert camera.after(1, full) is None
    assert camera.after(2, full) is None
    assert [record.getMessage() for record in caplog.records] == [
        "There will be no videos in the logs from iteration 1 on: [Errno 28] No space left on device"
    ]


def test_a_clip_that_takes_too_long_is_said_to(tmp_path, monkeypatch, caplog):
    """The line names the timeout, not the last words of the process, which are bytes then."""
    command = [sys.executable, "-c", "import sys, time; print('a hint', file=sys.stderr, flush=True); time.sleep(60)"]

    def slow(*paths):
        subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=1.0)

    monkeypatch.setattr("deimos.run.clips.render", slow)
    assert Camera(RunFolder(tmp_path), 1).after(1, lambda path: None) is None
    (record,) = caplog.records
    assert record.getMessage().endswith("timed out after 1.0 seconds")
    assert PATIENCE_SECONDS < ranks.PATIENCE.total_seconds()  # the other ranks wait for the clip


def test_clips_after_an_iteration_are_dropped(tmp_path):
    """A resumed run keeps the clips up to its checkpoint, and files that are none."""
    (tmp_path / "videos").mkdir()
    for name in ("000002.gif", "000010.gif", "1000000.gif", "mine.gif"):
        (tmp_path / "videos" / name).touch()
    cut_clips(RunFolder(tmp_path), 10)
    assert sorted(path.name for path in (tmp_path / "videos").iterdir()) == ["000002.gif", "000010.gif", "mine.gif"]
    assert list(clips(RunFolder(tmp_path))) == [2, 10]


def test_the_number_of_iterations_is_checked():
    """A negative number is refused by its name."""
    with pytest.raises(ValueError, match="video_every must be at least 0, got -1"):
        TrainConfig(video_every=-1)
