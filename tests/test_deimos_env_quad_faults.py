"""What goes wrong with legged robots: invalid worlds, actions and goals that are no numbers, buffers too small."""

import math

import pytest
import torch
from quad_worlds import actions, build
from worlds import build_loop, rows_of

from deimos.checks import SimulationError
from deimos.sim.legged.engines import PhysicsConfig


@pytest.mark.parametrize("often", [True, False])
def test_too_many_invalid_worlds_stop_the_run(torch_device, often):
    """More than 0.1 % of 10 000 world-steps are too many, however often the check looks; it names what was wrong."""
    env = build(torch_device)
    for count in range(11):
        assert env.invalid_steps == (count if often else 0)
        env.tensors["qvel"][4, 1] = 123.0
        step = env.step(torch.zeros(6, 12, device=torch_device))
        assert step.invalid.tolist() == [False] * 4 + [True, False]
        env.reset(step.invalid)
        if often and count < 10:
            env.check()
    wanted = r"World 4: its speed was 1[12]\d.* 11 of the last 66 world-steps were invalid, more than 0.1 % of 10000"
    with pytest.raises(SimulationError, match=wanted):
        env.check()
    env.check()
    assert env.report()["invalid_steps"] == 11
    assert env.report()["invalid_steps"] == 0


def test_invalid_worlds_are_forgotten_after_a_window(torch_device):
    """Ten invalid world-steps in every window of 10 000 or more are no reason to stop, for however long."""
    env = build(torch_device, num_envs=512)
    for _ in range(3):
        env.tensors["qvel"][:10, 1] = 123.0
        for _ in range(20):
            step = env.step(torch.zeros(512, 12, device=torch_device))
            env.reset(step.terminated | step.truncated)
            env.check()
    assert env.report()["invalid_steps"] == 30


def test_a_goal_that_is_not_finite_breaks_its_world(torch_device):
    """A NaN goal is named like a broken state, and the world that has it begins anew under a sound one."""
    env = build(torch_device, episode_steps=200, goal_period=100)
    loop = build_loop(env)
    goal = env.goal[:1].clone()
    goal[0, 1] = torch.nan
    env.set_goals(rows_of(env, 3), goal)
    step = env.step(actions(6, torch_device))
    assert step.invalid.tolist() == [False, False, False, True, False, False]
    assert env.describe_fault(3) == "its goal was nan"
    loop.advance(step)
    assert bool(env.obs.isfinite().all())
    assert not env.step(actions(6, torch_device)).invalid.any()


def test_buffers_too_small_say_how_large_they_had_to_be(torch_device):
    """The message names the bit, the buffer, its size, what was needed and the flag, and no other buffer."""
    env = build(torch_device, physics=PhysicsConfig(rows=8))
    for _ in range(20):
        env.step(actions(6, torch_device))
    message = (
        r"lost contacts \(NEFC: up to \d+ constraint rows .* were needed, the buffer holds 8; raise physics.rows\)"
    )
    with pytest.raises(SimulationError, match=message):
        env.check()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_broken_action_stops_the_run(torch_device, value):
    """A single action that is not finite is an error at once, with the world's number."""
    env = build(torch_device)
    action = actions(6, torch_device)
    action[3, 5] = value
    env.step(action)
    with pytest.raises(SimulationError, match="World 3: its action is not finite"):
        env.check()


@pytest.mark.parametrize("shape", [(6,), (6, 11), (5, 12), (1, 12)])
def test_actions_of_another_shape_are_refused(torch_device, shape):
    """Actions are never broadcast."""
    env = build(torch_device)
    with pytest.raises(ValueError, match=r"action must have the shape \(6, 12\), got"):
        env.step(torch.zeros(shape, device=torch_device))
