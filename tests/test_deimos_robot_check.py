"""``deimos robot``: what it finds about a robot that lacks something or stands badly, what it writes, how it ends."""

import dataclasses
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from robot_models import PAGE, write_scout

from deimos import plugins
from deimos.app import cli, robot
from deimos.sim.legged import engines, robot_check, robot_draft, robots
from deimos.sim.legged.engines import PhysicsConfig

HOME = Path(__file__).resolve().parent.parent


@pytest.fixture
def page(tmp_path):
    """The page's robot: its MJCF and its data file."""
    text = re.search(r"```toml\n(# scout.toml\n.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    write_scout(tmp_path).with_suffix(".toml").write_text(text)
    return tmp_path


def change(path, old, new):
    """Replace a text of a file, which must be there."""
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))


def check(folder, robot="scout.toml"):
    """What a check of a robot file finds."""
    from deimos.sim.legged import robot_file

    with robot_file.opened(folder / robot) as (described, home):
        return robot_check.check_robot(described.build(home))


def test_the_robot_of_the_page_has_no_faults(page):
    """It stands level on its four feet without sliding, and its weight is on them."""
    report = check(page)
    assert (report.faults, report.oddities) == ((), ())
    standing = report.standing
    assert 0.9 < standing.height <= 1.0
    assert standing.tilt < math.radians(2)
    assert standing.slide < 0.002
    weight = 9.81 * report.physics.model.body_mass.sum()
    assert standing.force[1:5].sum() == pytest.approx(weight, rel=0.01)
    assert not standing.force[[0, *range(5, 13)]].any()


@pytest.mark.parametrize("name", plugins.names(robots))
def test_our_own_robots_pass(name):
    """Every robot that comes with Deimos stands, and nothing is odd about it."""
    report = robot_check.check_robot(plugins.load(robots, name).build())
    assert (report.faults, report.oddities) == ((), ())


def test_engines_agree_on_standing(page, simulator):
    """On either engine the robot stands as MuJoCo itself has it stand: the same height and torques."""
    robot = robot_draft.draft(page / "scout.xml")[0].build(page)
    here, native = (
        robot_check.stand(robot, engines.build(engine, robot, None, 1, device, PhysicsConfig()))
        for engine, device in (simulator, ("native", simulator.device))
        if not (engine == "native" and device.type == "cuda")
    )
    assert here.height == pytest.approx(native.height, abs=1e-3)
    np.testing.assert_allclose(here.torque, native.torque, atol=0.05)
    np.testing.assert_allclose(here.force, native.force, atol=0.5)


FAULTS = {
    "a shell that does not collide": (
        "xml", 'name="shell"', 'name="shell" contype="0" conaffinity="0"',
        "base 'chassis' does not collide, so a fall is not a crash; give it a geom with a contype of 1",
    ),
    "soft joints": ("toml", "stiffness = 25 ", "stiffness = 1 ", r"it falls from its pose: .* raise stiffness"),
    "weak motors": ("toml", "[9.0, 9.0, 9.0]", "[0.5, 0.5, 0.5]", r"'knee_\w+' is .* of 0.5 N m; raise stiffness or"),
    "a pose that tips over": ("toml", "[0.0, 0.8, -1.5]", "[0.0, 2.3, -1.5]", "it falls from its pose: after 2 s"),
}  # fmt: skip
ODDITIES = {
    "hips that do not collide": (
        "xml", 'class="motor"><geom', 'class="motor"><geom contype="0" conaffinity="0"',
        r"hip 'shoulder_fl' \(front left\) does not collide: a robot on its side may rest on its legs",
    ),
    "legs that do not collide": (
        "xml", 'er"><geom', 'er"><geom contype="0" conaffinity="0"', "front left: neither thigh nor calf collides",
    ),
    "a light base": ("xml", 'mass="4.5"', 'mass="1"', "base 'chassis' weighs 1 kg, .* use --env.payload 0.25"),
    "a pose at a limit": ("xml", "-2.5 -0.4", "-1.54 -0.4", "pose of 'knee_fl', -1.5 rad, is in the outer tenth of"),
    "motors near their limit": ("toml", "[9.0, 9.0, 9.0]", "[9.0, 9.0, 2.6]", "standing takes .* of the 2.6 N m of 'k"),
    "soft knees": ("toml", "stiffness = 25 ", "stiffness = [25, 25, 6] ", "'knee_rl' gives way by -.* raise stiffness"),
    "trembling joints": ("xml", 'armature="0.004"', 'armature="0"', "joints tremble at .* raise damping or armature"),
    "a load at the front left": (
        "xml", 'name="shell"', 'name="shell" pos="0.12 0.12 0"', "the rear right foot is off the ground when the",
    ),
    "a knee for a foot": (
        "toml", 'feet = ["pad_fl"]', 'feet = ["lower_fl_geom0"]', "the front left calf touches the ground when the",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_found(page, name):
    """What keeps a robot from being trained is a fault, which names body or joint and a way out."""
    file, old, new, message = FAULTS[name]
    change(page / f"scout.{file}", old, new)
    faults = check(page).faults
    assert any(re.search(message, fault) for fault in faults), faults


@pytest.mark.parametrize("name", ODDITIES)
def test_oddities_are_found(page, name):
    """What may be meant is odd, names body or joint and a way out, and is no fault."""
    file, old, new, message = ODDITIES[name]
    change(page / f"scout.{file}", old, new)
    report = check(page)
    assert any(re.search(message, oddity) for oddity in report.oddities), report
    assert report.faults == ()


def test_a_robot_of_another_weight_is_odd(page):
    """Where the task's numbers have not been tried, the weight is said beside the range that they are made for."""
    change(page / "scout.xml", 'mass="4.5"', 'mass="200"')
    assert "it weighs 203 kg; the task is made for 2 to 100 kg" in check(page).oddities


def test_a_robot_that_slides_is_odd(page):
    """A base that still moves when its joints have settled is told of, in centimetres."""
    standing = dataclasses.replace(check(page).standing, slide=0.054)
    assert robot_check.judge_feet(standing) == ["it slides by 5 cm in 0.5 s; put its feet below its hips"]


def run(folder, *arguments, **more):
    """``deimos robot`` in a process of its own, for MuJoCo decides once how it renders."""
    path = os.pathsep.join([str(HOME), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, "-m", "deimos", "robot", *arguments], cwd=folder, env=os.environ | {"PYTHONPATH": path} | more,
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_a_check_ends_with_a_picture(page):
    """A sound robot: a table with all joints, exit code 0, and both views of the robot in one picture."""
    done = run(page, "check", "scout.toml")
    assert (done.returncode, done.stderr) == (0, "")
    assert len(re.findall(r"^(?:front|rear) (?:left|right) (?:hip|thigh|calf) ", done.stdout, re.MULTILINE)) == 12
    assert done.stdout.splitlines()[-2:] == ["It stands, and can be trained.", "scout.png"]
    picture = np.asarray(Image.open(page / "scout.png"))
    assert picture.shape == (480, 960, 3)
    robot._check_picture(page / "scout.png")  # another check may replace it
    red = (picture[:, :, 0] > 150) & (picture[:, :, 1:] < 90).all(axis=2)
    assert red[:, 480:].sum() > 1000 > red[:, :480].sum()  # the base, where it is drawn as what collides


def test_a_check_without_a_renderer_is_one_line(page):
    """Where MuJoCo has nothing to render with, it cannot even be imported; the line says what to install."""
    done = run(page, "check", "scout.toml", MUJOCO_GL="nonsense")
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"deimos: Nothing can be rendered with MUJOCO_GL=nonsense .*install libegl1 .*\n", done.stderr)


def test_a_check_ends_with_1_where_there_is_a_fault(page):
    """What is odd about the MJCF is said too, and the picture of a robot that falls is drawn where it is asked for."""
    change(page / "scout.toml", "stiffness = 25 ", "stiffness = 1 ")
    change(page / "scout.xml", "<freejoint/>", '<freejoint/><geom name="lid" size=".05" contype="0" conaffinity="0"/>')
    done = run(page, "check", "scout.toml", "--picture", "fallen.png")
    assert done.returncode == 1
    assert "\nfault: it falls from its pose" in done.stdout
    assert "\nnote: geom 'lid' touches nothing but adds to the weight" in done.stdout
    assert "It cannot be trained like this." in done.stdout
    assert (page / "fallen.png").is_file()


def test_an_mjcf_is_checked_as_it_would_be_drafted(page):
    """Without a data file, what is guessed is said beside what is found."""
    done = run(page, "check", "scout.xml")
    assert done.returncode == 0, done.stderr
    assert "note: pose is a guess" in done.stdout
    assert "deimos robot new scout.xml writes these values to a file" in done.stdout


def test_a_draft_is_not_written_over_a_file(page, monkeypatch, capsys):
    """A file that exists stays, unless it is forced."""
    monkeypatch.chdir(page)
    before = (page / "scout.toml").read_text()
    assert cli.main(["robot", "new", "scout.xml"]) == 2
    assert capsys.readouterr().err == (
        "deimos: scout.toml exists and is not overwritten; choose another name, or add --force.\n"
    )
    assert cli.main(["robot", "new", "scout.xml", "--out", "other.toml"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "other.toml"
    assert (page / "scout.toml").read_text() == before
    assert cli.main(["robot", "new", "scout.xml", "--force"]) == 0
    assert (page / "scout.toml").read_text() == (page / "other.toml").read_text() != before


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["check", "nobody"], "deimos.sim.legged.robots has no 'nobody'; it has: go1, go1_rx150."),
        (["check", "none.toml"], "robot must be a name or a robot file, but there is no none.toml."),
        (["check", "none.xml"], "mjcf must be an MJCF file, but there is no none.xml."),
        (["check", "scout.toml", "--held", "a"], "held is for an MJCF; a robot file names the joints that it holds."),
        (["check", "scout.toml", "--picture", "a.jpg"], "picture must end in .png, got a.jpg."),
        (["check", "scout.toml", "--picture", "no/a.png"], "The folder no does not exist; make it first."),
        (["new", "none.xml"], "mjcf must be an MJCF file, but there is no none.xml."),
        (["new", "scout.xml", "--held", "tail"], "held must name joints of scout.xml, which has no 'tail'."),
        (
            ["new", "scout.xml", "--out", "../a.toml"],
            "out must be a .toml file in the folder of scout.xml, got ../a.toml.",
        ),
    ],
)
def test_bad_requests_end_in_one_line(page, monkeypatch, capsys, arguments, line):
    """What cannot be checked or drafted is said in one line, with exit code 2, before any work is done."""
    monkeypatch.chdir(page)
    (page / "scout.toml").rename(page / "kept.toml") if arguments[0] == "new" else None
    assert cli.main(["robot", *arguments]) == 2
    assert capsys.readouterr() == ("", f"deimos: {line}\n")


@pytest.mark.parametrize("is_picture", [True, False])
def test_a_file_that_no_check_has_drawn_stays(page, monkeypatch, capsys, is_picture):
    """A texture of the robot's own, say, or what only ends in .png, is not overwritten."""
    monkeypatch.chdir(page)
    monkeypatch.setattr(robot, "check_robot", lambda *args: pytest.fail("checked in vain"))
    Image.new("RGB", (4, 4)).save("scout.png") if is_picture else Path("scout.png").write_text("a note")
    before = Path("scout.png").read_bytes()
    assert cli.main(["robot", "check", "scout.toml"]) == 2
    line = "scout.png exists and is not overwritten: it is not a picture of a check; choose another --picture."
    assert capsys.readouterr().err == f"deimos: {line}\n"
    assert Path("scout.png").read_bytes() == before
