"""The legged robots' observation: what the robot feels, then the heights around it and the noise."""

import warp as wp

from ..check import require, require_axes
from ..random import Purpose, uniform4
from ..rotations import down_in_body, heading, rotate_by_heading, rotate_inverse
from .height_scan import require_heights, sample_minimum
from .state import (
    GOAL_START,
    HEIGHT_BOUND,
    HEIGHT_SCALE,
    JOINT_SPEED_SCALE,
    RATE_SCALE,
    VELOCITY_SCALE,
    Joints,
    LocomotionParams,
    LocomotionState,
    require_obs,
    require_state,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def base_quaternion(qpos: wp.array2d[float], env: int) -> wp.vec4:
    """Orientation of the base, (w, x, y, z)."""
    return wp.vec4(qpos[env, 3], qpos[env, 4], qpos[env, 5], qpos[env, 6])


@wp.func
def base_velocity(qpos: wp.array2d[float], qvel: wp.array2d[float], env: int) -> wp.vec3:
    """Velocity of the base in its own frame [m/s]; MuJoCo has it in the world's."""
    return rotate_inverse(base_quaternion(qpos, env), wp.vec3(qvel[env, 0], qvel[env, 1], qvel[env, 2]))


@wp.func
def base_rate(qvel: wp.array2d[float], env: int) -> wp.vec3:
    """Angular velocity of the base in its own frame [rad/s], as MuJoCo has it."""
    return wp.vec3(qvel[env, 3], qvel[env, 4], qvel[env, 5])


@wp.func
def write_goal(env: int, goal: wp.array2d[float], goal_scale: wp.array[float], obs: wp.array2d[float]):
    """Write the goal slot."""
    for k in range(goal.shape[1]):
        obs[env, wp.static(GOAL_START) + k] = goal[env, k] * goal_scale[k]


@wp.func
def write_proprioception(
    env: int,
    joints: Joints,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    state: LocomotionState,
    goal_scale: wp.array[float],
    obs: wp.array2d[float],
):
    """Write everything but what comes after the last action, without noise."""
    velocity = base_velocity(qpos, qvel, env)
    rate = base_rate(qvel, env)
    down = down_in_body(base_quaternion(qpos, env))
    for i in range(3):
        obs[env, i] = velocity[i] * wp.static(VELOCITY_SCALE)
        obs[env, 3 + i] = rate[i] * wp.static(RATE_SCALE)
        obs[env, 6 + i] = down[i]
    write_goal(env, state.goal, goal_scale, obs)
    num_joints = state.action.shape[1]
    start = wp.static(GOAL_START) + state.goal.shape[1]
    for j in range(num_joints):
        obs[env, start + j] = qpos[env, 7 + j] - joints.pose[j]
        obs[env, start + num_joints + j] = qvel[env, 6 + j] * wp.static(JOINT_SPEED_SCALE)
        obs[env, start + 2 * num_joints + j] = state.action[env, j]


@wp.kernel
def _finish_obs(
    # In
    params: LocomotionParams,
    mask: wp.array[wp.bool],
    wanted: wp.bool,
    heights: wp.array2d[float],
    point: wp.array[wp.vec2],
    noise: wp.array[float],
    qpos: wp.array2d[float],
    episode_count: wp.array[int],
    episode_step: wp.array[int],
    env_stride: int,
    block_stride: int,
    # In and out
    obs: wp.array2d[float],
):
    # A block is four components, as many as one draw gives.
    first_env, first_block = wp.tid()
    num_blocks = (obs.shape[1] + 3) // 4
    for env in range(first_env, mask.shape[0], env_stride):
        if mask[env] != wanted:
            continue
        direction = heading(wp.vec4(qpos[env, 3], qpos[env, 4], qpos[env, 5], qpos[env, 6]))
        for block in range(first_block, num_blocks, block_stride):
            u = wp.vec4(0.5)
            if params.noise:
                u = uniform4(
                    params.seed, wp.static(int(Purpose.NOISE)), params.world_offset + env, episode_count[env],
                    episode_step[env], block,
                )  # fmt: skip
            for lane in range(wp.min(4, obs.shape[1] - 4 * block)):
                i = 4 * block + lane
                seen = obs[env, i]
                k = i - params.scan_start
                if k >= 0:
                    offset = rotate_by_heading(direction, point[k][0], point[k][1])
                    ground = sample_minimum(
                        heights, params.cell, params.corner, qpos[env, 0] + offset[0], qpos[env, 1] + offset[1]
                    )
                    bound = wp.static(HEIGHT_BOUND)
                    clearance = qpos[env, 2] - params.standing_height - ground
                    seen = wp.static(HEIGHT_SCALE) * wp.clamp(clearance, -bound, bound)
                obs[env, i] = seen + noise[i] * (2.0 * u[lane] - 1.0)


def finish_obs(
    params: LocomotionParams,
    mask: wp.array,
    heights: wp.array,
    point: wp.array,
    noise: wp.array,
    qpos: wp.array,
    state: LocomotionState,
    obs: wp.array,
    *,
    wanted: bool,
) -> None:
    """Write the heights around every robot and add the noise, in the worlds where ``mask`` is ``wanted``.

    A height is seen as 5 clip(z - standing height - ground, -1 m, 1 m), z being the base's, at points that turn with
    the robot's yaw alone. Legged Gym subtracts 0.5 m from every robot; with the robot's own height the inputs are
    around 0 on level ground. Inputs that are all the same and far from 0 act as one bias with a hundred times
    the step size of the other weights.

    Args:
        params: What all worlds share.
        mask: bool, shape (num_envs,).
        heights: The height grid [m], float32, shape (nx, ny).
        point: Points in the frame of the robot's yaw [m], vec2, shape (obs_dim - params.scan_start,).
        noise: Half width of the uniform noise of every component, as the policy sees it, float32, shape (obs_dim,).
        qpos: Positions, float32, shape (num_envs, 7 + num_joints).
        state: The worlds; its clocks address the draws.
        obs: Observations, float32, shape (num_envs, obs_dim). Updated.
        wanted: Value of ``mask`` where to write.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("mask", mask, dtype=wp.bool)
    require_heights("heights", heights, mask)
    require_axes("qpos", qpos, 2)
    require("qpos", qpos, dtype=wp.float32, shape=(mask.shape[0], qpos.shape[1]), like=mask)
    require_state(state, mask.shape[0], qpos.shape[1] - 7, mask)
    require_obs("obs", obs, state, mask)
    n, obs_dim = obs.shape
    require("point", point, dtype=wp.vec2, shape=(obs_dim - params.scan_start,), like=mask)
    require("noise", noise, dtype=wp.float32, shape=(obs_dim,), like=mask)
    threads = (1, 1) if mask.device.is_cpu else (n, (obs_dim + 3) // 4)
    wp.launch(
        _finish_obs,
        dim=threads,
        inputs=[
            params, mask, wanted, heights, point, noise, qpos, state.episode_count, state.episode_step, *threads,
        ],
        outputs=[obs],
        device=mask.device,
    )  # fmt: skip
