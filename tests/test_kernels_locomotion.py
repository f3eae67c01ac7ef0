"""One control step of the legged robots: actions, health, crash, reward, clocks, observation."""

from dataclasses import astuple, replace

import numpy as np
import pytest
import warp as wp
from deimos.kernels.episodes import make_worlds
from deimos.kernels.legged.rewards import TERMS, RewardWeights, vec12, vecT
from deimos.kernels.legged.state import (
    BROKEN,
    COLUMNS,
    NUM_COLUMNS,
    NUM_PARTS,
    TABLES,
    LeggedWorlds,
    LevelRule,
    LocomotionParams,
    build,
    make_params,
    sizes,
)
from deimos.kernels.legged.step import apply_actions, evaluate_step
from deimos.kernels.random import Purpose

J, G, OBS, SUBSTEPS = 12, 3, 48, 4
DT = 0.02
COUNTERS = ("goal_clock", "episode_step", "episode_count", "goal_count")
FLAGS = ("terminated", "truncated", "goal_due", "invalid")
GOAL_SCALE = np.array([2.0, 2.0, 0.25], np.float32)
POSE = np.tile([0.1, 0.8, -1.5], 4).astype(np.float32)
LOW, HIGH = POSE - 0.5, POSE + 0.5
PARAMS = {
    "dt": DT, "stagger": False, "noise": False, "push_interval": 0, "push_speed": 1.0,
    "weight": vecT(*astuple(RewardWeights())), "air_time_target": 0.3, "soft_low": vec12(*LOW),
    "soft_high": vec12(*HIGH), "max_speed": 20.0, "max_rate": 500.0, "lost_contacts": 0b1011, "scan_start": OBS,
    "standing_height": 0.325, "spawn_height": 0.42, "spawn_range": 1.0, "spawn_speed": 0.5, "spawn_reach": 0.5,
    "level_rule": int(LevelRule.REWARD), "start_levels": 6, "cell": 0.1, "corner": wp.vec2(-50.0, -50.0),
    "low": wp.vec2(-49.0, -48.0), "high": wp.vec2(47.0, 46.0),
}  # fmt: skip
"""Legged Gym's numbers on a plane."""


def make_world(n, seed=0):
    """A random moment of n worlds, in NumPy."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(n, 4))
    w = {
        "qpos": np.concatenate([
            rng.uniform(-40, 40, (n, 3)), quat / np.linalg.norm(quat, axis=1, keepdims=True),
            POSE + rng.normal(scale=0.4, size=(n, J)),
        ], axis=1),
        "qvel": rng.normal(size=(n, 6 + J)),
        "ctrl": np.full((n, J), np.nan),
        "torque": rng.normal(scale=10, size=(n, J)),
        "part_force": rng.exponential(size=(SUBSTEPS, n, NUM_PARTS)) * (rng.random((SUBSTEPS, n, NUM_PARTS)) < 0.15),
        "overflow": np.zeros(n),
        "wanted": rng.normal(size=(n, J)),
        "goal": rng.uniform(-1, 1, (n, G)), "action": rng.normal(size=(n, J)), "joint_speed": rng.normal(size=(n, J)),
        "air_time": rng.integers(0, 40, (n, 4)) * DT, "tracked": np.stack([rng.uniform(0, 9, n), np.full(n, 9.0)], 1),
        **{name: np.zeros(n) for name in (*COUNTERS, "level")},
        "foot_contact": rng.integers(0, 16, n), "goal_start": np.zeros((n, 3)), "progress": np.zeros((n, 4)),
    }  # fmt: skip
    integers = (*COUNTERS, "level", "foot_contact", "overflow")
    return {name: value.astype(np.int32 if name in integers else np.float32) for name, value in w.items()}


class World:
    """The same on a device, with outputs that no kernel has written yet; ``changes`` are fields of the parameters."""

    def __init__(self, arrays, device, garbage=np.nan, arm_terms=None, bound=100.0, seed=0, world_offset=0, **changes):
        n = len(arrays["qpos"])
        self.worlds = make_worlds(
            n, device, obs_dim=OBS, action_dim=J, goal_start=9, goal_scale=GOAL_SCALE, goal_period=500,
            time_limit=1000, seed=seed, world_offset=world_offset, num_groups=2,
        )  # fmt: skip
        for name in (*COUNTERS, "goal"):
            getattr(self.worlds, name).assign(arrays[name])
        self.worlds.action.assign(arrays["wanted"])
        for name in ("obs", "tracking", "reward"):
            getattr(self.worlds, name).fill_(garbage)
        for name in FLAGS:
            getattr(self.worlds, name).fill_(True)
        term = np.full((n, NUM_COLUMNS), garbage)
        if arm_terms is not None:
            term = np.concatenate([term, arm_terms], axis=1)
        values = arrays | {
            "term": term, "value": np.full(n, garbage), "pose": POSE, "action_scale": np.full(J, 0.25), "low": LOW,
            "high": HIGH, "action_low": np.full(J, -bound), "action_high": np.full(J, bound),
            "heights": np.zeros((2, 2)), "origin": np.zeros((1, 1, 3)), "noise": np.zeros(OBS),
            "point": np.zeros((0, 2)),
        }  # fmt: skip
        structs = {label: build(table, device, **values) for label, table in TABLES.items() if label != "worlds"}
        self.legged = LeggedWorlds(
            sizes=sizes(
                num_envs=n, num_joints=J, substeps=SUBSTEPS, num_points=0, heights=(2, 2), num_terms=term.shape[1]
            ),
            params=make_params(**(PARAMS | changes)), worlds=self.worlds, **structs,
        )  # fmt: skip
        self.sim, self.state = self.legged.sim, self.legged.state

    def evaluate(self):
        """One ``evaluate_step``; gives all that a step gives back."""
        evaluate_step(self.legged)
        names = ("obs", "reward", "tracking", "fault", "cause", *FLAGS)
        out = {name: getattr(self.worlds, name) for name in names}
        out |= {name: getattr(self.legged.out, name) for name in TABLES["out"].names}
        return {name: array.numpy() for name, array in out.items()}

    def apply(self):
        """One ``apply_actions``."""
        apply_actions(self.legged)


def to_matrix(quat):
    """Rotation matrix from body to world."""
    w, x, y, z = quat
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def evaluate_reference(w):
    """Terms, observation and what is remembered, robot by robot, in float64, from Legged Gym's source."""
    n = len(w["qpos"])
    w = {name: value.astype(np.float64) if value.dtype == np.float32 else value for name, value in w.items()}
    force = w["part_force"].max(axis=0)
    result = {"terms": [], "obs": [], "air_time": [], "crashed": [], "tracking": []}
    for i in range(n):
        rotation = to_matrix(w["qpos"][i, 3:7])
        v, rate, down = rotation.T @ w["qvel"][i, :3], w["qvel"][i, 3:6], rotation.T @ [0, 0, -1]
        q, qd, goal, action = w["qpos"][i, 7:], w["qvel"][i, 6:], w["goal"][i], w["wanted"][i]
        contact = [force[i, 1 + k] > 1.0 or bool(w["foot_contact"][i] & 1 << k) for k in range(4)]
        air = w["air_time"][i]
        landed = sum(air[k] + DT - 0.3 for k in range(4) if contact[k] and air[k] > 0)
        terms = {
            "linear_tracking": np.exp(-((goal[0] - v[0]) ** 2 + (goal[1] - v[1]) ** 2) / 0.25),
            "yaw_tracking": np.exp(-((goal[2] - rate[2]) ** 2) / 0.25),
            "vertical_speed": v[2] ** 2,
            "roll_pitch_rate": rate[0] ** 2 + rate[1] ** 2,
            "tilt": down[0] ** 2 + down[1] ** 2,
            "torque": (w["torque"][i] ** 2).sum(),
            "joint_acceleration": (((w["joint_speed"][i] - qd) / DT) ** 2).sum(),
            "action_rate": ((w["action"][i] - action) ** 2).sum(),
            "joint_limit": (np.maximum(LOW - q, 0) + np.maximum(q - HIGH, 0)).sum(),
            "collision": (force[i, 5:] > 0.1).sum(),
            "air_time": landed if np.hypot(goal[0], goal[1]) > 0.1 else 0.0,
        }
        weights = vars(RewardWeights())
        result["terms"].append([DT * weights[name] * terms[name] for name in TERMS])
        result["tracking"].append([terms["linear_tracking"], terms["yaw_tracking"]])
        result["obs"].append(np.concatenate([2 * v, 0.25 * rate, down, goal * GOAL_SCALE, q - POSE, 0.05 * qd, action]))
        result["air_time"].append([0.0 if contact[k] else air[k] + DT for k in range(4)])
        result["crashed"].append(force[i, 0] > 1.0)
    return {name: np.array(value) for name, value in result.items()}


@pytest.mark.parametrize("n", [1, 257])
def test_step_matches_reference(device, n):
    """Terms, reward, observation, air times and the crash flag equal plain NumPy from the same state."""
    arrays = make_world(n, seed=n)
    world, expected = World(arrays, device), evaluate_reference(arrays)
    out = world.evaluate()
    # Sums of at most 24 squares of float32 numbers of order 10; exp passes the error of its argument on.
    np.testing.assert_allclose(out["term"][:, :-1], expected["terms"], rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(out["tracking"], expected["tracking"], rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(out["obs"], expected["obs"], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(out["reward"], np.maximum(expected["terms"].sum(1), 0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(world.state.air_time.numpy(), expected["air_time"], rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(out["terminated"], expected["crashed"])
    np.testing.assert_array_equal(world.state.action.numpy(), arrays["wanted"])
    np.testing.assert_array_equal(world.state.joint_speed.numpy(), arrays["qvel"][:, 6:])
    np.testing.assert_allclose(
        world.state.tracked.numpy(),
        arrays["tracked"] + np.stack([expected["tracking"][:, 0], np.ones(n)], 1),
        rtol=1e-5,
    )
    assert not out["invalid"].any()
    if n > 1:
        assert 0 < expected["crashed"].sum() < n


def test_columns_add_up_to_the_reward(device):
    """The logged columns, what clipping added being one of them, sum to the reward, which is never negative."""
    arrays = make_world(400)
    arrays["qvel"] *= 0.3
    arrays["torque"] *= 0.1
    arrays["part_force"] *= 0.1
    arrays["action"] = arrays["wanted"]
    arrays["joint_speed"] = arrays["qvel"][:, 6:]
    out = World(arrays, device).evaluate()
    total = out["term"].astype(np.float64).sum(1)
    # Each of the 12 additions is rounded by 2^-24 of a partial sum, all of which are below the sum of the magnitudes.
    bound = 13 * 2.0**-24 * np.abs(out["term"]).sum(1)
    assert np.all(np.abs(total - out["reward"]) <= bound)
    assert np.all(out["reward"] >= 0)
    clipped = out["term"][:, COLUMNS.index("clipping")] > 0
    assert 0 < clipped.sum() < 400
    assert np.all(out["reward"][clipped] == 0)


def test_terms_of_an_arm_count_before_the_clip(device):
    """Columns beyond the legs', written before, are kept, join the sum that is clipped, and go where a world breaks."""
    arrays = make_world(300)
    arrays["qvel"] *= 0.3
    arrays["qvel"][7, 0] = np.nan
    alone = World(arrays, device).evaluate()
    arms = np.random.default_rng(0).normal(scale=0.3, size=(300, 2)).astype(np.float32)
    out = World(arrays, device, arm_terms=arms).evaluate()
    arms[7] = 0
    np.testing.assert_array_equal(out["term"][:, NUM_COLUMNS:], arms)
    np.testing.assert_array_equal(out["term"][:, : len(TERMS)], alone["term"][:, : len(TERMS)])
    total = out["term"][:, : len(TERMS)].astype(np.float64).sum(1) + arms.sum(1, dtype=np.float64)
    bound = 15 * 2.0**-24 * np.abs(out["term"]).sum(1)
    assert np.all(np.abs(out["reward"] - np.maximum(total, 0)) <= bound)
    assert np.all(np.abs(out["term"].astype(np.float64).sum(1) - out["reward"]) <= bound)
    assert 0 < ((out["reward"] > 0) & (alone["reward"] == 0)).sum() < 300


def test_crash_needs_more_than_a_newton_on_the_base_in_any_substep(device):
    """1 N on the base is no crash, the next float32 is, in whichever substep; other parts never are."""
    arrays = make_world(2 * SUBSTEPS + NUM_PARTS)
    arrays["part_force"][:] = 0
    one = np.float32(1.0)
    for substep in range(SUBSTEPS):
        arrays["part_force"][substep, 2 * substep, 0] = one
        arrays["part_force"][substep, 2 * substep + 1, 0] = np.nextafter(one, np.float32(2))
    for part in range(1, NUM_PARTS):
        arrays["part_force"][0, 2 * SUBSTEPS + part, part] = 1000.0
    out = World(arrays, device).evaluate()
    assert out["terminated"].tolist() == [False, True] * SUBSTEPS + [False] * NUM_PARTS


def test_air_time_counts_from_lift_to_touch(device):
    """A foot that is up for 0.4 s and lands earns 0.4 s plus the step of the landing minus the target, once."""
    arrays = make_world(1)
    arrays |= {"part_force": np.zeros_like(arrays["part_force"]), "air_time": np.zeros((1, 4), np.float32)}
    arrays["foot_contact"][:] = 0
    arrays["goal"][:] = 1.0
    world = World(arrays, device)
    earned = []
    for step in range(30):
        force = np.zeros((SUBSTEPS, 1, NUM_PARTS), np.float32)
        force[1, 0, 2] = 5.0 if step >= 20 else 0.0  # the second foot lands on the 21st step
        world.sim.part_force.assign(force)
        earned.append(world.evaluate()["term"][0, TERMS.index("air_time")])
    assert np.flatnonzero(earned).tolist() == [20]
    # Twenty-one additions of 0.02 s, each rounded.
    np.testing.assert_allclose(earned[20], DT * (21 * DT - 0.3), rtol=1e-5)
    # It keeps counting in the other feet, and the landed one has none.
    np.testing.assert_allclose(world.state.air_time.numpy()[0], [30 * DT, 0, 30 * DT, 30 * DT], rtol=1e-5)


def test_clocks_and_ends(device):
    """A goal falls due after its period, an episode ends at its limit or off the terrain, and a crash comes first."""
    n = 6
    arrays = make_world(n)
    arrays["part_force"][:] = 0
    arrays["qpos"][:, :2] = 0
    arrays["goal_clock"][:] = [0, 498, 499, 500, 0, 499]
    arrays["episode_step"][:] = [0, 998, 999, 0, 0, 999]
    arrays["qpos"][4, 0] = 47.5  # beyond the terrain
    arrays["part_force"][2, 5, 0] = 9.0
    out = World(arrays, device).evaluate()
    assert out["goal_due"].tolist() == [False, False, True, True, False, True]
    assert out["truncated"].tolist() == [False, False, True, False, True, False]
    assert out["terminated"].tolist() == [False] * 5 + [True]
    assert out["fault"].tolist() == [0, n, n]


FAULTS = {
    "position": ("qpos", (2, 9), np.nan, 2), "far": ("qpos", (2, 0), np.inf, 2),
    "velocity": ("qvel", (2, 7), -np.inf, 4),
    "speed": ("qvel", (2, 1), 21.0, 8), "spin": ("qvel", (2, 17), -501.0, 8), "contacts": ("overflow", (2,), 2, 16),
    "goal": ("goal", (2, 2), np.nan, 32), "far goal": ("goal", (2, 0), np.inf, 32),
}  # fmt: skip


def test_every_fault_has_a_name():
    """The bit of every fault stands for the quantity that is at fault."""
    for name, (array, _, _, bit) in FAULTS.items():
        named = BROKEN[bit.bit_length() - 1]
        assert named == (name if name in BROKEN else {"qpos": "position", "qvel": "speed", "goal": "goal"}[array])


def test_a_reward_that_is_not_a_number_is_none(device):
    """A torque that is NaN, which leaves the state sound, makes the reward NaN, and not 0 as a maximum would."""
    arrays = make_world(3)
    arrays["torque"][1, 4] = np.nan
    out = World(arrays, device).evaluate()
    assert np.isnan(out["reward"]).tolist() == [False, True, False]
    assert not out["invalid"].any()


@pytest.mark.parametrize("fault", FAULTS)
def test_invalid_worlds_are_cut_off_and_reach_nobody(device, fault):
    """A broken world is flagged, gets no reward and keeps its observation; its neighbours notice nothing."""
    name, index, value, bit = FAULTS[fault]
    arrays = make_world(5)
    arrays["part_force"][:] = 0
    arrays["qpos"][:, :2] = 0
    arrays["goal_clock"][2] = 499
    sound = World(arrays, device, garbage=7.0).evaluate()
    broken_arrays = {key: array.copy() for key, array in arrays.items()}
    broken_arrays[name][index] = value
    world = World(broken_arrays, device, garbage=7.0)
    out = world.evaluate()
    assert out["invalid"].tolist() == [False, False, True, False, False]
    assert out["truncated"].tolist() == [False, False, True, False, False]
    assert sound["goal_due"].tolist() == [False, False, True, False, False]
    assert not out["goal_due"].any()
    assert out["fault"].tolist() == [1, 2, 5]
    assert out["cause"][2] == bit
    assert out["reward"][2] == 0
    assert not out["term"][2].any()
    assert not out["tracking"][2].any()
    assert np.all(out["obs"][2] == 7.0)
    for key in ("obs", "reward", "term", "terminated", "tracking"):
        np.testing.assert_array_equal(np.delete(out[key], 2, 0), np.delete(sound[key], 2, 0), err_msg=key)
    for key in ("action", "joint_speed", "air_time"):
        assert np.isfinite(getattr(world.state, key).numpy()).all()


def test_a_crash_counts_on_an_invalid_step_too(device):
    """A world that crashes and breaks on the same step is terminated, not merely cut off, and flagged all the same."""
    arrays = make_world(1)
    arrays["part_force"][3, 0, 0] = 50.0
    arrays["qvel"][0, 0] = 1e4
    out = World(arrays, device).evaluate()
    assert out["terminated"][0]
    assert not out["truncated"][0]
    assert out["invalid"][0]


def test_solver_limits_are_no_fault(device):
    """Overflow bits that lose no contact, such as the solver's iteration limit, leave a world valid."""
    arrays = make_world(2)
    arrays["overflow"][:] = 0b110100
    assert not World(arrays, device).evaluate()["invalid"].any()


def test_actions_become_targets(device):
    """Targets are pose plus scaled action, clipped at the joint's bounds, and the overflow bits are cleared."""
    arrays = make_world(50)
    arrays["overflow"][:] = 3
    arrays["wanted"] *= 10
    world = World(arrays, device, bound=5.0)
    world.apply()
    expected = POSE + 0.25 * np.clip(arrays["wanted"], -5, 5)
    np.testing.assert_allclose(world.sim.ctrl.numpy(), expected, rtol=3 * 2.0**-24, atol=2.0**-24)
    np.testing.assert_array_equal(world.sim.qvel.numpy(), arrays["qvel"])
    assert not world.sim.overflow.numpy().any()
    out = world.evaluate()
    np.testing.assert_array_equal(out["obs"][:, 36:], np.clip(arrays["wanted"], -5, 5))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_broken_actions_are_named(device, value):
    """The lowest world with an action that is not finite is noted, whatever clipping makes of it."""
    arrays = make_world(9)
    arrays["wanted"][[4, 7], 3] = value
    world = World(arrays, device)
    world.apply()
    assert world.worlds.fault.numpy().tolist() == [0, 9, 4]


def test_pushes_are_staggered_and_set_the_horizontal_velocity(device, uniform_reference):
    """Each robot is pushed once per interval, at a phase of its own, to the drawn velocity, with the rest untouched."""
    n, interval, seed, offset = 40, 25, 11, 1000
    arrays = make_world(n)
    arrays["episode_count"][:] = 3
    push = {"push_interval": interval, "push_speed": 0.8, "seed": seed, "world_offset": offset}
    worlds = offset + np.arange(n)
    phase = (uniform_reference(seed, Purpose.PUSH, worlds, 0)[:, 0] * interval).astype(int)
    assert len(set(phase)) > interval / 2
    for age in range(1, interval + 1):
        arrays["episode_step"][:] = age
        world = World(arrays, device, **push)
        world.apply()
        expected = arrays["qvel"].copy()
        due = (age + phase) % interval == 0
        u = uniform_reference(seed, Purpose.PUSH, worlds, 3, age)
        expected[due, :2] = ((2 * u[:, :2] - 1) * 0.8)[due]
        np.testing.assert_allclose(world.sim.qvel.numpy(), expected, rtol=0, atol=4 * 2.0**-24)


def test_a_fresh_episode_is_not_pushed(device):
    """No push falls on the first step of an episode."""
    arrays = make_world(300)
    world = World(arrays, device, push_interval=1)
    world.apply()
    np.testing.assert_array_equal(world.sim.qvel.numpy(), arrays["qvel"])


@pytest.mark.parametrize(
    ("label", "name"), [(label, name) for label, table in TABLES.items() for name in table.names]
)  # fmt: skip
@pytest.mark.parametrize("axis", [0, 1])
def test_rejects_arrays_of_another_length(device, label, name, axis):
    """Every array of every struct is checked when worlds are put together, and the message names it."""
    legged = World(make_world(5), device).legged
    struct = getattr(legged, label)
    shape = list(getattr(struct, name).shape)
    axis = min(axis, len(shape) - 1)
    shape[axis] += 1
    setattr(struct, name, wp.zeros(tuple(shape), dtype=TABLES[label].dtype(name), device=device))
    with pytest.raises(ValueError, match=rf"^{label}.{name} must be \w+\(.*got \w+\("):
        replace(legged)


@pytest.mark.parametrize(
    ("label", "name", "shape", "message"),
    [
        ("sim", "qpos", (5, 18), r"sim.qpos must be float32\(5, 19\).*got float32\(5, 18\)"),
        ("sim", "part_force", (4, 5, 3), r"sim.part_force must be float32\(4, 5, 13\)"),
        ("state", "air_time", (5, 3), r"state.air_time must be float32\(5, 4\)"),
        ("worlds", "goal", (5, 2), r"worlds.goal must be float32\(5, 3\)"),
        ("worlds", "fault", (2,), r"worlds.fault must be int32\(3,\)"),
        ("worlds", "action", (5, 11), r"worlds.action must be float32\(5, 12\)"),
        ("out", "term", (5, 3), r"out.term must be float32\(5, 12\)"),
        ("worlds", "tracking", (5, 1), r"worlds.tracking must be float32\(5, 2\)"),
        ("worlds", "obs", (5, 47), r"worlds.obs must be float32\(5, 48\)"),
        ("joints", "pose", (11,), r"joints.pose must be float32\(12,\)"),
        ("ground", "heights", (1, 9), r"ground.heights must be float32\(2, 2\).*got float32\(1, 9\)"),
    ],
)
def test_rejects_arrays_that_are_too_narrow(device, label, name, shape, message):
    """The message names the array, what it must be and what it was."""
    legged = World(make_world(5), device).legged
    setattr(getattr(legged, label), name, wp.zeros(shape, dtype=TABLES[label].dtype(name), device=device))
    with pytest.raises(ValueError, match=message):
        replace(legged)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("heights", (1, 9), "nx must be at least 2, got 1"), ("heights", (9, 1), "ny must be at least 2, got 1"),
        ("goal_dim", 2, "goal_dim must be at least 3, got 2"), ("num_joints", 11, "num_joints must be at least 12"),
        ("num_groups", 1, "num_groups must be at least 2"), ("num_terms", 3, "num_terms must be at least 12, got 3"),
    ],
)  # fmt: skip
def test_rejects_sizes_that_are_too_small(name, value, message):
    """A robot has four legs, a velocity goal, their terms, and stands on at least 2 x 2 samples."""
    right = {"num_envs": 5, "num_joints": J, "substeps": SUBSTEPS, "num_points": 0, "heights": (2, 2)}
    with pytest.raises(ValueError, match=message):
        sizes(**(right | {name: value}))


def test_parameters_are_given_all_and_by_name():
    """A parameter that is forgotten or misspelt is an error."""
    with pytest.raises(ValueError, match=r"params must be dt, stagger, .*high, got dt"):
        make_params(**{name: PARAMS[name] for name in PARAMS if name != "noise"})
    assert PARAMS.keys() == LocomotionParams.vars.keys()
