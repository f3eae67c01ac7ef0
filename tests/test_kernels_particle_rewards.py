"""The particle's reward shapes."""

import math
import typing

import numpy as np
import pytest
import warp as wp
from deimos.kernels.episodes import make_worlds
from deimos.kernels.particle import GOAL_START, OBS_DIM, PARTICLES, step_particles
from deimos.kernels.particle_rewards import RewardShape, reward_distances

from deimos.sim.envs.particle import HALF_SIDE, Config

U = 2.0**-24  # relative error of one float32 operation
VARIANTS = ["absolute", "directional", "relative"]


def shape_rewards(shape, distance, largest, length, device):
    """The reward of every distance, float32."""
    distance = wp.array(np.asarray(distance, np.float32), dtype=wp.float32, device=device)
    reward = wp.full(distance.shape, np.nan, dtype=wp.float32, device=device)
    reward_distances(distance, reward, shape=shape, largest=largest, length=length)
    return reward.numpy()


def reward_reference(shape, distance, largest, length):
    """What the configuration promises: 1 - d / (1.01 d_max), 1 / (1 + d / length) or exp(-d / length)."""
    return {
        "linear": 1 - distance / (1.01 * largest),
        "reciprocal": 1 / (1 + distance / length),
        "exponential": np.exp(-distance / length),
    }[shape]


def reward_tolerance(distance, length):
    """Bound of the error: ten operations, of which the exponential's argument amplifies those before it."""
    return U * (10 + 5 * distance / length)


@pytest.mark.parametrize("name", [shape.name.lower() for shape in RewardShape])
@pytest.mark.parametrize(("largest", "length"), [(34.6, 2.5), (3914.0, 250.0), (1.0, 1.0)])
def test_matches_reference(device, name, largest, length):
    """Every shape is the formula of the configuration, over all distances up to the largest."""
    distance = np.linspace(0.0, largest, 2001).astype(np.float32).astype(np.float64)
    reward = shape_rewards(RewardShape[name.upper()], distance, largest, length, device)
    error = np.abs(reward - reward_reference(name, distance, largest, length))
    assert np.all(error <= reward_tolerance(distance, length))


@pytest.mark.parametrize("shape", list(RewardShape))
def test_is_one_at_the_goal_and_falls_with_distance(device, shape):
    """The reward is exactly 1 at the goal, never above, and never rises with the distance."""
    reward = shape_rewards(shape, np.linspace(0.0, 100.0, 1001), 100.0, 10.0, device)
    assert reward[0] == 1.0
    assert np.all(np.diff(reward) < 0)


def test_characteristic_lengths(device):
    """At the reward length the reciprocal gives 1/2 and the exponential 1/e; the linear ends at 1/101."""
    for shape, distance, expected in (
        (RewardShape.RECIPROCAL, 7.0, 1 / 2),
        (RewardShape.EXPONENTIAL, 7.0, 1 / math.e),
        (RewardShape.LINEAR, 50.0, 1 / 101),
    ):
        reward = shape_rewards(shape, [distance], 50.0, 7.0, device)
        np.testing.assert_allclose(reward, expected, rtol=0, atol=reward_tolerance(1.0, 1.0))


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("shape", [RewardShape.LINEAR, RewardShape.RECIPROCAL])
def test_is_positive_wherever_a_particle_can_be(device, variant, shape):
    """Even the crash in the corner that is farthest from the farthest goal is rewarded with more than 0."""
    config = Config(variant=variant)
    params = config.params()
    # A velocity is within the bounds of speed; a position is within the cube, or one step outside of it.
    farthest = config.max_speed if variant == "directional" else HALF_SIDE + config.max_speed
    corner, goal = np.full(3, farthest), np.full(3, -config.goal_half_side)
    distance = np.linalg.norm(corner - goal)

    reward = shape_rewards(shape, [0.0, distance / 2, distance], params.largest_distance, params.reward_length, device)

    np.testing.assert_allclose(params.largest_distance, distance, rtol=U)
    assert np.all(reward > 0)
    assert np.all(reward <= 1)


def test_every_shape_can_be_configured():
    """The configuration offers exactly the shapes that the kernel knows, and its default is one of them."""
    offered = typing.get_args(typing.get_type_hints(Config)["reward"])
    assert sorted(offered) == sorted(shape.name.lower() for shape in RewardShape)
    assert Config().reward in offered


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", [shape.name.lower() for shape in RewardShape])
def test_configured_shape_is_the_one_that_steps_reward(device, variant, name):
    """A step pays the configured shape of the distance between particle and goal."""
    config = Config(variant=variant, reward=name)
    params = config.params()
    goal, at = np.array([3.0, 0.0, -4.0]), np.array([1.0, 2.0, -3.0])  # 3 apart
    worlds = make_worlds(
        1, device, obs_dim=OBS_DIM, action_dim=3, goal_start=GOAL_START, goal_scale=[1.0] * 3, goal_period=100
    )
    state = PARTICLES.allocate(device, num_envs=1)
    worlds.goal.assign([goal])
    moved = state.velocity if variant == "directional" else state.position
    moved.fill_(wp.vec3(*at))

    step_particles(worlds, state, params).launch()

    length = 2.5 if variant == "directional" else 250.0
    expected = reward_reference(name, 3.0, params.largest_distance, length)
    assert abs(worlds.reward.numpy()[0] - expected) <= reward_tolerance(3.0, length)


def test_rejects_arrays_that_do_not_fit(device):
    """The message names the argument, what it must be and what it was."""
    distance, reward = (wp.zeros(count, dtype=wp.float32, device=device) for count in (4, 5))
    with pytest.raises(ValueError, match=r"reward must be float32\(4,\).*got float32\(5,\)"):
        reward_distances(distance, reward, shape=RewardShape.LINEAR, largest=1.0, length=1.0)
