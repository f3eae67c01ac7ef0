"""The Go1: masses, kinematics, actuators, and geoms that a height field can bear."""

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from deimos.terrain import Grid, Share, build, flat
from deimos.terrain.shapes.stairs import Shape as Stairs

from deimos import plugins
from deimos.sim.legged import engines, robots
from deimos.sim.legged.engines import PhysicsConfig
from deimos.sim.legged.engines.model import build_spec
from deimos.sim.legged.robots import COLLISION_GROUP, VISUAL_GROUP, go1


@pytest.fixture(scope="module")
def robot():
    """A Go1."""
    return go1.build()


@pytest.fixture(scope="module")
def model(robot):
    """Its compiled model."""
    return robot.spec.compile()


def pose_data(robot, model, joints=None):
    """The robot in a pose, at the origin."""
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *(robot.pose if joints is None else joints)]
    mujoco.mj_forward(model, data)
    return data


def test_mass_and_tree(model):
    """12.743 kg in a trunk and four legs of three joints, in Legged Gym's order."""
    # Every mass is rounded to a gram or better in its source.
    assert model.body_mass.sum() == pytest.approx(go1.MASS, abs=1e-3)
    assert (model.nbody, model.nq, model.nv, model.nu) == (14, 19, 18, 12)
    names = [f"{leg}_{joint}" for leg in ("FL", "FR", "RL", "RR") for joint in ("hip", "thigh", "calf")]
    assert [model.joint(i).name for i in range(1, 13)] == names
    assert [model.actuator(i).name for i in range(12)] == names
    assert model.actuator_trnid[:, 0].tolist() == list(range(1, 13))


# go1.xml of MuJoCo Menagerie, letter by letter: mass [kg], pos [m], quat, diaginertia [kg m^2].
SOURCE = {
    "trunk": (
        5.204, (0.0223, 0.002, -0.0005), (-0.00342088, 0.705204, 0.000106698, 0.708996),
        (0.0716565, 0.0630105, 0.0168101),
    ),
    "FR_hip": (
        0.68, (-0.0049166, 0.00762615, -8.865e-05), (0.507341, 0.514169, 0.495027, 0.482891),
        (0.000734064, 0.000468438, 0.000398719),
    ),
    "FL_hip": (
        0.68, (-0.0049166, -0.00762615, -8.865e-05), (0.482891, 0.495027, 0.514169, 0.507341),
        (0.000734064, 0.000468438, 0.000398719),
    ),
    "RR_hip": (
        0.68, (0.0049166, 0.00762615, -8.865e-05), (0.495027, 0.482891, 0.507341, 0.514169),
        (0.000734064, 0.000468438, 0.000398719),
    ),
    "RL_hip": (
        0.68, (0.0049166, -0.00762615, -8.865e-05), (0.514169, 0.507341, 0.482891, 0.495027),
        (0.000734064, 0.000468438, 0.000398719),
    ),
    **dict.fromkeys(("FR_thigh", "RR_thigh"), (
        1.009, (-0.00304722, 0.019315, -0.0305004), (0.65243, -0.0272313, 0.0775126, 0.753383),
        (0.00478717, 0.00460903, 0.000709268),
    )),
    **dict.fromkeys(("FL_thigh", "RL_thigh"), (
        1.009, (-0.00304722, -0.019315, -0.0305004), (0.753383, 0.0775126, -0.0272313, 0.65243),
        (0.00478717, 0.00460903, 0.000709268),
    )),
    **dict.fromkeys([f"{leg}_calf" for leg in ("FL", "FR", "RL", "RR")], (
        0.195862, (0.00429862, 0.000976676, -0.146197), (0.691246, 0.00357467, 0.00511118, 0.722592),
        (0.00149767, 0.00148468, 3.58427e-05),
    )),
}  # fmt: skip


def tensor(quat, principal):
    """An inertia in the axes of its body."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, np.array(quat) / np.linalg.norm(quat))
    axes = axes.reshape(3, 3)
    return axes @ np.diag(principal) @ axes.T


@pytest.mark.parametrize("name", SOURCE)
def test_bodies_are_those_of_the_source(model, name):
    """Mass, centre and the whole tensor of inertia of every body are Menagerie's own numbers."""
    mass, centre, quat, principal = SOURCE[name]
    body = model.body(name)
    assert body.mass[0] == mass
    np.testing.assert_allclose(body.ipos, centre, rtol=0, atol=1e-12)
    # Numbers of six digits, turned by quaternions of six digits.
    expected = tensor(quat, principal)
    np.testing.assert_allclose(tensor(body.iquat, body.inertia), expected, rtol=0, atol=1e-5 * principal[0])
    np.testing.assert_allclose(np.sort(body.inertia)[::-1], principal, rtol=1e-5)


def test_source_names_every_body(model):
    """No body but the world's is left out above."""
    assert set(SOURCE) == {model.body(i).name for i in range(1, model.nbody)}


def test_joints_are_those_of_the_source(model):
    """Ranges are Menagerie's, armatures a rotor of 1.11842e-4 kg m^2 behind gears of 6 and 9."""
    limits = [(-0.863, 0.863), (-0.686, 4.501), (-2.818, -0.888)]  # [rad]: hip, thigh, calf
    np.testing.assert_array_equal(model.jnt_range[1:], limits * 4)
    np.testing.assert_allclose(model.dof_armature[6:], [0.0040263, 0.0040263, 0.0090592] * 4, rtol=1e-5)
    assert not model.dof_armature[:6].any()
    np.testing.assert_array_equal(model.actuator_forcerange[:, 1], [23.7, 23.7, 35.55] * 4)
    places = {
        "FL_hip": (0.1881, 0.04675, 0.0), "FR_hip": (0.1881, -0.04675, 0.0), "RL_hip": (-0.1881, 0.04675, 0.0),
        "RR_hip": (-0.1881, -0.04675, 0.0), "FL_thigh": (0.0, 0.08, 0.0), "RR_thigh": (0.0, -0.08, 0.0),
        "FL_calf": (0.0, 0.0, -0.213), "RR_calf": (0.0, 0.0, -0.213),
    }  # fmt: skip
    for name, place in places.items():
        np.testing.assert_allclose(model.body(name).pos, place, rtol=0, atol=1e-12)


def test_robot_is_a_mirror_image(robot, model):
    """Mirrored at its length, the robot has the same masses in the same places, the trunk's own offset apart."""
    data = pose_data(robot, model)
    for end in ("F", "R"):
        for link in ("hip", "thigh"):
            left, right = (data.xipos[model.body(f"{end}{side}_{link}").id] for side in "LR")
            np.testing.assert_allclose(left * [1, -1, 1], right, atol=1e-12)
            a, b = (data.ximat[model.body(f"{end}{side}_{link}").id].reshape(3, 3) for side in "LR")
            inertia = np.diag(model.body(f"{end}L_{link}").inertia)
            mirror = np.diag([1, -1, 1])
            np.testing.assert_allclose(mirror @ a @ inertia @ a.T @ mirror, b @ inertia @ b.T, atol=1e-12)


def test_kinematics_of_the_default_pose(robot, model):
    """The feet stand where the two-link formula puts them, level, and the base is as high as the robot says."""
    data = pose_data(robot, model)
    thigh, calf, hip = 0.8, -1.5, 0.1
    drop = go1.LINK * (np.cos(thigh) + np.cos(thigh + calf))
    for i, leg in enumerate(go1.LEGS):
        left, front = (1 if leg[1] == "L" else -1), (1 if leg[0] == "F" else -1)
        foot = data.geom(f"{leg}_foot").xpos
        x = front * go1.HIP_X - go1.LINK * (np.sin(thigh) + np.sin(thigh + calf))
        y = left * (go1.HIP_Y + go1.THIGH_Y * np.cos(hip) + drop * np.sin(hip))
        z = go1.THIGH_Y * np.sin(hip) - drop * np.cos(hip)
        np.testing.assert_allclose(foot, [x, y, z], atol=1e-9, err_msg=str(i))
        assert -foot[2] + go1.FOOT_RADIUS == pytest.approx(robot.standing_height, abs=1e-3)


def test_spawn_height_keeps_every_foot_above_the_ground(robot, model):
    """With every joint anywhere between 0.5 and 1.5 of its pose, within its range, no geom reaches the ground."""
    rng = np.random.default_rng(0)
    pose, limits = np.array(robot.pose), model.jnt_range[1:]
    factors = rng.uniform(0.5, 1.5, size=(2000, 12))
    factors[:64, 1::3] = 0.5 + 0.01 * rng.random((64, 4))  # legs nearly straight
    factors[:64, 2::3] = 0.5
    lowest, reach = np.inf, 0.0
    for row in factors:
        data = pose_data(robot, model, np.clip(pose * row, limits[:, 0], limits[:, 1]))
        feet = np.array([data.geom(f"{leg}_foot").xpos for leg in go1.LEGS])
        lowest = min(lowest, robot.spawn_height + feet[:, 2].min() - go1.FOOT_RADIUS)
        reach = max(reach, np.abs(feet[:, :2]).max() + go1.FOOT_RADIUS)
    assert 0 < lowest < 0.05
    assert reach < robot.reach


def test_actuators_are_a_limited_pd_controller(robot, model):
    """Torque is kp (target - angle) - kd speed, cut at 23.7 N m and 35.55 N m."""
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    for scale in (0.1, 10.0):
        data.qpos[7:] = robot.pose
        data.ctrl[:] = np.array(robot.pose) + rng.normal(scale=scale, size=12)
        data.qvel[6:] = rng.normal(scale=3.0, size=12)
        mujoco.mj_forward(model, data)
        limit = np.tile([23.7, 23.7, 35.55], 4)
        wanted = 30.0 * (data.ctrl - data.qpos[7:]) - 0.8 * data.qvel[6:]
        np.testing.assert_allclose(data.actuator_force, np.clip(wanted, -limit, limit), rtol=1e-9, atol=1e-9)
    assert np.abs(data.actuator_force).max() == pytest.approx(35.55)


@pytest.mark.parametrize("name", plugins.names(robots))
def test_a_robot_is_what_its_data_say(name):
    """Of every robot: names, order, ranges, gains and limits of the joints in the data are those of the model."""
    robot = plugins.load(robots, name).build(stiffness=25.0, damping=0.7, action_scale=0.2)
    model = robot.spec.compile()
    assert [model.joint(i).name for i in range(1, model.njnt)] == [joint.name for joint in robot.joints]
    assert [model.actuator(i).name for i in range(model.nu)] == [joint.name for joint in robot.joints]
    for i, joint in enumerate(robot.joints):
        assert tuple(model.jnt_range[1 + i]) == joint.range
        assert model.actuator_gainprm[i, 0] == joint.stiffness == -model.actuator_biasprm[i, 1]
        assert -model.actuator_biasprm[i, 2] == joint.damping
        assert model.actuator_forcerange[i].tolist() == [-joint.max_torque, joint.max_torque]
        assert joint.range[0] < joint.pose < joint.range[1]
    legs = [(joint.stiffness, joint.damping, joint.action_scale) for joint in robot.joints[:12]]
    assert legs == [(25.0, 0.7, 0.2)] * 12


def test_collision_geoms_are_spheres_and_capsules(robot, model):
    """What collides are 19 spheres and capsules, each of them watched, and what is visual weighs nothing."""
    sphere_or_capsule = {int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)}
    hard = [i for i in range(model.ngeom) if model.geom_contype[i]]
    assert {int(model.geom_type[i]) for i in hard} <= sphere_or_capsule
    assert {model.geom_group[i] for i in hard} == {COLLISION_GROUP}
    assert {model.geom_group[i] for i in range(model.ngeom) if i not in hard} == {VISUAL_GROUP}
    assert sorted(model.geom(i).name for i in hard) == sorted(name for part in robot.parts for name in part)
    assert len(hard) == 19
    assert len(robot.parts) == 13


def test_what_is_simulated_has_no_visual_geoms(robot, model):
    """The model to simulate is the one to look at without its visual geoms: the same bodies, masses and contacts."""
    ground = flat()
    seen, hard = (build_spec(robot, ground, PhysicsConfig(), visual=visual).compile() for visual in (True, False))
    assert seen.ngeom == model.ngeom + 1
    assert [hard.geom(i).name for i in range(hard.ngeom)] == [
        seen.geom(i).name for i in range(seen.ngeom) if seen.geom_group[i] != VISUAL_GROUP
    ]
    for name in ("body_mass", "body_inertia", "body_ipos", "jnt_range", "hfield_data", "actuator_gainprm"):
        assert np.array_equal(getattr(seen, name), getattr(hard, name))


def test_no_geom_covers_too_many_prisms(robot, device):
    """Pressed on stairs at 64 yaws, on belly, back, sides and nose, no geom loses a contact with the height field."""
    ground = build(
        Grid(shapes=(Share(shape=Stairs(tile=4.0, platform=1.0)),), levels=1, columns=1, tile=4.0, border=1.0)
    )
    yaws = np.arange(64) * 2 * np.pi / 64
    rolls = [(0, 0), (np.pi, 0), (np.pi / 2, 0), (-np.pi / 2, 0), (0, np.pi / 2), (0, 0.6)]  # roll, pitch
    poses = [robot.pose, [0.0, 1.57, -0.9] * 4]  # standing, and with legs stretched along the ground
    n = len(yaws) * len(rolls) * len(poses)
    physics = engines.build(
        "warp", robot, ground, n, torch.device(device), PhysicsConfig(substeps=1, contacts=200, rows=600)
    )
    qpos, world = np.zeros((n, 19)), 0
    half = ground.size[0] / 2 - 1.2
    rng = np.random.default_rng(2)
    for yaw in yaws:
        for roll, pitch in rolls:
            for pose in poses:
                quat, turn = np.zeros(4), np.zeros(4)
                mujoco.mju_euler2Quat(quat, [roll, pitch, 0.0], "xyz")
                mujoco.mju_axisAngle2Quat(turn, [0.0, 0.0, 1.0], yaw)
                mujoco.mju_mulQuat(qpos[world, 3:7], turn, quat)
                x, y = rng.uniform(-half, half, 2)
                i, j = (round((value - ground.corner[0]) / ground.cell) for value in (x, y))
                qpos[world, :3] = x, y, ground.heights[i, j] + 0.02
                qpos[world, 7:] = pose
                world += 1
    physics.arrays.qpos.assign(qpos.astype(np.float32))
    physics.step()
    lost = physics.arrays.overflow.numpy() & physics.lost_contacts
    assert not lost.any(), np.unique(lost)
    pressed = (physics.arrays.part_force.numpy()[0] > 0).sum(axis=0)
    assert np.all(pressed > 10), "every part must have been pressed on the ground"
    wp.synchronize()
