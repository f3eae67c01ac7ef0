"""What the kernels of the legged robots share: parameters, states, results.

The first twelve joints are those of the legs (``deimos.kernels.legged.rewards``), further ones belong to what
the robot carries. A goal begins with the velocity goal (v_x, v_y, yaw rate); further components are
the affair of the kernels of what is carried. The observation is Legged Gym's (Rudin et al. 2021)::

    velocity 3, angular velocity 3, gravity 3, goal G, joint angles J, joint velocities J, last action J,
    anything else, heights

with G components of the goal and J joints. Frames are the base's own but for the goal, which is meant in
the same frame, and the heights.
"""

from enum import IntEnum

import warp as wp

from ..check import require, require_axes
from .rewards import TERMS, vec12, vecT

wp.set_module_options({"enable_backward": False})

VELOCITY_SCALE = 2.0  # the policy sees velocities [m/s] times this
RATE_SCALE = 0.25  # and angular velocities [rad/s]
JOINT_SPEED_SCALE = 0.05  # and joint velocities [rad/s]
HEIGHT_SCALE = 5.0  # and heights [m]: how much the base is above the ground, beyond its height on level ground
HEIGHT_BOUND = 1.0  # [m]; clipped to this on either side
GOAL_START = 9  # where the goal starts in the observation

BASE_PART, FIRST_FOOT, FIRST_LIMB = 0, 1, 5  # parts of a robot, as in ``deimos.kernels.legged.contacts``
NUM_FEET, NUM_PARTS = 4, 13
CRASH_FORCE = 1.0  # [N] between base and terrain
FOOT_FORCE = 1.0  # [N] that makes a contact of a foot
LIMB_FORCE = 0.1  # [N] that makes a collision of a thigh or calf

BROKEN = ("action", "position", "velocity", "speed", "contacts", "goal")  # causes of an invalid world, by their bit
COUNTERS = ("foot_contact", "level", "goal_clock", "episode_step", "episode_count", "goal_count")  # of a state


class LevelRule(IntEnum):
    """How the level of a world changes at the end of an episode."""

    FROZEN = 0
    """World i stands on tile (i // columns) % levels for ever: for evaluation."""
    REWARD = 1
    """Up if the mean linear tracking is at least 0.8 without a crash, down if it is below 0.5 or after a crash."""
    DISPLACEMENT = 2
    """Legged Gym's: up if the robot is more than half a tile away from its start, down if it is less
    than half of what its last goal asked for."""


@wp.struct
class LocomotionParams:
    """What all worlds share."""

    dt: float  # duration of a step [s]
    goal_period: int  # T: steps that a goal is in force
    time_limit: int  # steps of an episode
    stagger: wp.bool  # whether the clocks of a world's first episode start at random steps
    seed: wp.uint32  # of every draw
    world_offset: int  # global number of world 0
    action_bound: float  # actions are clipped to [-action_bound, action_bound]
    noise: wp.bool  # whether observations are noisy
    push_interval: int  # steps from push to push, 0 for none
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
    start_levels: int  # levels that first episodes are drawn from
    cell: float  # of the height grid [m]
    corner: wp.vec2  # its first sample [m]
    low: wp.vec2  # least and largest x and y of the terrain; beyond them an episode is truncated [m]
    high: wp.vec2
    half_tile: float  # half side of a tile [m]


@wp.struct
class Joints:
    """The robot's joints. Arrays of shape (num_joints,)."""

    pose: wp.array[float]  # angles at an action of zero [rad]
    action_scale: wp.array[float]  # what an action of one adds to the target [rad]
    low: wp.array[float]  # range [rad]
    high: wp.array[float]


@wp.struct
class Ground:
    """The terrain."""

    heights: wp.array2d[float]  # (nx, ny) [m]
    origin: wp.array2d[wp.vec3]  # (levels, columns): where robots start [m]


@wp.struct
class LocomotionState:
    """What a bit-exact resume needs beyond the simulator's own state; (num_envs,) unless it says otherwise."""

    goal: wp.array2d[float]  # (num_envs, goal_dim); velocity goals in [m/s] and [rad/s]
    action: wp.array2d[float]  # (num_envs, num_joints): the last action, bounded
    joint_speed: wp.array2d[float]  # (num_envs, num_joints): at the end of the last step [rad/s]
    air_time: wp.array2d[float]  # (num_envs, 4): of every foot since it left the ground [s]
    foot_contact: wp.array[int]  # bit i: foot i touched the ground on the last step
    tracked: wp.array[wp.vec2]  # sum of the linear tracking in this episode, and its steps
    level: wp.array[int]
    goal_clock: wp.array[int]  # steps that the goal has been in force
    episode_step: wp.array[int]  # steps since the reset
    episode_count: wp.array[int]  # resets so far
    goal_count: wp.array[int]  # goals received so far, first goals apart


@wp.struct
class LocomotionStep:
    """What one step gives back; (num_envs,) unless it says otherwise."""

    obs: wp.array2d[float]  # (num_envs, obs_dim)
    reward: wp.array[float]  # at least 0, against the goal that was in force
    tracking: wp.array2d[float]  # (num_envs, groups of the goal): in [0, 1]; linear and yaw come first
    term: wp.array2d[float]  # (num_envs, NUM_COLUMNS and those of what is carried): what the reward is the sum of
    terminated: wp.array[wp.bool]  # crashed
    truncated: wp.array[wp.bool]  # cut off without a crash: time limit, off the terrain, or invalid
    goal_due: wp.array[wp.bool]  # the goal has been in force for its whole period, and the state is valid
    invalid: wp.array[wp.bool]  # the state is not physical any more
    fault: wp.array[int]  # (3,): invalid world-steps so far, lowest world among them, lowest world with a broken action
    cause: wp.array[int]  # bits of BROKEN on the last invalid step of this world
    value: wp.array[float]  # the value that was at fault then


@wp.struct
class Simulation:
    """The simulator's arrays, first axis num_envs but for ``part_force``."""

    qpos: wp.array2d[float]  # base position 3 [m], quaternion 4 (w, x, y, z), joint angles [rad]
    qvel: wp.array2d[float]  # base velocity 3 in the world [m/s], rate 3 in the base [rad/s], joint velocities [rad/s]
    ctrl: wp.array2d[float]  # target angles [rad]
    torque: wp.array2d[float]  # [N m]
    part_force: wp.array3d[float]  # (substeps, num_envs, parts): normal forces on the terrain [N]
    overflow: wp.array[int]  # bits of what the simulator ran out of


COLUMNS = (*TERMS, "clipping")  # of ``LocomotionStep.term``; what clipping at 0 added comes last
NUM_COLUMNS = len(COLUMNS)


def require_state(state: LocomotionState, num_envs: int, num_joints: int, like: wp.array) -> None:
    """Raise ``ValueError`` unless every array of ``state`` is as long as its struct says.

    Args:
        state: The worlds.
        num_envs: Their number.
        num_joints: Number of joints.
        like: An array on whose device they must be.
    """
    widths = {"goal": max(3, state.goal.shape[1]), "action": num_joints, "joint_speed": num_joints}
    for name, width in (widths | {"air_time": NUM_FEET}).items():
        require(f"state.{name}", getattr(state, name), dtype=wp.float32, shape=(num_envs, width), like=like)
    require("state.tracked", state.tracked, dtype=wp.vec2, shape=(num_envs,), like=like)
    for name in COUNTERS:
        require(f"state.{name}", getattr(state, name), dtype=wp.int32, shape=(num_envs,), like=like)


def require_joints(joints: Joints, num_joints: int, like: wp.array) -> None:
    """Raise ``ValueError`` unless ``joints`` are that many, on the device of ``like``."""
    for name in Joints.vars:
        require(f"joints.{name}", getattr(joints, name), dtype=wp.float32, shape=(num_joints,), like=like)


def require_obs(name: str, obs: wp.array, state: LocomotionState, like: wp.array) -> None:
    """Raise ``ValueError`` unless ``obs`` has a row for every world, with room for goal and joints of ``state``."""
    require_axes(name, obs, 2)
    least = GOAL_START + state.goal.shape[1] + 3 * state.action.shape[1]
    require(name, obs, dtype=wp.float32, shape=(state.goal.shape[0], max(least, obs.shape[1])), like=like)
