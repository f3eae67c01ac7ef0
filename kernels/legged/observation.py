"""The legged robots' observation: proprioception, then the heights around the robot and the noise."""

import warp as wp

from ..episodes import Worlds, write_goal
from ..lanes import is_serial
from ..random import Purpose, uniform4
from ..rotations import down_in_body, heading, rotate_by_heading, rotate_inverse
from .height_scan import sample_minimum
from .state import (
    HEIGHT_BOUND,
    HEIGHT_SCALE,
    JOINT_SPEED_SCALE,
    RATE_SCALE,
    VELOCITY_SCALE,
    Ground,
    Joints,
    LeggedWorlds,
    LocomotionParams,
    LocomotionState,
    Sensing,
    Simulation,
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
def write_proprioception(env: int, worlds: Worlds, joints: Joints, sim: Simulation, state: LocomotionState):
    """Write everything but what comes after the last action, without noise."""
    velocity = base_velocity(sim.qpos, sim.qvel, env)
    rate = base_rate(sim.qvel, env)
    down = down_in_body(base_quaternion(sim.qpos, env))
    for i in range(3):
        worlds.obs[env, i] = velocity[i] * wp.static(VELOCITY_SCALE)
        worlds.obs[env, 3 + i] = rate[i] * wp.static(RATE_SCALE)
        worlds.obs[env, 6 + i] = down[i]
    write_goal(env, worlds)
    num_joints = state.action.shape[1]
    start = worlds.goal_start + worlds.goal.shape[1]
    for j in range(num_joints):
        worlds.obs[env, start + j] = sim.qpos[env, 7 + j] - joints.pose[j]
        worlds.obs[env, start + num_joints + j] = sim.qvel[env, 6 + j] * wp.static(JOINT_SPEED_SCALE)
        worlds.obs[env, start + 2 * num_joints + j] = state.action[env, j]


@wp.kernel
def _finish_obs(
    # In and out
    worlds: Worlds,
    # In
    params: LocomotionParams,
    ground: Ground,
    sensing: Sensing,
    sim: Simulation,
    mask: wp.array[wp.bool],
    wanted: wp.bool,
    env_stride: int,
    block_stride: int,
):
    # A block is four components, as many as one draw gives.
    first_env, first_block = wp.tid()
    obs = worlds.obs
    num_blocks = (obs.shape[1] + 3) // 4
    for env in range(first_env, mask.shape[0], env_stride):
        if mask[env] != wanted:
            continue
        x = sim.qpos[env, 0]
        y = sim.qpos[env, 1]
        direction = heading(base_quaternion(sim.qpos, env))
        for block in range(first_block, num_blocks, block_stride):
            u = wp.vec4(0.5)
            if params.noise:
                u = uniform4(
                    worlds.seed, wp.static(int(Purpose.NOISE)), worlds.world_offset + env, worlds.episode_count[env],
                    worlds.episode_step[env], block,
                )  # fmt: skip
            for lane in range(wp.min(4, obs.shape[1] - 4 * block)):
                i = 4 * block + lane
                seen = obs[env, i]
                k = i - params.scan_start
                if k >= 0:
                    offset = rotate_by_heading(direction, sensing.point[k][0], sensing.point[k][1])
                    height = sample_minimum(ground.heights, params.cell, params.corner, x + offset[0], y + offset[1])
                    bound = wp.static(HEIGHT_BOUND)
                    clearance = sim.qpos[env, 2] - params.standing_height - height
                    seen = wp.static(HEIGHT_SCALE) * wp.clamp(clearance, -bound, bound)
                obs[env, i] = seen + sensing.noise[i] * (2.0 * u[lane] - 1.0)


def finish_obs(legged: LeggedWorlds, mask: wp.array, *, wanted: bool) -> None:
    """Write the heights around every robot and add the noise, in the worlds where ``mask`` is ``wanted``.

    A height is seen as 5 clip(z - standing height - ground, -1 m, 1 m), z being the base's, at points that turn only
    with the robot's yaw. Legged Gym subtracts 0.5 m from every robot; with the robot's own height the inputs are
    around 0 on level ground. Inputs that are all equal and far from 0 act as a bias with a hundred times the
    learning rate of the other weights.

    Args:
        legged: The worlds; their observations are updated, their clocks address the draws.
        mask: One of their masks, bool, shape (num_envs,).
        wanted: Value of ``mask`` in the worlds to write.
    """
    n, obs_dim = legged.worlds.obs.shape
    threads = (1, 1) if is_serial(mask.device) else (n, (obs_dim + 3) // 4)
    legged.launch(_finish_obs, threads, legged.ground, legged.sensing, legged.sim, mask, wanted, *threads)
