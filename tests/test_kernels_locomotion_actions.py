"""Actions of legged robots become the targets of their joints, and pushes velocities."""

import numpy as np
import pytest
from deimos.kernels.random import Purpose
from legged_arrays import POSE, World, make_world


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
