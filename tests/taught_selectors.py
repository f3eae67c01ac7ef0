"""Selectors that have learnt from outcomes, or from a short run, for the tests of what they choose then."""

import torch

from deimos.goals.core import GoalCore
from deimos.goals.selector import Spaces
from deimos.learn.ppo import PPOConfig
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

CPU = torch.device("cpu")
WORLDS, STATE, GOAL = 400, 3, 2
SPACES = Spaces(num_envs=WORLDS, state_dim=STATE, goal_dim=GOAL, goal_period=5, device=CPU, total_steps=96)


def history(selector, crashes, rollouts=40, seed=0):
    """Let a selector learn from goals of its own whose outcome is a function of (state, goal, next goal)."""
    core = GoalCore(selector, SPACES)
    generator = torch.Generator().manual_seed(seed)
    no = torch.zeros(WORLDS, dtype=torch.bool)
    doomed, goal = no.clone(), torch.rand(WORLDS, GOAL, generator=generator) * 2 - 1
    for now in range(5 * rollouts):
        due = no if (now + 1) % 5 else ~no
        crash = doomed if now % 5 == 2 else no  # halfway through the period
        changes = core.advance(crash, no, due, torch.zeros(WORLDS))
        rows = changes.due
        if len(rows):
            state = torch.randn(len(rows), STATE, generator=generator)
            options = torch.rand(len(rows), selector.num_candidates, GOAL, generator=generator) * 2 - 1
            draws = torch.rand(len(rows), 4, generator=generator)
            chosen = core.choose(rows, state, goal[rows], options, draws)
            doomed = no.clone()
            doomed[rows] = crashes(state, goal[rows], chosen)
            goal[rows] = chosen
            core.learn(None)
        doomed = doomed & ~crash
    return selector


def across(state, goal, next_goal):
    """A goal crashes where its first component agrees in sign with the state's, and both are large."""
    return (state[:, 0] * next_goal[:, 0]) > 0.4


def decisions(count=20_000, candidates=20, seed=5):
    """The arguments of ``propose``, with goals of [-1, 1]^2; any world may decide again."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.randn(count, STATE, generator=generator)
    goal, options = (torch.rand(*shape, generator=generator) * 2 - 1 for shape in ((count, 2), (count, candidates, 2)))
    return torch.arange(count) % WORLDS, state, goal, options, torch.rand(count, 4, generator=generator)


def cells(goal):
    """Cell of every goal on a grid of 8 x 8."""
    return ((goal + 1) * 4).long().clamp(0, 7) @ torch.tensor([8, 1])


def small_run(selector, **env):
    """A run of a few worlds whose policy throws itself about."""
    config = particle.Config(**({"goal_period": 8, "max_speed": 200.0, "max_force": 100.0} | env))
    ppo = PPOConfig(hidden=(16,), epochs=1, init_std=100.0)
    return Trainer(TrainConfig(env=config, selector=selector, ppo=ppo, num_envs=48, evaluation=False), CPU)
