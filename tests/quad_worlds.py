"""Worlds of Quad and Quad+arm for the tests of what an environment promises."""

import numpy as np
import torch

from deimos.sim.envs import quad, quad_arm

TASKS = {"quad": quad.Config, "quad-arm": quad_arm.Config}


def build(device, num_envs=6, seed=0, env_offset=0, task="quad", **config):
    """An environment with short goals and episodes unless told otherwise."""
    config = TASKS[task](**({"goal_period": 5, "episode_steps": 40, "engine": "warp"} | config))
    return config.build(num_envs, device, seed, env_offset)


def actions(num_envs, device, seed=0, scale=0.6, task="quad"):
    """Constant actions, other for every world: some robots fall early, some late."""
    joints = 12 if task == "quad" else 17
    a = np.random.default_rng(seed).normal(scale=scale, size=(num_envs, joints))
    return torch.tensor(a, dtype=torch.float32, device=device)
