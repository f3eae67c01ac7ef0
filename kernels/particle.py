"""Particle Gym: one thread moves one point mass, rewards it and writes what its policy sees.

The physics is that of Gauthier's thesis, section 4.1.1: a force is halved and added to the velocity,
every component of the velocity is clipped to ``max_speed``, the velocity is added to the position,
and a particle crashes when any component of its position leaves [-half_side, half_side]. Lengths are
in the thesis's length units [u], time is in steps, so velocities are in u/step and forces in
u/step^2 (the mass is one).

A goal is a velocity or a position in space; relative goals are positions whose ``Worlds.origin`` is the particle.
"""

import warp as wp

from .episodes import WORLDS, Worlds, begin_episode, end_step, record, write_goal
from .particle_rewards import shape_reward
from .random import Purpose, symmetric3
from .structs import StructTable

wp.set_module_options({"enable_backward": False})

OBS_DIM = 12  # velocity, position, last action, goal; three components each
GOAL_START = 9  # where the goal starts in the observation
BROKEN = ("action", "velocity", "position", "goal")  # quantities that may be broken, by their bit in ``Worlds.cause``


@wp.struct
class ParticleParams:
    """Parameters that all particles share."""

    velocity_goals: wp.bool  # whether goals are velocities, not positions
    half_side: float  # half side of the cube [u]
    max_speed: float  # bound of every component of the velocity [u/step]
    max_force: float  # bound of every component of the force [u/step^2], may be inf
    spawn_range: float  # half side of the box that particles start in [u]
    position_scale: float  # observed position = position * position_scale
    velocity_scale: float  # observed velocity = velocity * velocity_scale
    force_scale: float  # observed action = applied force * force_scale
    reward_shape: int  # one of RewardShape
    reward_length: float  # distance of the reward's 1/2 or 1/e [u] or [u/step]
    largest_distance: float  # largest distance to a goal that can occur [u] or [u/step]


@wp.struct
class ParticleState:
    """The state of every particle. Arrays of shape (num_envs,)."""

    position: wp.array[wp.vec3]  # [u]
    velocity: wp.array[wp.vec3]  # [u/step]
    force: wp.array[wp.vec3]  # last action as it was applied [u/step^2]


PARTICLES = StructTable(ParticleState)


@wp.func
def clamp3(v: wp.vec3, bound: float) -> wp.vec3:
    """Every component clipped to [-bound, bound]."""
    return wp.vec3(wp.clamp(v[0], -bound, bound), wp.clamp(v[1], -bound, bound), wp.clamp(v[2], -bound, bound))


@wp.func
def is_outside(position: wp.vec3, half_side: float) -> wp.bool:
    """True when any component has left [-half_side, half_side]."""
    return wp.abs(position[0]) > half_side or wp.abs(position[1]) > half_side or wp.abs(position[2]) > half_side


@wp.func
def is_finite(v: wp.vec3) -> wp.bool:
    """True when every component is finite: inf - inf and nan - nan are nan. A third of the time of ``wp.isfinite``."""
    zero = v - v
    return zero[0] + zero[1] + zero[2] == 0.0


@wp.func
def find_broken(action: wp.vec3, velocity: wp.vec3, position: wp.vec3, target: wp.vec3) -> int:
    """One bit for each of BROKEN that is not finite."""
    broken = int(0)
    if is_finite((action - action) + (velocity - velocity) + (position - position) + (target - target)):
        return broken  # one test where all is well
    if not is_finite(action):
        broken = broken | 1
    if not is_finite(velocity):
        broken = broken | 2
    if not is_finite(position):
        broken = broken | 4
    if not is_finite(target):
        broken = broken | 8
    return broken


@wp.func
def write_obs(env: int, velocity: wp.vec3, position: wp.vec3, force: wp.vec3, worlds: Worlds):
    """Write velocity, position and last action, all scaled."""
    for i in range(3):
        worlds.obs[env, i] = velocity[i]
        worlds.obs[env, 3 + i] = position[i]
        worlds.obs[env, 6 + i] = force[i]


@wp.kernel
def _step_particles(
    # In and out
    worlds: Worlds,
    state: ParticleState,
    # In
    params: ParticleParams,
    actions: wp.array[wp.vec3],  # those of ``worlds``, and its goals: a vector takes one address, not three
    goals: wp.array[wp.vec3],
):
    for env in range(wp.tid(), worlds.num_envs, worlds.num_threads):
        # Tested before anything is clipped: a clipped NaN may come out as a bound.
        action = actions[env]
        goal = goals[env]
        broken = find_broken(action, state.velocity[env], state.position[env], goal)

        force = clamp3(action, params.max_force)
        velocity = clamp3(state.velocity[env] + 0.5 * force, params.max_speed)
        position = state.position[env] + velocity
        state.force[env] = force
        state.velocity[env] = velocity
        state.position[env] = position

        distance = wp.length(position - goal)
        if params.velocity_goals:
            distance = wp.length(velocity - goal)
        worlds.reward[env] = shape_reward(params.reward_shape, distance, params.largest_distance, params.reward_length)
        write_obs(
            env, velocity * params.velocity_scale, position * params.position_scale, force * params.force_scale, worlds
        )
        end_step(env, is_outside(position, params.half_side), False, broken, worlds)


def step_particles(worlds: Worlds, state: ParticleState, params: ParticleParams) -> wp.Launch:
    """Record a launch that steps every particle: physics, crash, reward, clocks, observation.

    Args:
        worlds: The worlds. Their actions are forces [u/step^2], clipped to ``params.max_force``.
        state: The particles. Updated.
        params: Parameters that all particles share.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    _require(worlds, state)
    return record(_step_particles, worlds, state, params, _vectors(worlds.action), _vectors(worlds.goal))


@wp.kernel
def _reset_particles(
    # In and out
    worlds: Worlds,
    state: ParticleState,
    # In
    params: ParticleParams,
):
    for env in range(wp.tid(), worlds.num_envs, worlds.num_threads):
        if worlds.mask[env]:
            episode = begin_episode(env, worlds)
            world = worlds.world_offset + env
            position = symmetric3(worlds.seed, wp.static(int(Purpose.RESET)), world, episode, 0) * params.spawn_range
            zero = wp.vec3(0.0)
            state.position[env] = position
            state.velocity[env] = zero
            state.force[env] = zero
            write_obs(env, zero, position * params.position_scale, zero, worlds)
            write_goal(env, worlds)


def reset_particles(worlds: Worlds, state: ParticleState, params: ParticleParams) -> wp.Launch:
    """Record a launch that begins an episode, with a uniform first goal, in every world of ``worlds.mask``.

    It leaves the other worlds alone.

    The arguments are those of ``step_particles``.
    """
    _require(worlds, state)
    return record(_reset_particles, worlds, state, params)


def _vectors(array: wp.array) -> wp.array:
    """The rows of an array as vectors, in the same memory."""
    return wp.array(ptr=array.ptr, dtype=wp.vec3, shape=array.shape[0], device=array.device)


def _require(worlds: Worlds, state: ParticleState) -> None:
    n = worlds.num_envs
    sizes = {"num_groups": worlds.tracking.shape[1], "num_origins": worlds.origin.shape[0]}
    WORLDS.require("worlds", worlds, worlds.goal, num_envs=n, obs_dim=OBS_DIM, action_dim=3, goal_dim=3, **sizes)
    PARTICLES.require("state", state, worlds.goal, num_envs=n)
