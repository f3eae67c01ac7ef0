"""Particle Gym: one thread moves one point mass, judges it and writes what its policy sees.

The physics is that of Gauthier's thesis, section 4.1.1: a force is halved and added to the velocity,
every component of the velocity is clipped to ``max_speed``, the velocity is added to the position,
and a particle crashes when any component of its position leaves [-half_side, half_side]. Lengths are
in the thesis's length units [u], time is in steps, so velocities are in u/step and forces in
u/step^2 (the mass is one).
"""

from enum import IntEnum

import warp as wp

from .check import require, require_axes
from .goals import count_events, goal_is_due, time_is_up
from .particle_rewards import shape_reward
from .random import Purpose, symmetric3, uniform4

wp.set_module_options({"enable_backward": False})

OBS_DIM = 12  # velocity, position, last action, goal; three components each
BROKEN = ("action", "velocity", "position", "goal")  # quantities by their bit in ``ParticleStep.fault``
GOAL_START = 9  # where the goal starts in the observation


class Variant(IntEnum):
    """What a goal means."""

    ABSOLUTE = 0
    """A position in space; it may lie outside the cube."""
    DIRECTIONAL = 1
    """A velocity."""
    RELATIVE = 2
    """The way from the particle to a position in space; it changes as the particle moves."""


@wp.struct
class ParticleParams:
    """What all particles share."""

    variant: int  # one of Variant
    half_side: float  # half side of the cube [u]
    max_speed: float  # bound of every component of the velocity [u/step]
    max_force: float  # bound of every component of the force [u/step^2], may be inf
    goal_range: float  # half side of the box that goals are drawn from [u] or [u/step]
    spawn_range: float  # half side of the box that particles start in [u]
    position_scale: float  # observed position = position * position_scale
    velocity_scale: float  # observed velocity = velocity * velocity_scale
    force_scale: float  # observed action = applied force * force_scale
    reward_shape: int  # one of RewardShape
    reward_length: float  # distance of the reward's 1/2 or 1/e [u] or [u/step]
    largest_distance: float  # largest distance to a goal that can occur [u] or [u/step]
    goal_period: int  # T: steps that a goal is in force
    time_limit: int  # steps of an episode, 0 for no limit
    stagger: wp.bool  # whether the first goal clock of every world starts at a random step
    seed: wp.uint32  # of every draw
    world_offset: int  # global number of world 0


@wp.struct
class ParticleState:
    """Where every particle is; all that a bit-exact resume needs. Arrays of shape (num_envs,)."""

    position: wp.array[wp.vec3]  # [u]
    velocity: wp.array[wp.vec3]  # [u/step]
    force: wp.array[wp.vec3]  # last action as it was applied [u/step^2]
    target: wp.array[wp.vec3]  # goal: a velocity (DIRECTIONAL) or a position in space (the others)
    goal_clock: wp.array[int]  # steps that the goal has been in force
    episode_step: wp.array[int]  # steps since the reset
    episode_count: wp.array[int]  # resets so far
    goal_count: wp.array[int]  # goals received so far, first goals apart


@wp.struct
class ParticleStep:
    """What one step gives back. Arrays of shape (num_envs,) but for those that say otherwise."""

    obs: wp.array2d[float]  # (num_envs, OBS_DIM)
    reward: wp.array[float]  # in (0, 1], against the goal that was in force
    terminated: wp.array[wp.bool]  # crashed
    truncated: wp.array[wp.bool]  # reached the time limit without a crash
    goal_due: wp.array[wp.bool]  # the goal has been in force for its whole period
    invalid: wp.array[wp.bool]  # the action, or the state before the step, is not finite
    count: wp.array[int]  # (2,): worlds with a goal due that are not done, worlds that are done
    fault: wp.array[int]  # (3,): invalid world-steps so far, lowest world among them, bits of BROKEN


@wp.func
def observed_goal(
    variant: int, position_scale: float, velocity_scale: float, target: wp.vec3, position: wp.vec3
) -> wp.vec3:
    """The goal as the policy sees it."""
    if variant == wp.static(int(Variant.DIRECTIONAL)):
        return target * velocity_scale
    if variant == wp.static(int(Variant.RELATIVE)):
        return (target - position) * position_scale
    return target * position_scale


@wp.func
def goal_distance(variant: int, target: wp.vec3, position: wp.vec3, velocity: wp.vec3) -> float:
    """Distance to the goal: of velocities [u/step] or of positions [u]."""
    if variant == wp.static(int(Variant.DIRECTIONAL)):
        return wp.length(velocity - target)
    return wp.length(position - target)


@wp.func
def write_obs(env: int, velocity: wp.vec3, position: wp.vec3, force: wp.vec3, goal: wp.vec3, obs: wp.array2d[float]):
    """Write velocity, position, last action and goal, all scaled already."""
    for i in range(3):
        obs[env, i] = velocity[i]
        obs[env, 3 + i] = position[i]
        obs[env, 6 + i] = force[i]
        obs[env, 9 + i] = goal[i]


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


@wp.kernel
def _step_particles(
    # In
    params: ParticleParams,
    num_threads: int,
    action: wp.array[wp.vec3],
    target: wp.array[wp.vec3],
    # In and out
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    goal_clock: wp.array[int],
    episode_step: wp.array[int],
    count: wp.array[int],
    fault: wp.array[int],
    # Out
    force: wp.array[wp.vec3],
    obs: wp.array2d[float],
    reward: wp.array[float],
    terminated: wp.array[wp.bool],
    truncated: wp.array[wp.bool],
    goal_due: wp.array[wp.bool],
    invalid: wp.array[wp.bool],
):
    # A grid-stride loop: on a GPU each thread has one particle; on a CPU, where Warp copies the arguments anew for
    # every thread, one thread has them all.
    for env in range(wp.tid(), action.shape[0], num_threads):
        # Judged before anything is clipped: a clipped NaN may come out as a bound.
        wanted = action[env]
        aim = target[env]
        v_before = velocity[env]
        x_before = position[env]
        broken = find_broken(wanted, v_before, x_before, aim)
        f = clamp3(wanted, params.max_force)
        v = clamp3(v_before + 0.5 * f, params.max_speed)
        x = x_before + v
        force[env] = f
        velocity[env] = v
        position[env] = x

        crashed = is_outside(x, params.half_side)
        distance = goal_distance(params.variant, aim, x, v)
        reward[env] = shape_reward(params.reward_shape, distance, params.largest_distance, params.reward_length)

        clock = goal_clock[env] + 1
        age = episode_step[env] + 1
        goal_clock[env] = clock
        episode_step[env] = age
        is_due = goal_is_due(clock, params.goal_period)
        is_cut_off = time_is_up(age, params.time_limit) and not crashed
        terminated[env] = crashed
        truncated[env] = is_cut_off
        goal_due[env] = is_due
        invalid[env] = broken != 0
        count_events(is_due, crashed or is_cut_off, count)
        if broken != 0:
            wp.atomic_add(fault, 0, 1)
            wp.atomic_min(fault, 1, env)
            wp.atomic_or(fault, 2, broken)
        goal = observed_goal(params.variant, params.position_scale, params.velocity_scale, aim, x)
        write_obs(env, v * params.velocity_scale, x * params.position_scale, f * params.force_scale, goal, obs)


def step_particles(
    params: ParticleParams, action: wp.array, state: ParticleState, out: ParticleStep, *, record: bool = False
) -> wp.Launch | None:
    """Move every particle by one step, then judge it: crash, reward, clocks, observation, in this order.

    Nothing is reset and no goal changes; the observation is the one that the step ended in, with
    the goal that was in force.

    Args:
        params: What all particles share.
        action: Forces [u/step^2], vec3, shape (num_envs,). Clipped to ``params.max_force``.
        state: The particles. Updated.
        out: What the step gives back. Written, but for ``count`` (added to: zero it before the
            launch) and ``fault`` (added to; start it at 0, num_envs, 0).
        record: Return the launch, to be replayed with ``launch()``, instead of making it.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("action", action, dtype=wp.vec3)
    _require_state(state, action)
    _require_step(out, action)
    num_threads = 1 if action.device.is_cpu else action.shape[0]
    return wp.launch(
        _step_particles,
        dim=num_threads,
        inputs=[params, num_threads, action, state.target],
        outputs=[
            state.position,
            state.velocity,
            state.goal_clock,
            state.episode_step,
            out.count,
            out.fault,
            state.force,
            out.obs,
            out.reward,
            out.terminated,
            out.truncated,
            out.goal_due,
            out.invalid,
        ],
        device=action.device,
        record_cmd=record,
    )


@wp.kernel
def _reset_particles(
    params: ParticleParams,
    mask: wp.array[wp.bool],
    goal_scale: wp.array[float],
    state: ParticleState,
    obs: wp.array2d[float],
):
    env = wp.tid()
    if not mask[env]:
        return
    world = params.world_offset + env
    episode = state.episode_count[env]
    spawn = symmetric3(params.seed, wp.static(int(Purpose.RESET)), world, episode, 0)
    first = symmetric3(params.seed, wp.static(int(Purpose.FIRST_GOAL)), world, episode, 0)
    scale = wp.vec3(goal_scale[0], goal_scale[1], goal_scale[2])
    clock = 0
    if params.stagger and episode == 0:
        u = uniform4(params.seed, wp.static(int(Purpose.RESET)), world, episode, 1, 0)
        clock = int(u[0] * float(params.goal_period))
    position = spawn * params.spawn_range
    target = wp.cw_mul(first, scale) * params.goal_range
    zero = wp.vec3(0.0)
    state.position[env] = position
    state.velocity[env] = zero
    state.force[env] = zero
    state.target[env] = target
    state.goal_clock[env] = clock
    state.episode_step[env] = 0
    state.episode_count[env] = episode + 1
    goal = observed_goal(params.variant, params.position_scale, params.velocity_scale, target, position)
    write_obs(env, zero, position * params.position_scale, zero, goal, obs)


def reset_particles(
    params: ParticleParams,
    mask: wp.array,
    goal_scale: wp.array,
    state: ParticleState,
    obs: wp.array,
    *,
    record: bool = False,
) -> wp.Launch | None:
    """Start a new episode in every world of ``mask``, with a uniform first goal; leave the others alone.

    Args:
        params: What all particles share.
        mask: Worlds to reset, bool, shape (num_envs,).
        goal_scale: Share of the goal range that first goals are drawn from, float32, shape (3,), in (0, 1].
        state: The particles. Updated where ``mask`` is true.
        obs: Observations, float32, shape (num_envs, OBS_DIM). Refreshed where ``mask`` is true.
        record: Return the launch, to be replayed with ``launch()``, instead of making it.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("mask", mask, dtype=wp.bool)
    require("goal_scale", goal_scale, dtype=wp.float32, shape=(3,), like=mask)
    _require_state(state, mask)
    require("obs", obs, dtype=wp.float32, shape=(mask.shape[0], OBS_DIM), like=mask)
    return wp.launch(
        _reset_particles,
        dim=mask.shape[0],
        inputs=[params, mask, goal_scale],
        outputs=[state, obs],
        device=mask.device,
        record_cmd=record,
    )


@wp.kernel
def _set_goals(
    params: ParticleParams,
    row: wp.array[int],
    goal: wp.array[wp.vec3],
    state: ParticleState,
    obs: wp.array2d[float],
):
    i = wp.tid()
    env = row[i]
    target = goal[i]
    if params.variant == wp.static(int(Variant.DIRECTIONAL)):
        target = target / params.velocity_scale
    else:
        target = target / params.position_scale
    if params.variant == wp.static(int(Variant.RELATIVE)):
        target = target + state.position[env]
    state.target[env] = target
    state.goal_clock[env] = 0
    state.goal_count[env] = state.goal_count[env] + 1
    seen = observed_goal(params.variant, params.position_scale, params.velocity_scale, target, state.position[env])
    for k in range(3):
        obs[env, wp.static(GOAL_START) + k] = seen[k]


def set_goals(
    params: ParticleParams,
    row: wp.array,
    goal: wp.array,
    state: ParticleState,
    obs: wp.array,
    *,
    record: bool = False,
) -> wp.Launch | None:
    """Give the listed worlds a new goal and start its clock.

    Args:
        params: What all particles share.
        row: Worlds, int32, shape (n,), each in [0, num_envs) and at most once.
        goal: Goals as the policy sees them, scaled, vec3, shape (n,).
        state: The particles. Their targets and goal clocks and counts are updated.
        obs: Observations, float32, shape (num_envs, OBS_DIM). The goal is refreshed in the listed rows.
        record: Return the launch, to be replayed with ``launch()``, instead of making it.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("row", row, dtype=wp.int32)
    require("goal", goal, dtype=wp.vec3, like=row)
    require("obs", obs, dtype=wp.float32, shape=(state.position.shape[0], OBS_DIM), like=row)
    require("state.position", state.position, dtype=wp.vec3, shape=state.position.shape, like=row)
    _require_state(state, state.position)
    return wp.launch(
        _set_goals,
        dim=row.shape[0],
        inputs=[params, row, goal],
        outputs=[state, obs],
        device=row.device,
        record_cmd=record,
    )


@wp.kernel
def _make_relative(
    # In
    params: ParticleParams,
    row: wp.array[int],
    position: wp.array[wp.vec3],
    # In and out
    candidate: wp.array3d[float],
):
    i, k = wp.tid()
    origin = position[row[i]] * params.position_scale
    for c in range(3):
        candidate[i, k, c] = candidate[i, k, c] - origin[c]


def make_relative(
    params: ParticleParams, row: wp.array, position: wp.array, candidate: wp.array, *, record: bool = False
) -> wp.Launch | None:
    """Express candidate positions in space as seen from each particle.

    Args:
        params: What all particles share; only ``position_scale`` is read.
        row: Worlds that the candidates are for, int32, shape (n,), each in [0, num_envs).
        position: Positions [u], vec3, shape (num_envs,).
        candidate: Scaled positions, float32, shape (n, count, 3). Updated to scaled differences.
        record: Return the launch, to be replayed with ``launch()``, instead of making it.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("row", row, dtype=wp.int32)
    require("position", position, dtype=wp.vec3, shape=position.shape, like=row)
    require_axes("candidate", candidate, 3)
    require("candidate", candidate, dtype=wp.float32, shape=(row.shape[0], candidate.shape[1], 3), like=row)
    return wp.launch(
        _make_relative,
        dim=candidate.shape[:2],
        inputs=[params, row, position],
        outputs=[candidate],
        device=row.device,
        record_cmd=record,
    )


def _require_state(state: ParticleState, like: wp.array) -> None:
    for name in ("position", "velocity", "force", "target"):
        require(f"state.{name}", getattr(state, name), dtype=wp.vec3, like=like)
    for name in ("goal_clock", "episode_step", "episode_count", "goal_count"):
        require(f"state.{name}", getattr(state, name), dtype=wp.int32, like=like)


def _require_step(out: ParticleStep, like: wp.array) -> None:
    require("out.obs", out.obs, dtype=wp.float32, shape=(like.shape[0], OBS_DIM), like=like)
    require("out.reward", out.reward, dtype=wp.float32, like=like)
    for name in ("terminated", "truncated", "goal_due", "invalid"):
        require(f"out.{name}", getattr(out, name), dtype=wp.bool, like=like)
    require("out.count", out.count, dtype=wp.int32, shape=(2,), like=like)
    require("out.fault", out.fault, dtype=wp.int32, shape=(3,), like=like)
