"""Particle Gym: a point mass in a cube that must follow goals without leaving it (thesis, 4.1.1)."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
import warp as wp
from torch import Tensor

from deimos.checks import SimulationError, check_at_least, check_choice, check_positive, check_range
from deimos.kernels.particle import (
    BROKEN,
    OBS_DIM,
    ParticleParams,
    ParticleState,
    ParticleStep,
    Variant,
    make_relative,
    reset_particles,
    set_goals,
    step_particles,
)
from deimos.kernels.particle_rewards import RewardShape
from deimos.sim.env import EnvConfig, ObsField
from deimos.sim.shared import Shared
from deimos.sim.warp_env import WarpEnv

LARGEST = 1e6  # [u] or [u/step]; beyond, float32 positions no longer tell one step from the next
HALF_SIDE = 1000.0  # [u]; thesis, 4.1.1: the cube is 2000 length units a side


@dataclass(frozen=True, kw_only=True)
class Config(EnvConfig):
    """Particle Gym. Lengths are in the thesis's length units [u], times in steps."""

    variant: Literal["absolute", "directional", "relative"] = "directional"
    """What a goal is: a position in space, a velocity, or the way from the particle to a position."""
    goal_period: int = 100
    """T: steps that a goal is in force, at least 1."""
    max_speed: float = 10.0
    """Bound of every component of the velocity [u/step], positive."""
    max_force: float = 1.0
    """Bound of every component of the force [u/step^2], positive; inf for none."""
    goal_range: float | None = None
    """Half side of the box that goals are drawn from, positive. By default max_speed [u/step] for
    directional goals and 1250 u for positions, so that about half of them lie outside the cube."""
    reward: Literal["linear", "reciprocal", "exponential"] = "linear"
    """Reward of the distance d to the goal: 1 - d / (1.01 d_max), 1 / (1 + d / reward_length) or
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
        check_choice("variant", self.variant, [v.name.lower() for v in Variant])
        check_choice("reward", self.reward, [shape.name.lower() for shape in RewardShape])
        check_choice("obs_scale", self.obs_scale, ["unit", "raw"])
        check_at_least("goal_period", self.goal_period, 1)
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

    def build(self, num_envs: int, device: torch.device, seed: int, env_offset: int = 0) -> "Particle":
        """See ``EnvConfig.build``."""
        return Particle(self, num_envs, device, seed, env_offset)

    def with_goal_period(self, goal_period: int) -> "Config":
        """See ``EnvConfig.with_goal_period``."""
        return replace(self, goal_period=goal_period)

    def for_evaluation(self) -> "Config":
        """See ``EnvConfig.for_evaluation``."""
        return replace(self, stagger_goals=False)

    def params(self, seed: int, env_offset: int) -> ParticleParams:
        """What the kernels need to know."""
        params = ParticleParams()
        params.variant = int(Variant[self.variant.upper()])
        params.half_side = HALF_SIDE
        params.max_speed = self.max_speed
        params.max_force = self.max_force
        params.goal_range = self.goal_half_side
        params.spawn_range = self.spawn_range
        unit = self.obs_scale == "unit"
        params.position_scale = 1.0 / HALF_SIDE if unit else 1.0
        params.velocity_scale = 1.0 / self.max_speed if unit else 1.0
        params.force_scale = 1.0 / self.max_force if unit and math.isfinite(self.max_force) else 1.0
        params.reward_shape = int(RewardShape[self.reward.upper()])
        params.reward_length = self.reward_length or (2.5 if self.has_velocity_goals else 250.0)
        # A crashing particle is at most one step outside the cube.
        reach = self.max_speed if self.has_velocity_goals else HALF_SIDE + self.max_speed
        params.largest_distance = math.sqrt(3.0) * (reach + self.goal_half_side)
        params.goal_period = self.goal_period
        params.time_limit = self.time_limit
        params.stagger = self.stagger_goals
        params.seed = seed
        params.world_offset = env_offset
        return params


class Particle(WarpEnv):
    """Particle Gym; see ``Config``. Actions are forces [u/step^2]."""

    config: Config

    def __init__(self, config: Config, num_envs: int, device: torch.device, seed: int, env_offset: int) -> None:
        self.config = config
        self.num_envs = num_envs
        self.device = device
        self.action_dim = 3
        self.action_bound = config.max_force
        self.dt = 1.0
        self.goal_period = config.goal_period
        self.time_limit = config.time_limit
        self._params = params = config.params(seed, env_offset)
        goal_unit, goal_scale = ("u/step", params.velocity_scale) if config.has_velocity_goals else (
            "u", params.position_scale
        )  # fmt: skip
        self.layout = (
            ObsField("velocity", 3, "u/step", params.velocity_scale),
            ObsField("position", 3, "u", params.position_scale),
            ObsField("last_action", 3, "u/step^2", params.force_scale),
            ObsField("goal", 3, goal_unit, goal_scale),
        )
        seen_range = torch.full((3,), config.goal_half_side * goal_scale, device=device)
        self._allocate(seen_range, seed, env_offset)
        self._record()
        self.reset(torch.ones(num_envs, dtype=torch.bool, device=device))

    def _allocate(self, seen_range: Tensor, seed: int, env_offset: int) -> None:
        n, device = self.num_envs, self.device
        vectors = {name: Shared.zeros(n, wp.vec3, device) for name in ("position", "velocity", "force", "target")}
        counters = {
            name: Shared.zeros(n, wp.int32, device)
            for name in ("goal_clock", "episode_step", "episode_count", "goal_count")
        }
        flags = {name: Shared.zeros(n, wp.bool, device) for name in ("terminated", "truncated", "goal_due", "invalid")}
        out = {
            "obs": Shared.zeros((n, OBS_DIM), wp.float32, device),
            "reward": Shared.zeros(n, wp.float32, device),
            **flags,
            "count": Shared.zeros(2, wp.int32, device),
            "fault": Shared.zeros(3, wp.int32, device),
        }
        self._share(
            ParticleState(), vectors | counters, ParticleStep(), out, action=Shared.zeros(n, wp.vec3, device),
            new_goal=Shared.zeros(n, wp.vec3, device), first_range=torch.ones(3, device=device),
            seen_range=seen_range, seed=seed, env_offset=env_offset,
        )  # fmt: skip
        self._clear_faults()

    def _record(self) -> None:
        """Record the launches: replaying one costs half of making it (18 us against 34 us on a CPU).

        A step is one kernel, so a graph around it would save nothing more.
        """
        params, state, out = self._params, self.state_arrays, self.step_arrays
        reset = (params, self._mask.array, self._first_range.array, state, out.obs)
        self._launch_step = step_particles(params, self.action.array, state, out, record=True)
        self._launch_reset = reset_particles(*reset, record=True).launch
        self._launch_goals = set_goals(params, self._row.array, self._new_goal.array, state, out.obs, record=True)

    def launch_step(self) -> None:
        """See ``WarpEnv.launch_step``."""
        self._launch_step.launch()

    def _finish_candidates(self, candidates: wp.array) -> list[wp.Launch]:
        if self.config.variant != "relative":
            return []
        return [make_relative(self._params, self._row.array, self.state_arrays.position, candidates, record=True)]

    def check(self) -> None:
        """See ``Env.check``."""
        faults, world, bits = self._out["fault"].tolist()
        if faults == 0:
            return
        self._clear_faults()
        broken = " and ".join(name for bit, name in enumerate(BROKEN) if bits & 1 << bit)
        raise SimulationError(
            f"World {world}: its {broken} is not finite; {faults} world-steps were affected since the last check."
        )

    def _clear_faults(self) -> None:
        self._out["fault"].zero_()
        self._out["fault"][1] = self.num_envs

    def reference_policy(self, brake: bool = True) -> Callable[[Tensor], Tensor]:
        """A controller that follows goals and brakes in time for the wall.

        Per axis, a particle with speed v that brakes by a = max_force / 2 per step needs
        v^2 / (2 a) + v / 2 to stand still, this step included; so with a distance d left it may
        have v = -a / 2 + sqrt(a^2 / 4 + 2 a d). Distances to the wall bound every velocity;
        distances to a goal position give the velocity that arrives there soonest.

        Args:
            brake: Whether it minds the wall; without, it is the blind follower.
        """
        params, directional = self._params, self.config.has_velocity_goals
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
