"""A robot from an MJCF that is not ours: what is read, what is built of it, and which models are refused."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from robot_models import write_mule, write_scout

from deimos.sim.legged import robot_draft
from deimos.sim.legged.robots import COLLISION_GROUP, ROBOT_BIT, TERRAIN_BIT

MODELS = {"scout": (write_scout, ()), "mule": (write_mule, ("nod",))}


@pytest.fixture(params=MODELS)
def model(request, tmp_path):
    """The path of an MJCF and the joints that its robot holds."""
    write, held = MODELS[request.param]
    return write(tmp_path), held


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


SERVO = '<{} joint="{}" gear="2" {}/>'
SHARED = {
    "alone": ('kp="10" kv="0.5"', None, (40.0, 2.0)),
    "with a velocity actuator": ('kp="10"', 'kv="0.3" ctrlrange="-1 1"', (40.0, 1.2)),
    "a velocity actuator alone": (None, 'kv="0.3" ctrlrange="-20 20"', None),
}


@pytest.mark.parametrize("case", SHARED)
def test_gains_of_two_actuators_add_up(tmp_path, case):
    """A joint's servo may be a position actuator and one of velocity, whose bound of speed limits no torque."""
    position, velocity, gains = SHARED[case]
    path = write_scout(tmp_path)

    def servos(motor):
        kinds = (("position", position), ("velocity", velocity))
        return "".join(SERVO.format(kind, motor[1], numbers) for kind, numbers in kinds if numbers)

    path.write_text(re.sub(r'<motor joint="(\w+)"/>', servos, path.read_text()))
    robot, notes = robot_draft.draft(path)
    guessed = {note.split()[0] for note in notes if "is a guess" in note}
    assert guessed == {"pose", "max_torque", *(() if gains else ("stiffness", "damping"))}
    if gains:
        assert robot.stiffness == pytest.approx([gains[0]] * 3)
        assert robot.damping == pytest.approx([gains[1]] * 3)


def test_pieces_of_a_geom_have_names_of_their_own(tmp_path):
    """Where another geom is called as a piece would be, both are there, and both are watched."""
    path = write_scout(tmp_path)
    ball = '<geom name="shell_0" size="0.03" pos="0.2 0 0" mass="0"/><geom name="shell"'
    path.write_text(path.read_text().replace('<geom name="shell"', ball))
    robot = robot_draft.draft(path)[0].build(tmp_path)
    compiled = robot.spec.compile()
    base = robot.parts[0]
    assert len(set(base)) == len(base)
    assert compiled.geom("shell_0").type == mujoco.mjtGeom.mjGEOM_SPHERE
    on_base = [i for i in range(compiled.ngeom) if compiled.geom_bodyid[i] == 1 and compiled.geom_contype[i]]
    assert {compiled.geom(i).name for i in on_base} <= set(base)
    assert len(on_base) > 2


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


CORNERS = {"rr": (-0.2, -0.1), "rl": (-0.2, 0.1), "fr": (0.2, -0.1), "fl": (0.2, 0.1)}


def link(name, origin, mass):
    """A link of a URDF, with a ball that collides."""
    place = f'<origin xyz="{origin}"/>' if origin else ""
    inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    ball = f'<collision>{place}<geometry><sphere radius="0.03"/></geometry></collision>'
    return f'<link name="{name}"><inertial><mass value="{mass}"/>{inertia}</inertial>{ball}</link>'


def urdf_leg(leg):
    """Three links and three joints of a URDF."""
    (x, y), parent, parts = CORNERS[leg], "base", []
    limits = {"1": (-0.7, 0.7), "2": (-1.2, 2.4), "3": (-2.5, -0.4)}
    for part, (axis, xyz) in zip(
        "123", (("1 0 0", f"{x} {y} 0"), ("0 1 0", "0 0 0"), ("0 1 0", "0 0 -0.14")), strict=True
    ):
        low, high = limits[part]
        parts.append(link(leg + part, "0 0 -0.14", 0.3))
        parts.append(
            f'<joint name="{leg}{part}" type="revolute"><parent link="{parent}"/><child link="{leg}{part}"/><origin '
            f'xyz="{xyz}"/><axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="9" velocity="9"/></joint>'
        )
        parent = leg + part
    return "".join(parts)


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
    ("</worldbody>", "</worldbody><tendon><spatial><site site='s'/></spatial></tendon>", "MuJoCo loads, but .* fails"),
    ('pos="0.14 0.06', 'pos="-0.2 0.06', "base's frame must have x to the front and y to the left"),
    ('class="pad"><geom', 'class="pad"><geom contype="0" conaffinity="0"', None),
    ('0 0" mass="0.35"', '0 0" mass="0"', "mass and inertia of moving bodies must be larger .*'shoulder_rr'"),
    ("<worldbody>", "<worldbodies>", "must be a file that MuJoCo loads, but .* fails: XML"),
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


def test_a_urdf_is_refused_with_what_converts_it(tmp_path, monkeypatch, capsys):
    """What the message says makes an MJCF of a URDF, with a base that floats and all of its weight."""
    monkeypatch.chdir(tmp_path)
    Path("robot.urdf").write_text(f"<robot name='r'>{link('base', None, 4.0)}{''.join(map(urdf_leg, CORNERS))}</robot>")
    with pytest.raises(
        ValueError, match=r"mjcf must be an MJCF file, got robot\.urdf; convert it in Python: "
    ) as error:
        robot_draft.draft(Path("robot.urdf"))
    exec(str(error.value).partition("in Python: ")[2], {})
    Path("robot.xml").write_text(capsys.readouterr().out)
    robot, _ = robot_draft.draft(Path("robot.xml"))
    assert [leg.joints[0] for leg in robot.legs] == ["fl1", "fr1", "rl1", "rr1"]
    assert robot.max_torque == (9.0,) * 3
    assert robot.build(tmp_path).spec.compile().body_mass.sum() == pytest.approx(4.0 + 4 * 0.9)


def test_the_base_is_not_held(tmp_path):
    """A robot whose own free joint is to be held is told so in a line."""
    path = write_scout(tmp_path)
    path.write_text(path.read_text().replace("<freejoint/>", '<freejoint name="root"/>'))
    with pytest.raises(ValueError, match="held must name joints of a head, tail or arm, but 'root' is the base's free"):
        robot_draft.draft(path, ("root",))


def test_looks_that_weigh_are_named(tmp_path):
    """A geom that touches nothing and makes its body heavier is told of where the body has no inertial of its own."""
    path = write_scout(tmp_path)
    path.write_text(
        path.read_text().replace("<freejoint/>", '<freejoint/><geom name="lid" size=".1" contype="0" conaffinity="0"/>')
    )
    assert any("geom 'lid' touches nothing but adds to the weight" in note for note in robot_draft.draft(path)[1])


LEFT_OUT = {
    "gravcomp": (
        '<body name="upper_', '<body gravcomp="0.5" name="upper_',
        "gravcomp of body 'upper_rr', 'upper_rl', 'upper_fr', 'upper_fl' is left out: gravity acts on all of its mass",
    ),
    "delay": (
        '<motor joint="knee_fl"/>', '<motor joint="knee_fl" delay="0.01" nsample="4"/>',
        "the delay of the actuator of joint 'knee_fl' is left out: its torque is immediate",
    ),
    "timeconst": (
        '<motor joint="knee_fl"/>', '<general joint="knee_fl" dyntype="filter" dynprm="0.1" ctrlrange="-9 9"/>',
        "the activation (timeconst, dyntype) of the actuator of joint 'knee_fl' is left out: it acts at once",
    ),
    "jet": (
        "<actuator>", '<actuator><adhesion name="glue" body="lower_fl" ctrlrange="0 1" gain="3"/>',
        "actuator 'glue' is left out because it acts on no joint",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", LEFT_OUT)
def test_what_is_left_out_is_said(tmp_path, what):
    """What moves the robot in the file and is not simulated is a note; the robot itself is as without it."""
    path = write_scout(tmp_path)
    plain, notes = robot_draft.draft(path)
    old, new, note = LEFT_OUT[what]
    path.write_text(path.read_text().replace(old, new))
    robot, more = robot_draft.draft(path)
    assert robot == plain
    assert more == [note, *notes]


def test_what_a_held_joint_loses_is_not_said(tmp_path):
    """An actuator of a joint that is held moves nothing, whatever it has."""
    path = write_mule(tmp_path)
    path.write_text(path.read_text().replace('class="mule" joint="nod"', 'class="mule" joint="nod" timeconst="0.1"'))
    assert robot_draft.draft(path, ("nod",))[1] == []
