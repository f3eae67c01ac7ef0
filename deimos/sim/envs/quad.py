"""Quad: a Go1 that follows velocity goals over flat and rough ground (thesis, 4.1.2)."""

from dataclasses import dataclass
from typing import Any

import torch

from deimos.sim.legged.config import LocomotionConfig
from deimos.sim.legged.goal_parts import velocity_goal
from deimos.sim.legged.task import Locomotion


@dataclass(frozen=True, kw_only=True)
class Config(LocomotionConfig):
    """Quad: a Unitree Go1. Goals are v_x, v_y and yaw rate in the base's frame, uniform in [-1, 1]^3."""

    def build(self, num_envs: int, device: torch.device, seed: int, env_offset: int = 0) -> Locomotion:
        """See ``EnvConfig.build``."""
        return Locomotion(self, self.make_robot(), (velocity_goal(self.rewards),), num_envs, device, seed, env_offset)


# From scratch to walking on flat ground in a few minutes on one core: small networks and rollouts, a short horizon,
# goals of two seconds, and penalties so light that a robot that cannot step yet does not learn to stand still.
_WALK: dict[str, Any] = {
    "env": {
        "goal_period": 100,
        "noise": False,
        "rewards": {
            "vertical_speed": -1.0, "roll_pitch_rate": -0.02, "torque": -1e-4, "joint_acceleration": -1e-7,
            "action_rate": -0.005, "collision": -0.25, "air_time": 0.0,
        },
    },
    "method": "uniform",
    "num_envs": 512,
    "env_steps": 6000,
    "ppo": {
        "hidden": (128, 64, 32), "activation": "elu", "init_std": 0.6, "reward_scale": 1.0,
        "desired_kl": 0.02, "discount": 0.97, "entropy_coef": 0.002,
    },
    "eval": {"worlds": 256, "steps": 1000},
}  # fmt: skip

PRESETS = {
    # Sizes that two CPU cores can train within an hour.
    "quad": {
        "num_envs": 1024,
        "env_steps": 6400,
        # Rewards already include the time step. With a larger initial deviation, nearly all of them are clipped to 0.
        "ppo": {"hidden": (256, 128, 64), "activation": "elu", "init_std": 0.6, "reward_scale": 1.0},
        "eval": {"worlds": 256, "steps": 1000},
    },
    "quad-walk": _WALK,
    # The same without what a robot cannot measure: only the critic sees how fast the base moves. It takes longer.
    "quad-proprioceptive": _WALK | {"env": _WALK["env"] | {"privileged": ("linear_velocity",)}, "env_steps": 12_000},
    # From the policy of quad-walk over slopes, stairs and rectangles: goals of five seconds and episodes of two, so
    # that what a robot achieves soon shows which tile suits it.
    "quad-rough": _WALK | {
        "env": _WALK["env"] | {"terrain": "rough", "goal_period": 250, "episode_steps": 500},
        "env_steps": 40_000,
    },
    # Legged Gym's sizes on rough terrain: 3000 iterations of 24 steps.
    "quad-large": {
        "env": {"terrain": "rough"},
        "num_envs": 4096,
        "env_steps": 72_000,
        "ppo": {"hidden": (512, 256, 128), "activation": "elu", "reward_scale": 1.0},
        "eval": {"worlds": 4096, "steps": 2000},
    },
}  # fmt: skip
