"""What a control step of the legged robots comes to: health, crash, reward, clocks, observation."""

import numpy as np
import pytest
from deimos.kernels.legged.rewards import TERMS, RewardWeights
from deimos.kernels.legged.state import BROKEN, COLUMNS, NUM_COLUMNS, NUM_PARTS
from legged_arrays import DT, GOAL_SCALE, HIGH, LOW, POSE, SUBSTEPS, World, make_world


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
