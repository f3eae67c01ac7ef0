"""What goes wrong with particles: actions of another shape, and numbers that are none."""

import math
import re

import pytest
import torch
from particle_worlds import build, constant_actions
from states import assert_same

from deimos.checks import SimulationError
from deimos.sim.env import ObsField
from deimos.sim.envs.particle import Config
from deimos.sim.warp_env import WarpEnv

CPU = torch.device("cpu")
ALL, ROWS, GOALS = torch.ones(8, dtype=torch.bool), torch.tensor([2, 5]), torch.zeros(2, 3)


@pytest.mark.parametrize("shape", [(8,), (8, 2), (7, 3), (1, 3)])
def test_actions_of_another_shape_are_refused(torch_device, shape):
    """Actions are never broadcast: another shape is refused with both shapes, and nothing moves."""
    env = build(torch_device)
    before = env.state_dict()
    with pytest.raises(ValueError, match=rf"action must have the shape \(8, 3\), got {re.escape(str(shape))}"):
        env.step(torch.zeros(shape, device=torch_device))
    assert_same(env.state_dict(), before)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda env: env.reset(torch.tensor([2])), r"mask must have the shape \(8,\), got \(1,\)"),
        (lambda env: env.reset(torch.ones(8)), "mask must be bool, got torch.float32"),
        (lambda env: env.reset(ALL, torch.ones(1)), r"goal range must have the shape \(3,\), got \(1,\)"),
        (lambda env: env.sample_goals(ALL, 2), "rows must be whole numbers of worlds, got torch.bool"),
        (lambda env: env.sample_goals(ROWS, 0), "count must be at least 1, got 0"),
        (lambda env: env.sample_goals(ROWS, 2, torch.ones(1, 3)), r"must have the shape \(3,\), got \(1, 3\)"),
        (lambda env: env.draw(torch.ones(8)), "rows must be whole numbers of worlds, got torch.float32"),
        (lambda env: env.set_goals(ALL, torch.zeros(8, 3)), "rows must be whole numbers of worlds, got torch.bool"),
        (lambda env: env.set_goals(ROWS, torch.zeros(3)), r"goal must have the shape \(2, 3\), got \(3,\)"),
        (lambda env: env.set_goals(ROWS, torch.zeros(2, 3), ROWS), "where must be bool, got torch.int64"),
        (lambda env: env.set_goals([2, 5], GOALS), r"rows must be a torch.Tensor, got \[2, 5\]"),
        (lambda env: env.set_goals(ROWS, GOALS.numpy()), "goal must be a torch.Tensor, got array"),
        (lambda env: env.set_goals(ROWS[:1, None], GOALS[:1]), r"rows must have the shape \(B,\), .*, got \(1, 1\)"),
        (lambda env: env.set_goals(torch.arange(9), torch.zeros(9, 3)), r"at most 8 worlds, got \(9,\)"),
        (lambda env: env.set_goals(ROWS + 3, GOALS), r"rows must be worlds in \[0, 8\), got 8"),
        (lambda env: env.set_goals(ROWS - 3, GOALS), r"rows must be worlds in \[0, 8\), got -1"),
        (lambda env: env.set_goals(ROWS + 2**32, GOALS), r"rows must be worlds in \[0, 8\), got 4294967301"),
        (lambda env: env.set_goals(ROWS - ROWS, GOALS), "rows must be different worlds, got 0 more than once"),
        (lambda env: env.sample_goals(ROWS + 3, 2), r"rows must be worlds in \[0, 8\), got 8"),
        (lambda env: env.draw(ROWS - 3), r"rows must be worlds in \[0, 8\), got -1"),
        (lambda env: env.set_goals(ROWS, GOALS.double()), r"goal must be float32, got torch.float64; .* \.float\(\)"),
        (lambda env: env.set_goals(ROWS, GOALS.bool()), "goal must be float32, got torch.bool"),
        (lambda env: env.reset(ALL, torch.ones(3).double()), "goal range must be float32, got torch.float64"),
        (lambda env: env.set_goals(ROWS.to("meta"), GOALS), "rows must be on cpu, got it on meta; move it there"),
        (lambda env: env.set_goals(ROWS, GOALS.to("meta")), "goal must be on cpu, got it on meta; move it there"),
        (lambda env: env.reset(ALL.to("meta")), "mask must be on cpu, got it on meta; move it there"),
    ],
)
def test_masks_rows_and_goals_are_never_guessed(wrong, message):
    """A list of worlds is no mask and a mask no list, no shape is broadcast; what is refused changes nothing."""
    env = build(CPU)
    env.step(constant_actions(8, CPU))
    before = env.state_dict()
    with pytest.raises(ValueError, match=message):
        wrong(env)
    assert_same(env.state_dict(), before)


@pytest.mark.parametrize(
    ("num_envs", "seed", "message"),
    [
        (0, 0, "num_envs must be at least 1, got 0"), (4, -1, r"seed must be in \[0, 2\^32\), got -1"),
        (4, 2**32, r"seed must be in \[0, 2\^32\), got 4294967296"), (4, 1.5, "seed must be a whole number, got 1.5"),
    ],
)  # fmt: skip
def test_what_no_environment_can_be_built_of_is_refused(num_envs, seed, message):
    """A seed out of its range would be another one's, and no worlds have no numbers."""
    with pytest.raises(ValueError, match=message):
        Config().build(num_envs, CPU, seed)


def test_a_goal_has_a_scale_for_each_of_its_components():
    """A tuple of another length is refused by the environment's constructor, before anything is allocated."""
    with pytest.raises(ValueError, match="scale of the goal must have 2 components, got 1"):
        WarpEnv(Config(), 4, CPU, 0, 0, layout=(ObsField("goal", 2, "m", (1.0,)),), goal_range=(1.0, 1.0), action_dim=1)


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
