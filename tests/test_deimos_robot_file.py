"""A robot from an MJCF that is not ours and one data file: what is read, what is built of it, what is refused."""

import dataclasses
import re
import shutil
import zipfile
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from deimos.terrain import Grid, Share
from deimos.terrain.shapes.flat import Shape as Flat
from deimos.terrain.shapes.stairs import Shape as Stairs
from scipy.spatial.transform import Rotation

from deimos import terrain
from deimos.app import cli
from deimos.run.branch import check_branch
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import quad
from deimos.sim.legged import engines, mjcf, robot_draft, robot_file
from deimos.sim.legged.capsules import fill
from deimos.sim.legged.engines import PhysicsConfig
from deimos.sim.legged.robots import COLLISION_GROUP, ROBOT_BIT, TERRAIN_BIT, go1

PAGE = Path(__file__).parent.parent / "docs" / "add_a_robot.md"
SMALL = "--num-envs 16 --env-steps 48 --ppo.hidden 8 --env.goal-period 8 --threads 1 --no-evaluation".split()

# As models of MuJoCo Menagerie are: classes, an included file, meshes for looks, position actuators, a keyframe. The
# neck is one joint too many, the feet are on bodies of their own, and hip and thigh of a leg move one body.
MULE = """
<mujoco model="mule">
  <compiler angle="radian" meshdir="assets"/>
  <default>
    <default class="mule">
      <joint damping="0.1" armature="0.01" frictionloss="0.05"/>
      <position kp="60" kv="1.5" forcerange="-40 40"/>
      <default class="looks"><geom type="mesh" contype="0" conaffinity="0" mass="0" rgba="0.2 0.3 0.4 1"/></default>
      <default class="hit"><geom group="3" mass="0"/></default>
    </default>
  </default>
  <asset><mesh name="bone" file="bone.stl" scale="0.001 0.001 0.001"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="body" pos="0 0 0.5" childclass="mule">
      <freejoint name="root"/>
      <inertial mass="9" pos="0.01 0 0.02" quat="0.9 0.1 0.2 0.3" diaginertia="0.05 0.2 0.22"/>
      <geom class="looks" mesh="bone"/>
      <geom class="hit" name="barrel" type="ellipsoid" size="0.25 0.12 0.1"/>
      <geom class="hit" name="saddle" type="mesh" mesh="bone" pos="0.05 0 0.1"/>
      <body name="neck" pos="0.3 0 0.05">
        <joint name="nod" axis="0 1 0" range="-1 1"/><geom size="0.05" mass="0.4"/>
      </body>
      <include file="legs.xml"/>
    </body>
  </worldbody>
  <actuator>{actuators}<position class="mule" joint="nod"/></actuator>
  <sensor><jointpos joint="nod"/><touch site="hoof_hl"/></sensor>
  <keyframe><key name="home" qpos="0 0 0.5 1 0 0 0 0 {pose}"/></keyframe>
</mujoco>
"""
MULE_LEG = """
<body name="thigh_{leg}" pos="{x} {y} 0" quat="0.99 0.01 0.02 0.1">
  <inertial mass="1.1" pos="0 0.01 -0.08" diaginertia="0.006 0.005 0.002"/>
  <joint name="{leg}1" axis="1 0 0" range="-0.6 0.6"/><joint name="{leg}2" axis="0 -1 0" range="-2.4 1.0"/>
  <geom class="looks" mesh="bone"/><geom class="hit" type="box" size="0.02 0.03 0.1" pos="0 0 -0.11"/>
  <body name="shank_{leg}" pos="0 0 -0.23">
    <inertial mass="0.3" pos="0.01 0 -0.1" diaginertia="0.001 0.001 0.0001"/>
    <joint name="{leg}3" axis="0 -1 0" range="0.5 2.6"/>
    <geom class="hit" type="cylinder" size="0.012 0.08" pos="0 0 -0.1"/>
    <body name="hoof_{leg}" pos="0 0 -0.22">
      <geom class="hit" size="0.025" mass="0.05"/><site name="hoof_{leg}" size="0.03"/>
    </body>
  </body>
</body>
"""
MULE_LEGS = {"hl": (-0.22, 0.11), "fr": (0.22, -0.11), "fl": (0.22, 0.11), "hr": (-0.22, -0.11)}


def write_scout(folder):
    """The model of the page."""
    text = re.search(r"```xml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    (folder / "scout.xml").write_text(text)
    return folder / "scout.xml"


def write_mule(folder):
    """The other model, its legs in another order in the file, its actuators in a third."""
    (folder / "assets").mkdir()
    trimesh.creation.box((50, 60, 200)).export(folder / "assets" / "bone.stl")
    legs = [MULE_LEG.format(leg=leg, x=x, y=y) for leg, (x, y) in MULE_LEGS.items()]
    (folder / "legs.xml").write_text(f"<mujoco>{''.join(legs)}</mujoco>")
    actuators = [f'<position class="mule" joint="{leg}{i}"/>' for i in (3, 1, 2) for leg in ("fr", "hl", "hr", "fl")]
    pose = " ".join(["0.05 -0.8 1.5"] * 4)
    (folder / "mule.xml").write_text(MULE.format(actuators="".join(actuators), pose=pose))
    return folder / "mule.xml"


MODELS = {"scout": (write_scout, ()), "mule": (write_mule, ("nod",))}


@pytest.fixture(params=MODELS)
def model(request, tmp_path):
    """The path of an MJCF and the joints that its robot holds."""
    write, held = MODELS[request.param]
    return write(tmp_path), held


@pytest.fixture
def scout(tmp_path):
    """A robot file beside the page's MJCF."""
    return write_file(*robot_draft.draft(write_scout(tmp_path)), tmp_path / "scout.toml")


def write_file(robot, notes, path):
    path.write_text(robot_file.to_toml(robot))
    return path


def test_legs_are_in_the_order_of_the_task(model):
    """Whatever the order in the file, joints are those of front left, front right, rear left, rear right, hip first."""
    path, held = model
    robot = robot_draft.draft(path, held)[0].build(path.parent)
    legs = {"scout": ("fl", "fr", "rl", "rr"), "mule": ("fl", "fr", "hl", "hr")}[path.stem]
    pattern = {"scout": ("abduct_{}", "swing_{}", "knee_{}"), "mule": ("{}1", "{}2", "{}3")}[path.stem]
    compiled = robot.spec.compile()
    names = [part.format(leg) for leg in legs for part in pattern]
    assert [joint.name for joint in robot.joints] == names
    assert [compiled.joint(i).name for i in range(compiled.njnt)] == ["base", *names]
    assert [compiled.actuator(i).name for i in range(compiled.nu)] == names
    assert (compiled.nq, compiled.nv, compiled.nsensor, compiled.nkey) == (19, 18, 0, 0)


def test_the_copy_moves_as_its_source(model):
    """In free flight, the same accelerations follow from the same state and torques as in the MJCF itself."""
    path, held = model
    robot = robot_draft.draft(path, held)[0].build(path.parent)
    source, ours = mujoco.MjModel.from_xml_path(str(path)), robot.spec.compile()
    names = [joint.name for joint in robot.joints]
    theirs, data, rng = mujoco.MjData(source), mujoco.MjData(ours), np.random.default_rng(0)
    for option in (source.opt, ours.opt):
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    for dof in [source.joint(name).dofadr[0] for name in held]:  # a joint that hardly moves is one that is held
        source.dof_armature[dof] = 1e9
    for _ in range(20):
        turn = rng.normal(size=4)
        data.qpos[:7] = [0.1, 0.2, 3.0, *(turn / np.linalg.norm(turn))]
        data.qvel[:] = rng.normal(size=18)
        applied = rng.normal(scale=3.0, size=12)
        data.qpos[7:] = rng.uniform(*np.array([joint.range for joint in robot.joints]).T)
        data.qfrc_applied[6:] = applied
        theirs.qpos[:7], theirs.qvel[:6] = data.qpos[:7], data.qvel[:6]
        for i, name in enumerate(names):
            theirs.joint(name).qpos, theirs.joint(name).qvel = data.qpos[7 + i], data.qvel[6 + i]
            theirs.qfrc_applied[source.joint(name).dofadr[0]] = applied[i]
        for each, its in ((source, theirs), (ours, data)):
            mujoco.mj_forward(each, its)
        found = np.concatenate([theirs.qacc[:6], [theirs.joint(name).qacc[0] for name in names]])
        # A held joint gives way by 1e-9 of its torque.
        np.testing.assert_allclose(data.qacc, found, rtol=1e-6, atol=1e-6)
    for name in names:
        np.testing.assert_array_equal(source.joint(name).range, ours.joint(name).range)
        assert source.joint(name).frictionloss[0] == ours.joint(name).frictionloss[0]


def test_what_collides_touches_the_terrain_alone(model):
    """Spheres and capsules take the place of all that collides; feet have friction, and every piece is watched."""
    path, held = model
    robot = robot_draft.draft(path, held)[0].build(path.parent)
    compiled = robot.spec.compile()
    hard = [i for i in range(compiled.ngeom) if compiled.geom_contype[i] or compiled.geom_conaffinity[i]]
    kinds = {mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE}
    assert {mujoco.mjtGeom(int(compiled.geom_type[i])) for i in hard} <= kinds
    assert {compiled.geom_group[i] for i in hard} == {COLLISION_GROUP}
    assert set(compiled.geom_contype[hard]) == {ROBOT_BIT}
    assert set(compiled.geom_conaffinity[hard]) == {TERRAIN_BIT}
    assert sorted(compiled.geom(i).name for i in hard) == sorted(name for part in robot.parts for name in part)
    feet = {name for part in robot.parts[1:5] for name in part}
    assert all((compiled.geom_condim[i] == 3) == (compiled.geom(i).name in feet) for i in hard)
    assert len(feet) == 4
    assert any(i not in hard for i in range(compiled.ngeom))


def test_a_mesh_that_collides_is_filled_where_it_is(tmp_path):
    """Capsules take the place of a mesh, in its place, whatever frame MuJoCo has turned it into."""
    robot = robot_draft.draft(write_mule(tmp_path), ("nod",))[0].build(tmp_path)
    compiled = robot.spec.compile()
    data = mujoco.MjData(compiled)
    data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
    mujoco.mj_kinematics(compiled, data)
    pieces = [compiled.geom(name).id for name in robot.parts[0] if name.startswith("saddle")]
    assert pieces
    radius, half = compiled.geom_size[pieces, :2].T
    reach = np.abs(data.geom_xmat[pieces].reshape(-1, 3, 3)[:, :, 2]) * half[:, None] + radius[:, None]
    low, high = (data.geom_xpos[pieces] - reach).min(axis=0), (data.geom_xpos[pieces] + reach).max(axis=0)
    # The mesh is a box of (50, 60, 200) mm; of its 60 mm the capsules leave out 5 mm on either side.
    np.testing.assert_allclose(low, [0.025, -0.025, 0.0], atol=1e-6)
    np.testing.assert_allclose(high, [0.075, 0.025, 0.2], atol=1e-6)


def test_heights_are_those_of_the_legs(model):
    """The robot stands on its feet at the standing height, and whatever a reset draws, no leg is in the ground."""
    path, held = model
    robot = robot_draft.draft(path, held)[0].build(path.parent)
    compiled = robot.spec.compile()
    data, rng = mujoco.MjData(compiled), np.random.default_rng(0)
    low, high = np.array([joint.range for joint in robot.joints]).T

    def lowest(height, angles):
        data.qpos[:] = [0, 0, height, 1, 0, 0, 0, *np.clip(angles, low, high)]
        mujoco.mj_forward(compiled, data)
        feet = [compiled.geom(name).id for part in robot.parts[1:5] for name in part]
        assert np.abs(data.geom_xpos[feet, :2]).max() < robot.reach
        return min(data.geom_xpos[i, 2] - compiled.geom_size[i, 0] for i in feet)

    pose = np.array(robot.pose)
    assert lowest(robot.standing_height, pose) == pytest.approx(0.0, abs=1e-9)
    drawn = [lowest(robot.spawn_height, pose * rng.uniform(0.5, 1.5, 12)) for _ in range(1000)]
    assert 0.0 < min(drawn) < 0.06


def test_a_draft_says_what_the_model_says(tmp_path):
    """Pose, gains and limits come from the keyframe and the actuators where there are any, and nothing is guessed."""
    robot, notes = robot_draft.draft(write_mule(tmp_path), ("nod",))
    assert notes == []
    assert (robot.stiffness, robot.damping, robot.max_torque) == ((60.0,) * 3, (1.5,) * 3, (40.0,) * 3)
    assert {leg.pose for leg in robot.legs} == {(0.05, -0.8, 1.5)}
    assert robot.rear_left.feet == ("hoof_hl_geom0",)
    robot, notes = robot_draft.draft(write_scout(tmp_path))
    assert [note.split()[0] for note in notes] == ["pose", "stiffness", "damping"]
    assert robot.max_torque == (9.0,) * 3
    path = write_scout(tmp_path)
    path.write_text(path.read_text().replace('joint="knee_rr"/>', 'joint="knee_rr" ctrlrange="-12 12"/>'))
    robot, notes = robot_draft.draft(path)
    assert robot.max_torque == (9.0,) * 3
    assert any("the MJCF has others for other legs; write what suits all four" in note for note in notes)


def test_what_has_no_name_is_named_after_its_joint(tmp_path):
    """The draft of a model whose bodies and geoms have no names reads as the one with names, and builds."""
    path = write_scout(tmp_path)
    path.write_text(re.sub(r'<body name="\w+"', "<body", path.read_text()).replace('name="pad_fl"', ""))
    robot = robot_draft.draft(path)[0]
    assert robot.front_left.feet == ("knee_fl_geom1",)
    assert robot.front_right.feet == ("pad_fr",)
    assert robot.build(tmp_path).parts[1] == ("knee_fl_geom1",)


@pytest.mark.parametrize("knee", [-1, 1])
def test_a_guessed_pose_stands_over_its_feet(tmp_path, knee):
    """Without a keyframe the feet are below the thighs' joints, the legs bent, whichever way the knees turn."""
    path = write_scout(tmp_path)
    if knee > 0:
        text = path.read_text().replace('range="-2.5 -0.4"', 'range="0.4 2.5"').replace('"-1.2 2.4"', '"-2.4 1.2"')
        path.write_text(text)
    robot = robot_draft.draft(path)[0]
    hip, thigh, calf = robot.front_left.pose
    assert (hip, np.sign(calf)) == (0.0, knee)
    forward = -np.sin(thigh) - np.sin(thigh + calf)
    drop = (np.cos(thigh) + np.cos(thigh + calf)) / 2
    assert abs(0.14 * forward) < 0.01
    assert 0.6 < drop < 0.85


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


LEG = '<body><joint name="j{0}" axis="0 1 0" range="-1 1"/><geom size=".1"/></body>'
SIX = "".join(
    f'<body pos="{x} {y} 0"><joint name="a{x}{y}" range="-1 1"/><geom size=".1"/><body><joint name="b{x}{y}" '
    f'range="-1 1"/><geom size=".1"/><body><joint name="c{x}{y}" range="-1 1"/><geom size=".1"/></body></body></body>'
    for x in (-1, 0, 1) for y in (-1, 1)
)  # fmt: skip
BODIES = {
    "six legs": (SIX, "must have four legs of three hinges each.*found 6 chains.*with more or fewer legs are not supp"),
    "no legs": ("", "found 0 chains"),
    "short legs": (LEG.format(1), "found 1 chains of joints: j1"),
}


@pytest.mark.parametrize("name", BODIES)
def test_what_has_not_four_legs_is_refused(tmp_path, name):
    """A hexapod, a stone and a monopod are named for what they are."""
    legs, message = BODIES[name]
    text = f'<mujoco><worldbody><body name="b"><freejoint/><geom size=".1"/>{legs}</body></worldbody></mujoco>'
    (tmp_path / "robot.xml").write_text(text)
    with pytest.raises(ValueError, match=message):
        robot_draft.draft(tmp_path / "robot.xml")


CHANGES = [
    ("<freejoint/>", "", "must hold one body that floats, but .* has 0 free joints; put <freejoint/> .*'chassis'"),
    ('range="-0.7 0.7"', "", "joint 'abduct_rr' of body 'shoulder_rr' must have a range of angles"),
    ('<joint name="knee_fl"', '<joint name="knee_fl" type="slide"', "'knee_fl' of body 'lower_fl' must be a hinge"),
    ('name="abduct_fl" class="abduct"/>', 'name="abduct_fl" class="abduct"/> <joint name="more"/>', "found 4 chains"),
    ("</worldbody>", "</worldbody><equality><weld body1='lower_fl' body2='lower_fr'/></equality>", "equality constr"),
    ("</worldbody>", "</worldbody><tendon><spatial><site site='s'/></spatial></tendon>", "that MuJoCo loads, but of"),
    ('pos="0.14 0.06', 'pos="-0.2 0.06', "base's frame must have x to the front and y to the left"),
    ('class="pad"><geom', 'class="pad"><geom contype="0" conaffinity="0"', None),
    ('0 0" mass="0.35"', '0 0" mass="0"', "mass and inertia of moving bodies must be larger .*'shoulder_rr'"),
    ("<worldbody>", "<worldbodies>", "must be a file that MuJoCo loads, but of .* it says: XML"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), CHANGES)
def test_a_model_without_what_a_robot_needs_is_refused(tmp_path, old, new, message):
    """One line names the body or the joint and the way out."""
    path = write_scout(tmp_path)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    if message is None:  # the pads do not collide, so the lower legs are the feet
        assert robot_draft.draft(path)[0].front_left.feet == ("lower_fl_geom0",)
        path.write_text(
            path.read_text().replace('class="lower"><geom', 'class="lower"><geom contype="0" conaffinity="0"')
        )
        message = "body 'lower_fl' must have a geom that collides, its foot; give one a contype of 1"
    with pytest.raises(ValueError, match=message) as error:
        robot_draft.draft(path)
    assert "\n" not in str(error.value)


def test_looks_that_weigh_are_named(tmp_path):
    """A geom that touches nothing and makes its body heavier is told of where the body has no inertial of its own."""
    path = write_scout(tmp_path)
    path.write_text(
        path.read_text().replace("<freejoint/>", '<freejoint/><geom name="lid" size=".1" contype="0" conaffinity="0"/>')
    )
    assert any("geom 'lid' touches nothing and adds to the weight" in note for note in robot_draft.draft(path)[1])


@pytest.mark.parametrize(
    "half", [(0.02,) * 3, (0.015, 0.1, 0.015), (0.13, 0.09, 0.05), (0.4, 0.12, 0.1), (0.3, 0.3, 0.02)]
)
def test_capsules_fill_a_box(half):
    """No piece leaves the box or is larger than a height field bears, and they nearly reach every face of it."""
    pieces = fill(half)
    low = np.array([np.minimum(piece.start, piece.end) - piece.radius for piece in pieces])
    high = np.array([np.maximum(piece.start, piece.end) + piece.radius for piece in pieces])
    np.testing.assert_allclose(high.max(axis=0), -low.min(axis=0), atol=1e-12)
    assert (high.max(axis=0) <= np.array(half) + 1e-9).all()
    assert (high.max(axis=0) >= np.array(half) - 0.3 * min(half) - 1e-9).all()
    for piece in pieces:
        length = np.abs(np.subtract(piece.end, piece.start)).max() / 2 + piece.radius
        assert length <= 0.13 + 1e-9
        assert length * piece.radius <= 0.0065 + 1e-9


def test_a_go1s_trunk_is_filled_as_its_own_file_fills_it():
    """Of the trunk's box of (0.26, 0.18, 0.1) m become the two capsules of go1.py, which never lose a contact."""
    spec = go1.build().spec.compile()
    (left, right) = sorted(fill((0.13, 0.09, 0.05)), key=lambda piece: -piece.start[1])
    for piece, name in ((left, "trunk_left"), (right, "trunk_right")):
        geom = spec.geom(name)
        assert piece.radius == geom.size[0]
        np.testing.assert_allclose(geom.pos, np.add(piece.start, piece.end) / 2, atol=1e-9)
        np.testing.assert_allclose(geom.size[1], (piece.end[0] - piece.start[0]) / 2, atol=1e-9)


def test_pieces_lose_no_contact_on_stairs(tmp_path, torch_device):
    """On stairs at 64 yaws, on all six sides, the pieces of a large box cover no more prisms than are tested."""
    path = write_scout(tmp_path)
    path.write_text(path.read_text().replace('size="0.18 0.08 0.045"', 'size="0.3 0.15 0.12"'))
    robot = robot_draft.draft(path)[0].build(tmp_path)
    shape = Share(shape=Stairs(tile=4.0, platform=1.0))
    ground = terrain.build(Grid(shapes=(shape,), levels=1, columns=1, tile=4.0, border=1.0))
    sides = [(0, 0), (np.pi, 0), (np.pi / 2, 0), (-np.pi / 2, 0), (0, np.pi / 2), (0, -np.pi / 2)]  # roll, pitch
    angles = [(yaw, pitch, roll) for yaw in np.arange(64) * np.pi / 32 for roll, pitch in sides]
    quat = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
    n, rng = len(angles), np.random.default_rng(2)
    place = rng.uniform(-1.5, 1.5, (n, 2))
    i, j = np.round((place - ground.corner) / ground.cell).astype(int).T
    height = ground.heights[i, j] + 0.02
    physics = engines.build(
        "warp", robot, ground, n, torch_device, PhysicsConfig(substeps=1, contacts=400, rows=1200)
    )  # fmt: skip
    qpos = np.column_stack([place, height, quat, np.tile(robot.pose, (n, 1))])
    physics.arrays.qpos.assign(qpos.astype(np.float32))
    physics.step()
    assert not (physics.arrays.overflow.numpy() & physics.lost_contacts).any()
    pressed = physics.arrays.part_force.numpy()[0] > 0
    assert pressed[:, 0].mean() > 0.9, "nearly every robot's box must have been pressed on the ground"


def test_a_run_keeps_its_robot(tmp_path, capsys):
    """Data file, MJCF, includes and meshes are kept in one file; the run goes on from it, bit for bit, without them.

    A branch may name either.
    """
    home = tmp_path / "home"
    home.mkdir()
    path = write_mule(home)
    drafted, _ = robot_draft.draft(path, ("nod",))
    file = write_file(drafted, None, home / "mule.toml")
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
    assert "is not a robot that a run has kept" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--env.robot", "none.toml"], "robot must be a name or a robot file, but there is no none.toml."),
        (["--env.robot", "scout.toml", "--threads", "-1"], "threads must be in [0, 4096], got -1."),
        (
            ["--env.robot", "scout.toml", "--env.terrain", "fine.npz"],
            "terrain must have cells of at least 0.05 m under",
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
