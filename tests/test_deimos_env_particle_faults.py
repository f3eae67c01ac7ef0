"""What goes wrong with particles: actions of another shape, and numbers that are none."""

import math
import re

import pytest
import torch
from particle_worlds import build, constant_actions
from states import assert_same

from deimos.checks import SimulationError


@pytest.mark.parametrize("shape", [(8,), (8, 2), (7, 3), (1, 3)])
def test_actions_of_another_shape_are_refused(torch_device, shape):
    """Actions are never broadcast: another shape is refused with both shapes, and nothing moves."""
    env = build(torch_device)
    before = env.state_dict()
    with pytest.raises(ValueError, match=rf"action must have the shape \(8, 3\), got {re.escape(str(shape))}"):
        env.step(torch.zeros(shape, device=torch_device))
    assert_same(env.state_dict(), before)


def test_sound_worlds_pass_the_check(torch_device):
    """Crashes, bounds and time limits are no faults."""
    env = build(torch_device, time_limit=30)
    for _ in range(150):
        env.step(10 * constant_actions(8, torch_device))
    env.check()


@pytest.mark.parametrize("sound", [0, 3])
def test_check_names_world_and_action(torch_device, sound):
    """A NaN action is found at the end of a rollout, after sound ones too; no finite position is blamed for it."""
    env = build(torch_device)
    action = constant_actions(8, torch_device)
    action[5, 1] = torch.nan
    env.step(action)
    for _ in range(sound):
        env.step(constant_actions(8, torch_device))
    with pytest.raises(SimulationError, match=r"World 5: its action is not finite\."):
        env.check()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_check_names_world_and_position(torch_device, value):
    """A position that is not finite stops the run with the lowest world that it happened in, however late."""
    env = build(torch_device)
    env.tensors["position"][2, 0] = value
    env.tensors["position"][4, 2] = value
    for _ in range(3):
        env.step(constant_actions(8, torch_device))
    with pytest.raises(SimulationError, match="World 2: its position is not finite; 6 of the last 24 world-steps"):
        env.check()


@pytest.mark.parametrize("name", ["velocity", "goal"])
def test_check_finds_any_broken_state(torch_device, name):
    """A velocity or a goal that is not finite stops the run too, as every state must be finite."""
    env = build(torch_device)
    env.tensors[name][3, 1] = torch.nan
    env.step(constant_actions(8, torch_device))
    with pytest.raises(SimulationError, match=f"World 3: its {name} is not finite"):
        env.check()
