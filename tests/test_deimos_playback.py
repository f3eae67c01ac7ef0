"""``deimos play``: pictures of a policy, or one line that says why there are none."""

import inspect
import os
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch

from deimos.app import cli
from deimos.app.playback import PlayOptions
from deimos.checks import RunError
from deimos.run.video import ENDINGS, pictures, video
from deimos.sim.drawing import BLUE, ORANGE, OUTSIDE, PAPER, REACH, RED, Drawing, with_caption
from deimos.sim.envs.particle import Config

HOME = Path(__file__).parent.parent
WALK = HOME / "docs" / "results" / "quad_flat"
PICTURE = np.zeros((48, 64, 3), np.uint8)


def play(*arguments, **environment):
    """Exit code, last line of stdout and stderr of the command in a process of its own: MuJoCo chooses once."""
    known = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"} | environment
    command = [sys.executable, "-m", "deimos", "play", *map(str, arguments)]
    done = subprocess.run(command, cwd=HOME, env=known, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout.strip(), done.stderr.strip()


@pytest.fixture(scope="module")
def particle(tmp_path_factory):
    """Folder of a run in Particle Gym that has hardly learnt anything, with its policy and its fear network."""
    path = tmp_path_factory.mktemp("play") / "run"
    budget = "--no-evaluation --num-envs 32 --env-steps 48 --threads 1 --device cpu --ppo.hidden 16"
    assert cli.main(["train", *budget.split(), "--env.goal-period", "10", "--out", str(path)]) == 0
    return path


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_format_that_help_names_works(particle, tmp_path, ending, capsys):
    """A video of every ending has the size, the number of pictures and the duration that were asked for."""
    assert ending in inspect.getsource(PlayOptions)
    path = tmp_path / f"x{ending}"
    asked = "--seconds 1 --fps 10 --width 160 --height 120".split()
    assert cli.main(["play", str(particle), "--video", str(path), *asked]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(path)
    frames, seconds = decoded_webp(path) if ending == ".webp" else decoded(path)
    frames = frames.reshape(10, 120, 160, 3)
    assert len({frame.tobytes() for frame in frames}) > 1
    assert seconds == pytest.approx(1.0, abs=0.06)
    assert list(tmp_path.iterdir()) == [path]


def decoded(path):
    """The pictures of a video, by ffmpeg, uint8 and flat, and its duration [s]."""
    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(decode, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8), imageio_ffmpeg.count_frames_and_secs(str(path))[1]


def decoded_webp(path):
    """The same by Pillow: ffmpeg reads no animated WebP."""
    from PIL import Image, ImageSequence

    with Image.open(path) as image:
        found = [(np.asarray(frame.convert("RGB")), frame.info["duration"]) for frame in ImageSequence.Iterator(image)]
    return np.stack([picture for picture, _ in found]), sum(duration for _, duration in found) / 1000


def test_the_shortest_video_has_a_picture(particle, tmp_path, capsys):
    """However short a video is asked for, it holds the first picture."""
    path = tmp_path / "x.gif"
    assert cli.main(["play", str(particle), "--video", str(path), "--seconds", "0.001"]) == 0
    assert path.read_bytes().startswith(b"GIF")


def test_a_particle_is_drawn_where_it_is():
    """The particle, its goal and the wall are where they should be in both views, and an episode's end is marked."""
    env = Config(variant="absolute").build(1, torch.device("cpu"), seed=0)
    env.tensors["position"][0] = torch.tensor([500.0, -500.0, 900.0])
    env.set_goals(torch.tensor([0]), torch.tensor([[-0.5, 0.5, 0.0]]))
    drawing = Drawing(env, 640, 480)
    picture = drawing()
    assert picture.shape == (480, 640, 3)
    side, top, gap = drawing._side, drawing._top, (640 - 2 * drawing._side) // 3

    def pixel(place, x, y):
        half = REACH * 1000
        column = gap + place * (side + gap) + round(side / 2 * (1 + x / half))
        return tuple(picture[top + round(side / 2 * (1 - y / half)), column].tolist())

    assert pixel(0, 500, -500) == pixel(1, 500, 900) == BLUE
    assert pixel(0, -500, 500) == ORANGE
    assert pixel(0, -500, -500) == PAPER
    assert pixel(0, 1080, 0) == pixel(1, -1080, 0) == OUTSIDE
    blank = (picture == 255).all(axis=(1, 2))
    assert abs(top + side + 8 + (top - drawing._header) - 480) <= 1  # as much is left below as above
    assert blank[top + side :].all()
    counts = [int((picture == colour).all(axis=2).sum()) for colour in (ORANGE, RED)]
    assert counts[0] > 20
    env.step(torch.zeros(1, 3))
    drawing()
    env.reset(torch.ones(1, dtype=torch.bool))
    assert int((drawing() == RED).all(axis=2).sum()) > counts[1] + 20
    env.reset(torch.ones(1, dtype=torch.bool))
    env.step(torch.zeros(1, 3))
    drawing()
    assert len(drawing._ends) == 2  # though the episode is older than the last one was in its picture


@pytest.mark.parametrize("width", [160, 640, 1920])
def test_a_caption_grows_with_the_picture(width):
    """At the width of a phone (360 pixels) letters are more than 9 pixels high, and no word is cut off."""
    blue = np.full((width, width, 3), BLUE, np.uint8)
    goals = "  ".join(f"{value:+.2f}" for value in np.linspace(-1.0, 1.0, 12))

    def inked(text):
        """Rows and columns that hold letters, as first and last."""
        rows, columns = np.nonzero(with_caption(blue, text).max(axis=2) < 170)
        return rows.min(), rows.max(), columns.min(), columns.max()

    first, last, *_ = inked("|")
    assert 9.0 < (last - first) * 360 / width < 20.0
    top, bottom, *_ = inked("goal")
    assert inked(f"goal {goals}")[1] - top > 1.5 * (bottom - top)  # a second line
    assert inked(f"goal {goals}")[3] < width - 2


def test_a_velocity_leads_somewhere():
    """The goal of a directional particle is drawn where it leads by the time that it ends."""
    env = Config(goal_period=40).build(1, torch.device("cpu"), seed=0)
    env.set_goals(torch.tensor([0]), torch.tensor([[0.5, 0.0, -0.25]]))
    np.testing.assert_allclose(env.sketch(0).target, [200.0, 0.0, -100.0], rtol=1e-5)
    for _ in range(10):
        env.step(torch.zeros(1, 3))
    sketch = env.sketch(0)
    np.testing.assert_allclose(sketch.target - sketch.position, [150.0, 0.0, -75.0], rtol=1e-5)


def test_pictures_of_a_particle_need_no_mujoco(particle, tmp_path):
    """A particle is shown where MuJoCo is missing or has nothing to render with."""
    code, said, complaint = play(particle, "--frames", tmp_path / "x", "--seconds", "0.2", MUJOCO_GL="nonsense")
    assert (code, said) == (0, str(tmp_path / "x")), complaint
    assert len(list((tmp_path / "x").iterdir())) == 5


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("x.avi", "video must end in one of .mp4, .mkv, .mov, .webm, .gif, .webp, got x.avi"),
        ("x", "video must end in one of"),
        ("nowhere/x.gif", "The folder nowhere does not exist; make it first"),
    ],
)
def test_what_cannot_be_written_is_refused(particle, tmp_path, monkeypatch, capsys, name, message):
    """Another ending or a folder that is not there is refused in one line, before anything is rendered."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["play", str(particle), "--video", name]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def write_into(writer, *pictures):
    """Write pictures into a video or a folder, whole."""
    with writer as write:
        for picture in pictures:
            write(picture)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_video_without_a_picture_is_one_line(tmp_path, ending):
    """A video that no picture was written into is refused, and nothing is left."""
    with pytest.raises(RunError, match=rf"x{ending} could not be written \(there are no pictures"):
        write_into(video(tmp_path / f"x{ending}", (64, 48), 25.0))
    assert not list(tmp_path.iterdir())


def test_a_video_that_cannot_be_written_is_one_line(tmp_path, monkeypatch):
    """An encoder that is gone when a picture comes is one line, without its whole command."""

    def broken(*arguments, **options):
        yield
        raise OSError("[Errno 32] Broken pipe\n\nFFMPEG COMMAND: ...")

    monkeypatch.setattr(imageio_ffmpeg, "write_frames", broken)
    with pytest.raises(RunError, match=r"/x.mp4 could not be written \(\[Errno 32\] Broken pipe\)\.$"):
        write_into(video(tmp_path / "x.mp4", (64, 48), 25.0), PICTURE)
    assert not list(tmp_path.iterdir())


def test_pictures_that_cannot_be_written_are_one_line(tmp_path):
    """A folder that exists or cannot be made, or that is gone when a picture comes, is named in one line."""
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="file exists already; choose another folder"):
        write_into(pictures(tmp_path / "file"))
    with pytest.raises(RunError, match=r"file/x could not be written \(Not a directory\)"):
        write_into(pictures(tmp_path / "file" / "x"))
    with pictures(tmp_path / "x") as write:
        (tmp_path / "x").rmdir()
        with pytest.raises(RunError, match=r"000000.png could not be written \(No such file or directory\)"):
            write(PICTURE)


def test_frames_show_something(tmp_path):
    """Pictures have the size and the number that were asked for, and are neither of one colour nor all the same."""
    from PIL import Image

    options = ("--seconds", "0.2", "--fps", "10", "--width", "64", "--height", "48")
    code, said, complaint = play(WALK, "--frames", tmp_path / "frames", *options)
    if code == 2 and "Nothing can be rendered" in complaint:
        pytest.skip("There is neither EGL nor OSMesa here.")
    assert code == 0, complaint
    assert said.endswith("frames")
    pictures = [Image.open(path) for path in sorted((tmp_path / "frames").iterdir())]
    assert [picture.size for picture in pictures] == [(64, 48)] * 2
    assert all(len(picture.getcolors(10_000)) > 20 for picture in pictures)
    assert pictures[0].tobytes() != pictures[1].tobytes()


@pytest.mark.parametrize("backend", ["nonsense", "osmesa-of-nowhere"])
def test_an_unknown_back_end_is_one_line(tmp_path, backend):
    """What MuJoCo says of it arrives in one line with the way out; nothing is left behind."""
    code, _, complaint = play(WALK, "--video", tmp_path / "x.mp4", MUJOCO_GL=backend)
    assert code == 2
    assert f"MUJOCO_GL={backend}" in complaint
    assert "libegl1" in complaint
    assert "Traceback" not in complaint
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "Give either --video FILE or --frames FOLDER"),
        ({"video": Path("x.mp4"), "frames": Path("x")}, "Give either --video FILE or --frames FOLDER"),
        ({"video": Path("x.mp4"), "seconds": 0.0}, "seconds must be finite and positive, got 0.0"),
        ({"video": Path("x.mp4"), "fps": float("inf")}, "fps must be finite and positive, got inf"),
        ({"video": Path("x.mp4"), "width": 8}, r"width must be in \[16, 8192\], got 8"),
        ({"video": Path("x.mp4"), "world": -1}, "world must be at least 0, got -1"),
        ({"video": Path("x.mp4"), "seed": -1}, r"seed must be in \[0, 2\^32\), got -1"),
        ({"video": Path("x.mp4"), "goal_period": 0}, "goal_period must be at least 1, got 0"),
    ],
)
def test_options_are_checked(options, message):
    """The message names the option, what it must be and what it was."""
    with pytest.raises(ValueError, match=message):
        PlayOptions(run=Path("run"), **options)
