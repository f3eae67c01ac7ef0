"""Worlds of Particle Gym for the tests of what an environment promises."""

import numpy as np
import torch

from deimos.sim.envs.particle import HALF_SIDE, Config

VARIANTS = ["absolute", "directional", "relative"]
U = 2.0**-24  # relative error of one float32 operation


def build(device, num_envs=8, seed=0, env_offset=0, **config):
    """An environment with short goals unless told otherwise."""
    return Config(**({"goal_period": 5} | config)).build(num_envs, device, seed, env_offset)


def constant_actions(num_envs, device, seed=0):
    """A force of its own for every world: some crash early, some late."""
    force = np.random.default_rng(seed).uniform(-1, 1, size=(num_envs, 3))
    return torch.tensor(force, dtype=torch.float32, device=device)


def put_outside(env, rows):
    """Make the listed worlds crash on the next step."""
    env.tensors["position"][rows] = 2 * HALF_SIDE
