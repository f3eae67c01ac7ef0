"""An arm on a legged robot: kinematics, evaluation, and arrays that do not fit."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import warp as wp
from arm_arrays import (
    DT,
    GARBAGE,
    TIP,
    World,
    geometry,
    goal_reference,
    make_arm,
    make_world,
    place_of,
    place_reference,
    tip_reference,
)
from deimos.kernels.legged.arm_goals import ARM
from deimos.kernels.legged.arm_rewards import ARM_TERMS, ArmWeights
from deimos.kernels.legged.state import COLUMNS, NUM_COLUMNS

from deimos.sim.legged.robots import go1_rx150 as rx150


def test_kinematics_are_the_tables(device):
    """The end effector is that of the chain of published offsets, and at the zero pose where the table says."""
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, size=(200, 5))
    angles[0] = 0.0
    qpos = np.concatenate([np.zeros((200, 19)), angles], axis=1)
    tip = geometry(qpos, np.zeros((200, 3)), device)[0]
    # Five turns of vectors below 0.7 m, about ten rounded operations each.
    np.testing.assert_allclose(tip, [tip_reference(a) for a in angles], rtol=0, atol=50 * 2.0**-24)
    np.testing.assert_allclose(tip[0] - rx150.MOUNT, (0.358575, 0.0, 0.25457), atol=1e-6)


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
    world = World(make_world(4), device)
    view = wp.to_torch(world.arm.error)
    assert view.data_ptr() == world.arm.error.ptr
    assert torch.all(view == GARBAGE)
    world.evaluate()
    np.testing.assert_array_equal(view.cpu().numpy(), world.arm.error.numpy())
    assert not torch.any(view == GARBAGE)


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
