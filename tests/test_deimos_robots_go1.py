"""The Go1: masses, kinematics, actuators, and geoms that a height field can bear."""

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

from deimos.physics import Physics, PhysicsConfig
from deimos.robots import COLLISION_GROUP, VISUAL_GROUP, go1
from terrain import Grid, Share, build
from terrain.shapes.stairs import Shape as Stairs

HFIELD_BIT = 32  # of mujoco-warp's overflow: a geom covered more prisms than are tested


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


def test_inertias_are_those_of_the_source(model):
    """Principal inertias of trunk, front right hip and thigh and of the calf are those that Menagerie stores."""
    # kg m^2, as go1.xml has them (diaginertia), sorted; the table that the code holds was computed from them.
    for name, numbers in {"trunk": go1.TRUNK, "FR_hip": go1.HIP, "FR_thigh": go1.THIGH, "FR_calf": go1.CALF}.items():
        mass, centre, (xx, yy, zz, xy, xz, yz) = numbers
        body = model.body(name)
        expected = np.sort(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        np.testing.assert_allclose(np.sort(body.inertia), expected, rtol=1e-9)
        np.testing.assert_allclose(body.ipos, centre, atol=1e-12)
        assert body.mass[0] == mass
        assert expected[0] + expected[1] > expected[2], "a rigid body obeys the triangle inequality"


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


def test_collision_geoms_are_spheres_and_capsules(robot, model):
    """What collides are 15 spheres and capsules, each of them watched, and what is for the eye weighs nothing."""
    sphere_or_capsule = {int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)}
    hard = [i for i in range(model.ngeom) if model.geom_contype[i]]
    assert {int(model.geom_type[i]) for i in hard} <= sphere_or_capsule
    assert {model.geom_group[i] for i in hard} == {COLLISION_GROUP}
    assert {model.geom_group[i] for i in range(model.ngeom) if i not in hard} == {VISUAL_GROUP}
    assert sorted(model.geom(i).name for i in hard) == sorted(name for part in robot.parts for name in part)
    assert len(hard) == 15
    assert len(robot.parts) == 13


def test_no_geom_covers_too_many_prisms(robot, device):
    """Pressed on stairs at 64 yaws, on belly, back, sides and nose, no geom loses a contact with the height field."""
    ground = build(
        Grid(shapes=(Share(shape=Stairs(tile=4.0, platform=1.0)),), levels=1, columns=1, tile=4.0, border=1.0)
    )
    yaws = np.arange(64) * 2 * np.pi / 64
    rolls = [(0, 0), (np.pi, 0), (np.pi / 2, 0), (-np.pi / 2, 0), (0, np.pi / 2), (0, 0.6)]  # roll, pitch
    poses = [robot.pose, [0.0, 1.57, -0.9] * 4]  # standing, and with legs stretched along the ground
    n = len(yaws) * len(rolls) * len(poses)
    physics = Physics(robot, ground, n, torch.device(device), PhysicsConfig(substeps=1, contacts=200, rows=600))
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
    physics.qpos.assign(qpos.astype(np.float32))
    physics.step()
    lost = physics.overflow.numpy() & physics.lost_contacts
    assert not lost.any(), np.unique(lost)
    pressed = (physics.part_force.numpy()[0] > 0).sum(axis=0)
    assert np.all(pressed > 10), "every part must have been pressed on the ground"
    wp.synchronize()
