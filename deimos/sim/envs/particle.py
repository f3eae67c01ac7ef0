"""Particle Gym: a point mass in a cube that must follow goals without leaving it (thesis, 4.1.1)."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
import warp as wp
from torch import Tensor

from deimos.checks import check_at_least, check_choice, check_positive, check_range
from deimos.kernels.particle import BROKEN, PARTICLES, ParticleParams, reset_particles, step_particles
from deimos.kernels.particle_rewards import RewardName, RewardShape, reward_distances
from deimos.nn.host import own_settings
from deimos.sim.env import EnvConfig, ObsField, Sketch
from deimos.sim.shared import check_stream
from deimos.sim.warp_env import WarpEnv

LARGEST = 1e6  # [u] or [u/step]; beyond, float32 positions no longer resolve a step
HALF_SIDE = 1000.0  # [u]; thesis, 4.1.1: the cube is 2000 length units a side


@dataclass(frozen=True, kw_only=True)
class Config(EnvConfig):
    """Particle Gym. Lengths are in the thesis's length units [u], times in steps."""

    variant: Literal["absolute", "directional", "relative"] = "directional"
    """What a goal is: a position in space, a velocity, or the way from the particle to a position."""
    max_speed: float = 10.0
    """Bound of every component of the velocity [u/step], positive."""
    max_force: float = 1.0
    """Bound of every component of the force [u/step^2], positive; inf for none."""
    goal_range: float | None = None
    """Half side of the box that goals are drawn from, positive. By default max_speed [u/step] for
    directional goals and 1250 u for positions, so that about half of them are outside the cube."""
    reward: RewardName = "linear"
    """Reward for the distance d to the goal: 1 - d / (1.01 d_max), 1 / (1 + d / reward_length) or
    exp(-d / reward_length)."""
    reward_length: float | None = None
    """Distance at which the reciprocal reward is 1/2 and the exponential 1/e, positive. By default
    2.5 u/step for directional goals and 250 u for positions."""
    spawn_range: float = 0.0
    """Half side of the box that particles start in [u], in [0, 1000); 0 for the origin."""
    time_limit: int = 0
    """Steps after which an episode is truncated; 0 for never, as in the thesis."""
    stagger_goals: bool = False
    """Whether the first goal clock of every world starts at a random step, so that goals fall due evenly."""
    obs_scale: Literal["unit", "raw"] = "unit"
    """Whether the policy sees numbers of order 1, or the physical values."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("variant", self.variant, ["absolute", "directional", "relative"])
        check_choice("reward", self.reward, [shape.name.lower() for shape in RewardShape])
        check_choice("obs_scale", self.obs_scale, ["unit", "raw"])
        check_at_least("time_limit", self.time_limit, 0)
        check_positive("max_speed", self.max_speed, finite=True)
        check_range("max_speed", self.max_speed, 0, LARGEST)
        check_positive("max_force", self.max_force)
        for name in ("goal_range", "reward_length"):
            if getattr(self, name) is not None:
                check_positive(name, getattr(self, name), finite=True)
                check_range(name, getattr(self, name), 0, LARGEST)
        if not 0 <= self.spawn_range < HALF_SIDE:
            raise ValueError(f"spawn_range must be in [0, {HALF_SIDE:g}), got {self.spawn_range}.")

    @property
    def has_velocity_goals(self) -> bool:
        """Whether goals are velocities, not positions."""
        return self.variant == "directional"

    @property
    def goal_half_side(self) -> float:
        """Half side of the box that goals are drawn from [u] or [u/step]."""
        if self.goal_range is not None:
            return self.goal_range
        return self.max_speed if self.has_velocity_goals else 1250.0

    @property
    def reward_distance(self) -> float:
        """Distance [u] or [u/step] at which the reciprocal reward is 1/2 and the exponential 1/e."""
        if self.reward_length is not None:
            return self.reward_length
        return 2.5 if self.has_velocity_goals else 250.0

    def implied(self, name: str) -> float | None:
        """See ``EnvConfig.implied``."""
        return {"goal_range": self.goal_half_side, "reward_length": self.reward_distance}.get(name)

    def build(self, num_envs: int, device: torch.device, seed: int, env_offset: int = 0) -> "Particle":
        """See ``EnvConfig.build``."""
        return Particle(self, num_envs, device, seed, env_offset)

    def without_randomness(self) -> "Config":
        """See ``EnvConfig.without_randomness``."""
        return replace(self, stagger_goals=False)

    def params(self) -> ParticleParams:
        """Parameters for the kernels."""
        params = ParticleParams()
        params.velocity_goals = self.has_velocity_goals
        params.half_side = HALF_SIDE
        params.max_speed = self.max_speed
        params.max_force = self.max_force
        params.spawn_range = self.spawn_range
        unit = self.obs_scale == "unit"
        params.position_scale = 1.0 / HALF_SIDE if unit else 1.0
        params.velocity_scale = 1.0 / self.max_speed if unit else 1.0
        params.force_scale = 1.0 / self.max_force if unit and math.isfinite(self.max_force) else 1.0
        params.reward_shape = int(RewardShape[self.reward.upper()])
        params.reward_length = self.reward_distance
        # A crashing particle is at most one step outside the cube.
        reach = self.max_speed if self.has_velocity_goals else HALF_SIDE + self.max_speed
        params.largest_distance = math.sqrt(3.0) * (reach + self.goal_half_side)
        return params


class Particle(WarpEnv):
    """Particle Gym; see ``Config``. Actions are forces [u/step^2]."""

    config: Config
    recordable = True
    quantities = BROKEN

    @own_settings()
    def __init__(self, config: Config, num_envs: int, device: torch.device, seed: int, env_offset: int = 0) -> None:
        params = config.params()
        goal_unit, goal_scale = ("u", params.position_scale)
        if config.has_velocity_goals:
            goal_unit, goal_scale = ("u/step", params.velocity_scale)
        super().__init__(
            config, num_envs, device, seed, env_offset,
            layout=(
                ObsField("velocity", 3, "u/step", params.velocity_scale),
                ObsField("position", 3, "u", params.position_scale),
                ObsField("last_action", 3, "u/step^2", params.force_scale),
                ObsField("goal", 3, goal_unit, goal_scale),
            ),
            goal_range=(config.goal_half_side,) * 3, action_dim=3, action_bound=config.max_force,
            time_limit=config.time_limit, stagger=config.stagger_goals,
        )  # fmt: skip
        state = self.allocate(PARTICLES)
        if config.variant == "relative":
            self.worlds.origin = wp.from_torch(self.tensors["position"])
        self.begin(
            step=step_particles(self.worlds, state, params).launch,
            reset=reset_particles(self.worlds, state, params).launch,
        )

    def sketch(self, world: int) -> Sketch:
        """See ``Env.sketch``."""
        goal, position = (self.tensors[name][world].cpu().numpy().copy() for name in ("goal", "position"))
        if self.config.has_velocity_goals:
            goal = position + goal * (self.goal_period - int(self.tensors["goal_clock"][world]))
        return Sketch(HALF_SIDE, position, goal)

    def achieved(self, obs: Tensor) -> Tensor | None:
        """See ``Env.achieved``: velocity or position. The way to a position from elsewhere is not a goal from here."""
        if self.config.variant == "relative":
            return None
        return obs[:, 0:3] if self.config.has_velocity_goals else obs[:, 3:6]

    def goal_reward(self, achieved: Tensor, goal: Tensor) -> Tensor:
        """See ``Env.goal_reward``."""
        check_stream(self.device)
        params = self.config.params()
        scale = params.velocity_scale if self.config.has_velocity_goals else params.position_scale
        distance = ((achieved - goal) / scale).norm(dim=1).float()
        reward = torch.empty_like(distance)
        reward_distances(
            wp.from_torch(distance), wp.from_torch(reward), shape=RewardShape(params.reward_shape),
            largest=params.largest_distance, length=params.reward_length,
        )  # fmt: skip
        return reward

    def place(self, rows: Tensor) -> Tensor:
        """See ``Env.place``."""
        return self.tensors["position"][rows] / HALF_SIDE

    def risk_contrast(self) -> tuple[Tensor, Tensor]:
        """See ``Env.risk_contrast``: at rest, 1 u from a wall and at the origin (thesis, 4.2)."""
        rows = torch.arange(self.num_envs, device=self.device)
        risky, safe = rows[::2], rows[1::2]
        velocity, position = self.tensors["velocity"], self.tensors["position"]
        velocity.zero_()
        position.zero_()
        position[risky, 0] = 1.0 - HALF_SIDE
        self.obs[:, 0:3], self.obs[:, 3:6] = velocity, position * self.config.params().position_scale
        self.set_goals(rows, self.sample_goals(rows, 1).squeeze(1).clone())
        return risky, safe

    def scripted_goals(self, rows: Tensor, goal: Tensor) -> Tensor:
        """See ``Env.scripted_goals``: full speed away from the origin, or the farthest place beyond the position.

        A particle at the origin itself is sent along the diagonal.
        """
        position = self.tensors["position"][rows]
        outward = torch.where(position < 0, -1.0, 1.0).float()
        if not self.config.has_velocity_goals:
            reach = position.abs().amax(1, keepdim=True)
            outward = torch.where(reach > 0, position / reach, outward)
        origin = self.config.params().position_scale * position if self.config.variant == "relative" else 0.0
        return outward * self._seen_range - origin

    def reference_policy(self, brake: bool = True) -> Callable[[Tensor], Tensor]:
        """A controller that follows goals and brakes in time for the wall.

        Per axis, a particle with speed v that brakes by a = max_force / 2 per step needs
        v^2 / (2 a) + v / 2 to stop, this step included; so with a distance d left it may
        have v = -a / 2 + sqrt(a^2 / 4 + 2 a d). Distances to the wall bound every velocity;
        distances to a goal position give the velocity that arrives there soonest.

        Args:
            brake: Whether it brakes for the wall; without, it follows goals blindly.
        """
        params, directional = self.config.params(), self.config.has_velocity_goals
        relative = self.config.variant == "relative"
        accel = 0.5 * params.max_force

        def fastest(distance: Tensor) -> Tensor:
            if math.isinf(accel):
                return distance
            return torch.sqrt(accel * accel / 4 + 2 * accel * distance.clamp(min=0)) - accel / 2

        def act(obs: Tensor) -> Tensor:
            velocity = obs[:, 0:3] / params.velocity_scale
            position = obs[:, 3:6] / params.position_scale
            if directional:
                wanted = obs[:, 9:12] / params.velocity_scale
            else:
                way = obs[:, 9:12] / params.position_scale - (0.0 if relative else position)
                wanted = way.sign() * torch.minimum(fastest(way.abs()), way.abs())
            if brake:
                margin = 1e-3 * HALF_SIDE  # [u]; keeps rounding on this side of the wall
                wanted = torch.minimum(wanted, fastest(HALF_SIDE - margin - position))
                wanted = torch.maximum(wanted, -fastest(HALF_SIDE - margin + position))
            wanted = wanted.clamp(-params.max_speed, params.max_speed)
            return (2.0 * (wanted - velocity)).clamp(-params.max_force, params.max_force)

        return act
