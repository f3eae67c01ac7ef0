"""The simulator behind its face: agreement with MuJoCo C, resets, friction, payload, contact forces."""

import math
import re
import time

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from deimos.terrain import Grid, Share, build
from deimos.terrain.shapes.stairs import Shape as Stairs

from deimos.sim.legged import engines
from deimos.sim.legged.engines import PhysicsConfig
from deimos.sim.legged.engines.captured import Captured
from deimos.sim.legged.robots import go1
from deimos.sim.legged.robots import go1_rx150 as rx150

ROBOT = go1.build()
ROBOTS = {"go1": ROBOT, "go1_rx150": rx150.mount(go1.build())}
MASS = {"go1": go1.MASS, "go1_rx150": go1.MASS + rx150.MASS}  # [kg]


@pytest.fixture(scope="module")
def stairs():
    """A small hill of stairs with risers of 0.14 m."""
    return build(
        Grid(shapes=(Share(shape=Stairs(tile=4.0, platform=1.0, direction="down")),), levels=1, columns=1, tile=4.0,
             border=1.0, hardest=0.5, easiest=0.5)
    )  # fmt: skip


def make(n, simulator, terrain=None, robot=ROBOT, **options):
    """Worlds with robots in their default pose, high above the ground."""
    engine, device = simulator
    config = options.pop("config", PhysicsConfig())
    physics = engines.build(engine, robot, terrain, n, torch.device(device), config, **options)
    place(physics, 5.0, robot=robot)
    return physics


def place(physics, z, quat=(1, 0, 0, 0), robot=ROBOT):
    """Put every robot into its default pose at the origin."""
    qpos = np.zeros((physics.num_envs, 7 + len(robot.pose)), np.float32)
    qpos[:, 2:7] = [z, *quat]
    qpos[:, 7:] = robot.pose
    physics.arrays.qpos.assign(qpos)
    physics.arrays.ctrl.assign(qpos[:, 7:])
    physics.arrays.qvel.zero_()


def reference(physics, world=0):
    """MuJoCo C in the state of a world."""
    return physics.to_mujoco(world)


def run_both(physics, targets):
    """Step both simulators with the same targets; gives positions and velocities of both, (steps, nq + nv) each."""
    data = reference(physics)
    ours, theirs = [], []
    for target in targets:
        physics.arrays.ctrl.assign(np.tile(target, (physics.num_envs, 1)).astype(np.float32))
        physics.step()
        data.ctrl[:] = target
        for _ in range(physics.config.substeps):
            mujoco.mj_step(physics.model, data)
        ours.append(np.concatenate([physics.arrays.qpos.numpy()[0], physics.arrays.qvel.numpy()[0]]))
        theirs.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(ours), np.array(theirs)


def wave(steps, size, seed=0):
    """Smooth random targets of the legs around the default pose."""
    rng = np.random.default_rng(seed)
    t, phase = np.arange(steps)[:, None] * 0.02, rng.uniform(0, 2 * np.pi, 12)
    return np.array(ROBOT.pose) + size * np.sin(2 * np.pi * 1.5 * t + phase)


def swing(steps, joints, seed=0):
    """Targets of the arm's first joints that jump between the ends of their ranges every 0.4 s, (steps, joints)."""
    high = np.random.default_rng(seed).integers(0, 2, (-(-steps // 20), joints)).repeat(20, axis=0)[:steps]
    return np.radians([rx150.RANGE[i][end] for row in high for i, end in enumerate(row)]).reshape(steps, joints)


@pytest.mark.parametrize("name", ROBOTS)
def test_free_flight_agrees_with_mujoco(name, simulator):
    """Half a second of tumbling with moving legs and an arm at its limits: every angle to 1e-4, as float32 allows."""
    robot = ROBOTS[name]
    physics = make(1, simulator, robot=robot)
    nq, nv = physics.model.nq, physics.model.nv
    qvel = np.random.default_rng(1).normal(size=(1, nv)).astype(np.float32)
    physics.arrays.qvel.assign(qvel)
    ours, theirs = run_both(physics, np.hstack([wave(25, 0.4), swing(25, nv - 18)]))
    # 100 substeps, each with rounding of about 1e-7 in numbers of order 5, and forces of 30 N m/rad that bind them.
    np.testing.assert_allclose(ours[:, :nq], theirs[:, :nq], rtol=0, atol=1e-4)
    np.testing.assert_allclose(ours[:, nq:], theirs[:, nq:], rtol=0, atol=2e-3)


@pytest.mark.parametrize("name", ROBOTS)
def test_standing_agrees_with_mujoco(name, simulator):
    """Set down on flat ground, swaying, an arm swinging between its limits: base to a millimetre, joints to 5 mrad."""
    robot = ROBOTS[name]
    physics = make(1, simulator, robot=robot)
    place(physics, robot.standing_height, robot=robot)
    nq, joints = physics.model.nq, physics.model.nu - 12
    ours, theirs = run_both(physics, np.hstack([wave(50, 0.1), swing(50, joints, seed=1)]))
    np.testing.assert_allclose(ours[:, :3], theirs[:, :3], rtol=0, atol=1e-3)
    np.testing.assert_allclose(ours[:, 3:nq], theirs[:, 3:nq], rtol=0, atol=5e-3)
    assert 0.2 < theirs[-1, 2] < 0.33
    low, high = np.radians(rx150.RANGE[:joints]).reshape(-1, 2).T
    at_limit = np.abs(theirs[:, 19:nq] - np.clip(theirs[:, 19:nq], low + 0.02, high - 0.02)) > 0
    assert at_limit.any(axis=0).sum() >= min(joints, 3), "the arm must have been at its limits"


def test_fall_on_stairs_agrees_with_mujoco(simulator, stairs):
    """Dropped askew onto stairs: the same until shortly after the first contacts; later on the stairs, nothing lost."""
    physics = make(1, simulator, stairs)
    tilt = np.array([np.cos(0.3), np.sin(0.3), 0.0, 0.0])
    place(physics, stairs.heights.max() + 0.45, tilt)
    qpos = physics.arrays.qpos.numpy()
    qpos[0, 0] = 0.9
    physics.arrays.qpos.assign(qpos)
    ours, theirs = run_both(physics, np.tile(ROBOT.pose, (100, 1)))
    touched = np.flatnonzero(np.abs(np.diff(theirs[:, 21])) < 0.15)[0]  # the fall is braked
    # A fall is chaotic: contacts on the two sides of a prism's edge part ways, so only its start can be compared.
    first = touched + 3
    assert first < 30
    np.testing.assert_allclose(ours[:first, :3], theirs[:first, :3], rtol=0, atol=3e-3)
    np.testing.assert_allclose(ours[:first, 3:19], theirs[:first, 3:19], rtol=0, atol=3e-2)
    low = stairs.heights.min()
    assert low < ours[-1, 2] < stairs.heights.max() + 0.45
    assert not physics.arrays.overflow.numpy()[0] & physics.lost_contacts


@pytest.mark.parametrize("name", ROBOTS)
def test_part_forces_carry_the_robot(name, simulator):
    """Standing still, the feet's normal forces add up to the weight, and no other part touches the ground."""
    physics = make(3, simulator, robot=ROBOTS[name])
    place(physics, 0.29, robot=ROBOTS[name])
    for _ in range(150):
        physics.step()
    force = physics.arrays.part_force.numpy()
    assert force.shape == (4, 3, 13)
    # What remains of the swaying after 3 s moves the forces by less than 2 %.
    np.testing.assert_allclose(force[:, :, 1:5].sum(axis=2), MASS[name] * 9.81, rtol=0.02)
    assert not force[:, :, [0, *range(5, 13)]].any()


def test_part_forces_agree_with_mujoco(simulator):
    """Lying on its back: the normal force on every part is that of MuJoCo C in the same state."""
    physics = make(1, simulator, config=PhysicsConfig(substeps=1))
    place(physics, 0.049, (0, 1, 0, 0))
    data = reference(physics)
    physics.step()
    part = {name: i for i, names in enumerate(ROBOT.parts) for name in names}
    expected, wrench = np.zeros(13), np.zeros(6)
    for i in range(data.ncon):
        mujoco.mj_contactForce(physics.model, data, i, wrench)
        names = [physics.model.geom(g).name for g in data.contact[i].geom]
        expected[next(part[name] for name in names if name in part)] += wrench[0]
    assert expected[0] > 1.0
    # Five Newton iterations converge to float32's accuracy of a stiff problem.
    np.testing.assert_allclose(physics.arrays.part_force.numpy()[0, 0], expected, rtol=1e-2, atol=0.1)


def test_reset_forgets_everything_and_touches_nobody_else(simulator):
    """A masked reset takes a NaN world back to the start, warm start too, and leaves the others bit for bit."""
    physics, twin = (make(4, simulator) for _ in range(2))
    for both in (physics, twin):
        place(both, 0.3)
        both.step()
    qpos = physics.arrays.qpos.numpy()
    qpos[1] = np.nan
    physics.arrays.qpos.assign(qpos)
    for both in (physics, twin):
        both.step()
    assert np.isnan(physics.tensors["warmstart"][1].cpu().numpy()).any()
    mask = wp.array([False, True, False, False], dtype=wp.bool, device=str(simulator.device))
    for both in (physics, twin):
        both.reset(mask)
        both.step()
    for name in physics.tensors:
        a, b = (both.tensors[name].cpu().numpy() for both in (physics, twin))
        assert np.isfinite(a).all(), name
        np.testing.assert_array_equal(a, b, err_msg=name)


def test_identical_worlds_stay_identical(simulator):
    """Worlds do not depend on their number: equal states give equal motion, bit for bit, on a CPU."""
    physics = make(5, simulator)
    place(physics, 0.3)
    for target in wave(20, 0.3):
        physics.arrays.ctrl.assign(np.tile(target, (5, 1)).astype(np.float32))
        physics.step()
    qpos = physics.arrays.qpos.numpy()
    if simulator.device.type == "cpu":
        np.testing.assert_array_equal(qpos, np.tile(qpos[0], (5, 1)))
    else:  # the order of contacts, and with it that of sums, is not fixed there
        np.testing.assert_allclose(qpos, np.tile(qpos[0], (5, 1)), atol=1e-3)


def test_capture_replays_the_step(simulator):
    """A captured step does what the launches do, and the launches are made once."""
    physics, twin = (make(2, simulator) for _ in range(2))
    step = physics.record_step(lambda: None, [lambda: None] * len(physics.parts))
    for both in (physics, twin):
        for tensor in both.tensors.values():
            tensor.zero_()
        place(both, 0.3)
    for _ in range(5):
        step()
        twin.step()
    np.testing.assert_array_equal(physics.arrays.qpos.numpy(), twin.arrays.qpos.numpy())


def test_compiling_is_said_only_where_it_happens(torch_device, capsys, monkeypatch, tmp_path):
    """A first run that compiles says so; one that is only slow, or finds its kernels compiled, says nothing."""
    monkeypatch.setattr("deimos.sim.legged.engines.captured.PATIENCE", 0.001)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))

    @wp.kernel(module="unique")
    def double(x: wp.array[float]):
        x[wp.tid()] = 2.0 * x[wp.tid()]

    x = wp.ones(3, device=str(torch_device))

    def launch():
        wp.launch(double, dim=3, inputs=[x], device=x.device)

    Captured(lambda: time.sleep(0.1), torch_device)
    assert capsys.readouterr().err == ""
    Captured(launch, torch_device)
    assert capsys.readouterr().err.startswith("Compiling the simulator for this machine")
    Captured(launch, torch_device)
    assert capsys.readouterr().err == ""


def test_friction_is_the_worlds_own(simulator):
    """On its own slippery feet a sliding robot slides farther than one with grip, by what friction brakes."""
    physics = make(2, simulator, friction=np.array([0.2, 1.0]))
    place(physics, 0.29)
    for _ in range(50):
        physics.step()
    physics.arrays.qvel.assign(np.array([[1.0, *[0.0] * 17]] * 2, np.float32))
    start = physics.arrays.qpos.numpy()[:, 0].copy()
    for _ in range(50):
        physics.step()
    way = physics.arrays.qpos.numpy()[:, 0] - start
    assert way[0] > 1.5 * way[1]


def test_payload_changes_mass_and_what_follows_from_it(simulator):
    """A payload adds to the base's mass, scales its inertia, and is carried by the feet; sensitivities are MuJoCo's."""
    payload = np.array([-1.0, 0.0, 1.0])
    physics = make(3, simulator, payload=payload)
    mass = physics.tensors["body_mass"].cpu().numpy()
    np.testing.assert_allclose(mass.sum(axis=1), go1.build().spec.compile().body_mass.sum() + payload, rtol=1e-6)
    place(physics, 0.29)
    for _ in range(150):
        physics.step()
    carried = physics.arrays.part_force.numpy()[-1, :, 1:5].sum(axis=1)
    np.testing.assert_allclose(carried, (go1.MASS + payload) * 9.81, rtol=0.02)
    spec = go1.build().spec
    spec.body("trunk").mass += 1.0
    spec.body("trunk").fullinertia = np.array(spec.body("trunk").fullinertia) * (1 + 1 / 5.204)
    heavy = spec.compile()
    np.testing.assert_allclose(
        physics.tensors["dof_invweight0"][2].cpu().numpy(), heavy.dof_invweight0, rtol=1e-3, atol=1e-6
    )


def test_buffers_tell_their_use(device):
    """The peak of contacts and rows is counted, and too few rows set a bit that means lost contacts."""
    physics = make(2, ("warp", device))
    place(physics, 0.05, (0, 1, 0, 0))
    physics.step()
    use = physics.buffer_use()
    assert 0 < use["contacts"] <= use["max_contacts"]
    # Four feet with four rows each, a head and four hips, ten capsules with two contacts each, and twelve limits.
    assert 0 < use["rows"] <= use["max_rows"] == 4 * 4 + 5 + 10 * 2 + 12
    assert physics.buffer_use()["rows"] == 0  # since the last call
    small = make(2, ("warp", device), config=PhysicsConfig(rows=8))
    place(small, 0.25)
    small.step()
    assert np.all(small.arrays.overflow.numpy() & small.lost_contacts)


def test_dry_friction_has_rows(device):
    """Every joint of dry friction takes a row whatever the robot touches, and the buffer has it."""
    robot = go1.build()
    for leg in robot.spec.joints[1:]:
        leg.frictionloss = 0.1
    assert make(1, ("warp", device), robot=robot).max_rows == 53 + 12


@pytest.mark.parametrize(
    ("bits", "message"),
    [
        (1, r"^NEFC: up to \d+ constraint rows in a world were needed, the buffer holds 53; raise physics.rows$"),
        (16, r"^CCD: up to \d+ contacts in all worlds were needed, the buffer holds 96; raise physics.contacts$"),
        (32, "^HFIELD: a geom covered more of the height field than is tested; use a terrain with larger cells$"),
        (256, "^EPA_HORIZON: a contact was deeper than the collision test can resolve$"),
        (33 + 512, "^NEFC: .*; HFIELD: "),
    ],
)
def test_losses_are_explained(device, bits, message):
    """Every bit that means a lost contact has its name, its reason and what helps, and the solver's bits have none."""
    assert re.search(message, make(2, ("warp", device)).explain_loss(bits))


def test_every_loss_has_an_explanation(simulator):
    """No single bit of those that mean a lost contact is left without words."""
    physics = make(1, simulator)
    bits = [1 << i for i in range(16) if physics.lost_contacts & 1 << i]
    assert len(bits) == 7
    assert all(physics.explain_loss(bit) for bit in bits)


def test_buffers_hold_an_arm_that_touches_everything(device, stairs):
    """The buffers hold the arm's contacts with ground and guards, and an arm that swings into both loses none."""
    robot = ROBOTS["go1_rx150"]
    physics = make(4, ("warp", device), robot=robot)
    # Beside the Go1's 53: five limits, two capsules on the ground and on two guards, twice each, and on a ball.
    among_itself = 2 * 2 * 2 + 2
    assert physics.max_rows == 53 + 5 + 2 * 2 + among_itself
    # On a height field four fifths of what four contacts of each need: four rows for four feet, one for 17 others.
    assert make(1, ("warp", device), stairs, robot).max_rows == math.ceil(
        0.8 * (4 * 4 * 4 + 17 * 4 + 12 + 5 + among_itself)
    )
    place(physics, 0.1, (0, 1, 0, 0), robot=robot)  # on its back, upon the arm
    touched = set()
    for target in swing(60, 5, seed=1):
        physics.arrays.ctrl.assign(np.tile([*ROBOT.pose, *target], (4, 1)).astype(np.float32))
        physics.step()
        touched |= {physics.model.geom(geom).name for pair in physics.to_mujoco(0).contact.geom for geom in pair}
    assert {"ground", "guard_left", "guard_right", "forearm", "gripper"} <= touched
    use = physics.buffer_use()
    assert use["rows"] < use["max_rows"]
    assert use["contacts"] < use["max_contacts"]
    assert not (physics.arrays.overflow.numpy() & physics.lost_contacts).any()


def test_to_mujoco_shows_the_state(simulator):
    """One world comes out as MuJoCo's own data, with the geoms where its kinematics put them."""
    physics = make(2, simulator)
    place(physics, 0.3)
    qpos = physics.arrays.qpos.numpy()
    qpos[1, 0] = 2.0
    physics.arrays.qpos.assign(qpos)
    data = physics.to_mujoco(1)
    np.testing.assert_allclose(data.qpos, qpos[1], rtol=0)
    np.testing.assert_allclose(data.body("trunk").xpos, [2.0, 0.0, 0.3], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("timestep", 0.0, "timestep must be finite and positive, got 0.0"),
        ("substeps", 0, "substeps must be at least 1, got 0"),
        ("iterations", 0, "iterations must be at least 1, got 0"),
        ("line_search", 0, "line_search must be at least 1, got 0"),
        ("contacts", -1, "contacts must be at least 0, got -1"),
        ("rows", 2.5, "rows must be a whole number, got 2.5"),
    ],
)
def test_config_rejects_bad_values(field, value, message):
    """The message names the field, what it must be and what it was."""
    with pytest.raises(ValueError, match=message):
        PhysicsConfig(**{field: value})
