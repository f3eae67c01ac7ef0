"""The data file of a robot: read as it is written, refused with a reason, kept by a run."""

import dataclasses
import io
import re
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from deimos.terrain import Grid, Share
from deimos.terrain.shapes.flat import Shape as Flat
from robot_models import write_mule, write_scout

from deimos import terrain
from deimos.app import cli
from deimos.run.branch import check_branch
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import quad
from deimos.sim.legged import mjcf, robot_draft, robot_file

SMALL = "--num-envs 16 --env-steps 48 --ppo.hidden 8 --env.goal-period 8 --threads 1 --no-evaluation".split()


@pytest.fixture
def scout(tmp_path):
    """A robot file beside the page's MJCF."""
    path = tmp_path / "scout.toml"
    path.write_text(robot_file.to_toml(robot_draft.draft(write_scout(tmp_path))[0]))
    return path


def test_a_file_is_read_as_it_is_written(scout):
    """What is drafted comes back from its file, and a single number stands for three."""
    drafted = robot_draft.draft(scout.with_suffix(".xml"))[0]
    with robot_file.opened(scout) as (read, folder):
        assert (read, folder) == (drafted, scout.parent)
    text = re.sub(r"stiffness = .*", "stiffness = 21", scout.read_text())
    scout.write_text(text)
    with robot_file.opened(scout) as (read, _):
        assert read.stiffness == (21.0,) * 3
        robot = read.build(scout.parent, damping=0.9)
    assert {(joint.stiffness, joint.damping) for joint in robot.joints} == {(21.0, 0.9)}


def test_the_order_of_legs_is_always_the_same(scout):
    """Whatever the order of the tables in the file, policies get front left, front right, rear left, rear right."""
    head, *tables = re.split(r"(?m)^(?=\[)", scout.read_text())
    assert len(tables) == 4
    scout.write_text(head + "".join(reversed(tables)))
    with robot_file.opened(scout) as (read, folder):
        names = [joint.name for joint in read.build(folder).joints]
    assert [name[-2:] for name in names] == [side for side in ("fl", "fr", "rl", "rr") for _ in range(3)]


FILES = {
    'mjcf = "scout.xml"': [
        ('mjcf = "none.xml"', "mjcf must be an MJCF file, but there is no .*none.xml"),
        ("mjcf = 3", "mjcf must be the path of a file, got 3"),
        ("", "it lacks mjcf; deimos robot new MODEL.xml writes a file to start from"),
        ('mjcf = "scout.xml"\nmass = 3', "it has 'mass', but may have only mjcf, stiffness, .*, rear_right"),
        ("mjcf = ", "Invalid value"),
    ],
    "stiffness = .*": [
        ("stiffness = -1", "stiffness must be finite and positive, got -1"),
        ("stiffness = [1, 2]", r"stiffness must be a number or three numbers, got \[1, 2\]"),
        ('stiffness = "stiff"', "stiffness must be a number or three numbers, got 'stiff'"),
    ],
    'joints = ."abduct_fl.*': [
        ('joints = ["abduct_fl", "swing_fl"]', r"front_left.joints must be 3 names, got \['abduct_fl', 'swing_fl'\]"),
        ('joints = ["swing_fl", "abduct_fl", "knee_fl"]', r"front_left.joints must be \['abduct_fl', 'swing_fl', 'kn"),
    ],
    'feet = ."pad_fl.*': [
        ('feet = ["paw"]', "front_left.feet must name geoms that collide on shoulder_fl, .*, pad_fl, .*got 'paw'"),
        ("feet = []", "front_left.feet must name at least one geom of"),
        ("feet = 3", "front_left.feet must be a list of names, got 3"),
    ],
    "pose = .*": [
        ("pose = [0, 3.0, -1]", r"front_left.pose of 'swing_fl' must be within \(-1.2, 2.4\) rad, got 3"),
        ("pose = 1", "front_left.pose must be three numbers, got 1"),
        ("colour = 1", r"\[front_left\] has 'colour', but may have only joints, feet, pose"),
    ],
    "held = .*": [('held = ["tail"]', "held must name joints of .*scout.xml, which has no 'tail'")],
}  # fmt: skip


@pytest.mark.parametrize(
    ("line", "change", "message"), [(line, *case) for line, cases in FILES.items() for case in cases]
)
def test_a_broken_file_is_refused(scout, line, change, message):
    """One line names the field, what it must be and what it was."""
    text, count = re.subn(f"^{line}$", change, scout.read_text(), count=1, flags=re.MULTILINE)
    assert count
    scout.write_text(text.replace("  # [N m/rad] of hip, thigh and calf", ""))
    with pytest.raises(ValueError, match=message) as error:
        quad.Config(robot=str(scout)).make_robot()
    assert "\n" not in str(error.value)


def test_a_damaged_copy_of_a_robot_is_refused(tmp_path):
    """Whatever damage makes the archive's reader raise, here a mark of encryption, it is one ValueError."""
    path = tmp_path / "robot.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("robot.toml", "")
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"is not a run's copy of a robot: .* is encrypted"), robot_file.opened(path):
        pass


def test_a_run_keeps_its_robot(tmp_path, capsys):
    """Data file, MJCF, includes and meshes are kept in one file; the run goes on from it, bit for bit, without them.

    A branch may name either.
    """
    home = tmp_path / "home"
    home.mkdir()
    file = home / "mule.toml"
    file.write_text(robot_file.to_toml(robot_draft.draft(write_mule(home), ("nod",))[0]))
    assert robot_file.pack(file) == robot_file.pack(file)
    flags = ["train", "env:quad", "--env.robot", str(file), *SMALL]
    assert cli.main([*flags, "--out", str(tmp_path / "run")]) == 0
    flags[flags.index("--env-steps") + 1] = "96"
    assert cli.main([*flags, "--out", str(tmp_path / "straight")]) == 0
    check_branch(*[TrainConfig(env=quad.Config(robot=str(each))) for each in (file, tmp_path / "run" / "robot.zip")])
    shutil.rmtree(home)
    with zipfile.ZipFile(tmp_path / "run" / "robot.zip") as archive:
        assert sorted(archive.namelist()) == ["assets/bone.stl", "legs.xml", "mule.xml", "robot.toml"]
    assert cli.main(["train", "--resume", str(tmp_path / "run"), "--env-steps", "96"]) == 0
    rows = [RunFolder(tmp_path / name).read_csv("progress.csv") for name in ("run", "straight")]
    assert len(rows[0]) == 4
    assert rows[0] == rows[1]
    (tmp_path / "run" / "robot.zip").write_bytes(b"nothing")
    capsys.readouterr()
    assert cli.main(["train", "--resume", str(tmp_path / "run"), "--env-steps", "144"]) == 2
    assert "is not a run's copy of a robot" in capsys.readouterr().err


def test_a_robot_that_no_run_could_keep_is_refused(tmp_path):
    """Files named by absolute paths would stay behind when a run moves; a folder beside goes along."""
    home, shared = tmp_path / "home", tmp_path / "shared"
    home.mkdir()
    path = write_mule(home)
    (home / "assets").rename(shared)
    file, text = home / "mule.toml", path.read_text()
    for folder in (shared.as_posix(), "../shared"):
        path.write_text(text.replace('meshdir="assets"', f'meshdir="{folder}"'))
        file.write_text(robot_file.to_toml(robot_draft.draft(path, ("nod",))[0]))
        if folder == "../shared":
            with zipfile.ZipFile(io.BytesIO(robot_file.pack(file))) as archive:
                assert "shared/bone.stl" in archive.namelist()
        else:
            with pytest.raises(
                ValueError, match=r"mjcf must name its files by relative paths, .* names .*shared/bone.stl"
            ):
                robot_file.pack(file)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--env.robot", "none.toml"], "robot must be a name or a robot file, but there is no none.toml."),
        (["--env.robot", "scout.toml", "--threads", "-1"], "threads must be in [0, 4096], got -1."),
        (
            ["--env.robot", "scout.toml", "--env.terrain", "fine.npz"],
            "terrain must have cells of at least 0.05 m under",
        ),
        (
            ["--env.robot", "light.toml"],
            "payload must be less than the 0.9 kg of 'chassis', since it is also subtracted, got 1; use --env.pa",
        ),
        (["--env.robot", "scout.toml", "--num-envs", "2000000000"], "2000000000 worlds, each at least "),
        (["--env.robot", "bad.toml"], "joint 'abduct_rr' of body 'shoulder_rr' must have a range of angles; give it"),
        (
            ["--env.robot", "scout.xml"],
            "robot must be a name or the path of a robot file, got 'scout.xml'; make a robot ",
        ),
    ],
)
def test_bad_input_of_a_training_ends_in_one_line(scout, monkeypatch, capsys, arguments, line):
    """A robot, a terrain, a number of worlds or of threads that cannot be are refused in a line, and no run is left."""
    monkeypatch.chdir(scout.parent)
    shape = Share(shape=Flat(tile=2.0, platform=1.0))
    terrain.build(Grid(shapes=(shape,), levels=1, columns=1, tile=2.0, border=1.0, cell=0.025)).save("fine.npz")
    Path("bad.toml").write_text(scout.read_text().replace("scout.xml", "bad.xml"))
    Path("bad.xml").write_text(Path("scout.xml").read_text().replace('range="-0.7 0.7"', ""))
    Path("light.toml").write_text(scout.read_text().replace("scout.xml", "light.xml"))
    Path("light.xml").write_text(Path("scout.xml").read_text().replace('mass="4.5"', 'mass="0.9"'))
    assert cli.main(["train", "env:quad", *SMALL, *arguments, "--out", "run"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"deimos: {line}")
    assert said.count("\n") == 1
    assert not Path("run").exists()


def test_the_task_has_the_robots_numbers(scout, torch_device):
    """Ranges of actions, masses and heights of the worlds are those of the data file, and gains can be changed."""
    env = quad.Config(robot=str(scout), stiffness=33.0, terrain="flat").build(4, torch_device, 0)
    assert {joint.stiffness for joint in env.robot.joints} == {33.0}
    low, _ = env.action_range
    np.testing.assert_allclose(low[0] * 0.25, -0.7, rtol=1e-5)
    step = env.step(torch.zeros(4, 12, device=torch_device))
    assert bool(step.obs.isfinite().all())
    assert dataclasses.asdict(env.config)["robot"] == str(scout)
    assert mjcf.read(scout.with_suffix(".xml")).model.body_mass.sum() == pytest.approx(
        env.physics.model.body_mass.sum(), abs=1e-9
    )
