"""What the kernels of the legged robots share: parameters, states, results.

The first twelve joints are those of the legs (``deimos.kernels.legged.rewards``), further ones those of an arm. A goal
begins with the velocity goal (v_x, v_y, yaw rate); further components are the arm's (``deimos.kernels.legged.arm``).
The observation is Legged Gym's (Rudin et al. 2021)::

    velocity 3, angular velocity 3, gravity 3, goal G, joint angles J, joint velocities J, last action J,
    the arm's, heights

with G components of the goal and J joints. Vectors are in the base's own frame, the goal's too, except for
the heights.

Every array is in a struct, and every struct has a table of shapes. ``LeggedWorlds`` combines the structs and checks
them once: the launchers do not check again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import warp as wp

from ..episodes import WORLDS, Worlds
from ..structs import StructTable
from .rewards import LEG_JOINTS, TERMS, vec12, vecT

wp.set_module_options({"enable_backward": False})

VELOCITY_SCALE = 2.0  # the policy sees velocities [m/s] times this
RATE_SCALE = 0.25  # and angular velocities [rad/s]
JOINT_SPEED_SCALE = 0.05  # and joint velocities [rad/s]
HEIGHT_SCALE = 5.0  # and heights [m]: of the base above the ground, minus its height on level ground
HEIGHT_BOUND = 1.0  # [m]; clipped to this on either side
GOAL_START = 9  # where the goal starts in the observation

BASE_PART, FIRST_FOOT, FIRST_LIMB = 0, 1, 5  # parts of a robot, as in ``deimos.kernels.legged.contacts``
NUM_FEET, NUM_PARTS = 4, 13
CRASH_FORCE = 1.0  # [N] between base and terrain
FOOT_FORCE = 1.0  # [N] from which a foot is in contact
LIMB_FORCE = 0.1  # [N] from which a thigh or calf has collided

BROKEN = ("action", "position", "velocity", "speed", "contacts", "goal")  # causes of an invalid world, by their bit


class LevelRule(IntEnum):
    """How the level of a world changes at the end of an episode."""

    FROZEN = 0
    """World i always stands on tile (i // columns) % levels: for evaluation."""
    REWARD = 1
    """Up if the mean linear tracking is at least 0.8 without a crash, down if it is below 0.5 or after a crash."""
    DISPLACEMENT = 2
    """The same with the agreement of the robot's displacements and those of its goals' paths (``levels``)."""


@wp.struct
class LocomotionParams:
    """Parameters that all worlds share."""

    dt: float  # duration of a step [s]
    stagger: wp.bool  # whether the clocks of a world's first episode start at random steps
    noise: wp.bool  # whether observations are noisy
    push_interval: int  # steps from push to push, 0 disables pushes
    push_speed: float  # bound of the velocity that a push sets [m/s]
    weight: vecT  # of the reward's terms
    air_time_target: float  # [s]
    soft_low: vec12  # soft limits of the legs' joints [rad]
    soft_high: vec12
    max_speed: float  # of the base; beyond it a world is invalid [m/s]
    max_rate: float  # of base and joints; beyond it a world is invalid [rad/s]
    lost_contacts: int  # bits of the simulator's overflow that make a world invalid
    scan_start: int  # where the heights start in the observation
    standing_height: float  # of the base on level ground [m]
    spawn_height: float  # of the base above the ground [m]
    spawn_range: float  # half side of the square that robots start in, around the origin of their tile [m]
    spawn_speed: float  # bound of every component of the base's first velocity [m/s] and [rad/s]
    spawn_reach: float  # half side of the square below the base whose highest ground counts [m]
    level_rule: int  # one of LevelRule
    start_levels: int  # levels that first episodes are drawn from, all if there are fewer
    cell: float  # of the height grid [m]
    corner: wp.vec2  # its first sample [m]
    low: wp.vec2  # least and largest x and y of the terrain; beyond them an episode is truncated [m]
    high: wp.vec2


@wp.struct
class Joints:
    """The robot's joints."""

    pose: wp.array[float]  # angles at an action of zero [rad]
    action_scale: wp.array[float]  # what an action of 1 adds to the target [rad]
    low: wp.array[float]  # range [rad]
    high: wp.array[float]
    action_low: wp.array[float]  # actions are clipped to what takes the target to an end of the range
    action_high: wp.array[float]


@wp.struct
class Ground:
    """The terrain."""

    heights: wp.array2d[float]  # [m]
    origin: wp.array2d[wp.vec3]  # where robots start on the tile of every level and column [m]


@wp.struct
class Sensing:
    """How the policy sees the worlds."""

    noise: wp.array[float]  # half width of the uniform noise of every component of the observation
    point: wp.array[wp.vec2]  # where heights are read, in the frame of the robot's yaw [m]


@wp.struct
class LocomotionState:
    """What a bit-exact resume needs beyond ``Worlds`` and the simulator's own state."""

    action: wp.array2d[float]  # the last action, bounded
    joint_speed: wp.array2d[float]  # at the end of the last step [rad/s]
    air_time: wp.array2d[float]  # of every foot since it left the ground [s]
    foot_contact: wp.array[int]  # bit i: foot i touched the ground on the last step
    tracked: wp.array[wp.vec2]  # sum of the linear tracking in this episode, and its steps
    level: wp.array[int]
    goal_start: wp.array[wp.vec3]  # where the robot was when its goal began: x and y [m], and the goal's clock
    progress: wp.array[wp.vec4]  # how well displacements agree with paths, see ``follow_path``


@wp.struct
class LocomotionStep:
    """What a step returns beyond ``Worlds``, whose ``tracking`` begins with linear and yaw."""

    term: wp.array2d[float]  # terms of the reward: ``COLUMNS``, then the arm's
    value: wp.array[float]  # the value that was at fault on the last invalid step of this world


@wp.struct
class Simulation:
    """The simulator's arrays."""

    qpos: wp.array2d[float]  # base position 3 [m], quaternion 4 (w, x, y, z), joint angles [rad]
    qvel: wp.array2d[float]  # base velocity 3 in the world [m/s], rate 3 in the base [rad/s], joint velocities [rad/s]
    ctrl: wp.array2d[float]  # target angles [rad]
    torque: wp.array2d[float]  # [N m]
    part_force: wp.array3d[float]  # of every substep: normal forces of the parts on the terrain [N]
    overflow: wp.array[int]  # bits of what the simulator ran out of


COLUMNS = (*TERMS, "clipping")  # of ``LocomotionStep.term``; the last one is what clipping at 0 added
NUM_COLUMNS = len(COLUMNS)

JOINTS = StructTable(Joints, dict.fromkeys(Joints.vars, ("num_joints",)))
GROUND = StructTable(Ground, {"heights": ("nx", "ny"), "origin": ("levels", "columns")})
SENSING = StructTable(Sensing, {"noise": ("obs_dim",), "point": ("num_points",)})
STATE = StructTable(LocomotionState, {
    "action": ("num_envs", "num_joints"), "joint_speed": ("num_envs", "num_joints"), "air_time": ("num_envs", NUM_FEET),
})  # fmt: skip
STEP = StructTable(LocomotionStep, {"term": ("num_envs", "num_terms")})
SIMULATION = StructTable(Simulation, {
    "qpos": ("num_envs", "nq"), "qvel": ("num_envs", "nv"), "ctrl": ("num_envs", "num_joints"),
    "torque": ("num_envs", "num_joints"), "part_force": ("substeps", "num_envs", NUM_PARTS),
})  # fmt: skip
TABLES = {
    "worlds": WORLDS, "joints": JOINTS, "ground": GROUND, "sensing": SENSING, "state": STATE, "out": STEP,
    "sim": SIMULATION,
}  # fmt: skip


def build(table: StructTable, device: str, **values: Any) -> Any:
    """A struct of these values, one for every array of its table: numbers are copied, Warp arrays are kept."""
    struct = table.struct()
    for name in table.names:
        value = values[name]
        if not isinstance(value, wp.array):
            value = wp.array(value, dtype=table.dtype(name), device=device)
        setattr(struct, name, value)
    return struct


def make_params(**values: Any) -> LocomotionParams:
    """Params of these values: all of them, by name."""
    if values.keys() != LocomotionParams.vars.keys():
        raise ValueError(f"params must be {', '.join(LocomotionParams.vars)}, got {', '.join(values)}.")
    params = LocomotionParams()
    for name, value in values.items():
        setattr(params, name, value)
    return params


def sizes(
    *, num_envs: int, num_joints: int, substeps: int, num_points: int, heights: Sequence[int],
    tiles: Sequence[int] = (1, 1), goal_dim: int = 3, num_groups: int = 2, num_terms: int = NUM_COLUMNS,
    arm_fields: int = 0,
) -> dict[str, int]:  # fmt: skip
    """The sizes that the tables name; the legs' joints, the velocity goal's components and their terms come first.

    ``heights`` are the samples of the height grid along each axis, at least 2, ``tiles`` the levels and columns of the
    terrain, and ``arm_fields`` the components of the observation between the last action and the heights.

    Raises:
        ValueError: If a size is less than these first ones need.
    """
    found = {
        "num_envs": num_envs, "num_origins": 0, "num_joints": num_joints, "action_dim": num_joints,
        "nq": 7 + num_joints, "nv": 6 + num_joints, "substeps": substeps, "num_points": num_points,
        "nx": heights[0], "ny": heights[1], "levels": tiles[0], "columns": tiles[1], "goal_dim": goal_dim,
        "num_groups": num_groups, "num_terms": num_terms,
        "obs_dim": GOAL_START + goal_dim + 3 * num_joints + arm_fields + num_points,
    }  # fmt: skip
    least = {"num_joints": LEG_JOINTS, "goal_dim": 3, "num_groups": 2, "num_terms": NUM_COLUMNS, "nx": 2, "ny": 2}
    for name, bound in least.items():
        if found[name] < bound:
            raise ValueError(f"{name} must be at least {bound}, got {found[name]}.")
    return found


@dataclass(frozen=True, kw_only=True)
class LeggedWorlds:
    """All that the kernels of legged robots read and write, checked once.

    Args:
        sizes: What ``sizes`` returns.

    Raises:
        ValueError: If an array does not have the shape, dtype and device that its table requires.
    """

    sizes: dict[str, int]
    params: LocomotionParams
    worlds: Worlds
    joints: Joints
    ground: Ground
    sensing: Sensing
    state: LocomotionState
    out: LocomotionStep
    sim: Simulation

    def __post_init__(self) -> None:
        for name, table in TABLES.items():
            table.require(name, getattr(self, name), self.worlds.goal, **self.sizes)

    def rows(self, rows: slice, fault: wp.array) -> "LeggedWorlds":
        """Some of these worlds, for a separate thread; draws stay those of the worlds' global numbers.

        Args:
            rows: Which, from a start to a stop.
            fault: Replaces ``worlds.fault``, int32, shape (3,); worlds in it count from the first row.
        """
        parts = {name: table.rows(getattr(self, name), rows) for name, table in TABLES.items()}
        worlds = parts["worlds"]
        worlds.num_envs, worlds.fault = rows.stop - rows.start, fault
        worlds.world_offset += rows.start
        return LeggedWorlds(sizes=self.sizes | {"num_envs": worlds.num_envs}, params=self.params, **parts)

    def launch(self, kernel: wp.Kernel, dim: Any, *inputs: Any) -> None:
        """Launch a kernel on these worlds with the arguments ``worlds``, ``params`` and ``inputs``."""
        wp.launch(kernel, dim, inputs=[self.worlds, self.params, *inputs], device=self.worlds.goal.device)
