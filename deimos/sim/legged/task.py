"""Legged robots that follow velocity goals: everything that the environments of such robots share.

The task is Legged Gym's (Rudin et al. 2021) as Gauthier's thesis uses it (4.1.2): no heading mode, levels that
rise and fall with the reward.
"""

from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from deimos import terrain
from deimos.kernels.episodes import RESUMED, WORLDS
from deimos.kernels.legged.height_scan import scan_points
from deimos.kernels.legged.observation import finish_obs
from deimos.kernels.legged.reset import reset_worlds, update_levels
from deimos.kernels.legged.rewards import LEG_JOINTS, vec12, vecT
from deimos.kernels.legged.state import (
    BROKEN,
    COLUMNS,
    HEIGHT_SCALE,
    JOINT_SPEED_SCALE,
    NUM_FEET,
    RATE_SCALE,
    VELOCITY_SCALE,
    Ground,
    Joints,
    LevelRule,
    LocomotionParams,
    LocomotionState,
    LocomotionStep,
    Simulation,
)
from deimos.kernels.legged.step import apply_actions, judge_step
from deimos.kernels.random import Purpose, draw_uniforms
from deimos.sim.env import ObsField
from deimos.sim.legged.config import LocomotionConfig
from deimos.sim.legged.engines.mujoco_warp import Captured, Physics
from deimos.sim.legged.robots import Robot
from deimos.sim.shared import Shared, warp_device
from deimos.sim.warp_env import WarpEnv
from deimos.terrain import Terrain

if TYPE_CHECKING:
    import mujoco

SOFT_LIMIT = 0.9  # share of a joint's range; Legged Gym's A1
MAX_SPEED, MAX_RATE = 20.0, 500.0  # [m/s] and [rad/s]; no Go1 is as fast, so a faster one is a simulation gone wrong
ACTION_BOUND = 100.0  # Legged Gym's: far beyond what a policy does, so that only nonsense is clipped
SPAWN_RANGE, SPAWN_SPEED = 1.0, 0.5  # [m], [m/s] and [rad/s]; Legged Gym's
EDGE = 0.3  # [m] of the terrain's edge that count as beyond it
NOWHERE = 1e9  # [m]; a plane has no edge
NOISE = {
    "linear_velocity": 0.1, "angular_velocity": 0.2, "gravity": 0.05, "joint_position": 0.01, "joint_velocity": 1.5,
    "heights": 0.1,
}  # half widths, in the unit of each field; Legged Gym's  # fmt: skip


class Locomotion(WarpEnv):
    """A legged robot in many worlds; see ``LocomotionConfig``.

    Actions are differences from the default pose, in units of ``action_scale``.

    What the robot carries has its joints after those of the legs and may add components to the goal, fields to the
    observation and terms to the reward: set the class's attributes and override ``_judge_carried``,
    ``_reset_carried`` and ``_finish_candidates``.

    Args:
        config: The task.
        robot: Who does it.
        goal_range: Half side of the box of goals along every component, [m/s], [m/s], [rad/s] first.
        goal_scale: What the policy sees goals multiplied by, a number for every component.
        num_envs: Number of worlds.
        device: Where they are simulated.
        seed: Seed of every draw.
        env_offset: Global number of world 0.
    """

    config: LocomotionConfig
    goal_groups: tuple[slice, ...] = (slice(0, 2), slice(2, 3))
    may_go_on_invalid = True
    goal_unit = "m/s, m/s, rad/s"
    """Units of the goal's components."""
    carried_fields: tuple[ObsField, ...] = ()
    """What the observation has between the last action and the heights."""
    noise = NOISE
    """Half width of the noise of every noisy field of the observation, in its unit."""
    columns: tuple[str, ...] = COLUMNS
    """What the reward is the sum of: those of ``deimos.kernels.legged.step``, then the terms of what is carried."""

    def __init__(
        self,
        config: LocomotionConfig,
        robot: Robot,
        goal_range: tuple[float, ...],
        goal_scale: tuple[float, ...],
        num_envs: int,
        device: torch.device,
        seed: int,
        env_offset: int = 0,
    ) -> None:
        self.robot = robot
        self.points = scan_points()
        super().__init__(
            config, num_envs, device, seed, env_offset, layout=self._make_layout(goal_scale), goal_range=goal_range,
            action_dim=len(robot.pose), action_bound=ACTION_BOUND,
            dt=config.physics.timestep * config.physics.substeps, time_limit=config.episode_steps,
        )  # fmt: skip
        ground = config.load_terrain()
        self.terrain = ground or terrain.flat()
        self._goal_scale, self._mask, self._first_range = (
            self.worlds.goal_scale, self.worlds.mask, self.worlds.first_range,
        )  # fmt: skip
        self._allocate()
        self.physics = self._build_physics(ground)
        self._params = self._make_params(ground)
        self._wire()
        self._capture()

    def _build_physics(self, ground: Terrain | None) -> Physics:
        """The simulator, with a friction and a payload for every world unless they are fixed."""
        config, n = self.config, self.num_envs
        self._set_rows(torch.arange(n))
        draw_uniforms(
            self._row.array, self.state_arrays.episode_count, self._draw.array,
            seed=self._seed, purpose=Purpose.FRICTION, world_offset=self._offset,
        )  # fmt: skip
        u = self._draw.array.numpy().astype(np.float64)
        low, high = config.friction
        varied = high > low or low != 1.0
        return Physics(
            self.robot, ground, n, self.device, config.physics,
            friction=low + (high - low) * u[:, 0] if varied else None,
            payload=config.payload * (2.0 * u[:, 1] - 1.0) if config.payload > 0 else None,
        )  # fmt: skip

    def _make_params(self, ground: Terrain | None) -> LocomotionParams:
        """What the kernels need to know."""
        config, robot, land = self.config, self.robot, self.terrain
        limits = self.physics.joint_range[:LEG_JOINTS]
        middle, half = limits.mean(axis=1), SOFT_LIMIT * np.ptp(limits, axis=1) / 2
        corner = np.array(land.corner)
        far = corner + (np.array(land.heights.shape) - 1) * land.cell
        params = LocomotionParams()
        values = {
            "dt": self.dt, "goal_period": config.goal_period, "time_limit": config.episode_steps,
            "stagger": config.stagger, "seed": self._seed, "world_offset": self._offset,
            "action_bound": ACTION_BOUND, "noise": config.noise,
            "push_interval": max(1, round(config.push_interval / self.dt)) if config.push_interval else 0,
            "push_speed": config.push_speed,
            "weight": vecT(*asdict(config.rewards).values()), "air_time_target": config.air_time_target,
            "soft_low": vec12(*(middle - half)), "soft_high": vec12(*(middle + half)),
            "max_speed": MAX_SPEED, "max_rate": MAX_RATE, "lost_contacts": self.physics.lost_contacts,
            "scan_start": self.obs_dim - len(self.points), "standing_height": robot.standing_height,
            "spawn_height": robot.spawn_height, "spawn_range": SPAWN_RANGE, "spawn_speed": SPAWN_SPEED,
            "spawn_reach": robot.reach, "level_rule": int(LevelRule[config.levels.upper()]),
            "start_levels": config.start_levels, "cell": land.cell, "corner": wp.vec2(*land.corner),
            "low": wp.vec2(*(corner + EDGE)) if ground else wp.vec2(-NOWHERE),
            "high": wp.vec2(*(far - EDGE)) if ground else wp.vec2(NOWHERE),
            "half_tile": land.tile / 2,
        }  # fmt: skip
        for name in LocomotionParams.vars:
            setattr(params, name, values[name])
        return params

    def _make_layout(self, goal_scale: tuple[float, ...]) -> tuple[ObsField, ...]:
        """Legged Gym's observation, with what is carried before the heights."""
        joints = len(self.robot.pose)
        return (
            ObsField("linear_velocity", 3, "m/s", VELOCITY_SCALE),
            ObsField("angular_velocity", 3, "rad/s", RATE_SCALE),
            ObsField("gravity", 3, "1", 1.0),
            ObsField("goal", len(goal_scale), self.goal_unit, goal_scale),
            ObsField("joint_position", joints, "rad", 1.0),
            ObsField("joint_velocity", joints, "rad/s", JOINT_SPEED_SCALE),
            ObsField("last_action", joints, "1", 1.0),
            *self.carried_fields,
            ObsField("heights", len(self.points), "m", HEIGHT_SCALE),
        )

    def _allocate(self) -> None:
        n, joints = self.num_envs, self.action_dim
        self.state_arrays, self.step_arrays = LocomotionState(), LocomotionStep()
        rows = {"action": joints, "joint_speed": joints, "air_time": NUM_FEET}
        for name in LocomotionState.vars:
            if name in RESUMED:
                setattr(self.state_arrays, name, getattr(self.worlds, name))
                continue
            shape = (n, rows[name]) if name in rows else n
            shared = Shared.zeros(shape, LocomotionState.vars[name].type.dtype, self.device)
            setattr(self.state_arrays, name, shared.array)
            self.tensors[name] = shared.tensor
            self._memory.append(shared.tensor)
        term = Shared.zeros((n, len(self.columns)), wp.float32, self.device)
        self._value = Shared.zeros(n, wp.float32, self.device)
        for name in LocomotionStep.vars:
            if name in WORLDS.names:
                setattr(self.step_arrays, name, getattr(self.worlds, name))
        self.step_arrays.term, self.step_arrays.value = term.array, self._value.array
        self._memory += (term.tensor, self._value.tensor)
        self.term = term.tensor
        """What the last reward is the sum of, shape (num_envs, len(columns))."""
        self._sums = torch.zeros(len(self.columns), dtype=torch.float64, device=self.device)
        self._steps_reported = 0

    def _wire(self) -> None:
        """Join the simulator's arrays and the robot's numbers to the kernels."""
        name, robot, physics, land = warp_device(self.device), self.robot, self.physics, self.terrain
        self.tensors = physics.tensors | self.tensors
        self._joints, self._ground, self._sim = Joints(), Ground(), Simulation()
        low, high = physics.joint_range.T
        for key, value in (("pose", robot.pose), ("action_scale", robot.action_scale), ("low", low), ("high", high)):
            setattr(self._joints, key, wp.array(np.asarray(value, np.float32), dtype=wp.float32, device=name))
        self._ground.heights = wp.array(land.heights, dtype=wp.float32, device=name)
        self._ground.origin = wp.array(land.origins, dtype=wp.vec3, device=name)
        for key in Simulation.vars:
            setattr(self._sim, key, getattr(physics, key))
        self._points = wp.array(self.points, dtype=wp.vec2, device=name)
        noise = [
            self.noise.get(entry.name, 0.0) * scale
            for entry in self.layout
            for scale in np.broadcast_to(entry.scale, entry.size)
        ]
        self._noise = wp.array(noise, dtype=wp.float32, device=name)

    def _capture(self) -> None:
        """Record the step and the reset, each as one graph, and begin the first episodes."""
        self._step_graph = Captured(self._run_step, self.device)
        self.begin(self._count_step, Captured(self._run_reset, self.device), valid_goals=self._record_valid_goals())
        self.physics.buffer_use()  # what the recording needed says nothing about these worlds

    def _record_valid_goals(self) -> Callable[[wp.array], wp.Launch] | None:
        """What makes valid goals of candidates; ``None`` where all are."""
        return None

    def _run_step(self) -> None:
        params, state, out, sim = self._params, self.state_arrays, self.step_arrays, self._sim
        apply_actions(params, self._joints, self.worlds.action, state, sim, out.fault)
        self.physics.step()
        self._judge_carried()
        judge_step(params, self._joints, self.worlds.action, self._goal_scale, sim, state, out)
        self._run_scan(out.invalid, wanted=False)

    def _run_scan(self, mask: wp.array, *, wanted: bool) -> None:
        finish_obs(
            self._params, mask, self._ground.heights, self._points, self._noise, self._sim.qpos, self.state_arrays,
            self.step_arrays.obs, wanted=wanted,
        )  # fmt: skip

    def _run_reset(self) -> None:
        params, state, out, sim, mask = (
            self._params, self.state_arrays, self.step_arrays, self._sim, self._mask,
        )  # fmt: skip
        update_levels(
            params, self._ground.origin, mask, out.terminated, out.truncated, out.invalid, sim.qpos, state
        )  # fmt: skip
        self.physics.reset(mask)
        reset_worlds(
            params, self._joints, self._ground, mask, self._first_range, self._goal_scale, state, sim.qpos,
            sim.qvel, out.obs,
        )  # fmt: skip
        self._reset_carried()
        self._run_scan(mask, wanted=True)

    def _judge_carried(self) -> None:
        """Launch what judges the robot's burden, before the whole step is judged."""

    def _reset_carried(self) -> None:
        """Launch what else the worlds of ``_mask`` need to begin an episode."""

    def _count_step(self) -> None:
        """Simulate one step, and add up what the report says."""
        self._step_graph()
        self._sums += self.term.sum(0)
        self._steps_reported += 1

    def describe_fault(self, world: int) -> str:
        """See ``WarpEnv.describe_fault``."""
        cause = BROKEN[int(self._views["cause"][world]).bit_length() - 1]
        value = float(self._value.tensor[world])
        if cause == "contacts":
            return f"it lost contacts ({self.physics.explain_loss(int(value))})"
        unit = " m/s or rad/s" if cause == "speed" else ""
        return f"its {cause} was {value:g}{unit}"

    def report(self) -> dict[str, float]:
        """What a log wants to know since the last call: means of the reward's terms per step, levels, buffers.

        The terms add up to the mean reward.
        """
        steps, self._steps_reported = max(self._steps_reported, 1), 0
        means = (self._sums / (steps * self.num_envs)).tolist()
        self._sums.zero_()
        invalid, self.invalid_steps = self.invalid_steps, 0
        use = self.physics.buffer_use()
        return {
            **{f"reward/{name}": value for name, value in zip(self.columns, means, strict=True)},
            "level": self.tensors["level"].float().mean().item(),
            "invalid_steps": invalid,
            "contact_use": use["contacts"] / use["max_contacts"],
            "row_use": use["rows"] / use["max_rows"],
        }

    def tiles(self) -> list[tuple[str, int]]:
        """Shape and level of the tile that every world's episode began on; reads the device."""
        columns = len(self.terrain.shapes)
        levels = self.tensors["level"].tolist()
        return [(self.terrain.shapes[(self._offset + i) % columns], level) for i, level in enumerate(levels)]

    def strata(self) -> list[str]:
        """See ``Env.strata``: shape and level of the tile; empty on flat ground."""
        return [] if self.config.terrain == "flat" else [f"{shape} {level}" for shape, level in self.tiles()]

    def scene(self, world: int) -> "tuple[mujoco.MjModel, mujoco.MjData]":
        """See ``Env.scene``."""
        return self.physics.model, self.physics.to_mujoco(world)
