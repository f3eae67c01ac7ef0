"""``deimos play``: pictures of a policy, or one line that says why there are none."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from deimos.app.playback import PlayOptions

HOME = Path(__file__).parent.parent
WALK = HOME / "docs" / "results" / "quad_flat"


def play(*arguments, **environment):
    """Exit code, last line of stdout and stderr of the command in a process of its own: MuJoCo chooses once."""
    known = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"} | environment
    command = [sys.executable, "-m", "deimos", "play", *map(str, arguments)]
    done = subprocess.run(command, cwd=HOME, env=known, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout.strip(), done.stderr.strip()


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
        ({}, "Give one of --video FILE and --frames FOLDER"),
        ({"video": Path("x.mp4"), "frames": Path("x")}, "Give one of --video FILE and --frames FOLDER"),
        ({"video": Path("x.mp4"), "seconds": 0.0}, "seconds must be finite and positive, got 0.0"),
        ({"video": Path("x.mp4"), "fps": float("inf")}, "fps must be finite and positive, got inf"),
        ({"video": Path("x.mp4"), "width": 8}, "width must be at least 16, got 8"),
        ({"video": Path("x.mp4"), "world": -1}, "world must be at least 0, got -1"),
    ],
)
def test_options_are_checked(options, message):
    """The message names the option, what it must be and what it was."""
    with pytest.raises(ValueError, match=message):
        PlayOptions(run=Path("run"), **options)
