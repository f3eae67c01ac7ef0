"""Quad+arm: a Go1 with a ReactorX-150 on its back, which walks and reaches at the same time (thesis, 4.1.2)."""

from dataclasses import dataclass, field, replace

import torch

from deimos.checks import check_range
from deimos.kernels.legged.arm_rewards import ArmWeights
from deimos.sim.envs import quad
from deimos.sim.legged.config import LocomotionConfig, check_weights
from deimos.sim.legged.goal_parts import end_effector_goal, velocity_goal
from deimos.sim.legged.robots._primitives import hold_base
from deimos.sim.legged.task import Locomotion


@dataclass(frozen=True, kw_only=True)
class Config(LocomotionConfig):
    """Quad+arm: a Go1 and its arm. Goals are a velocity and a position of the end effector, in [-1, 1]^6."""

    robot: str = "go1_rx150"
    """Which robot walks and reaches: a name of ``deimos.sim.legged.robots``; it must have an arm."""
    speed: float = 1.0
    """Fraction of the range of the velocity goals, in [0, 1]; 0 for standing and reaching."""
    arm_rewards: ArmWeights = field(default_factory=ArmWeights)
    """Weights of the reward's terms for the arm."""
    hold_trunk: bool = False
    """Whether the trunk is held fixed in the air, its legs free: a test of the arm alone, not a task."""

    @property
    def largest_reward(self) -> float:
        """See ``EnvConfig.largest_reward``: perfect tracking, and the end effector at its goal."""
        per_second = max(self.arm_rewards.reach, 0.0) + max(self.arm_rewards.precision, 0.0)
        return super().largest_reward + per_second * self.physics.control_period

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("speed", self.speed, 0.0, 1.0)
        check_weights("arm_rewards", self.arm_rewards)

    def build(self, num_envs: int, device: torch.device, seed: int, env_offset: int = 0) -> Locomotion:
        """See ``EnvConfig.build``."""
        config, robot = self, self.make_robot()
        if self.hold_trunk:
            config, robot = replace(self, push_interval=0.0, payload=0.0), hold_base(robot)
        parts = (velocity_goal(self.rewards, self.speed), end_effector_goal(robot, self.arm_rewards))
        return Locomotion(config, robot, parts, num_envs, device, seed, env_offset)


# KL divergences add up over the joints. With half of this bound, which suits a Quad's twelve, the arm hardly learnt.
_PPO = {"hidden": (256, 128, 64), "activation": "elu", "init_std": 0.6, "reward_scale": 1.0, "desired_kl": 0.02}

PRESETS = {
    "quad-arm": quad.PRESETS["quad"] | {"ppo": _PPO},
    # Standing and reaching: a quarter of an hour on one core. A reach takes half a second, so the horizon is short.
    "quad-arm-stand": quad.PRESETS["quad"] | {
        "env": {"speed": 0.0, "goal_period": 100, "noise": False},
        "method": "uniform",
        "num_envs": 512,
        "env_steps": 4800,
        "ppo": _PPO | {"discount": 0.95, "gae_lambda": 0.9},
    },
    # Walking first, from scratch, as a Quad learns it.
    "quad-arm-walk": quad.PRESETS["quad-walk"] | {
        "env_steps": 7872,
        "ppo": _PPO | {"discount": 0.97, "entropy_coef": 0.002},
    },
    # From the policy of quad-arm-walk, whose arm has hardly learnt: a larger weight of reaching, a larger divergence.
    "quad-arm-reach": quad.PRESETS["quad-walk"] | {
        "env": quad.PRESETS["quad-walk"]["env"] | {"arm_rewards": {"reach": 1.0, "precision": 2.0}},
        "env_steps": 12_000,
        "ppo": _PPO | {"learning_rate": 3e-4, "desired_kl": 0.03, "discount": 0.97, "entropy_coef": 0.002},
    },
    "quad-arm-large": quad.PRESETS["quad-large"] | {"ppo": _PPO | {"hidden": (512, 256, 128)}},
}  # fmt: skip
