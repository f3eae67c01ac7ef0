"""The legged robots' resets, levels and goals, and the heights and the noise of their observation."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.legged.observation import finish_obs
from deimos.kernels.legged.reset import change_of_level, reset_worlds, set_goals, update_levels
from deimos.kernels.legged.rewards import vec12, vecT
from deimos.kernels.legged.state import COUNTERS, Ground, Joints, LevelRule, LocomotionParams, LocomotionState
from deimos.kernels.random import Purpose

N, J, G, SCAN = 40, 12, 3, 10
OBS = 48 + SCAN
CELL, CORNER = 0.1, (-6.0, -8.0)
LEVELS, COLUMNS = 3, 4
POSE = np.tile([0.1, 0.8, -1.5], 4)
LOW, HIGH = POSE - 0.5, POSE + 0.3
GOAL_SCALE = np.array([2.0, 2.0, 0.25])
SHAPES = {"goal": (G,), "action": (J,), "joint_speed": (J,), "air_time": (4,)}


def make_params(**changes):
    """Legged Gym's numbers on a small terrain."""
    values = {
        "dt": 0.02, "goal_period": 500, "time_limit": 1000, "stagger": False, "seed": 9, "world_offset": 100,
        "action_bound": 100.0, "noise": False, "push_interval": 0, "push_speed": 1.0, "weight": vecT(1.0),
        "air_time_target": 0.3, "soft_low": vec12(*LOW), "soft_high": vec12(*HIGH), "max_speed": 20.0,
        "max_rate": 500.0, "lost_contacts": 0, "scan_start": 48, "standing_height": 0.325,
        "spawn_height": 0.42, "spawn_range": 1.0,
        "spawn_speed": 0.5, "spawn_reach": 0.5, "level_rule": int(LevelRule.REWARD), "start_levels": 2, "cell": CELL,
        "corner": wp.vec2(*CORNER), "low": wp.vec2(-9.0), "high": wp.vec2(9.0), "half_tile": 2.0,
    }  # fmt: skip
    params = LocomotionParams()
    for name in LocomotionParams.vars:
        setattr(params, name, (values | changes)[name])
    return params


class World:
    """Worlds in the middle of something, and the ground that they are on."""

    def __init__(self, device, seed=0):
        rng = np.random.default_rng(seed)
        self.device = device
        self.heights = rng.uniform(0, 0.3, size=(121, 161)).astype(np.float32)
        self.origins = rng.uniform(-3, 3, size=(LEVELS, COLUMNS, 3)).astype(np.float32)
        self.ground, self.joints, self.state = Ground(), Joints(), LocomotionState()
        self.ground.heights = self.array(self.heights)
        self.ground.origin = wp.array(self.origins, dtype=wp.vec3, device=device)
        for name, value in (("pose", POSE), ("action_scale", np.full(J, 0.25)), ("low", LOW), ("high", HIGH)):
            setattr(self.joints, name, self.array(value))
        for name, shape in SHAPES.items():
            setattr(self.state, name, self.array(rng.normal(size=(N, *shape))))
        for name in COUNTERS:
            setattr(self.state, name, wp.array(rng.integers(1, 3, size=N), dtype=wp.int32, device=device))
        self.state.tracked = wp.array(np.tile([30.0, 40.0], (N, 1)), dtype=wp.vec2, device=device)
        self.qpos, self.qvel = self.array(rng.normal(size=(N, 7 + J))), self.array(rng.normal(size=(N, 6 + J)))
        self.obs = self.array(np.full((N, OBS), np.nan))
        self.goal_range, self.goal_scale = self.array(np.array([1.0, 0.5, 2.0])), self.array(GOAL_SCALE)

    def array(self, value):
        """A float32 array."""
        return wp.array(np.asarray(value, np.float32), dtype=wp.float32, device=self.device)

    def flags(self, value):
        """A mask."""
        return wp.array(np.broadcast_to(value, N), dtype=wp.bool, device=self.device)

    def reset(self, mask, **changes):
        """``reset_worlds``."""
        reset_worlds(
            make_params(**changes), self.joints, self.ground, self.flags(mask), self.goal_range, self.goal_scale,
            self.state, self.qpos, self.qvel, self.obs,
        )  # fmt: skip

    def snapshot(self):
        """Everything that a reset may write."""
        arrays = {name: getattr(self.state, name) for name in LocomotionState.vars}
        arrays |= {"qpos": self.qpos, "qvel": self.qvel, "obs": self.obs}
        return {name: array.numpy().copy() for name, array in arrays.items()}


def bilinear(heights, x, y):
    """Ground at a point, clamped to the grid."""
    u, v = (x - CORNER[0]) / CELL, (y - CORNER[1]) / CELL
    i, j = (int(np.clip(np.floor(w), 0, n - 2)) for w, n in zip((u, v), heights.shape, strict=True))
    s, t = np.clip(u - i, 0, 1), np.clip(v - j, 0, 1)
    near = heights[i, j] * (1 - t) + heights[i, j + 1] * t
    return near * (1 - s) + (heights[i + 1, j] * (1 - t) + heights[i + 1, j + 1] * t) * s


def test_reset_matches_reference(device, uniform_reference):
    """Place, height, speeds, joints, goal, clocks and observation of a new episode are the reference's draws."""
    world = World(device)
    before = world.snapshot()
    mask = np.arange(N) % 3 == 0
    world.reset(mask)
    after, seed = world.snapshot(), 9
    for i in np.flatnonzero(mask):
        number, episode = 100 + i, int(before["episode_count"][i])

        def draw(block, purpose=Purpose.RESET, number=number, episode=episode):
            return uniform_reference(seed, purpose, number, episode, 0, block)

        u = draw(0)
        origin = world.origins[before["level"][i], number % COLUMNS].astype(float)
        x, y = origin[:2] + 2 * u[:2] - 1
        offsets = np.linspace(-0.5, 0.5, 5)
        ground = max(bilinear(world.heights.astype(float), x + a, y + b) for a in offsets for b in offsets)
        qpos, qvel = after["qpos"][i], after["qvel"][i]
        np.testing.assert_allclose(qpos[:3], [x, y, ground + 0.42], rtol=0, atol=2e-5)
        np.testing.assert_array_equal(qpos[3:7], [1, 0, 0, 0])
        factor = 0.5 + np.concatenate([draw(4 + k) for k in range(3)])
        np.testing.assert_allclose(qpos[7:], np.clip(POSE * factor, LOW, HIGH), rtol=1e-6)
        speeds = np.concatenate([draw(1)[:3], draw(2)[:3]]) - 0.5
        np.testing.assert_allclose(qvel, np.append(speeds, np.zeros(J)), rtol=0, atol=1e-6)
        goal = (2 * draw(0, Purpose.FIRST_GOAL)[:3] - 1) * [1.0, 0.5, 2.0]
        np.testing.assert_allclose(after["goal"][i], goal, rtol=0, atol=1e-6)
        body = np.concatenate([2 * qvel[:3], 0.25 * qvel[3:6], [0, 0, -1], goal * GOAL_SCALE, qpos[7:] - POSE])
        np.testing.assert_allclose(after["obs"][i, :48], np.append(body, np.zeros(24)), rtol=0, atol=1e-5)
        assert after["episode_count"][i] == episode + 1
    for name in ("action", "joint_speed", "air_time", "tracked", "foot_contact", "goal_clock", "episode_step"):
        assert not after[name][mask].any(), name
    for name in after:
        np.testing.assert_array_equal(after[name][~mask], before[name][~mask], err_msg=name)
    np.testing.assert_array_equal(after["goal_count"], before["goal_count"])


def test_only_first_episodes_are_staggered(device, uniform_reference):
    """Clocks start at the drawn steps in a world's first episode, and at 0 in every later one."""
    world = World(device)
    world.state.episode_count.assign(np.arange(N) % 2)
    world.reset(True, stagger=True)
    after = world.snapshot()
    u = uniform_reference(9, Purpose.RESET, 100 + np.arange(N), 0, 0, 3)
    first = np.arange(N) % 2 == 0
    np.testing.assert_array_equal(after["goal_clock"], np.where(first, (u[:, 0] * 500).astype(int), 0))
    np.testing.assert_array_equal(after["episode_step"], np.where(first, (u[:, 1] * 1000).astype(int), 0))


@wp.kernel
def _changes(rule: int, crashed: wp.array[wp.bool], number: wp.array2d[float], change: wp.array[int]):
    i = wp.tid()
    change[i] = change_of_level(rule, crashed[i], number[i, 0], number[i, 1], number[i, 2], number[i, 3])


@pytest.mark.parametrize(
    ("rule", "crashed", "tracking", "distance", "wanted", "expected"),
    [
        (LevelRule.REWARD, False, 0.8, 0.0, 0.0, 1), (LevelRule.REWARD, False, 0.79, 9.0, 0.0, 0),
        (LevelRule.REWARD, False, 0.5, 0.0, 0.0, 0), (LevelRule.REWARD, False, 0.49, 9.0, 0.0, -1),
        (LevelRule.REWARD, True, 1.0, 9.0, 0.0, -1), (LevelRule.DISPLACEMENT, False, 0.0, 4.1, 20.0, 1),
        (LevelRule.DISPLACEMENT, True, 0.0, 4.1, 20.0, 1), (LevelRule.DISPLACEMENT, False, 1.0, 3.9, 8.0, -1),
        (LevelRule.DISPLACEMENT, False, 0.0, 3.9, 7.0, 0), (LevelRule.FROZEN, True, 0.0, 9.0, 9.0, 0),
    ],
)  # fmt: skip
def test_change_of_level(device, rule, crashed, tracking, distance, wanted, expected):
    """The table of the two rules, at and around their thresholds."""
    number = wp.array([[tracking, distance, wanted, 4.0]], dtype=wp.float32, device=device)
    change = wp.full(1, 7, dtype=wp.int32, device=device)
    flag = wp.array([crashed], dtype=wp.bool, device=device)
    wp.launch(_changes, dim=1, inputs=[int(rule), flag, number], outputs=[change], device=device)
    assert change.numpy()[0] == expected


def test_levels_of_first_episodes_and_frozen_ones(device, uniform_reference):
    """First levels are drawn from the lowest ones; frozen levels are a function of the world's number alone."""
    world = World(device)
    world.state.episode_count.zero_()
    flags = [world.flags(value) for value in (True, False, False, False)]
    for rule in (LevelRule.REWARD, LevelRule.FROZEN):
        update_levels(make_params(level_rule=int(rule)), world.ground.origin, *flags, world.qpos, world.state)
        number = 100 + np.arange(N)
        drawn = (uniform_reference(9, Purpose.LEVEL, number, 0)[:, 0] * 2).astype(int)
        expected = drawn if rule == LevelRule.REWARD else number // COLUMNS % LEVELS
        np.testing.assert_array_equal(world.state.level.numpy(), expected)


def test_levels_outside_the_mask_stay(device):
    """Only the worlds that are about to be reset are judged."""
    world = World(device)
    before = world.state.level.numpy().copy()
    mask = np.arange(N) % 2 == 0
    flags = [world.flags(value) for value in (mask, True, False, False)]
    update_levels(make_params(), world.ground.origin, *flags, world.qpos, world.state)
    after = world.state.level.numpy()
    np.testing.assert_array_equal(after[~mask], before[~mask])
    np.testing.assert_array_equal(after[mask], before[mask] - 1)


def test_goals_reach_the_listed_worlds(device):
    """A listed world gets its goal, in physical units, a fresh clock and a higher count; the others keep theirs."""
    world = World(device)
    before = world.snapshot()
    rows, goals = np.array([31, 2, 17]), np.random.default_rng(1).uniform(-2, 2, (3, G)).astype(np.float32)
    row = wp.array(rows, dtype=wp.int32, device=device)
    set_goals(row, world.array(goals), world.goal_scale, world.state, world.obs)
    after = world.snapshot()
    np.testing.assert_allclose(after["goal"][rows], goals / GOAL_SCALE, rtol=1e-6)
    np.testing.assert_allclose(after["obs"][rows, 9:12], goals, rtol=1e-6)
    np.testing.assert_array_equal(after["goal_clock"][rows], 0)
    np.testing.assert_array_equal(after["goal_count"][rows], before["goal_count"][rows] + 1)
    others = np.setdiff1d(np.arange(N), rows)
    for name in after:
        np.testing.assert_array_equal(after[name][others], before[name][others], err_msg=name)


@pytest.mark.parametrize("wanted", [True, False])
def test_heights_and_noise_match_reference(device, uniform_reference, wanted):
    """Heights are 5 clip(z - 0.325 - ground, -1, 1) at points turned by the yaw, the noise is the reference's draw."""
    world, rng = World(device), np.random.default_rng(3)
    points, noise = rng.uniform(-0.8, 0.8, (SCAN, 2)), rng.uniform(0, 0.5, OBS)
    quat = rng.normal(size=(N, 4))
    qpos = world.qpos.numpy().copy()
    qpos[:, 2] = rng.uniform(-1, 2, N)
    qpos[:, 3:7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    world.qpos.assign(qpos)
    body = rng.normal(size=(N, OBS)).astype(np.float32)
    world.obs.assign(body)
    mask = np.arange(N) % 4 < 2
    point = wp.array(points, dtype=wp.vec2, device=device)
    finish_obs(
        make_params(noise=True), world.flags(mask), world.ground.heights, point, world.array(noise), world.qpos,
        world.state, world.obs, wanted=wanted,
    )  # fmt: skip
    found = world.obs.numpy()
    near_edge = 0
    for i in np.flatnonzero(mask == wanted):
        episode, step = (int(getattr(world.state, name).numpy()[i]) for name in ("episode_count", "episode_step"))
        u = uniform_reference(9, Purpose.NOISE, 100 + i, episode, step, np.arange((OBS + 3) // 4)).reshape(-1)[:OBS]
        w, x, y, z = qpos[i, 3:7].astype(float)
        yaw = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        c, s = np.cos(yaw), np.sin(yaw)
        expected = body[i].astype(float)
        cells = (qpos[i, :2] + points @ np.array([[c, s], [-s, c]]) - CORNER) / CELL
        a, b = np.clip(np.floor(cells), 0, [119, 159]).astype(int).T
        h = world.heights
        ground = np.minimum(np.minimum(h[a, b], h[a + 1, b]), h[a, b + 1])
        expected[48:] = 5 * np.clip(qpos[i, 2] - 0.325 - ground, -1, 1)
        wrong = np.abs(found[i] - expected - noise * (2 * u - 1)) > 2e-5
        near = np.append(np.zeros(48, bool), (np.abs(cells - np.round(cells)) < 1e-4).any(axis=1))
        assert not (wrong & ~near).any()
        near_edge += near.sum()
    assert near_edge < 10
    np.testing.assert_array_equal(found[mask != wanted], body[mask != wanted])


def launch_by_name(call, world, **wrong):
    """Call a launcher with arguments that fit, but for what is given."""
    state, device = world.state, world.device
    mask, params = world.flags(True), make_params()
    right = {
        "reset": {
            "joints": world.joints, "ground": world.ground, "mask": mask, "goal_range": world.goal_range,
            "goal_scale": world.goal_scale, "state": state, "qpos": world.qpos, "qvel": world.qvel, "obs": world.obs,
        },
        "levels": {
            "origin": world.ground.origin, "mask": mask, "terminated": mask, "truncated": mask, "invalid": mask,
            "qpos": world.qpos, "state": state,
        },
        "finish": {
            "mask": mask, "heights": world.ground.heights, "point": wp.zeros(SCAN, dtype=wp.vec2, device=device),
            "noise": world.array(np.zeros(OBS)), "qpos": world.qpos, "state": state, "obs": world.obs, "wanted": True,
        },
        "goals": {
            "row": wp.zeros(2, dtype=wp.int32, device=device), "goal": world.array(np.zeros((2, G))),
            "goal_scale": world.goal_scale, "state": state, "obs": world.obs,
        },
    }[call]  # fmt: skip
    launcher = {"reset": reset_worlds, "levels": update_levels, "finish": finish_obs, "goals": set_goals}[call]
    launcher(*(() if call == "goals" else (params,)), **(right | wrong))


CALLS = ("reset", "levels", "finish", "goals")


@pytest.mark.parametrize("call", CALLS)
def test_right_arguments_are_taken(device, call):
    """What the following tests spoil is sound before."""
    launch_by_name(call, World(device))


@pytest.mark.parametrize("rows", [0, N - 1])
@pytest.mark.parametrize("name", LocomotionState.vars)
@pytest.mark.parametrize("call", CALLS)
def test_rejects_a_wrong_state(device, call, name, rows):
    """Every launcher checks every array of the state, and the message names it."""
    world = World(device)
    array = getattr(world.state, name)
    setattr(world.state, name, wp.zeros((rows, *array.shape[1:]), dtype=array.dtype, device=device))
    # A goal is set in as many worlds as have one, so there it is the others that do not fit.
    wrong = "state.action" if (call, name) == ("goals", "goal") else f"state.{name}"
    with pytest.raises(ValueError, match=rf"^{wrong} must be \w+\(.*got \w+\("):
        launch_by_name(call, world)


@pytest.mark.parametrize("call", CALLS)
def test_rejects_goals_without_three_components(device, call):
    """A goal begins with three components of velocity."""
    world = World(device)
    world.state.goal = world.array(np.zeros((N, 2)))
    with pytest.raises(ValueError, match=r"^state.goal must be float32\(40, 3\).*got float32\(40, 2\)"):
        launch_by_name(call, world)


@pytest.mark.parametrize("shape", [(N, 47), (N, 5), (N - 1, OBS), (0, OBS)])
@pytest.mark.parametrize("call", ["reset", "finish", "goals"])
def test_rejects_observations_without_room(device, call, shape):
    """An observation has a row for every world and room for 9 numbers, the goal and three for every joint."""
    world = World(device)
    right = rf"40, {max(48, shape[1])}"
    with pytest.raises(ValueError, match=rf"^obs must be float32\({right}\).*got float32\({shape[0]}, {shape[1]}\)"):
        launch_by_name(call, world, obs=world.array(np.zeros(shape)))


@pytest.mark.parametrize("name", Joints.vars)
def test_rejects_wrong_joints(device, name):
    """A reset needs all numbers of all joints, as many as the robot has angles."""
    world = World(device)
    setattr(world.joints, name, world.array(np.zeros(J - 1)))
    with pytest.raises(ValueError, match=r"(joints.\w+|state.action) must be float32\(.*1[12].*got float32\(.*1[12]"):
        launch_by_name("reset", world)


@pytest.mark.parametrize(
    ("call", "name", "dtype", "shape", "right"),
    [
        ("reset", "goal_range", wp.float32, (2,), r"float32\(3,\)"),
        ("reset", "goal_scale", wp.float32, (4,), r"float32\(3,\)"),
        ("reset", "qpos", wp.float32, (N, 18), r"float32\(40, 19\)"),
        ("reset", "qvel", wp.float32, (39, 18), r"float32\(40, 18\)"),
        ("levels", "truncated", wp.bool, (39,), r"bool\(40,\)"),
        ("levels", "qpos", wp.float32, (39, 19), r"float32\(40, 19\)"),
        ("levels", "origin", wp.float32, (3, 4), r"vec3f\(3, 4\)"),
        ("finish", "heights", wp.float32, (1, 9), r"float32\(2, 9\)"),
        ("finish", "point", wp.vec2, (SCAN + 1,), r"vec2f\(10,\)"),
        ("finish", "noise", wp.float32, (OBS - 1,), r"float32\(58,\)"),
        ("finish", "qpos", wp.float32, (0, 19), r"float32\(40, 19\)"),
        ("goals", "goal", wp.float32, (2, 4), r"float32\(2, 3\)"),
        ("goals", "goal_scale", wp.float32, (4,), r"float32\(3,\)"),
    ],
)
def test_rejects_a_wrong_argument(device, call, name, dtype, shape, right):
    """Each launcher names the array, what it must be and what it was."""
    wrong = {name: wp.zeros(shape, dtype=dtype, device=device)}
    with pytest.raises(ValueError, match=rf"^{name} must be {right} on .*got \w+\({shape[0]},"):
        launch_by_name(call, World(device), **wrong)


def test_rejects_a_ground_of_one_row(device):
    """A robot is placed on at least 2 x 2 samples."""
    world = World(device)
    world.ground.heights = world.array(np.zeros((1, 9)))
    with pytest.raises(ValueError, match=r"^ground.heights must be float32\(2, 9\).*got float32\(1, 9\)"):
        launch_by_name("reset", world)
