"""Quad+arm: a Go1 with a ReactorX-150 on its back, which walks and reaches at once (thesis, 4.1.2)."""

from collections.abc import Callable
from dataclasses import astuple, dataclass, field, replace

import numpy as np
import torch
import warp as wp

from deimos.checks import check_range
from deimos.kernels.legged.arm import judge_arms, reset_arms
from deimos.kernels.legged.arm_goals import Arm, locate_goals, redraw_candidates
from deimos.kernels.legged.arm_rewards import ARM_TERMS, ArmWeights, vecA
from deimos.kernels.legged.state import COLUMNS
from deimos.learn.ppo import PPOConfig
from deimos.sim.env import ObsField
from deimos.sim.envs import quad
from deimos.sim.legged.config import LocomotionConfig, check_weights
from deimos.sim.legged.robots import go1, rx150
from deimos.sim.legged.task import NOISE, Locomotion
from deimos.sim.shared import Shared, warp_device

# Corners of a Go1's trunk with head and hips in the trunk's frame [m]: the arm's goals keep out of it, and of what is
# below it.
BODY_LOW, BODY_HIGH = (-0.24, -0.15, -np.inf), (0.30, 0.15, 0.06)


@dataclass(frozen=True, kw_only=True)
class Config(LocomotionConfig):
    """Quad+arm: a Go1 and its arm. Goals are a velocity goal and a place of the end effector, in [-1, 1]^6."""

    speed: float = 1.0
    """Share of the range of the velocity goals, in [0, 1]; 0 for standing and reaching."""
    arm_rewards: ArmWeights = field(default_factory=ArmWeights)
    """Weights of the reward's terms for the arm."""
    hold_trunk: bool = False
    """Whether the trunk is held fixed in the air, its legs free: a test of the arm alone, no task."""

    @property
    def largest_reward(self) -> float:
        """See ``EnvConfig.largest_reward``: perfect tracking, and the end effector at its goal."""
        per_second = max(self.arm_rewards.reach, 0.0) + max(self.arm_rewards.precision, 0.0)
        return super().largest_reward + per_second * self.physics.timestep * self.physics.substeps

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("speed", self.speed, 0.0, 1.0)
        check_weights("arm_rewards", self.arm_rewards)

    def build(self, num_envs: int, device: torch.device, seed: int, env_offset: int = 0) -> "QuadArm":
        """See ``EnvConfig.build``."""
        legs = go1.build(stiffness=self.stiffness, damping=self.damping, action_scale=self.action_scale)
        robot = rx150.mount(legs, hold_trunk=self.hold_trunk)
        config = replace(self, push_interval=0.0, payload=0.0) if self.hold_trunk else self
        goal_range = (*(self.speed * bound for bound in quad.GOAL_RANGE), 1.0, 1.0, 1.0)
        return QuadArm(config, robot, goal_range, (*quad.GOAL_SCALE, 1.0, 1.0, 1.0), num_envs, device, seed, env_offset)


class QuadArm(Locomotion):
    """A quadruped with an arm in many worlds; see ``Config``, and ``kernels.legged.arm_goals`` for its goals."""

    config: Config
    goal_groups = (*Locomotion.goal_groups, slice(3, 6))
    goal_unit = f"{Locomotion.goal_unit}, 1, 1, 1"
    carried_fields = (ObsField("end_effector", 3, "1", 1.0),)
    noise = NOISE | {"end_effector": 0.01}  # what that of the joints' angles makes of it
    columns = (*COLUMNS, *ARM_TERMS)

    def _wire(self) -> None:
        super()._wire()
        name, shoulder = warp_device(self.device), np.array(rx150.SHOULDER)
        offsets = np.array(rx150.OFFSETS)
        offsets[0] += rx150.MOUNT
        axes = [[float(axis == each) for each in "xyz"] for axis in rx150.AXES]
        self._arm = Arm()
        self._arm.offset = wp.array(offsets, dtype=wp.vec3, device=name)
        self._arm.axis = wp.array(axes, dtype=wp.vec3, device=name)
        self._arm.origin = wp.vec3(shoulder[0], shoulder[1], shoulder[2] + self.robot.standing_height)
        self._arm.body_low = wp.vec3(*(np.array(BODY_LOW) - rx150.GRIPPER_RADIUS - shoulder))
        self._arm.body_high = wp.vec3(*(np.array(BODY_HIGH) + rx150.GRIPPER_RADIUS - shoulder))
        self._arm.clearance = rx150.GRIPPER_RADIUS
        self._arm.weight = vecA(*astuple(self.config.arm_rewards))
        self._arm.obs_start = self.obs_dim - len(self.points) - self.carried_fields[0].size
        self._error = Shared.zeros(self.num_envs, wp.float32, self.device)
        self.errors = {"end effector [m]": self._error.tensor}

    def _judge_carried(self) -> None:
        judge_arms(
            self._params, self._arm, self._ground.heights, self.action.array, self._sim, self.state_arrays,
            self.step_arrays, self._error.array,
        )  # fmt: skip

    def _reset_carried(self) -> None:
        reset_arms(
            self._params, self._arm, self._ground.heights, self._mask, self._first_range, self._goal_scale,
            self._sim.qpos, self.state_arrays, self.step_arrays.obs, self._error.array,
        )  # fmt: skip

    def _record_valid_goals(self) -> Callable[[wp.array], wp.Launch]:
        return lambda candidates: redraw_candidates(
            self._params, self._arm, self._ground.heights, self._sim.qpos, self._row.array,
            self.state_arrays.goal_count, self._candidate_scale.array, candidates, record=True,
        )  # fmt: skip

    def goal_point(self, world: int) -> np.ndarray:
        """See ``Env.goal_point``."""
        points = wp.zeros(self.num_envs, dtype=wp.vec3, device=warp_device(self.device))
        locate_goals(self._params, self._arm, self._ground.heights, self._sim.qpos, self.state_arrays, points)
        return points.numpy()[world]

    def report(self) -> dict[str, float]:
        """See ``Locomotion.report``; the arm's error is the mean over the worlds at this moment [m]."""
        return super().report() | {"end_effector_error": self._error.tensor.mean().item()}


# KL divergences add up over the joints. Under half of this bound, which suits a Quad's twelve, the arm hardly learnt.
_PPO = PPOConfig(hidden=(256, 128, 64), activation="elu", init_std=0.6, reward_scale=1.0, desired_kl=0.02)

PRESETS = {
    "quad-arm": quad.PRESETS["quad"] | {"env": Config(), "ppo": _PPO},
    # Standing and reaching: a quarter of an hour on one core. A reach takes half a second, so the horizon is short.
    "quad-arm-stand": quad.PRESETS["quad"] | {
        "env": Config(speed=0.0, goal_period=100, noise=False),
        "method": "uniform",
        "num_envs": 512,
        "env_steps": 4800,
        "ppo": replace(_PPO, discount=0.95, gae_lambda=0.9),
    },
    "quad-arm-thesis": quad.PRESETS["quad-thesis"] | {
        "env": Config(terrain="rough"), "ppo": replace(_PPO, hidden=(512, 256, 128)),
    },
}  # fmt: skip
