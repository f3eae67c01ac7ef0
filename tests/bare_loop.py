"""The worlds that adapters are tested on, in a loop driven by hand: what an adapter must show."""

import numpy as np
import torch

from deimos.goals.selectors import uniform
from deimos.run.loop import GoalLoop, spaces
from deimos.sim.envs import particle

TIME_LIMIT = 12
# Particles start anywhere in the cube and cross a tenth of it per step, so that some crash, some reach the
# time limit, and some get two goals before either.
CONFIG = particle.Config(
    goal_period=5, time_limit=TIME_LIMIT, max_speed=100.0, max_force=100.0, spawn_range=990.0
)  # fmt: skip
CPU = torch.device("cpu")


class Bare:
    """An environment and its goal loop, driven by hand: what an adapter must show and nothing else."""

    def __init__(self, num_envs, seed, device=CPU, config=CONFIG):
        self.env = config.build(num_envs, device, seed)
        self.loop = GoalLoop(self.env, uniform.Config().build(spaces(self.env), seed))

    def step(self, action):
        """Copies of the last observation, reward, terminated, truncated, and the observation to act on next."""
        step = self.env.step(action)
        ended = [x.clone() for x in (step.obs, step.reward, step.terminated, step.truncated)]
        self.loop.advance(step)
        return *ended, self.env.obs.clone()


def random_actions(num_steps, num_envs, seed=0, bound=150.0):
    """Forces, float32, shape (num_steps, num_envs, 3); a third of them beyond the bound of ``CONFIG``."""
    return np.random.default_rng(seed).uniform(-bound, bound, (num_steps, num_envs, 3)).astype(np.float32)
