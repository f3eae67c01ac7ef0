"""Resets of particles: where they start, under which first goal, and who is left alone."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.particle import reset_particles
from deimos.kernels.random import Purpose
from particle_arrays import GOAL_RANGE, GOAL_SCALE, VARIANTS, VECTORS, U, World


@pytest.mark.parametrize("num_envs", [1, 257])
@pytest.mark.parametrize("variant", VARIANTS)
def test_reset_matches_reference(device, uniform_reference, variant, num_envs):
    """Start and first goal are the draws addressed by the world's own number and episode, bit for bit."""
    rng = np.random.default_rng(seed=num_envs)
    episode, goal_count = rng.integers(1000, size=(2, num_envs))
    first_range = np.array([1.0, 0.5, 0.3], np.float32) * np.float32(GOAL_RANGE[variant])
    values = {"episode_count": episode, "goal_count": goal_count, "goal_clock": 8, "episode_step": 9}
    values |= dict.fromkeys((*VECTORS, "goal"), np.nan)
    world = World(num_envs, device, variant, values=values, spawn_range=300.0, seed=77, world_offset=500)

    world.reset(first_range=first_range)

    number = 500 + np.arange(num_envs)
    spawn = uniform_reference(77, Purpose.RESET, number, episode)[:, :3]
    first = uniform_reference(77, Purpose.FIRST_GOAL, number, episode)[:, :3]
    # 2 u - 1 is exact in float32, so only the products round.
    position = np.float32(2 * spawn - 1) * np.float32(300)
    goal = np.float32(2 * first - 1) * first_range
    np.testing.assert_array_equal(world.get("position"), position)
    np.testing.assert_array_equal(world.get("velocity"), np.zeros((num_envs, 3)))
    np.testing.assert_array_equal(world.get("force"), np.zeros((num_envs, 3)))
    np.testing.assert_array_equal(world.get("goal"), goal)
    np.testing.assert_array_equal(world.get("goal_clock"), 0)
    np.testing.assert_array_equal(world.get("episode_step"), 0)
    np.testing.assert_array_equal(world.get("episode_count"), episode + 1)
    np.testing.assert_array_equal(world.get("goal_count"), goal_count)
    seen = (goal.astype(np.float64) - (position if variant == "relative" else 0.0)) * GOAL_SCALE[variant]
    obs = np.concatenate([np.zeros((num_envs, 3)), position / 1000, np.zeros((num_envs, 3)), seen], axis=1)
    # Three roundings: of the difference, of the scale and of the product with it.
    np.testing.assert_allclose(world.get("obs"), obs, rtol=3.01 * U, atol=0)


def test_reset_leaves_the_others_alone(device):
    """Worlds outside the mask keep every byte; those inside are made new, even out of NaN."""
    world = World(4, device, values=dict.fromkeys((*VECTORS, "goal"), np.nan))
    before = world.snapshot()
    world.reset([True, False, True, False])
    after = world.snapshot()
    for name in before:
        assert [before[name][i] == after[name][i] for i in (1, 3)] == [True, True]
    for name in (*VECTORS, "goal", "obs"):
        assert np.isfinite(world.get(name)[[0, 2]]).all()


def test_particles_start_uniformly_in_their_box(device):
    """Starts and first goals fill their boxes evenly and independently: mean, spread and correlation say so."""
    n = 2**14
    world = World(n, device, spawn_range=100.0).reset()
    x = np.concatenate([world.get("position") / 100.0, world.get("goal") / 10.0], axis=1).astype(np.float64)
    sigmas = 5.0  # exceeded once in 1.7 million tests
    assert np.abs(x).max() <= 1.0
    assert np.all(np.abs(x.mean(axis=0)) < sigmas / np.sqrt(3 * n))  # the variance of a component is 1/3
    assert np.all(np.abs((x**2).mean(axis=0) - 1 / 3) < sigmas * np.sqrt(4 / 45 / n))  # that of its square 4/45
    assert np.all(np.abs(np.corrcoef(x.T) - np.eye(6)) < sigmas / np.sqrt(n))


def test_reset_works_in_shared_memory(device):
    """A torch mask written before the launch decides, and torch views see the reset at the same addresses."""
    world = World(2, device, values={"position": 5.0})
    chosen, position, obs = (wp.to_torch(world.array(name)) for name in ("mask", "position", "obs"))
    launch = reset_particles(world.worlds, world.state, world.params)
    chosen[1] = True
    launch.launch()
    for view, name in ((chosen, "mask"), (position, "position"), (obs, "obs")):
        assert view.data_ptr() == world.array(name).ptr
    assert position.tolist() == [[5.0] * 3, [0.0] * 3]
    assert obs.isfinite().all(dim=1).tolist() == [False, True]
