"""Where the end effector of a legged robot's arm is, and where its goals are.

The arm's joints follow those of the legs, and the last three components of a goal are the arm's: where the end
effector should be, relative to an origin that is ``Arm.origin`` above the ground below the robot and
turns only with the base's yaw. They are its distance, pitch (up positive) and yaw, each mapped linearly to [-1, 1]::

    distance = 0.30 m + 0.15 m g_0        in [0.15, 0.45] m
    pitch    = 7.5 deg + 52.5 deg g_1     in [-45, 60] deg
    yaw      = 108 deg g_2                in [-108, 108] deg

and the wanted position is distance (cos pitch cos yaw, cos pitch sin yaw, sin pitch). The numbers of a goal do not
change while it is active. Goals inside the robot's own body, or less than ``Arm.clearance`` above the ground
where the robot is when they are drawn, are not valid and are drawn again. On level ground the lowest are 0.17 m
above it.

The end effector comes from the joints' angles by forward kinematics, since the simulator's own lags them by a substep.
"""

import math

import warp as wp

from ..episodes import Worlds, record
from ..goals import check_candidates
from ..random import Purpose, uniform4
from ..rotations import heading, rotate, rotate_about, rotate_by_heading
from ..structs import StructTable
from .arm_rewards import vecA
from .height_scan import sample_height
from .observation import base_quaternion
from .rewards import LEG_JOINTS
from .state import Ground, LeggedWorlds, LocomotionParams, Simulation

wp.set_module_options({"enable_backward": False})

SHELL_LOW = (0.15, math.radians(-45), math.radians(-108))  # distance [m], pitch and yaw [rad] of the goals
SHELL_HIGH = (0.45, math.radians(60), math.radians(108))
_MIDDLE = wp.constant(wp.vec3(*((low + high) / 2 for low, high in zip(SHELL_LOW, SHELL_HIGH, strict=True))))
_HALF = wp.constant(wp.vec3(*((high - low) / 2 for low, high in zip(SHELL_LOW, SHELL_HIGH, strict=True))))
GOAL_COMPONENT = 3  # where the arm's begin in a goal
FOOTPRINT = (0.38, 0.25)  # [m] along and across a Go1's trunk: what counts as below the robot
MAX_DRAWS = 64  # per goal; on level ground one in eight is not valid, so all of them fail once in 10^57
FIRST_REDRAW = 2  # block of a goal's draws that redraws begin with; six components take two


@wp.struct
class Arm:
    """The arm and the parameters of its goals."""

    offset: wp.array[wp.vec3]  # of every joint, and of the end effector, in the frame before it [m]
    axis: wp.array[wp.vec3]  # of every joint
    origin: wp.vec3  # of the goals, in the frame of the base's yaw, above the ground below the robot [m]
    body_low: wp.vec3  # corners of the box that goals stay out of, relative to the origin [m]
    body_high: wp.vec3
    clearance: float  # least height of goals above the ground [m]
    weight: vecA  # of the reward's terms
    obs_start: int  # where the end effector starts in the observation
    error: wp.array[float]  # distance of the end effector from its goal at the end of the last step [m]


ARM = StructTable(Arm, {"offset": ("num_links",), "axis": ("num_arm_joints",)})


def check_arm(arm: Arm, legged: LeggedWorlds) -> None:
    """Raise ``ValueError`` unless ``arm`` fits the joints of ``legged`` that are not the legs'. Call it once."""
    joints = legged.sizes["num_joints"] - LEG_JOINTS
    ARM.require("arm", arm, legged.worlds.goal, num_arm_joints=joints, num_links=joints + 1, **legged.sizes)


@wp.func
def end_effector(arm: Arm, qpos: wp.array2d[float], env: int) -> wp.vec3:
    """The end effector relative to the base, in the base's frame [m]."""
    last = arm.axis.shape[0]
    point = arm.offset[last]
    for k in range(last):
        j = last - 1 - k
        point = arm.offset[j] + rotate_about(point, arm.axis[j], qpos[env, 7 + wp.static(LEG_JOINTS) + j])
    return point


@wp.func
def ground_below(params: LocomotionParams, heights: wp.array2d[float], direction: wp.vec2, x: float, y: float) -> float:
    """Mean of the ground at 3 x 3 points below the trunk [m], so that a step does not count all at once."""
    total = float(0.0)
    for i in range(3):
        for j in range(3):
            along = wp.static(FOOTPRINT[0]) * 0.5 * float(i - 1)
            across = wp.static(FOOTPRINT[1]) * 0.5 * float(j - 1)
            offset = rotate_by_heading(direction, along, across)
            total += sample_height(heights, params.cell, params.corner, x + offset[0], y + offset[1])
    return total / 9.0


@wp.func
def place_of_end_effector(
    params: LocomotionParams, arm: Arm, heights: wp.array2d[float], qpos: wp.array2d[float], env: int
) -> wp.vec3:
    """The end effector relative to the goals' origin, in the frame of the base's yaw [m]."""
    quat = base_quaternion(qpos, env)
    direction = heading(quat)
    offset = rotate(quat, end_effector(arm, qpos, env))
    level = rotate_by_heading(wp.vec2(direction[0], -direction[1]), offset[0], offset[1])
    ground = ground_below(params, heights, direction, qpos[env, 0], qpos[env, 1])
    return wp.vec3(level[0], level[1], qpos[env, 2] - ground + offset[2]) - arm.origin


@wp.func
def place_of_goal(goal: wp.vec3) -> wp.vec3:
    """Where the arm's part of a goal is, relative to the origin [m]."""
    s = _MIDDLE + wp.cw_mul(goal, _HALF)
    level = s[0] * wp.cos(s[1])
    return wp.vec3(level * wp.cos(s[2]), level * wp.sin(s[2]), s[0] * wp.sin(s[1]))


@wp.func
def goal_of_place(place: wp.vec3) -> wp.vec3:
    """The arm's part of the goal that is at ``place``; the inverse of ``place_of_goal``."""
    level = wp.sqrt(place[0] * place[0] + place[1] * place[1])
    s = wp.vec3(wp.length(place), wp.atan2(place[2], level), wp.atan2(place[1], place[0]))
    return wp.cw_div(s - _MIDDLE, _HALF)


@wp.func
def is_clear(arm: Arm, goal: wp.vec3) -> wp.bool:
    """Whether a goal is outside the robot's body."""
    place = place_of_goal(goal)
    for i in range(3):
        if place[i] < arm.body_low[i] or place[i] > arm.body_high[i]:
            return True
    return False


@wp.struct
class Spot:
    """Where a robot's goals are."""

    origin: wp.vec3  # of the goals, in the world [m]
    direction: wp.vec2  # of the base's yaw: cosine and sine


@wp.func
def find_spot(
    params: LocomotionParams, arm: Arm, heights: wp.array2d[float], qpos: wp.array2d[float], env: int
) -> Spot:
    """Where the goals of a robot are at this moment."""
    spot = Spot()
    spot.direction = heading(base_quaternion(qpos, env))
    level = rotate_by_heading(spot.direction, arm.origin[0], arm.origin[1])
    ground = ground_below(params, heights, spot.direction, qpos[env, 0], qpos[env, 1])
    spot.origin = wp.vec3(qpos[env, 0] + level[0], qpos[env, 1] + level[1], ground + arm.origin[2])
    return spot


@wp.func
def point_of_goal(spot: Spot, goal: wp.vec3) -> wp.vec3:
    """Where the arm's part of a goal is in the world [m]."""
    place = place_of_goal(goal)
    level = rotate_by_heading(spot.direction, place[0], place[1])
    return spot.origin + wp.vec3(level[0], level[1], place[2])


@wp.func
def is_valid(params: LocomotionParams, arm: Arm, heights: wp.array2d[float], spot: Spot, goal: wp.vec3) -> wp.bool:
    """Whether a goal is outside the robot's body and clear of the ground."""
    if not is_clear(arm, goal):
        return False
    point = point_of_goal(spot, goal)
    return point[2] >= sample_height(heights, params.cell, params.corner, point[0], point[1]) + arm.clearance


@wp.func
def draw_again(
    params: LocomotionParams, arm: Arm, heights: wp.array2d[float], spot: Spot, seed: wp.uint32, purpose: int,
    world: int, count: int, index: int, scale: wp.array[float], first: wp.vec3,
) -> wp.vec3:  # fmt: skip
    """``first`` if it is valid, else the first valid one of further draws from the same box, else the middle."""
    goal = first
    draws = int(1)
    while not is_valid(params, arm, heights, spot, goal):
        if draws == wp.static(MAX_DRAWS):
            return wp.vec3(0.0)
        u = uniform4(seed, purpose, world, count, index, wp.static(FIRST_REDRAW - 1) + draws)
        for i in range(3):
            goal[i] = (2.0 * u[i] - 1.0) * scale[wp.static(GOAL_COMPONENT) + i]
        draws += 1
    return goal


@wp.func
def active_goal(worlds: Worlds, env: int) -> wp.vec3:
    """The arm's part of the goal."""
    g = wp.static(GOAL_COMPONENT)
    return wp.vec3(worlds.goal[env, g], worlds.goal[env, g + 1], worlds.goal[env, g + 2])


@wp.kernel
def _locate_goals(
    # In
    worlds: Worlds,
    params: LocomotionParams,
    arm: Arm,
    ground: Ground,
    sim: Simulation,
    # Out
    point: wp.array[wp.vec3],
):
    env = wp.tid()
    point[env] = point_of_goal(find_spot(params, arm, ground.heights, sim.qpos, env), active_goal(worlds, env))


def locate_goals(legged: LeggedWorlds, arm: Arm) -> wp.array:
    """Positions of the arms' goals in the world [m], vec3, shape (num_envs,); for pictures."""
    point = wp.empty(legged.worlds.num_envs, dtype=wp.vec3, device=arm.error.device)
    legged.launch(_locate_goals, len(point), arm, legged.ground, legged.sim, point)
    return point


@wp.kernel
def _redraw_candidates(
    # In
    worlds: Worlds,
    params: LocomotionParams,
    arm: Arm,
    ground: Ground,
    sim: Simulation,
    row: wp.array[int],
    scale: wp.array[float],
    # In and out
    candidate: wp.array3d[float],
):
    i, k = wp.tid()
    env = row[i]
    g = wp.static(GOAL_COMPONENT)
    first = wp.vec3(candidate[i, k, g], candidate[i, k, g + 1], candidate[i, k, g + 2])
    goal = draw_again(
        params, arm, ground.heights, find_spot(params, arm, ground.heights, sim.qpos, env), worlds.seed,
        wp.static(int(Purpose.CANDIDATE)), worlds.world_offset + env, worlds.goal_count[env], k, scale, first,
    )  # fmt: skip
    for c in range(3):
        candidate[i, k, g + c] = goal[c]


def redraw_candidates(legged: LeggedWorlds, arm: Arm, row: wp.array, scale: wp.array, candidate: wp.array) -> wp.Launch:
    """Record a launch that replaces invalid candidates of ``draw_candidates`` with valid ones.

    The arm's part of such a candidate is drawn again from the same box until it is valid, which makes it uniform over
    the valid goals. On level ground the result depends only on (seed, world, the number of the goal, k); elsewhere also
    on where the robot is. For ``row``, ``scale`` and ``candidate`` see ``draw_candidates``.

    Returns:
        The launch, a thread for each candidate of each row.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    check_candidates(row, scale, candidate, legged.worlds)
    inputs = legged.params, arm, legged.ground, legged.sim, row, scale, candidate
    return record(_redraw_candidates, legged.worlds, *inputs, dim=candidate.shape[:2])
