"""Quad: a Go1 that follows velocity goals over flat and rough ground (thesis, 4.1.2)."""

from dataclasses import dataclass

import torch

from deimos.kernels.legged.state import RATE_SCALE, VELOCITY_SCALE
from deimos.learn.ppo import PPOConfig
from deimos.run.evaluation import EvalConfig
from deimos.sim.legged.robots import go1
from deimos.sim.legged.task import Locomotion, LocomotionConfig

GOAL_RANGE = (1.0, 1.0, 1.0)  # v_x, v_y [m/s], yaw rate [rad/s]; thesis, 4.1.2
GOAL_SCALE = (VELOCITY_SCALE, VELOCITY_SCALE, RATE_SCALE)


@dataclass(frozen=True, kw_only=True)
class Config(LocomotionConfig):
    """Quad: a Unitree Go1. Goals are v_x, v_y and yaw rate in the base's frame, uniform in [-1, 1]^3."""

    def build(self, num_envs: int, device: torch.device, seed: int, env_offset: int = 0) -> Locomotion:
        """See ``EnvConfig.build``."""
        robot = go1.build(stiffness=self.stiffness, damping=self.damping, action_scale=self.action_scale)
        return Locomotion(self, robot, GOAL_RANGE, GOAL_SCALE, num_envs, device, seed, env_offset)


PRESETS = {
    # Sizes that two CPU cores can train within the hour.
    "quad": {
        "env": Config(),
        "num_envs": 1024,
        "env_steps": 6400,
        # Rewards hold the time step already. A larger deviation at the start clips nearly all of them to 0.
        "ppo": PPOConfig(hidden=(256, 128, 64), activation="elu", init_std=0.6, reward_scale=1.0),
        "eval": EvalConfig(worlds=256, steps=1000, adversary_steps=1500, adversary_patience=2, adversary_enough="any"),
    },
    # The thesis's (4.2): 3000 iterations of 24 steps on Legged Gym's sizes.
    "quad-thesis": {
        "env": Config(terrain="rough"),
        "num_envs": 4096,
        "env_steps": 72_000,
        "ppo": PPOConfig(hidden=(512, 256, 128), activation="elu", reward_scale=1.0),
        "eval": EvalConfig(worlds=4096, steps=2000, adversary_steps=1500, adversary_patience=2, adversary_enough="any"),
    },
}
