"""Legged robots that follow velocity goals: everything that the environments of such robots share.

The task is Legged Gym's (Rudin et al. 2021) as Gauthier's thesis uses it (4.1.2): no heading mode, levels that
rise and fall with the reward.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from deimos import terrain
from deimos.kernels.legged import state as tables
from deimos.kernels.legged.height_scan import scan_points
from deimos.kernels.legged.levels import update_levels
from deimos.kernels.legged.observation import finish_obs
from deimos.kernels.legged.reset import reset_worlds
from deimos.kernels.legged.rewards import LEG_JOINTS, vec12, vecT
from deimos.kernels.legged.state import (
    BROKEN,
    COLUMNS,
    HEIGHT_SCALE,
    JOINT_SPEED_SCALE,
    RATE_SCALE,
    VELOCITY_SCALE,
    LeggedWorlds,
    LevelRule,
    LocomotionParams,
)
from deimos.kernels.legged.step import apply_actions, evaluate_step
from deimos.kernels.random import Purpose, draw_uniforms
from deimos.nn.host import own_settings
from deimos.nn.ranks import max_over_ranks, mean_over_ranks, sum_over_ranks
from deimos.sim.env import ObsField
from deimos.sim.legged import engines
from deimos.sim.legged.config import LocomotionConfig
from deimos.sim.legged.engines import Physics
from deimos.sim.legged.engines.captured import Captured
from deimos.sim.legged.goal_parts import GoalPart, Launches
from deimos.sim.legged.robot_check import PAYLOAD
from deimos.sim.legged.robots import Robot
from deimos.sim.shared import warp_device
from deimos.sim.warp_env import WarpEnv
from deimos.terrain import Terrain

if TYPE_CHECKING:
    import mujoco

SOFT_LIMIT = 0.9  # share of a joint's range; Legged Gym's A1
MAX_SPEED, MAX_RATE = 20.0, 500.0  # [m/s] and [rad/s]; no Go1 is that fast, so a faster one is a simulation gone wrong
SPAWN_RANGE, SPAWN_SPEED = 1.0, 0.5  # [m], [m/s] and [rad/s]; Legged Gym's
STEP_IN_SIGHT = 0.02  # [m]; the lowest step of the stairs is 5 cm high
EDGE = 0.3  # [m] along the terrain's edge that count as outside it
NOWHERE = 1e9  # [m]; a plane has no edge
FARTHEST = 4096.0  # [m] from the origin; beyond, float32 resolves 0.5 mm at best, and smaller movements per step vanish
SETTLED = 2.0  # [s] after which a standing robot is at rest
GOALS_AT_REST = 2**18  # goals with which the mean tracking by a robot at rest is known to 0.001
NOISE = {
    "linear_velocity": 0.1, "angular_velocity": 0.2, "gravity": 0.05, "joint_position": 0.01, "joint_velocity": 1.5,
    "heights": 0.1,
}  # half widths, in the unit of each field; Legged Gym's  # fmt: skip


class Locomotion(WarpEnv):
    """A legged robot in many worlds; see ``LocomotionConfig``.

    Actions are differences from the default pose, in units of every joint's ``action_scale``, and clipped to what takes
    the target angle to an end of the joint's range.

    Args:
        config: The task.
        robot: The robot.
        parts: The parts of its goals; the velocity goal comes first.
        num_envs, device, seed, env_offset: See ``EnvConfig.build``.
    """

    config: LocomotionConfig
    may_go_on_invalid = True
    quantities = BROKEN

    @own_settings()
    def __init__(
        self, config: LocomotionConfig, robot: Robot, parts: Sequence[GoalPart], num_envs: int, device: torch.device,
        seed: int, env_offset: int = 0,
    ) -> None:  # fmt: skip
        self.robot, self.parts, self.points = robot, tuple(parts), scan_points()
        ends = accumulate((size for part in parts for size in part.groups), initial=0)
        self.goal_groups = tuple(slice(start, stop) for start, stop in pairwise(ends))
        self.goal_group_names = tuple(name for part in parts for name in part.group_names)
        self.goal_group_weights = tuple(max(weight, 0.0) for part in parts for weight in part.weights)
        self.columns = (*COLUMNS, *(name for part in parts for name in part.columns))
        """The terms that the reward is the sum of: the legs', what clipping adds, and those of the goal's parts."""
        super().__init__(
            config, num_envs, device, seed, env_offset,
            layout=_layout(robot, parts, len(self.points), config.privileged),
            goal_range=[half for part in parts for half in part.range],
            action_dim=len(robot.joints), dt=config.physics.control_period, time_limit=config.episode_steps,
            action_bound=max(abs(end) for joint in robot.joints for end in joint.action_range),
        )  # fmt: skip
        ground = config.load_terrain()
        if ground:
            _require_room(ground)
            _require_nearness(ground)
        self.terrain = ground or terrain.flat()
        self.physics = self._build_physics(ground)
        self.recordable = self.physics.recordable
        self.tensors = self.physics.tensors | self.tensors
        self.legged = self._join(ground)
        """Everything that the kernels work on."""
        self.term = wp.to_torch(self.legged.out.term)
        """The terms of the last reward, shape (num_envs, len(columns))."""
        self._launches = [part.bind(self.legged) for part in parts]
        self.errors = {name: error for part in self._launches for name, error in part.errors.items()}
        self._sums = torch.zeros(len(self.columns), dtype=torch.float64, device=device)
        self._reported_at = 0  # step of the last call of report
        self._begin()

    def _build_physics(self, ground: Terrain | None) -> Physics:
        """The simulator, with a friction and a payload for every world unless they are fixed.

        Raises:
            ValueError: If a payload could cancel the base's whole mass.
        """
        config, n = self.config, self.num_envs
        self._set_rows(torch.arange(n, device=self.device))
        draw_uniforms(
            self._row.array, self.worlds.episode_count, self._draw.array,
            seed=self._seed, purpose=Purpose.FRICTION, world_offset=self._offset,
        )  # fmt: skip
        u = self._draw.array.numpy().astype(np.float64)
        low, high = config.friction
        own = {self.robot.spec.geom(name).friction[0] for foot in self.robot.parts[1:5] for name in foot}
        varied = high > low or own != {low}
        self._require_base_mass()
        return engines.build(
            config.engine, self.robot, ground, n, self.device, config.physics,
            friction=low + (high - low) * u[:, 0] if varied else None,
            payload=config.payload * (2.0 * u[:, 1] - 1.0) if config.payload > 0 else None,
        )  # fmt: skip

    def _require_base_mass(self) -> None:
        model = self.robot.spec.compile()
        base, payload = model.body(model.jnt_bodyid[0]), self.config.payload
        if payload >= base.mass[0]:
            raise ValueError(
                f"payload must be less than the {base.mass[0]:.3g} kg of '{base.name}', since it is also subtracted, "
                f"got {payload:g}; use --env.payload {PAYLOAD * base.mass[0]:.2g}."
            )

    def _join(self, ground: Terrain | None) -> LeggedWorlds:
        """Join the arrays of worlds, simulator, robot and terrain for the kernels."""
        land, joints = self.terrain, self.robot.joints
        sizes = tables.sizes(
            num_envs=self.num_envs, num_joints=len(joints), substeps=self.config.physics.substeps,
            num_points=len(self.points), heights=land.heights.shape, tiles=land.origins.shape[:2],
            goal_dim=self.goal_dim, num_groups=len(self.goal_groups), num_terms=len(self.columns),
            arm_fields=sum(field.size for part in self.parts for field in part.fields),
        )  # fmt: skip
        numbers: dict[str, Any] = {name: size for name, size in sizes.items() if name != "num_envs"}
        low, high = np.array([joint.range for joint in joints]).T
        action_low, action_high = np.array([joint.action_range for joint in joints]).T
        device = warp_device(self.device)
        return LeggedWorlds(
            sizes=sizes,
            params=self._make_params(ground),
            worlds=self.worlds,
            joints=tables.build(
                tables.JOINTS, device, pose=self.robot.pose, action_scale=[joint.action_scale for joint in joints],
                low=low, high=high, action_low=action_low, action_high=action_high,
            ),
            ground=tables.build(tables.GROUND, device, heights=land.heights, origin=land.origins),
            sensing=tables.build(tables.SENSING, device, noise=_noise(self.layout, self.parts), point=self.points),
            state=self.allocate(tables.STATE, **numbers),
            out=self.allocate(tables.STEP, resume=False, **numbers),
            sim=self.physics.arrays,
        )  # fmt: skip

    def _make_params(self, ground: Terrain | None) -> LocomotionParams:
        """Parameters for the kernels."""
        config, robot, land = self.config, self.robot, self.terrain
        limits = np.array([joint.range for joint in robot.joints[:LEG_JOINTS]])
        middle, half = limits.mean(axis=1), SOFT_LIMIT * np.ptp(limits, axis=1) / 2
        corner = np.array(land.corner)
        far = corner + (np.array(land.heights.shape) - 1) * land.cell
        return tables.make_params(**{
            "dt": self.dt, "stagger": config.stagger, "noise": config.noise,
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
        })  # fmt: skip

    def _begin(self) -> None:
        """Record step and reset, each as one graph, and begin every world's first episode.

        The recordings refer to the memory that they work on, not to the environment, which holds them: so the
        environment is freed with its last reference, without waiting for Python's garbage collector.
        """
        legged, launches, rows = self.legged, self._launches, self.physics.parts
        faults = wp.zeros((len(rows), 3), dtype=wp.int32, device=self.worlds.fault.device)
        evaluate = [partial(_finish_step, legged.rows(part, faults[i]), launches, part) for i, part in enumerate(rows)]
        run_step = self.physics.record_step(partial(apply_actions, legged), evaluate)
        gather_faults = self._gather(wp.to_torch(faults))
        sums, term = self._sums, self.term

        def step() -> None:
            run_step()
            gather_faults()
            sums.add_(term.sum(0))

        validations = [part.validate for part in launches if part.validate]
        if len(validations) > 1:
            raise ValueError(f"At most one part may restrict which goals are valid, got {len(validations)}.")
        valid_goals = partial(validations[0], self._row.array, self._candidate_scale.array) if validations else None
        run_reset = partial(_run_reset, legged, launches, self.physics)
        self.begin(step, Captured(run_reset, self.device), valid_goals=valid_goals)
        self.physics.report()  # buffer use while recording says nothing about these worlds

    def _gather(self, faults: Tensor) -> Callable[[], None]:
        """Makes a function that adds the faults of parts, shape (parts, 3), to those of all worlds."""
        known, nothing = self._views["fault"], self._no_fault
        first = torch.tensor([[0, rows.start, rows.start] for rows in self.physics.parts]).to(faults)
        faults.copy_(nothing)

        def gather() -> None:
            found = faults + first
            known[0] += found[:, 0].sum()
            torch.minimum(known[1:], found[:, 1:].amin(0), out=known[1:])
            faults.copy_(nothing)

        return gather

    @property
    def action_range(self) -> tuple[Tensor, Tensor]:
        """See ``Env.action_range``: the actions that take the joints' targets to the ends of their ranges."""
        low, high = torch.tensor([joint.action_range for joint in self.robot.joints], dtype=torch.float32).T
        return low, high

    def describe_fault(self, world: int) -> str:
        """See ``WarpEnv.describe_fault``."""
        cause = BROKEN[int(self._views["cause"][world]).bit_length() - 1]
        value = float(self.legged.out.value.numpy()[world])
        if cause == "contacts":
            return f"it lost contacts ({self.physics.explain_loss(int(value))})"
        unit = " m/s or rad/s" if cause == "speed" else ""
        return f"its {cause} was {value:g}{unit}"

    def report(self) -> dict[str, float]:
        """Numbers for the log since the last call: means of the reward's terms per step, levels, buffers, errors.

        The terms add up to the mean reward; the errors are means over the worlds at this moment.
        """
        steps, self._reported_at = max(self.steps - self._reported_at, 1), self.steps
        means = mean_over_ranks(self._sums / (steps * self.num_envs)).tolist()
        self._sums.zero_()
        invalid, self.invalid_steps = self.invalid_steps, 0
        use = self.physics.report()
        most = max_over_ranks(torch.tensor([*use.values()], dtype=torch.float64)).tolist()
        return {
            **{f"reward/{name}": value for name, value in zip(self.columns, means, strict=True)},
            "level": mean_over_ranks(self.tensors["level"].float().mean()).item(),
            "invalid_steps": int(sum_over_ranks(torch.tensor(invalid))),
            **dict(zip(use, most, strict=True)),
            **{_error_name(name): mean_over_ranks(error.mean()).item() for name, error in self.errors.items()},
        }

    def tiles(self) -> list[tuple[str, int]]:
        """Shape and level of the tile that every world's episode began on; reads the device."""
        columns = len(self.terrain.shapes)
        levels = self.tensors["level"].tolist()
        return [(self.terrain.shapes[(self._offset + i) % columns], level) for i, level in enumerate(levels)]

    def scripted_goals(self, rows: Tensor, goal: Tensor) -> Tensor:
        """See ``Env.scripted_goals``: the reverse of the active velocity at its limits; the rest is left to chance."""
        count = len(self.parts[0].range)
        reverse = torch.where(self.goal[rows, :count] < 0, 1.0, -1.0).float() * self._seen_range[:count]
        return torch.cat([reverse, goal[:, count:]], dim=1)

    def rest_goal(self) -> tuple[float | None, ...]:
        """See ``Env.rest_goal``: no velocity, and the arm's goal stays."""
        walk, *others = (len(part.range) for part in self.parts)
        return (0.0,) * walk + (None,) * sum(others)

    def risk_contrast(self) -> tuple[Tensor, Tensor] | None:
        """See ``Env.risk_contrast``: robots where they are, on stairs and on flat ground (thesis, 4.1).

        Smooth slopes are flat on level 0. A robot on stairs that sees no step, or on flat ground that sees one, is in
        neither group.
        """
        shapes = ["flat" if shape.startswith("slope") and not level else shape for shape, level in self.tiles()]
        stairs, flat = (
            torch.tensor([i for i, shape in enumerate(shapes) if shape.startswith(kind)], device=self.device)
            for kind in ("stairs", "flat")
        )
        if not len(stairs) or not len(flat):
            return None
        seen = self.obs[:, self.obs_dim - len(self.points) :].aminmax(dim=1)
        uneven = seen.max - seen.min > HEIGHT_SCALE * STEP_IN_SIGHT
        return stairs[uneven[stairs]], flat[~uneven[flat]]

    def tracking_at_rest(self) -> float | None:
        """See ``Env.tracking_at_rest``: of at least ``GOALS_AT_REST`` goals, by the robots once they stand.

        ``None`` if no part of the goal has a weight.
        """
        if not sum(self.goal_group_weights) > 0.0:
            return None
        nothing = torch.zeros(self.num_envs, self.action_dim, dtype=torch.float32, device=self.device)
        for _ in range(round(SETTLED / self.dt)):
            self.step(nothing)
        everyone, count = torch.arange(self.num_envs, device=self.device), -(-GOALS_AT_REST // self.num_envs)
        goals = self.sample_goals(everyone, count) / self._views["goal_scale"]
        tracking = torch.cat(self.at_rest(goals), dim=2).double().mean((0, 1)).tolist()
        return float(np.average(tracking, weights=self.goal_group_weights))

    def at_rest(self, goals: Tensor) -> list[Tensor]:
        """Tracking of goals by robots that stand as these do, for each part, shape (num_envs, n, groups).

        Args:
            goals: In physical units, shape (num_envs, n, goal_dim).
        """
        places = dict(
            zip((field.name for field in self.layout), self.obs.split([f.size for f in self.layout], 1), strict=True)
        )
        components = goals.split([len(part.range) for part in self.parts], dim=2)
        seen = [torch.cat([self.obs[:, :0], *(places[f.name] for f in part.fields)], dim=1) for part in self.parts]
        return [part.at_rest(*own) for part, *own in zip(self.parts, components, seen, strict=True)]

    def strata(self) -> list[str]:
        """See ``Env.strata``: shape and level of the tile; empty on flat ground."""
        return [] if self.config.terrain == "flat" else [f"{shape} {level}" for shape, level in self.tiles()]

    def scene(self, world: int) -> "tuple[mujoco.MjModel, mujoco.MjData]":
        """See ``Env.scene``."""
        return self.physics.model, self.physics.to_mujoco(world)

    def goal_point(self, world: int) -> np.ndarray | None:
        """See ``Env.goal_point``."""
        places = [part.points for part in self._launches if part.points]
        return places[0]()[world] if places else None


def _finish_step(legged: LeggedWorlds, launches: Sequence[Launches], rows: slice) -> None:
    """Launch what follows a step of the simulator, in some of the worlds: ``legged`` is restricted to them."""
    for part in launches:
        part.evaluate(legged, rows)
    evaluate_step(legged)
    finish_obs(legged, legged.worlds.invalid, wanted=False)


def _run_reset(legged: LeggedWorlds, launches: Sequence[Launches], physics: Physics) -> None:
    """Launch the reset of the worlds in the mask."""
    mask = legged.worlds.mask
    update_levels(legged)
    physics.reset(mask)
    reset_worlds(legged)
    for part in launches:
        part.reset()
    finish_obs(legged, mask, wanted=True)


def _require_room(ground: Terrain) -> None:
    """Raise ``ValueError`` unless robots start on the terrain wherever they start around a tile's middle."""
    beyond_corner = ground.origins[..., :2] - ground.corner
    room, need = np.minimum(beyond_corner, ground.size - beyond_corner).min(), SPAWN_RANGE + EDGE
    if room < need - 1e-4:
        raise ValueError(
            f"terrain must reach {need:g} m beyond the middle of every tile, around which robots start, got "
            f"{room:.3g} m; make its tiles larger, or its border wider by {need - room:.3g} m."
        )


def _require_nearness(ground: Terrain) -> None:
    """Raise ``ValueError`` if robots start where single precision is too coarse for their positions."""
    farthest = np.abs(ground.origins).max()
    if farthest > FARTHEST:
        raise ValueError(
            f"terrain must have the middles of its tiles within {FARTHEST:g} m of the origin under a robot, whose "
            f"position is in single precision, got {farthest:g} m; move it closer to the origin before importing it."
        )


def _layout(
    robot: Robot, parts: Sequence[GoalPart], num_points: int, privileged: Sequence[str]
) -> tuple[ObsField, ...]:
    """Legged Gym's observation, with the fields of the goal's parts before the heights.

    Raises:
        ValueError: If ``privileged`` names an unknown field, or the goal, which the actor must see.
    """
    joints = len(robot.joints)
    units = [unit for part in parts for unit in part.units]
    scale = tuple(scale for part in parts for scale in part.scale)
    layout = (
        ObsField("linear_velocity", 3, "m/s", VELOCITY_SCALE),
        ObsField("angular_velocity", 3, "rad/s", RATE_SCALE),
        ObsField("gravity", 3, "1", 1.0),
        ObsField("goal", len(scale), ", ".join(units), scale),
        ObsField("joint_position", joints, "rad", 1.0),
        ObsField("joint_velocity", joints, "rad/s", JOINT_SPEED_SCALE),
        ObsField("last_action", joints, "1", 1.0),
        *(field for part in parts for field in part.fields),
        ObsField("heights", num_points, "m", HEIGHT_SCALE),
    )
    possible = [field.name for field in layout if field.name != "goal"]
    if unknown := sorted(set(privileged) - set(possible)):
        raise ValueError(f"privileged must be some of {', '.join(possible)}, got {', '.join(unknown)}.")
    return tuple(replace(field, seen_by="critic") if field.name in privileged else field for field in layout)


def _noise(layout: Sequence[ObsField], parts: Sequence[GoalPart]) -> list[float]:
    """Half width of the noise of every component of the observation, as the policy sees it."""
    noise = dict(NOISE)
    for part in parts:
        noise |= part.noise
    return [
        noise.get(entry.name, 0.0) * scale for entry in layout for scale in np.broadcast_to(entry.scale, entry.size)
    ]


def _error_name(name: str) -> str:
    """The name of a log's column for an error such as ``end effector [m]``."""
    return name.partition(" [")[0].replace(" ", "_") + "_error"
