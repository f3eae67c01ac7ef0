"""The legged robots' resets, levels and goals: what happens between two steps."""

import warp as wp

from ..check import require, require_axes
from ..random import Purpose, uniform4
from ..rotations import from_yaw
from .height_scan import require_heights, sample_height
from .observation import write_goal, write_proprioception
from .rewards import LEG_JOINTS
from .state import (
    NUM_FEET,
    Ground,
    Joints,
    LevelRule,
    LocomotionParams,
    LocomotionState,
    require_joints,
    require_obs,
    require_state,
)

wp.set_module_options({"enable_backward": False})

PROMOTED, DEMOTED = 0.8, 0.5  # mean linear tracking that lifts and that lowers a world's level
CARRIED_SPREAD = 0.2  # [rad] about the pose that joints of what is carried start in; more, and an arm may hit the trunk
SPAWN_SAMPLES = 5  # heights along each side of the square below the base
BLOCK_PLACE, BLOCK_SPEED, BLOCK_CLOCK, BLOCK_JOINTS = 0, 1, 3, 4  # of the draws of a reset


@wp.func
def change_of_level(
    rule: int, crashed: wp.bool, tracking: float, distance: float, wanted_distance: float, half_tile: float
) -> int:
    """By how much an episode's outcome moves its world's level: 1, 0 or -1.

    Args:
        rule: One of ``LevelRule``.
        crashed: Whether the episode ended in a crash.
        tracking: Mean linear tracking of the episode, in [0, 1].
        distance: From where the robot started to where it ended [m].
        wanted_distance: What the last goal asks for within a whole episode [m].
        half_tile: Half side of a tile [m].
    """
    if rule == wp.static(int(LevelRule.REWARD)):
        if crashed or tracking < wp.static(DEMOTED):
            return -1
        if tracking >= wp.static(PROMOTED):
            return 1
    if rule == wp.static(int(LevelRule.DISPLACEMENT)):
        if distance > half_tile:
            return 1
        if distance < 0.5 * wanted_distance:
            return -1
    return 0


@wp.func
def next_level(
    params: LocomotionParams,
    env: int,
    num_levels: int,
    num_columns: int,
    crashed: wp.bool,
    counts: wp.bool,
    distance: float,
    state: LocomotionState,
) -> int:
    """The level that a world's next episode is played on; the last one's outcome may not count."""
    world = params.world_offset + env
    episode = state.episode_count[env]
    if params.level_rule == wp.static(int(LevelRule.FROZEN)):
        return (world // num_columns) % num_levels
    u = uniform4(params.seed, wp.static(int(Purpose.LEVEL)), world, episode, 0, 0)
    if episode == 0:
        return wp.min(int(u[0] * float(params.start_levels)), num_levels - 1)
    level = state.level[env]
    seen = state.tracked[env]
    if not counts or seen[1] == 0.0:
        return level
    speed = wp.sqrt(state.goal[env, 0] * state.goal[env, 0] + state.goal[env, 1] * state.goal[env, 1])
    wanted = speed * params.dt * float(params.time_limit)
    level += change_of_level(params.level_rule, crashed, seen[0] / seen[1], distance, wanted, params.half_tile)
    if level >= num_levels:  # who has passed the last level is not kept there
        return wp.min(int(u[0] * float(num_levels)), num_levels - 1)
    return wp.max(level, 0)


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
    params: LocomotionParams,
    joints: Joints,
    ground: Ground,
    env: int,
    episode: int,
    origin: wp.vec3,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
):
    """Draw where and how a robot starts, within its joints' ranges.

    As in Legged Gym the legs' joints are at 0.5 to 1.5 of their pose; those of what is carried are near theirs.
    """
    world = params.world_offset + env
    purpose = wp.static(int(Purpose.RESET))
    u = uniform4(params.seed, purpose, world, episode, 0, wp.static(BLOCK_PLACE))
    x = origin[0] + (2.0 * u[0] - 1.0) * params.spawn_range
    y = origin[1] + (2.0 * u[1] - 1.0) * params.spawn_range
    qpos[env, 0] = x
    qpos[env, 1] = y
    qpos[env, 2] = highest_ground(params, ground.heights, x, y) + params.spawn_height
    upright = from_yaw(0.0)
    for i in range(4):
        qpos[env, 3 + i] = upright[i]
    first = uniform4(params.seed, purpose, world, episode, 0, wp.static(BLOCK_SPEED))
    second = uniform4(params.seed, purpose, world, episode, 0, wp.static(BLOCK_SPEED + 1))
    for i in range(3):
        qvel[env, i] = (2.0 * first[i] - 1.0) * params.spawn_speed
        qvel[env, 3 + i] = (2.0 * second[i] - 1.0) * params.spawn_speed
    num_joints = joints.pose.shape[0]
    for block in range((num_joints + 3) // 4):
        v = uniform4(params.seed, purpose, world, episode, 0, wp.static(BLOCK_JOINTS) + block)
        for lane in range(wp.min(4, num_joints - 4 * block)):
            j = 4 * block + lane
            angle = joints.pose[j] * (0.5 + v[lane])
            if j >= wp.static(LEG_JOINTS):
                angle = joints.pose[j] + (2.0 * v[lane] - 1.0) * wp.static(CARRIED_SPREAD)
            qpos[env, 7 + j] = wp.clamp(angle, joints.low[j], joints.high[j])
            qvel[env, 6 + j] = 0.0


@wp.func
def draw_first_goal(
    params: LocomotionParams, env: int, episode: int, goal_range: wp.array[float], state: LocomotionState
):
    """A goal uniform in its box."""
    for block in range((goal_range.shape[0] + 3) // 4):
        u = uniform4(
            params.seed, wp.static(int(Purpose.FIRST_GOAL)), params.world_offset + env, episode, 0, block
        )  # fmt: skip
        for lane in range(wp.min(4, goal_range.shape[0] - 4 * block)):
            k = 4 * block + lane
            state.goal[env, k] = (2.0 * u[lane] - 1.0) * goal_range[k]


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
def _update_levels(
    # In
    params: LocomotionParams,
    origin: wp.array2d[wp.vec3],
    mask: wp.array[wp.bool],
    terminated: wp.array[wp.bool],
    truncated: wp.array[wp.bool],
    invalid: wp.array[wp.bool],
    qpos: wp.array2d[float],
    # In and out
    state: LocomotionState,
):
    env = wp.tid()
    if not mask[env]:
        return
    num_levels = origin.shape[0]
    num_columns = origin.shape[1]
    start = origin[wp.min(state.level[env], num_levels - 1), (params.world_offset + env) % num_columns]
    dx = qpos[env, 0] - start[0]
    dy = qpos[env, 1] - start[1]
    distance = wp.sqrt(dx * dx + dy * dy)
    # A reset in the middle of an episode, or of an invalid world, says nothing about how it went.
    counts = (terminated[env] or truncated[env]) and not invalid[env]
    state.level[env] = next_level(params, env, num_levels, num_columns, terminated[env], counts, distance, state)


def update_levels(
    params: LocomotionParams,
    origin: wp.array,
    mask: wp.array,
    terminated: wp.array,
    truncated: wp.array,
    invalid: wp.array,
    qpos: wp.array,
    state: LocomotionState,
) -> None:
    """Give every world of ``mask`` the level that its last episode earned; call it before anything is reset.

    Args:
        params: What all worlds share.
        origin: Where robots start on each tile [m], vec3, shape (levels, columns).
        mask: Worlds that are about to be reset, bool, shape (num_envs,).
        terminated: Worlds whose last step ended in a crash, bool, shape (num_envs,).
        truncated: Worlds whose last step cut the episode off, bool, shape (num_envs,).
        invalid: Worlds whose last step was not physical; they keep their level, bool, shape (num_envs,).
        qpos: Positions, float32, shape (num_envs, 7 + num_joints).
        state: The worlds. Their levels are updated where ``mask`` is true.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("mask", mask, dtype=wp.bool)
    for name, flags in (("terminated", terminated), ("truncated", truncated), ("invalid", invalid)):
        require(name, flags, like=mask)
    require_axes("origin", origin, 2)
    require("origin", origin, dtype=wp.vec3, shape=origin.shape, like=mask)
    require_axes("qpos", qpos, 2)
    require("qpos", qpos, dtype=wp.float32, shape=(mask.shape[0], qpos.shape[1]), like=mask)
    require_state(state, mask.shape[0], qpos.shape[1] - 7, mask)
    wp.launch(
        _update_levels,
        dim=mask.shape[0],
        inputs=[params, origin, mask, terminated, truncated, invalid, qpos],
        outputs=[state],
        device=mask.device,
    )


@wp.kernel
def _reset_worlds(
    # In
    params: LocomotionParams,
    joints: Joints,
    ground: Ground,
    mask: wp.array[wp.bool],
    goal_range: wp.array[float],
    goal_scale: wp.array[float],
    # In and out
    state: LocomotionState,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    obs: wp.array2d[float],
):
    env = wp.tid()
    if not mask[env]:
        return
    episode = state.episode_count[env]
    column = (params.world_offset + env) % ground.origin.shape[1]
    place_robot(params, joints, ground, env, episode, ground.origin[state.level[env], column], qpos, qvel)
    clear_memory(env, state)
    draw_first_goal(params, env, episode, goal_range, state)
    age = int(0)
    clock = int(0)
    if params.stagger and episode == 0:
        purpose = wp.static(int(Purpose.RESET))
        u = uniform4(params.seed, purpose, params.world_offset + env, episode, 0, wp.static(BLOCK_CLOCK))
        clock = int(u[0] * float(params.goal_period))
        age = int(u[1] * float(params.time_limit))
    state.goal_clock[env] = clock
    state.episode_step[env] = age
    state.episode_count[env] = episode + 1
    write_proprioception(env, joints, qpos, qvel, state, goal_scale, obs)


def reset_worlds(
    params: LocomotionParams,
    joints: Joints,
    ground: Ground,
    mask: wp.array,
    goal_range: wp.array,
    goal_scale: wp.array,
    state: LocomotionState,
    qpos: wp.array,
    qvel: wp.array,
    obs: wp.array,
) -> None:
    """Start a new episode, with a uniform first goal, in every world of ``mask``; leave the others alone.

    Args:
        params: What all worlds share.
        joints: The robot's joints.
        ground: The terrain.
        mask: Worlds to reset, bool, shape (num_envs,).
        goal_range: Half side of the box of first goals along every component, float32, shape (goal_dim,).
        goal_scale: What the policy sees goals multiplied by, float32, shape (goal_dim,).
        state: The worlds. Updated where ``mask`` is true.
        qpos: Positions, float32, shape (num_envs, 7 + num_joints). Likewise.
        qvel: Velocities, float32, shape (num_envs, 6 + num_joints). Likewise.
        obs: Observations, float32, shape (num_envs, obs_dim). Likewise; heights and noise are left to ``finish_obs``.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("mask", mask, dtype=wp.bool)
    n, num_joints = mask.shape[0], joints.pose.shape[0]
    require_joints(joints, num_joints, mask)
    require_state(state, n, num_joints, mask)
    require_obs("obs", obs, state, mask)
    require("goal_range", goal_range, dtype=wp.float32, shape=state.goal.shape[1:], like=mask)
    require("goal_scale", goal_scale, like=goal_range)
    require("qpos", qpos, dtype=wp.float32, shape=(n, 7 + num_joints), like=mask)
    require("qvel", qvel, dtype=wp.float32, shape=(n, 6 + num_joints), like=mask)
    require_axes("ground.origin", ground.origin, 2)
    require("ground.origin", ground.origin, dtype=wp.vec3, shape=ground.origin.shape, like=mask)
    require_heights("ground.heights", ground.heights, mask)
    wp.launch(
        _reset_worlds,
        dim=n,
        inputs=[params, joints, ground, mask, goal_range, goal_scale],
        outputs=[state, qpos, qvel, obs],
        device=mask.device,
    )


@wp.kernel
def _set_goals(
    # In
    row: wp.array[int],
    goal: wp.array2d[float],
    goal_scale: wp.array[float],
    # In and out
    state: LocomotionState,
    obs: wp.array2d[float],
):
    i = wp.tid()
    env = row[i]
    for k in range(goal.shape[1]):
        state.goal[env, k] = goal[i, k] / goal_scale[k]
    state.goal_clock[env] = 0
    state.goal_count[env] = state.goal_count[env] + 1
    write_goal(env, state.goal, goal_scale, obs)


def set_goals(
    row: wp.array,
    goal: wp.array,
    goal_scale: wp.array,
    state: LocomotionState,
    obs: wp.array,
    *,
    record: bool = False,
) -> wp.Launch | None:
    """Give the listed worlds a new goal and start its clock.

    Args:
        row: Worlds, int32, shape (n,), each in [0, num_envs) and at most once.
        goal: Goals as the policy sees them, scaled, float32, shape (n, goal_dim).
        goal_scale: What the policy sees goals multiplied by, float32, shape (goal_dim,).
        state: The worlds. Their goals and goal clocks and counts are updated.
        obs: Observations, float32, shape (num_envs, obs_dim). The goal is refreshed in the listed rows.
        record: Return the launch, to be replayed with ``launch()``, instead of making it.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("row", row, dtype=wp.int32)
    require_state(state, state.goal.shape[0], state.action.shape[1], row)
    require("goal", goal, dtype=wp.float32, shape=(row.shape[0], state.goal.shape[1]), like=row)
    require("goal_scale", goal_scale, dtype=wp.float32, shape=goal.shape[1:], like=row)
    require_obs("obs", obs, state, row)
    return wp.launch(
        _set_goals,
        dim=row.shape[0],
        inputs=[row, goal, goal_scale],
        outputs=[state, obs],
        device=row.device,
        record_cmd=record,
    )
