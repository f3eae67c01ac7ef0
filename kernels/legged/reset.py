"""The legged robots' resets, between two steps."""

import warp as wp

from ..episodes import Worlds, begin_episode
from ..random import Purpose, uniform4
from ..rotations import from_yaw
from .height_scan import sample_height
from .levels import begin_path
from .observation import write_proprioception
from .rewards import LEG_JOINTS
from .state import NUM_FEET, Ground, Joints, LeggedWorlds, LocomotionParams, LocomotionState, Simulation

wp.set_module_options({"enable_backward": False})

ARM_SPREAD = 0.2  # [rad] about the pose that an arm's joints start in; more, and it may hit the trunk
SPAWN_SAMPLES = 5  # heights along each side of the square below the base
BLOCK_PLACE, BLOCK_SPEED, BLOCK_CLOCK, BLOCK_JOINTS = 0, 1, 3, 4  # blocks of the draws of a reset


@wp.func
def highest_ground(params: LocomotionParams, heights: wp.array2d[float], x: float, y: float) -> float:
    """The highest sample of the ground in a square around (x, y) [m]."""
    highest = sample_height(heights, params.cell, params.corner, x, y)
    spacing = 2.0 * params.spawn_reach / float(wp.static(SPAWN_SAMPLES - 1))
    for i in range(wp.static(SPAWN_SAMPLES)):
        for j in range(wp.static(SPAWN_SAMPLES)):
            px = x - params.spawn_reach + float(i) * spacing
            py = y - params.spawn_reach + float(j) * spacing
            highest = wp.max(highest, sample_height(heights, params.cell, params.corner, px, py))
    return highest


@wp.func
def place_robot(
    worlds: Worlds, params: LocomotionParams, joints: Joints, ground: Ground, env: int, episode: int, origin: wp.vec3,
    sim: Simulation,
):  # fmt: skip
    """Draw where and how a robot starts, within its joints' ranges.

    As in Legged Gym the legs' joints are at 0.5 to 1.5 of their pose; an arm's are near theirs.
    """
    qpos = sim.qpos
    qvel = sim.qvel
    world = worlds.world_offset + env
    purpose = wp.static(int(Purpose.RESET))
    u = uniform4(worlds.seed, purpose, world, episode, 0, wp.static(BLOCK_PLACE))
    x = origin[0] + (2.0 * u[0] - 1.0) * params.spawn_range
    y = origin[1] + (2.0 * u[1] - 1.0) * params.spawn_range
    qpos[env, 0] = x
    qpos[env, 1] = y
    qpos[env, 2] = highest_ground(params, ground.heights, x, y) + params.spawn_height
    upright = from_yaw(0.0)
    for i in range(4):
        qpos[env, 3 + i] = upright[i]
    first = uniform4(worlds.seed, purpose, world, episode, 0, wp.static(BLOCK_SPEED))
    second = uniform4(worlds.seed, purpose, world, episode, 0, wp.static(BLOCK_SPEED + 1))
    for i in range(3):
        qvel[env, i] = (2.0 * first[i] - 1.0) * params.spawn_speed
        qvel[env, 3 + i] = (2.0 * second[i] - 1.0) * params.spawn_speed
    num_joints = joints.pose.shape[0]
    for block in range((num_joints + 3) // 4):
        v = uniform4(worlds.seed, purpose, world, episode, 0, wp.static(BLOCK_JOINTS) + block)
        for lane in range(wp.min(4, num_joints - 4 * block)):
            j = 4 * block + lane
            angle = joints.pose[j] * (0.5 + v[lane])
            if j >= wp.static(LEG_JOINTS):
                angle = joints.pose[j] + (2.0 * v[lane] - 1.0) * wp.static(ARM_SPREAD)
            qpos[env, 7 + j] = wp.clamp(angle, joints.low[j], joints.high[j])
            qvel[env, 6 + j] = 0.0


@wp.func
def clear_memory(env: int, state: LocomotionState):
    """Forget the last episode."""
    for j in range(state.action.shape[1]):
        state.action[env, j] = 0.0
        state.joint_speed[env, j] = 0.0
    for i in range(wp.static(NUM_FEET)):
        state.air_time[env, i] = 0.0
    state.foot_contact[env] = 0
    state.tracked[env] = wp.vec2(0.0)


@wp.kernel
def _reset_worlds(
    # In and out
    worlds: Worlds,
    # In
    params: LocomotionParams,
    joints: Joints,
    ground: Ground,
    # In and out
    state: LocomotionState,
    # Out
    sim: Simulation,
):
    env = wp.tid()
    if not worlds.mask[env]:
        return
    episode = begin_episode(env, worlds)
    world = worlds.world_offset + env
    origin = ground.origin[state.level[env], world % ground.origin.shape[1]]
    place_robot(worlds, params, joints, ground, env, episode, origin, sim)
    clear_memory(env, state)
    if params.stagger and episode == 0:
        u = uniform4(worlds.seed, wp.static(int(Purpose.RESET)), world, episode, 0, wp.static(BLOCK_CLOCK))
        worlds.goal_clock[env] = int(u[0] * float(worlds.goal_period))
        worlds.episode_step[env] = int(u[1] * float(worlds.time_limit))
    begin_path(env, worlds, sim, state)
    write_proprioception(env, worlds, joints, sim, state)


def reset_worlds(legged: LeggedWorlds) -> None:
    """Start a new episode, with a uniform first goal, in every world of ``worlds.mask``; leave the others alone.

    Heights and noise of the observation are left to ``finish_obs``, a valid goal of an arm to ``reset_arms``.
    """
    legged.launch(
        _reset_worlds, legged.worlds.num_envs, legged.joints, legged.ground, legged.state, legged.sim
    )  # fmt: skip
