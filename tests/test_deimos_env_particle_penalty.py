"""The penalty of a crash: what it takes from whom, and checkpoints that know nothing of it."""

import math

import pytest
import torch
from particle_worlds import VARIANTS, U, build, constant_actions, put_outside
from worlds import rows_of

from deimos.checks import RunError
from deimos.learn.ppo import PPOConfig
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs.particle import Config


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_crash_costs_what_the_penalty_says(torch_device, variant):
    """The penalty is subtracted on the step of a crash alone; without it, and in evaluation, nothing is."""
    config = {"variant": variant, "time_limit": 9}
    plain, punished = build(torch_device, **config), build(torch_device, crash_penalty=2.5, **config)
    assert (plain.crash_penalty, punished.crash_penalty) == (0.0, 2.5)
    for t in range(8):
        for env in (plain, punished):
            if t == 3:
                put_outside(env, rows_of(env, 1, 6))
            step = env.step(constant_actions(8, torch_device))
        expected = plain._step.reward - 2.5 * plain._step.terminated
        assert torch.equal(step.reward, expected)
        assert bool(step.terminated.any()) == (t >= 3)
    assert bool((step.reward < 0).any())
    assert Config(crash_penalty=2.5).for_evaluation() == Config()


@pytest.mark.parametrize("value", [-0.1, math.inf, math.nan])
def test_a_penalty_that_is_none_is_refused(value):
    """A penalty must be finite and at least 0, in every environment's configuration."""
    with pytest.raises(ValueError, match=r"crash_penalty must be in \[0, .*\], got"):
        Config(crash_penalty=value)


def train_config(**env):
    """A few worlds close to the walls, so that some crash at once."""
    env = Config(goal_period=5, spawn_range=999.0, **env)
    return TrainConfig(env=env, ppo=PPOConfig(hidden=(8,)), num_envs=64, evaluation=False)


def test_the_learner_sees_the_penalty_and_reports_do_not(torch_device):
    """What is learnt from holds the penalty of every crash; the reported reward is that of a run without it."""
    plain, punished = (Trainer(train_config(crash_penalty=cost), torch_device) for cost in (0.0, 3.0))
    expected, row = plain.iterate(), punished.iterate()
    assert row["crashes"] == expected["crashes"] > 0
    assert row["reward"] == pytest.approx(expected["reward"], abs=64 * U)
    learnt, crashed = punished.rollout.reward, plain.rollout.terminated
    assert torch.equal(learnt, plain.rollout.reward - 3.0 * crashed)
    assert bool((learnt < 0).any())


def test_checkpoints_of_before_the_penalty_load(torch_device):
    """A checkpoint that lacks a newer field of the configuration was made with its default."""
    trainer = Trainer(train_config(), torch_device)
    state = trainer.state_dict()
    del state["made_for"]["env"]["crash_penalty"]
    trainer.load_state_dict(state)
    state["made_for"]["env"]["max_speed"] = 3.0
    with pytest.raises(RunError, match="another environment"):
        trainer.load_state_dict(state)
