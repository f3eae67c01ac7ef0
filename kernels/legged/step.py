"""One control step of the legged robots, around the simulator's: what goes in, and what came out of it."""

import warp as wp

from ..check import require, require_axes
from ..random import Purpose, uniform4
from ..rotations import down_in_body
from .contacts import peak_force
from .observation import base_quaternion, base_rate, base_velocity, write_proprioception
from .rewards import (
    LEG_JOINTS,
    TERMS,
    LegMotion,
    linear_tracking,
    vec12,
    weighted_terms,
    yaw_tracking,
)
from .state import (
    BASE_PART,
    CRASH_FORCE,
    FIRST_FOOT,
    FIRST_LIMB,
    FOOT_FORCE,
    LIMB_FORCE,
    NUM_COLUMNS,
    NUM_FEET,
    NUM_PARTS,
    Joints,
    LocomotionParams,
    LocomotionState,
    LocomotionStep,
    Simulation,
    require_joints,
    require_obs,
    require_state,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def push_is_due(params: LocomotionParams, env: int, age: int) -> wp.bool:
    """True on the steps that a robot is pushed on; every world has a phase of its own."""
    if params.push_interval == 0 or age == 0:
        return False
    u = uniform4(params.seed, wp.static(int(Purpose.PUSH)), params.world_offset + env, 0, 0, 0)
    return (age + int(u[0] * float(params.push_interval))) % params.push_interval == 0


@wp.kernel
def _apply_actions(
    # In
    params: LocomotionParams,
    joints: Joints,
    num_threads: int,
    action: wp.array2d[float],
    episode_count: wp.array[int],
    episode_step: wp.array[int],
    # Out
    sim: Simulation,
    fault: wp.array[int],
):
    for env in range(wp.tid(), action.shape[0], num_threads):
        sim.overflow[env] = 0
        unsound = float(0.0)
        for j in range(action.shape[1]):
            a = action[env, j]
            unsound += a - a  # 0, or NaN for NaN and infinity
            bounded = wp.clamp(a, -params.action_bound, params.action_bound)
            sim.ctrl[env, j] = joints.pose[j] + joints.action_scale[j] * bounded
        if unsound != 0.0:
            wp.atomic_min(fault, 2, env)
        age = episode_step[env]
        if push_is_due(params, env, age):
            count = episode_count[env]
            u = uniform4(params.seed, wp.static(int(Purpose.PUSH)), params.world_offset + env, count, age, 0)
            sim.qvel[env, 0] = (2.0 * u[0] - 1.0) * params.push_speed
            sim.qvel[env, 1] = (2.0 * u[1] - 1.0) * params.push_speed


def apply_actions(
    params: LocomotionParams,
    joints: Joints,
    action: wp.array,
    state: LocomotionState,
    sim: Simulation,
    fault: wp.array,
) -> None:
    """Turn actions into target angles, push the robots that are due, and clear the simulator's overflow bits.

    A push sets the horizontal velocity of the base, as in Legged Gym.

    Args:
        params: What all worlds share.
        joints: The robot's joints.
        action: Actions, float32, shape (num_envs, num_joints). Clipped to ``params.action_bound``.
        state: The worlds; only clocks are read.
        sim: The simulator. ``ctrl``, ``overflow`` and, on a push, ``qvel`` are written.
        fault: int32, shape (3,). ``fault[2]`` is lowered to the lowest world whose action is not finite.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    _require_simulation(sim, action)
    require("fault", fault, dtype=wp.int32, shape=(3,), like=action)
    require_joints(joints, action.shape[1], action)
    require_state(state, *action.shape, action)
    num_threads = 1 if action.device.is_cpu else action.shape[0]
    wp.launch(
        _apply_actions,
        dim=num_threads,
        inputs=[params, joints, num_threads, action, state.episode_count, state.episode_step],
        outputs=[sim, fault],
        device=action.device,
    )


@wp.func
def find_fault(params: LocomotionParams, sim: Simulation, goal: wp.array2d[float], env: int) -> wp.vec2:
    """(bit of BROKEN, value): why a world is not physical any more or has no goal, or (0, 0) where all is well."""
    position = float(0.0)
    for i in range(sim.qpos.shape[1]):
        position += sim.qpos[env, i] - sim.qpos[env, i]  # 0, or NaN for NaN and infinity
    velocity = float(0.0)
    fastest = float(0.0)
    for i in range(sim.qvel.shape[1]):
        velocity += sim.qvel[env, i] - sim.qvel[env, i]
        if i >= 3:
            fastest = wp.max(fastest, wp.abs(sim.qvel[env, i]))
    aim = float(0.0)
    for i in range(goal.shape[1]):
        aim += goal[env, i] - goal[env, i]
    if position != 0.0:
        return wp.vec2(2.0, position)
    if velocity != 0.0:
        return wp.vec2(4.0, velocity)
    if aim != 0.0:
        return wp.vec2(32.0, aim)
    speed = wp.length(wp.vec3(sim.qvel[env, 0], sim.qvel[env, 1], sim.qvel[env, 2]))
    if speed > params.max_speed:
        return wp.vec2(8.0, speed)
    if fastest > params.max_rate:
        return wp.vec2(8.0, fastest)
    lost = sim.overflow[env] & params.lost_contacts
    if lost != 0:
        return wp.vec2(16.0, float(lost))
    return wp.vec2(0.0, 0.0)


@wp.func
def load12(array: wp.array2d[float], env: int, start: int) -> vec12:
    """Twelve numbers of a row, from ``start`` on."""
    v = vec12()
    for j in range(wp.static(LEG_JOINTS)):
        v[j] = array[env, start + j]
    return v


@wp.func
def feet_in_contact(part_force: wp.array3d[float], env: int) -> int:
    """Bit i: foot i pushes on the terrain."""
    feet = int(0)
    for i in range(wp.static(NUM_FEET)):
        if peak_force(part_force, env, wp.static(FIRST_FOOT) + i) > wp.static(FOOT_FORCE):
            feet = feet | (1 << i)
    return feet


@wp.func
def count_collisions(part_force: wp.array3d[float], env: int) -> int:
    """Number of limbs that touch the terrain."""
    total = int(0)
    for part in range(wp.static(FIRST_LIMB), part_force.shape[2]):
        if peak_force(part_force, env, part) > wp.static(LIMB_FORCE):
            total += 1
    return total


@wp.func
def update_air_time(params: LocomotionParams, part_force: wp.array3d[float], env: int, state: LocomotionState) -> float:
    """Advance the feet's air times; gives the sum over the feet that touch down of (air time - target) [s].

    As in Legged Gym a foot is on the ground if it has touched it on this step or on the last.
    """
    feet = feet_in_contact(part_force, env)
    grounded = feet | state.foot_contact[env]
    state.foot_contact[env] = feet
    landed = float(0.0)
    for i in range(wp.static(NUM_FEET)):
        before = state.air_time[env, i]
        now = before + params.dt
        if (grounded & (1 << i)) != 0:
            if before > 0.0:
                landed += now - params.air_time_target
            now = 0.0
        state.air_time[env, i] = now
    return landed


@wp.func
def leg_motion(
    params: LocomotionParams, sim: Simulation, action: wp.array2d[float], env: int, state: LocomotionState
) -> LegMotion:
    """What the reward is made of; the air times move on."""
    m = LegMotion()
    m.velocity = base_velocity(sim.qpos, sim.qvel, env)
    m.rate = base_rate(sim.qvel, env)
    m.down = down_in_body(base_quaternion(sim.qpos, env))
    m.goal = wp.vec3(state.goal[env, 0], state.goal[env, 1], state.goal[env, 2])
    m.angle = load12(sim.qpos, env, 7)
    m.speed = load12(sim.qvel, env, 6)
    m.last_speed = load12(state.joint_speed, env, 0)
    m.torque = load12(sim.torque, env, 0)
    m.last_action = load12(state.action, env, 0)
    for j in range(wp.static(LEG_JOINTS)):
        m.action[j] = wp.clamp(action[env, j], -params.action_bound, params.action_bound)
    m.soft_low = params.soft_low
    m.soft_high = params.soft_high
    m.collisions = count_collisions(sim.part_force, env)
    m.landed_air_time = update_air_time(params, sim.part_force, env, state)
    m.dt = params.dt
    return m


@wp.func
def write_reward(m: LegMotion, params: LocomotionParams, env: int, out: LocomotionStep):
    """Write the terms, what clipping their sum at 0 adds, the reward, and how well the goal is met."""
    out.tracking[env, 0] = linear_tracking(m)
    out.tracking[env, 1] = yaw_tracking(m)
    terms = weighted_terms(m, params.weight)
    total = float(0.0)
    for k in range(wp.static(len(TERMS))):
        out.term[env, k] = terms[k]
        total += terms[k]
    for k in range(wp.static(NUM_COLUMNS), out.term.shape[1]):  # those of what is carried, written before
        total += out.term[env, k]
    reward = total - wp.min(total, 0.0)  # a maximum of NaN and 0 would be 0
    out.term[env, wp.static(len(TERMS))] = reward - total
    out.reward[env] = reward


@wp.func
def remember(params: LocomotionParams, sim: Simulation, action: wp.array2d[float], env: int, state: LocomotionState):
    """Keep this step's action and joint velocities for the next."""
    for j in range(action.shape[1]):
        state.action[env, j] = wp.clamp(action[env, j], -params.action_bound, params.action_bound)
        state.joint_speed[env, j] = sim.qvel[env, 6 + j]


@wp.func
def is_off(params: LocomotionParams, x: float, y: float) -> wp.bool:
    """True beyond the terrain."""
    return x < params.low[0] or y < params.low[1] or x > params.high[0] or y > params.high[1]


@wp.kernel
def _judge_step(
    # In
    params: LocomotionParams,
    joints: Joints,
    num_threads: int,
    action: wp.array2d[float],
    goal_scale: wp.array[float],
    sim: Simulation,
    # In and out
    state: LocomotionState,
    out: LocomotionStep,
):
    for env in range(wp.tid(), action.shape[0], num_threads):
        found = find_fault(params, sim, state.goal, env)
        broken = found[0] > 0.0
        crashed = peak_force(sim.part_force, env, wp.static(BASE_PART)) > wp.static(CRASH_FORCE)

        if broken:
            # The last sound observation stays: what follows a broken state must not reach a learner.
            out.reward[env] = 0.0
            for k in range(out.term.shape[1]):
                out.term[env, k] = 0.0
            for k in range(out.tracking.shape[1]):
                out.tracking[env, k] = 0.0
            wp.atomic_add(out.fault, 0, 1)
            wp.atomic_min(out.fault, 1, env)
            out.cause[env] = int(found[0])
            out.value[env] = found[1]
        else:
            m = leg_motion(params, sim, action, env, state)
            write_reward(m, params, env, out)
            state.tracked[env] = state.tracked[env] + wp.vec2(out.tracking[env, 0], 1.0)
            remember(params, sim, action, env, state)
            write_proprioception(env, joints, sim.qpos, sim.qvel, state, goal_scale, out.obs)

        clock = state.goal_clock[env] + 1
        age = state.episode_step[env] + 1
        state.goal_clock[env] = clock
        state.episode_step[env] = age
        is_due = clock >= params.goal_period and not broken
        time_is_up = params.time_limit > 0 and age >= params.time_limit
        is_over = broken or time_is_up or is_off(params, sim.qpos[env, 0], sim.qpos[env, 1])
        out.terminated[env] = crashed
        out.truncated[env] = is_over and not crashed
        out.goal_due[env] = is_due
        out.invalid[env] = broken


def judge_step(
    params: LocomotionParams,
    joints: Joints,
    action: wp.array,
    goal_scale: wp.array,
    sim: Simulation,
    state: LocomotionState,
    out: LocomotionStep,
) -> None:
    """Judge what the simulator has done: health, crash, reward, clocks, observation without heights and noise.

    Nothing is reset and no goal changes. A world whose state is not physical any more (not finite, too
    fast, or with contacts lost), or whose goal is not finite, is marked ``invalid`` and cut off: it gets a reward
    of 0, keeps the observation of the step before, and no goal falls due in it. A crash on the same step counts
    all the same.

    Args:
        params: What all worlds share.
        joints: The robot's joints.
        action: The actions of this step, float32, shape (num_envs, num_joints).
        goal_scale: What the policy sees goals multiplied by, float32, shape (goal_dim,).
        sim: The simulator after its substeps.
        state: The worlds. Updated.
        out: What the step gives back. Written, but for ``fault`` (added to; start it at 0, num_envs, num_envs) and
            what is carried: terms from column ``NUM_COLUMNS`` on count in the reward as they are, unless the world is
            invalid, and ``tracking`` beyond linear and yaw stays.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    _require_simulation(sim, action)
    require_joints(joints, action.shape[1], action)
    require_state(state, *action.shape, action)
    require("goal_scale", goal_scale, dtype=wp.float32, shape=state.goal.shape[1:], like=action)
    require_obs("out.obs", out.obs, state, action)
    _require_step(out, action)
    num_threads = 1 if action.device.is_cpu else action.shape[0]
    wp.launch(
        _judge_step,
        dim=num_threads,
        inputs=[params, joints, num_threads, action, goal_scale, sim],
        outputs=[state, out],
        device=action.device,
    )


def _require_simulation(sim: Simulation, action: wp.array) -> None:
    require("action", action, dtype=wp.float32)
    require_axes("action", action, 2)
    n, num_joints = action.shape
    for name, width in (
        ("qpos", 7 + num_joints),
        ("qvel", 6 + num_joints),
        ("ctrl", num_joints),
        ("torque", num_joints),
    ):
        require(f"sim.{name}", getattr(sim, name), dtype=wp.float32, shape=(n, width), like=action)
    parts = (sim.part_force.shape[0], n, NUM_PARTS)
    require("sim.part_force", sim.part_force, dtype=wp.float32, shape=parts, like=action)
    require("sim.overflow", sim.overflow, dtype=wp.int32, shape=(n,), like=action)


def _require_step(out: LocomotionStep, action: wp.array) -> None:
    n = action.shape[0]
    for name, shape, dtype in (
        ("reward", (n,), wp.float32), ("tracking", (n, max(2, out.tracking.shape[1])), wp.float32),
        ("term", (n, max(NUM_COLUMNS, out.term.shape[1])), wp.float32),
        ("fault", (3,), wp.int32), ("cause", (n,), wp.int32), ("value", (n,), wp.float32),
        *((flag, (n,), wp.bool) for flag in ("terminated", "truncated", "goal_due", "invalid")),
    ):  # fmt: skip
        require(f"out.{name}", getattr(out, name), dtype=dtype, shape=shape, like=action)
