"""gymnasium's three ways to reset worlds give the Director the same interactions."""

from dataclasses import dataclass

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from deimos import GoalDirector
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig

N, PERIOD, LIMIT = 12, 4, 11


class Cart(gymnasium.Env):
    """A cart on a track of 2 m whose episodes begin in places of their own: position [m] and speed [m/s]."""

    observation_space = gymnasium.spaces.Box(-10.0, 10.0, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        """See ``gymnasium.Env.reset``."""
        super().reset(seed=seed)
        self.state, self.age = np.array([self.np_random.uniform(-0.5, 0.5), 0.0]), 0
        return self.state.copy(), {}

    def step(self, action):
        """See ``gymnasium.Env.step``."""
        self.state[1] += 0.5 * (action[0] - self.state[1])
        self.state[0] += 0.3 * self.state[1]
        self.age += 1
        crashed = bool(abs(self.state[0]) > 1)
        return self.state.copy(), 0.0, crashed, self.age >= LIMIT and not crashed, {}


@dataclass(frozen=True)
class FarSide(SelectorConfig):
    """Chooses the candidate nearest to position plus half the active goal: another start or goal, another choice."""

    def build(self, spaces, seed):
        """See ``SelectorConfig.build``."""
        return _FarSide()


class _FarSide(GoalSelector):
    num_candidates = 8

    def propose(self, rows, state, goal, candidates, draws):
        """See ``GoalSelector.propose``."""
        pick = (candidates - state[:, None, :1] - 0.5 * goal[:, None]).abs().sum(2).argmin(1)
        return Proposal(candidates[torch.arange(len(rows)), pick], torch.full((len(rows),), torch.nan))


def outcomes(mode, first_goals, steps=160):
    """Of every world in their order: state, goals, outcome and horizon of all interactions."""
    envs = SyncVectorEnv([Cart] * N, autoreset_mode=mode)
    goals = GoalDirector(
        FarSide(), PERIOD, num_envs=N, state_dim=2, goal_dim=1, device="cpu", goal_box=([-1.0], [1.0]),
        autoreset=envs.metadata["autoreset_mode"], first_goals=first_goals,
    )  # fmt: skip
    obs, _ = envs.reset(seed=0)
    goal, found, seen = goals.propose(None, obs, np.zeros((N, 1))), [[] for _ in range(N)], 0
    for _ in range(steps):
        obs, _, terminated, truncated, _ = envs.step(goal)
        done = terminated | truncated
        if mode is AutoresetMode.DISABLED and done.any():
            obs, _ = envs.reset(options={"reset_mask": done})
        goal = goals.step(obs, goal, terminated, truncated).goal
        new = goals.interactions.resolved(seen)
        seen = goals.interactions.now
        for row in range(len(new)):
            parts = (new.state, new.goal, new.next_goal, new.crashed, new.resolved - new.issued, new.horizon)
            found[int(new.env[row])].append([part[row].tolist() for part in parts])
    return found


@pytest.mark.parametrize("first_goals", ["uniform", "chosen"])
def test_three_modes_give_the_same_interactions(first_goals):
    """A step that only resets a world is no step of its goal, and its state is where the next episode begins."""
    expected = outcomes(AutoresetMode.SAME_STEP, first_goals)
    assert outcomes(AutoresetMode.DISABLED, first_goals) == expected
    with_steps_of_their_own = outcomes(AutoresetMode.NEXT_STEP, first_goals)
    for ours, theirs in zip(with_steps_of_their_own, expected, strict=True):
        assert 10 < len(ours) <= len(theirs)
        assert ours == theirs[: len(ours)]
    labels = [crashed for world in expected for *_, crashed, _, _ in world]
    assert 0.05 < np.mean(labels) < 0.95
