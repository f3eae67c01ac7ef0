"""The ReactorX-150 on a Go1: masses, kinematics, servos, what touches what, and a trunk that is held."""

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from deimos.terrain import Grid, Share, build
from deimos.terrain.shapes.stairs import Shape as Stairs

from deimos.sim.legged import engines
from deimos.sim.legged.engines import PhysicsConfig
from deimos.sim.legged.robots import COLLISION_GROUP, VISUAL_GROUP, go1
from deimos.sim.legged.robots import go1_rx150 as rx150
from deimos.sim.legged.robots._primitives import hold_base


@pytest.fixture(scope="module")
def robot():
    """A Go1 with the arm."""
    return rx150.mount(go1.build())


@pytest.fixture(scope="module")
def model(robot):
    """Its compiled model."""
    return robot.spec.compile()


def pose_data(model, arm, base=(0, 0, 0, 1, 0, 0, 0)):
    """The robot with its arm in a pose and its legs stretched."""
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[19:] = base, arm
    mujoco.mj_forward(model, data)
    return data


def turn(axis, angle):
    """Rotation about x, y or z."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    matrix = np.eye(3)
    matrix[j, j] = matrix[k, k] = np.cos(angle)
    matrix[k, j] = np.sin(angle)
    matrix[j, k] = -matrix[k, j]
    return matrix


def end_effector(arm):
    """Where the table of offsets puts the end effector, in the trunk."""
    place, frame = np.array(rx150.MOUNT), np.eye(3)
    for offset, axis, angle in zip(rx150.OFFSETS, rx150.AXES, arm, strict=False):
        place = place + frame @ offset
        frame = frame @ turn(axis, angle)
    return place + frame @ rx150.OFFSETS[-1]


def test_mass_and_tree(robot, model):
    """14.515 kg in all; five joints and actuators come after the twelve of the legs, which stay as they were."""
    # Twelve numbers are rounded to a tenth of a gram or better, the Go1's thirteen to a gram in all.
    assert model.body_mass.sum() == pytest.approx(14.515, abs=1e-3)
    arm = [body for body in range(model.nbody) if model.body(body).name.startswith("arm_")]
    assert model.body_mass[arm].sum() == pytest.approx(rx150.MASS, abs=1e-3)
    assert (model.nq, model.nv, model.nu) == (24, 23, 17)
    joints = [f"{leg}_{joint}" for leg in go1.LEGS for joint in go1.JOINTS]
    joints += ["waist", "shoulder", "elbow", "wrist_angle", "wrist_rotate"]
    assert [model.joint(i).name for i in range(1, 18)] == joints
    assert [model.actuator(i).name for i in range(17)] == joints
    assert model.actuator_trnid[:, 0].tolist() == list(range(1, 18))
    assert len(robot.pose) == len(robot.joints) == 17
    bare = go1.build()
    assert robot.pose[:12] == bare.pose
    assert robot.joints[:12] == bare.joints


# rx150.urdf.xacro of Interbotix, letter by letter: mass [kg], xyz [m], (ixx, iyy, izz, ixy, ixz, iyz) [kg m^2] in axes
# that are turned by a quarter about z.
SOURCE = {
    "arm_base": (
        0.766135, (-0.03545010, -0.00335813, 0.02534180),
        (0.003354, 0.001357, 0.004111, -0.0001247, 0.00001105, 0.0002102),
    ),
    "arm_shoulder": (
        0.257774, (-0.000127549, -0.000184747, 0.0079473),
        (0.0002195, 0.0002226, 0.0002898, -0.0000000045, 0.0000010964, 0.0000001746),
    ),
    "arm_upper": (
        0.283759, (0.0125618, -0.000124017, 0.106762),
        (0.0008609, 0.0007957, 0.0001568, -0.0000009758, 0.0000015061, 0.0001518),
    ),
    "arm_forearm": (
        0.23568, (0.08509, 0.000404824, 0.0), (0.0004693, 0.00006242, 0.0004895, -0.000001355, 0.0, 0.0),
    ),
    "arm_wrist": (
        0.084957, (0.04236, -0.000010411, 0.010577),
        (0.00003082, 0.00002822, 0.00003152, 0.0000000191, 0.0000000023, 0.0000025481),
    ),
}  # fmt: skip
# The gripper's six parts put together, its fingers half-way: in its own axes.
GRIPPER = (0.143916, (0.04298, 0.0, 0.00696), (7.633e-5, 1.269e-4, 1.561e-4, 9e-7, 1.706e-5, 3e-7))


def tensor(numbers):
    """A symmetric matrix of (xx, yy, zz, xy, xz, yz)."""
    xx, yy, zz, xy, xz, yz = numbers
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@pytest.mark.parametrize("name", [*SOURCE, "arm_gripper"])
def test_bodies_are_those_of_the_source(model, name):
    """Mass, centre and the whole tensor of inertia of every link are the vendor's, and no dummy inertia swells them."""
    mass, centre, numbers = GRIPPER if name == "arm_gripper" else SOURCE[name]
    quarter = np.eye(3) if name == "arm_gripper" else turn("z", np.pi / 2)
    expected = quarter @ tensor(numbers) @ quarter.T
    body = model.body(name)
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, body.iquat)
    found = axes.reshape(3, 3) @ np.diag(body.inertia) @ axes.reshape(3, 3).T
    assert body.mass[0] == mass
    # What the code holds is rounded to 0.01 mm and four digits, and small products of the shoulder are left out.
    np.testing.assert_allclose(body.ipos, centre, rtol=0, atol=1.2e-5)
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-3 * np.abs(expected).max())
    # No link is longer than 0.25 m, so none is farther from its centre than that.
    assert body.inertia.max() < mass * 0.125**2


def test_slender_links_point_along_themselves(model):
    """The axis of least inertia of upper arm and forearm is that of the link; 6 degrees off in the table itself."""
    for name, (x, y, z) in (("arm_upper", rx150.OFFSETS[2]), ("arm_forearm", rx150.OFFSETS[3])):
        data = pose_data(model, np.zeros(5))
        body = model.body(name)
        slender = data.ximat[body.id].reshape(3, 3)[:, np.argmin(body.inertia)]
        assert abs(slender @ [x, y, z]) / np.hypot(np.hypot(x, y), z) > np.cos(np.radians(10)), name


def test_joints_are_where_the_table_has_them(model):
    """At the zero pose the end effector is (0.358575, 0, 0.25457) m from the arm's base, and axes are z, y, y, y, x."""
    data = pose_data(model, np.zeros(5))
    at = data.site("end_effector").xpos - data.body("arm_base").xpos
    np.testing.assert_allclose(at, [0.358575, 0.0, 0.25457], atol=1e-12)
    np.testing.assert_allclose(data.body("arm_base").xpos, rx150.MOUNT, atol=1e-12)
    for name, axis in zip(rx150.JOINTS, rx150.AXES, strict=True):
        np.testing.assert_allclose(data.joint(name).xaxis, np.eye(3)["xyz".index(axis)], atol=1e-12)
    np.testing.assert_allclose(data.joint("shoulder").xanchor, rx150.SHOULDER, atol=1e-12)
    degrees = [(-180, 180), (-106, 100), (-102, 95), (-100, 123), (-180, 180)]
    np.testing.assert_allclose(model.jnt_range[13:], np.radians(degrees))
    # The half folded pose, as published.
    folded = pose_data(model, rx150.POSE).site("end_effector").xpos
    np.testing.assert_allclose(folded, [0.245, 0.0, 0.247], atol=5e-4)


def test_offsets_and_axes_give_the_end_effector(model):
    """Chaining the table's offsets and rotations gives MuJoCo's own place of the site, wherever the base is."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        arm = rng.uniform(*model.jnt_range[13:].T)
        base = rng.normal(size=7)
        base[3:] /= np.linalg.norm(base[3:])
        data = pose_data(model, arm, base)
        expected = base[:3] + data.body("trunk").xmat.reshape(3, 3) @ end_effector(arm)
        np.testing.assert_allclose(data.site("end_effector").xpos, expected, atol=1e-12)


def test_reach(model):
    """Within its joints' ranges the arm gets 0.467 m from its shoulder's axis, and no farther."""
    rng = np.random.default_rng(0)
    arms = rng.uniform(*model.jnt_range[13:].T, size=(5000, 5))
    elbow = -np.arctan2(rx150.OFFSETS[2][2], rx150.OFFSETS[2][0])  # where forearm and upper arm are in line
    arms[0] = 0.0, 0.0, elbow, 0.0, 0.0
    distance = np.array([np.linalg.norm(end_effector(arm) - rx150.SHOULDER) for arm in arms])
    assert model.joint("elbow").range[0] < elbow
    assert distance.argmax() == 0
    assert distance[0] == pytest.approx(0.467, abs=5e-4)
    assert distance.min() < 0.05


def test_stretched_arm_weighs_on_its_joints_as_published(model):
    """Level and straight, gravity asks for 1.74, 0.72 and 0.19 N m of shoulder, elbow and wrist; servos have more."""
    elbow = -np.arctan2(rx150.OFFSETS[2][2], rx150.OFFSETS[2][0])
    data = pose_data(model, [0.0, -elbow, elbow, 0.0, 0.0])
    torque = -data.qfrc_bias[19:22]
    np.testing.assert_allclose(torque, [1.74, 0.72, 0.19], atol=1e-2)
    assert np.all(torque < rx150.MAX_TORQUE[1:4])


def test_actuators_are_limited_pd_controllers(robot, model):
    """Torque is kp (target - angle) - kd speed, cut at what the servos give; the legs keep their own."""
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    limit = np.array([*[23.7, 23.7, 35.55] * 4, 4.1, 4.1, 4.1, 1.4, 1.0])
    stiffness = np.array([*[30.0] * 12, *[15.0] * 3, *[5.0] * 2])
    damping = np.array([*[0.8] * 12, *[0.25] * 3, 0.18, 0.24])
    for scale in (0.02, 10.0):
        data.qpos[7:] = robot.pose
        data.ctrl[:] = np.array(robot.pose) + rng.normal(scale=scale, size=17)
        data.qvel[6:] = rng.normal(scale=scale, size=17)
        mujoco.mj_forward(model, data)
        wanted = stiffness * (data.ctrl - data.qpos[7:]) - damping * data.qvel[6:]
        np.testing.assert_allclose(data.actuator_force, np.clip(wanted, -limit, limit), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(data.qfrc_passive[18:], -np.array(rx150.DRAG) * data.qvel[18:], rtol=1e-9)
    np.testing.assert_allclose(np.add(rx150.DRAG, rx150.DAMPING), [1.1, 1.1, 1.1, 0.4, 0.4])
    np.testing.assert_allclose(np.abs(data.actuator_force[12:]), limit[12:])
    np.testing.assert_allclose(model.dof_armature[18:], [0.02, 0.02, 0.02, 0.005, 0.005])
    assert not model.dof_frictionloss.any()


def test_what_touches_what(robot, model):
    """The arm's capsules touch the guards and are watched as the base is; guards touch nothing else."""
    sphere_or_capsule = {int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)}
    hard = [i for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]]
    assert {int(model.geom_type[i]) for i in hard} <= sphere_or_capsule
    assert {model.geom_group[i] for i in hard} == {COLLISION_GROUP}
    assert {model.geom_group[i] for i in range(model.ngeom) if i not in hard} == {VISUAL_GROUP}
    watched = [name for part in robot.parts for name in part]
    assert sorted(model.geom(i).name for i in hard) == sorted([*watched, *rx150.GUARDS])
    assert len(robot.parts) == 13
    assert robot.parts[0] == (*go1.build().parts[0], "forearm", "gripper")
    pairs = set()
    for a in hard:
        for b in hard:
            if model.geom_contype[a] & model.geom_conaffinity[b] and model.geom_bodyid[a] != model.geom_bodyid[b]:
                pairs.add(frozenset(model.geom(i).name for i in (a, b)))
    assert pairs == {frozenset((arm, guard)) for arm in ("forearm", "gripper") for guard in rx150.GUARDS}


def test_guards_fill_the_trunk(model):
    """The trunk's top is nowhere more than 1.5 cm above what the arm touches."""
    data = pose_data(model, rx150.POSE)
    guards = [model.geom(name).id for name in ("guard_left", "guard_right")]
    for x in np.linspace(-0.185, 0.235, 30):
        for y in np.linspace(-0.05, 0.05, 11):
            probe = np.array([x, y, 0.05])
            distance = []
            for guard in guards:
                local = data.geom_xmat[guard].reshape(3, 3).T @ (probe - data.geom_xpos[guard])
                radius, half = model.geom_size[guard, :2]
                local[2] -= np.clip(local[2], -half, half)
                distance.append(np.linalg.norm(local) - radius)
            assert min(distance) < 0.015  # between the two it is 14 mm: hypot(40 mm, 50 mm) less the radius of 50 mm


def test_arm_stays_out_of_the_trunk():
    """Driven into the trunk with all its torque, the arm rests on it within 2 mm, and never gets halfway through."""
    robot = hold_base(rx150.build())
    model = robot.spec.compile()
    model.opt.timestep = 0.005
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = pose_data(model, rx150.POSE)
    rng = np.random.default_rng(0)
    rests, deepest = [], 0.0
    for _ in range(60):
        low, high = model.jnt_range[13:].T
        data.ctrl[:12] = robot.pose[:12]
        data.ctrl[12:] = rng.uniform(low, high)
        data.ctrl[13:15] = rng.choice([0.5, 1.0, 1.7]), rng.choice([0.5, 1.6, -1.7])
        for _ in range(300):
            mujoco.mj_step(model, data)
            deepest = min([deepest, *data.contact.dist])
        if len(data.contact.dist) and np.abs(data.qvel[18:]).max() < 0.1:
            rests.append(data.contact.dist.min())
    assert len(rests) > 10
    assert min(rests) > -2e-3
    # The thinnest pair: a forearm of 25 mm and a guard of 50 mm pass each other at a depth of 75 mm.
    assert deepest > -0.0375


def test_no_geom_of_the_arm_covers_too_many_prisms(device):
    """Pressed on stairs at 64 yaws and four pitches, forearm and gripper lose no contact with the height field."""
    robot = rx150.mount(go1.build())
    for geom in robot.spec.geoms:
        if geom.name not in rx150.CAPSULES:
            geom.contype = geom.conaffinity = 0
    model = robot.spec.compile()
    ground = build(
        Grid(shapes=(Share(shape=Stairs(tile=4.0, platform=1.0)),), levels=1, columns=1, tile=4.0, border=1.0)
    )
    straight = pose_data(model, np.zeros(5))
    trunk = np.zeros((64 * 4 * 2, 24), np.float32)
    rng = np.random.default_rng(2)
    half = ground.size[0] / 2 - 1.2
    for world, row in enumerate(trunk):
        geom = model.geom(("forearm", "gripper")[world % 2])
        pitch = (0.0, 0.35, 0.8, np.pi / 2)[world // 2 % 4]
        x, y = rng.uniform(-half, half, 2)
        i, j = (round((value - ground.corner[0]) / ground.cell) for value in (x, y))
        depth = rng.uniform(0.005, 0.03)
        z = ground.heights[i, j] + geom.size[0] + geom.size[1] * np.sin(pitch) - depth
        frame = turn("z", 2 * np.pi * (world // 8) / 64) @ turn("y", pitch)
        # The straight arm's frames are those of the trunk, so the trunk goes where the geom's place in it asks for.
        row[:3] = np.array([x, y, z]) - frame @ straight.geom_xpos[geom.id]
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, frame.ravel())
        row[3:7] = quat
    physics = engines.build(
        "warp", robot, ground, len(trunk), torch.device(device), PhysicsConfig(substeps=1, contacts=40)
    )
    physics.arrays.qpos.assign(trunk)
    physics.step()
    lost = physics.arrays.overflow.numpy() & physics.lost_contacts
    assert not lost.any(), np.unique(lost)
    assert (physics.arrays.part_force.numpy()[0, :, 0] > 0).mean() > 0.9
    wp.synchronize()


def test_trunk_is_held(device):
    """With the arm swinging between its limits for 2 s, a held trunk that was thrown stays where it was put."""
    robot = hold_base(rx150.build())
    physics = engines.build("warp", robot, None, 2, torch.device(device), PhysicsConfig())
    assert physics.arrays.qpos.shape[1] == 24
    assert physics.arrays.qvel.shape[1] == 23
    rng = np.random.default_rng(3)
    start = np.zeros((2, 24), np.float32)
    start[:, :4] = [[3.0, -2.0, robot.spawn_height, 1.0], [-40.0, 7.0, robot.spawn_height + 0.2, 1.0]]
    start[:, 7:] = robot.pose
    throw = np.zeros((2, 23), np.float32)
    throw[:, :6] = rng.uniform(-0.5, 0.5, (2, 6))
    physics.arrays.qpos.assign(start)
    physics.arrays.qvel.assign(throw)
    data = physics.to_mujoco(0)
    low, high = np.array([joint.range for joint in robot.joints]).T
    for step in range(100):
        if step % 20 == 0:
            target = np.where(rng.random(17) < 0.5, low, high)
        physics.arrays.ctrl.assign(np.tile(target, (2, 1)).astype(np.float32))
        physics.step()
        data.ctrl[:] = target
        mujoco.mj_step(physics.model, data, physics.config.substeps)
        # An episode is ten times as long: 2 mm and 0.5 degrees for it.
        for qpos, origin in ((physics.arrays.qpos.numpy(), start), (data.qpos[None], start[:1])):
            assert np.abs(qpos[:, :3] - origin[:, :3]).max() < 2e-3 / 10
            assert 2 * np.linalg.norm(qpos[:, 4:7], axis=1).max() < np.radians(0.5) / 10
        assert not physics.arrays.part_force.numpy().any(), "nothing touches the ground"
    # The arms of both simulators have gone the same way, in spite of the huge forces that hold.
    np.testing.assert_allclose(physics.arrays.qpos.numpy()[0, 7:], data.qpos[7:], rtol=0, atol=5e-3)
    assert robot.spawn_height == robot.standing_height
