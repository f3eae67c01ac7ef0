"""An arm on a legged robot: kinematics, goals and their validity, evaluation, resets."""

import dataclasses
import math

import numpy as np
import pytest
import warp as wp
from deimos.kernels.episodes import make_worlds
from deimos.kernels.goals import draw_candidates
from deimos.kernels.legged.arm import evaluate_arms, reset_arms
from deimos.kernels.legged.arm_goals import (
    ARM,
    SHELL_HIGH,
    SHELL_LOW,
    Arm,
    check_arm,
    end_effector,
    goal_of_place,
    is_clear,
    place_of_goal,
    redraw_candidates,
)
from deimos.kernels.legged.arm_rewards import ARM_TERMS, ArmWeights, vecA
from deimos.kernels.legged.state import (
    COLUMNS,
    NUM_COLUMNS,
    TABLES,
    LeggedWorlds,
    LocomotionParams,
    build,
    make_params,
    sizes,
)
from deimos.kernels.random import Purpose
from scipy import stats

from deimos.sim.legged.robots import go1_rx150 as rx150

J, G, OBS_START, OBS, POINTS = 17, 6, 66, 76, 7
TIP = slice(OBS_START, OBS_START + 3)  # of the observation: the end effector
DT, CELL, CORNER = 0.02, 0.1, (-6.0, -8.0)
GARBAGE = 7.0
OFFSETS = np.array(rx150.OFFSETS) + np.array([rx150.MOUNT, *[(0.0, 0.0, 0.0)] * 5])
AXES = np.array([[float(axis == each) for each in "xyz"] for axis in rx150.AXES])
ORIGIN = np.add(rx150.SHOULDER, (0.0, 0.0, 0.325))
BODY_LOW, BODY_HIGH = np.array([-0.3, -0.2, -9.0]), np.array([0.3, 0.2, -0.06])
MIDDLE, HALF = (np.array(SHELL_HIGH) + SHELL_LOW) / 2, (np.array(SHELL_HIGH) - SHELL_LOW) / 2
MOST = 64  # draws of one goal


@wp.kernel
def _geometry(
    arm: Arm,
    qpos: wp.array2d[float],
    goal: wp.array[wp.vec3],
    tip: wp.array[wp.vec3],
    place: wp.array[wp.vec3],
    back: wp.array[wp.vec3],
    clear: wp.array[wp.bool],
):
    i = wp.tid()
    tip[i] = end_effector(arm, qpos, i)
    place[i] = place_of_goal(goal[i])
    back[i] = goal_of_place(place[i])
    clear[i] = is_clear(arm, goal[i])


def make_arm(device, low=BODY_LOW, high=BODY_HIGH, n=1):
    """The ReactorX-150 on a Go1, with some box to keep out of."""
    arm = build(ARM, device, offset=OFFSETS, axis=AXES, error=np.full(n, GARBAGE))
    arm.origin, arm.body_low, arm.body_high = wp.vec3(*ORIGIN), wp.vec3(*low), wp.vec3(*high)
    arm.weight, arm.obs_start, arm.clearance = vecA(*dataclasses.astuple(ArmWeights())), OBS_START, 0.035
    return arm


def geometry(qpos, goal, device):
    """Everything that ``_geometry`` writes."""
    n = len(goal)
    out = [wp.full(n, wp.vec3(np.nan), dtype=wp.vec3, device=device) for _ in range(3)]
    out.append(wp.zeros(n, dtype=wp.bool, device=device))
    inputs = [make_arm(device), to_array(qpos, device), wp.array(goal, dtype=wp.vec3, device=device)]
    wp.launch(_geometry, dim=n, inputs=inputs, outputs=out, device=device)
    return [array.numpy() for array in out]


def to_array(value, device):
    """A float32 array."""
    return wp.array(np.asarray(value, np.float32), dtype=wp.float32, device=device)


def rotation(axis, angle):
    """The matrix of a turn about a coordinate axis."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[j, i], matrix[i, j] = s, -s
    return matrix


def tip_reference(angles):
    """The end effector in the trunk's frame, from the base to the tip, frame by frame."""
    position, turned = np.array(rx150.MOUNT), np.eye(3)
    for offset, axis, angle in zip(rx150.OFFSETS, rx150.AXES, angles, strict=False):
        position = position + turned @ offset
        turned = turned @ rotation(axis, angle)
    return position + turned @ rx150.OFFSETS[-1]


def place_reference(goal):
    """Spherical to Cartesian."""
    distance, pitch, yaw = MIDDLE + np.asarray(goal, np.float64) * HALF
    level = distance * math.cos(pitch)
    return np.array([level * math.cos(yaw), level * math.sin(yaw), distance * math.sin(pitch)])


def goal_reference(place):
    """Cartesian to spherical."""
    x, y, z = place
    return (np.array([math.dist(place, (0, 0, 0)), math.atan2(z, math.hypot(x, y)), math.atan2(y, x)]) - MIDDLE) / HALF


def clear_reference(goals):
    """Whether goals are outside the box, shape (n,)."""
    places = np.array([place_reference(goal) for goal in goals])
    return ((places < BODY_LOW) | (places > BODY_HIGH)).any(axis=1)


def heights_reference():
    """A plane, so that what is bilinear is exact."""
    x, y = CORNER[0] + CELL * np.arange(121), CORNER[1] + CELL * np.arange(161)
    return 0.1 * x[:, None] - 0.05 * y[None, :] + 0.3


def make_world(n, seed=0):
    """A random moment of n worlds."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(n, 4))
    return {
        "qpos": np.concatenate([
            rng.uniform(-4, 4, (n, 2)), rng.uniform(0.2, 0.5, (n, 1)),
            quat / np.linalg.norm(quat, axis=1, keepdims=True),
            rng.uniform(-1.5, 1.5, (n, J)),
        ], axis=1),
        "qvel": rng.normal(size=(n, 6 + J)), "ctrl": rng.normal(size=(n, J)), "torque": rng.normal(size=(n, J)),
        "part_force": np.zeros((4, n, 13)), "overflow": np.zeros(n),
        "goal": rng.uniform(-1, 1, (n, G)), "action": rng.normal(size=(n, J)), "joint_speed": np.zeros((n, J)),
        "air_time": np.zeros((n, 4)), "tracked": np.zeros((n, 2)), "wanted": rng.normal(size=(n, J)),
        "foot_contact": np.zeros(n), "level": np.zeros(n), "goal_start": np.zeros((n, 3)), "progress": np.zeros((n, 4)),
        "episode_count": rng.integers(1, 5, n),
    }  # fmt: skip


class World:
    """The same on a device, with outputs that no kernel has written yet."""

    def __init__(self, arrays, device, *, seed=9, world_offset=50, heights=None, arm=None):
        n = len(arrays["qpos"])
        self.arm = arm or make_arm(device, n=n)
        self.worlds = make_worlds(
            n, device, obs_dim=OBS, action_dim=J, goal_start=9, goal_scale=[2.0, 2.0, 0.25, 1.0, 1.0, 1.0],
            goal_period=500, seed=seed, world_offset=world_offset, num_groups=3,
        )  # fmt: skip
        for name in ("goal", "episode_count"):
            getattr(self.worlds, name).assign(arrays[name])
        self.worlds.action.assign(arrays["wanted"])
        for name in ("obs", "tracking"):
            getattr(self.worlds, name).fill_(GARBAGE)
        heights = heights_reference() if heights is None else heights
        values = arrays | {
            "term": np.full((n, NUM_COLUMNS + len(ARM_TERMS)), GARBAGE), "value": np.zeros(n), "pose": np.zeros(J),
            "action_scale": np.zeros(J), "low": np.zeros(J), "high": np.zeros(J),
            "action_low": np.full(J, -100.0), "action_high": np.full(J, 100.0), "heights": heights,
            "origin": np.zeros((1, 1, 3)), "noise": np.zeros(OBS), "point": np.zeros((POINTS, 2)),
        }  # fmt: skip
        params = {name: getattr(LocomotionParams(), name) for name in LocomotionParams.vars} | {
            "dt": DT, "max_speed": 20.0, "max_rate": 500.0, "cell": CELL,
            "corner": wp.vec2(*CORNER),
        }  # fmt: skip
        self.legged = LeggedWorlds(
            sizes=sizes(
                num_envs=n, num_joints=J, substeps=4, num_points=POINTS, heights=heights.shape, goal_dim=G,
                num_groups=3, num_terms=NUM_COLUMNS + len(ARM_TERMS), arm_fields=3,
            ),
            params=make_params(**params),
            worlds=self.worlds,
            **{label: build(table, device, **values) for label, table in TABLES.items() if label != "worlds"},
        )  # fmt: skip
        check_arm(self.arm, self.legged)

    def evaluate(self):
        """One ``evaluate_arms``."""
        evaluate_arms(self.legged, self.arm)
        out = {"obs": self.worlds.obs, "tracking": self.worlds.tracking, "term": self.legged.out.term}
        return {name: array.numpy() for name, array in (out | {"error": self.arm.error}).items()}

    def reset(self, mask, goal_range):
        """One ``reset_arms``."""
        self.worlds.mask.assign(mask)
        self.worlds.first_range.assign(goal_range)
        reset_arms(self.legged, self.arm)


def place_of(qpos):
    """The end effector relative to the goals' origin, on the sloping plane, in float64."""
    w, x, y, z = qpos[3:7]
    forward = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    left = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
    tip = np.stack([forward, left, np.cross(forward, left)], axis=1) @ tip_reference(qpos[19:24])
    flat = rotation("z", math.atan2(forward[1], forward[0])).T @ tip
    # The mean of a plane over points around the base is its height below the base.
    ground = 0.1 * qpos[0] - 0.05 * qpos[1] + 0.3
    return np.add(flat, (0, 0, qpos[2] - ground)) - ORIGIN


def test_kinematics_are_the_tables(device):
    """The end effector is that of the chain of published offsets, and at the zero pose where the table says."""
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, size=(200, 5))
    angles[0] = 0.0
    qpos = np.concatenate([np.zeros((200, 19)), angles], axis=1)
    tip = geometry(qpos, np.zeros((200, 3)), device)[0]
    # Five turns of vectors below 0.7 m, about ten rounded operations each.
    np.testing.assert_allclose(tip, [tip_reference(a) for a in angles], rtol=0, atol=50 * 2.0**-24)
    np.testing.assert_allclose(tip[0] - rx150.MOUNT, (0.358575, 0.0, 0.25457), atol=1e-6)


def test_goals_map_to_places_and_back(device):
    """A goal's place is spherical geometry, corners of the box are those of the shell, and the way back is exact."""
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    goals = np.concatenate([corners, np.random.default_rng(1).uniform(-1, 1, size=(500, 3))])
    _, place, back, clear = geometry(np.zeros((len(goals), 24)), goals, device)
    expected = np.array([place_reference(goal) for goal in goals])
    np.testing.assert_allclose(place, expected, rtol=0, atol=10 * 2.0**-24)
    np.testing.assert_allclose(np.linalg.norm(place[:8], axis=1), np.repeat([0.15, 0.45], 4), rtol=1e-6)
    # Places of order 0.1 m are off by some 2^-26, an angle by that over the least level distance of 0.075 m.
    np.testing.assert_allclose(back, goals, rtol=0, atol=2e-6)
    assert np.array_equal(clear, clear_reference(goals))
    assert 0.1 < 1 - clear.mean() < 0.5


@pytest.mark.parametrize("n", [1, 130])
def test_evaluation_matches_reference(device, n):
    """Terms, tracking, observation and error equal plain NumPy from the same state, on sloping ground."""
    arrays = make_world(n, seed=n)
    out = World(arrays, device).evaluate()
    for i in range(n):
        place = place_of(arrays["qpos"][i])
        seen, goal = goal_reference(place), arrays["goal"][i, 3:]
        distance = np.linalg.norm(place - place_reference(goal))
        values = {
            "reach": np.exp(-np.abs(seen - goal).sum() / 2),
            "precision": 1 / (1 + distance / 0.05),
            "arm_energy": np.abs(arrays["torque"][i, 12:] * arrays["qvel"][i, 18:]).sum(),
            "arm_action_rate": ((arrays["wanted"][i, 12:] - arrays["action"][i, 12:]) ** 2).sum(),
        }
        terms = [DT * getattr(ArmWeights(), name) * values[name] for name in ARM_TERMS]
        # Positions of some metres are off by 2^-22 m; angles by that over the distance from the axis.
        slack = 1e-6 / max(0.01, math.hypot(place[0], place[1]))
        np.testing.assert_allclose(out["term"][i, NUM_COLUMNS:], terms, rtol=1e-4 + 10 * slack, atol=1e-7)
        np.testing.assert_allclose(out["tracking"][i, 2], values["reach"], rtol=1e-4 + 10 * slack)
        np.testing.assert_allclose(out["obs"][i, TIP], np.clip(seen, -2, 2), rtol=0, atol=1e-4 + slack)
        np.testing.assert_allclose(out["error"][i], distance, rtol=0, atol=2e-6)
    assert np.all(np.delete(out["obs"], TIP, axis=1) == GARBAGE)
    assert np.all(out["term"][:, :NUM_COLUMNS] == GARBAGE)
    assert np.all(out["tracking"][:, :2] == GARBAGE)


def test_a_goal_that_is_met_earns_all(device):
    """Where the end effector is the goal, the error is 0 and both rewards are their weights; the goal shows as seen."""
    arrays = make_world(100, seed=5)
    arrays["qpos"][:, 3:7] = (1, 0, 0, 0)
    places = np.array([place_of(q) for q in arrays["qpos"]])
    arrays["goal"][:, 3:] = [goal_reference(place) for place in places]
    out = World(arrays, device).evaluate()
    far = np.hypot(places[:, 0], places[:, 1]) > 0.05
    assert far.sum() > 80
    np.testing.assert_allclose(out["error"], 0, atol=2e-6)
    np.testing.assert_allclose(out["term"][far, NUM_COLUMNS], 0.5 * DT, rtol=1e-4)
    np.testing.assert_allclose(out["term"][:, NUM_COLUMNS + 1], ArmWeights().precision * DT, rtol=1e-4)
    seen = np.clip(arrays["goal"][far, 3:], -2, 2)
    np.testing.assert_allclose(out["obs"][far, TIP], seen, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "column", "value"),
    [("qpos", 20, np.nan), ("qvel", 8, np.inf), ("qvel", 0, 99.0), ("goal", 1, np.nan), ("goal", 5, np.inf)],
)
def test_worlds_that_are_not_physical_are_left_alone(device, name, column, value):
    """Nothing is written of a broken world, and no bit of its neighbours' changes."""
    arrays = make_world(5)
    sound = World(arrays, device).evaluate()
    arrays[name][2, column] = value
    broken = World(arrays, device).evaluate()
    for key, array in broken.items():
        assert np.all(array[2] == GARBAGE), key
        np.testing.assert_array_equal(np.delete(array, 2, 0), np.delete(sound[key], 2, 0), err_msg=key)


def test_torch_sees_the_error_in_place(device):
    """The error's torch view is the memory that the kernel writes."""
    torch = pytest.importorskip("torch")
    world = World(make_world(4), device)
    view = wp.to_torch(world.arm.error)
    assert view.data_ptr() == world.arm.error.ptr
    assert torch.all(view == GARBAGE)
    world.evaluate()
    np.testing.assert_array_equal(view.cpu().numpy(), world.arm.error.numpy())
    assert not torch.any(view == GARBAGE)


def draw(device, n, count, scale, *, arm=None, seed=3, world_offset=20, heights=None):
    """Candidates before and after ``redraw_candidates``, each (n, count, 6); robots face x at the world's origin."""
    arrays = make_world(n)
    arrays["qpos"] = np.zeros((n, 7 + J))
    arrays["qpos"][:, 3] = 1.0
    ground = np.zeros((121, 161)) if heights is None else heights
    world = World(
        arrays, device, seed=seed, world_offset=world_offset, heights=ground, arm=arm or make_arm(device, n=n)
    )
    world.worlds.goal_count.assign(np.arange(n) % 4)
    row = wp.array(np.arange(n), dtype=wp.int32, device=device)
    scale = to_array(scale, device)
    candidate = wp.full((n, count, G), np.nan, dtype=wp.float32, device=device)
    draw_candidates(row, scale, candidate, world.worlds).launch()
    first = candidate.numpy().copy()
    redraw_candidates(world.legged, world.arm, row, scale, candidate).launch()
    return first, candidate.numpy()


def test_no_goal_is_in_the_ground(device):
    """Beyond the edge of a high step goals stay above it by the clearance; those before it are as on level ground."""
    x = CORNER[0] + CELL * np.arange(121)
    heights = np.tile(np.where(x > 0.25, 0.5, 0.0)[:, None], (1, 161))  # rises from 0 to 0.5 m between 0.2 and 0.3 m
    first, last = draw(device, 60, 100, np.ones(G), heights=heights)
    level = draw(device, 60, 100, np.ones(G))[1].reshape(-1, G)[:, 3:]

    # The highest row of points below the trunk is at 0.19 m, before the step, so the origin is where it is without one.
    def above(goals):
        points = np.array([place_reference(goal) for goal in goals]) + ORIGIN
        return points[:, 2] - 0.5 * np.clip((points[:, 0] - 0.2) / 0.1, 0.0, 1.0)

    goals = last.reshape(-1, G)[:, 3:]
    assert above(goals).min() >= 0.035 - 1e-5
    sunk = above(level) < 0.035
    assert sunk.mean() > 0.05
    np.testing.assert_array_equal(goals[~sunk], level[~sunk])
    assert not np.any(goals[sunk] == level[sunk])
    assert np.isfinite(first).all()


def test_redraws_match_reference(device, uniform_reference):
    """Valid candidates stay bit for bit; others become the first valid one of further draws of their own address."""
    scale = np.array([1.0, 0.5, 2.0, 1.0, 0.9, 0.8], np.float32)
    first, last = draw(device, 12, 9, scale)
    np.testing.assert_array_equal(first[..., :3], last[..., :3])
    changed = 0
    for i in range(12):
        for k in range(9):
            goal, block = first[i, k, 3:], 2
            while not clear_reference([goal])[0]:
                u = uniform_reference(3, Purpose.CANDIDATE, 20 + i, i % 4, k, block)[:3]
                goal, block = np.float32(2 * u - 1) * scale[3:], block + 1
            changed += block > 2
            np.testing.assert_array_equal(last[i, k, 3:], goal)
    assert changed > 5


def test_no_goal_is_ever_invalid_and_valid_ones_are_uniform(device):
    """Of 200 000 goals not one is in the box, and cells that are all valid get equal shares (chi-square)."""
    goals = draw(device, 400, 500, np.ones(6))[1].reshape(-1, G)[:, 3:]
    assert geometry(np.zeros((len(goals), 24)), goals, device)[3].all()
    cells = 6
    edges = np.linspace(-1, 1, cells + 1)
    corners = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5 * cells + 1)] * 3, indexing="ij"), axis=-1)
    clear = clear_reference(corners.reshape(-1, 3)).reshape(corners.shape[:3])
    whole = np.array([
        clear[tuple(slice(5 * c, 5 * c + 6) for c in cell)].all() for cell in np.ndindex(cells, cells, cells)
    ])  # fmt: skip
    counts = np.histogramdd(goals, bins=[edges] * 3)[0].reshape(-1)[whole]
    assert 100 < whole.sum() < cells**3
    # A sound generator fails this once in a million.
    assert stats.chisquare(counts).pvalue > 1e-6


def test_where_no_goal_is_valid_it_is_the_middle(device):
    """After the last draw the arm's part is 0: a place before the shoulder."""
    everywhere = np.full(3, 1e3)
    goals = draw(device, 3, 4, np.ones(6), arm=make_arm(device, -everywhere, everywhere, n=3))[1]
    assert np.all(goals[..., 3:] == 0)
    assert clear_reference([np.zeros(3)])[0]


def test_reset_matches_reference(device, uniform_reference):
    """In masked worlds the first goal is valid, drawn again from its own address, and seen; others keep every bit."""
    arrays = make_world(120, seed=2)
    goal_range = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.5], np.float32)
    mask = np.arange(120) % 3 > 0
    world = World(arrays, device)
    before = world.worlds.goal.numpy().copy()
    world.reset(mask, goal_range)
    goals, obs, error = world.worlds.goal.numpy(), world.worlds.obs.numpy(), world.arm.error.numpy()
    changed = 0
    for i in range(120):
        if not mask[i]:
            np.testing.assert_array_equal(goals[i], before[i])
            assert np.all(obs[i] == GARBAGE)
            assert error[i] == GARBAGE
            continue
        goal, block = before[i, 3:], 2
        while not clear_reference([goal])[0]:
            u = uniform_reference(9, Purpose.FIRST_GOAL, 50 + i, arrays["episode_count"][i] - 1, 0, block)[:3]
            goal, block = np.float32(2 * u - 1) * goal_range[3:], block + 1
        changed += block > 2
        np.testing.assert_array_equal(goals[i], np.append(before[i, :3], goal))
        np.testing.assert_array_equal(obs[i, 9:15], goals[i] * np.float32([2, 2, 0.25, 1, 1, 1]))
        place = place_of(arrays["qpos"][i])
        np.testing.assert_allclose(error[i], np.linalg.norm(place - place_reference(goal)), rtol=0, atol=2e-6)
    assert changed > 3


def test_terms_have_names_of_their_own():
    """No column of the log stands for two terms."""
    assert not set(COLUMNS) & set(ARM_TERMS)


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("axis", (4,), r"arm.axis must be vec3f\(5,\).*got vec3f\(4,\)"),
        ("offset", (5,), r"arm.offset must be vec3f\(6,\).*got vec3f\(5,\)"),
        ("error", (4,), r"arm.error must be float32\(5,\).*got float32\(4,\)"),
    ],
)
def test_rejects_an_arm_of_other_joints(device, name, shape, message):
    """An arm has the joints that are not the legs'; the message names the array, what it must be and what it was."""
    arm = make_arm(device, n=5)
    setattr(arm, name, wp.zeros(shape, dtype=ARM.dtype(name), device=device))
    with pytest.raises(ValueError, match=message):
        World(make_world(5), device, arm=arm)


@pytest.mark.parametrize(
    ("label", "name", "shape", "message"),
    [
        ("sim", "qpos", (5, 19), r"sim.qpos must be float32\(5, 24\).*got float32\(5, 19\)"),
        ("worlds", "goal", (5, 3), r"worlds.goal must be float32\(5, 6\)"),
        ("worlds", "first_range", (3,), r"worlds.first_range must be float32\(6,\).*got float32\(3,\)"),
        ("out", "term", (5, 12), r"out.term must be float32\(5, 16\)"),
        ("worlds", "tracking", (5, 2), r"worlds.tracking must be float32\(5, 3\)"),
        ("worlds", "obs", (5, 62), r"worlds.obs must be float32\(5, 76\)"),
    ],
)
def test_rejects_arrays_without_the_arm(device, label, name, shape, message):
    """What robots with an arm have more of is checked with all the rest."""
    legged = World(make_world(5), device).legged
    setattr(getattr(legged, label), name, wp.zeros(shape, dtype=wp.float32, device=device))
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(legged)


def test_redraws_reject_arrays_of_another_shape(device):
    """Candidates have all components of a goal."""
    world, ints = World(make_world(5), device), wp.zeros(2, dtype=wp.int32, device=device)
    right, short = (wp.zeros((2, 4, width), dtype=wp.float32, device=device) for width in (6, 3))
    scale = to_array(np.ones(6), device)
    with pytest.raises(ValueError, match=r"candidate must be float32\(2, 4, 6\).*got float32\(2, 4, 3\)"):
        redraw_candidates(world.legged, world.arm, ints, scale, short)
    with pytest.raises(ValueError, match=r"scale must be float32\(6,\).*got float32\(3,\)"):
        redraw_candidates(world.legged, world.arm, ints, to_array(np.ones(3), device), right)
