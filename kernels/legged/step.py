"""One control step of the legged robots, around the simulator's: what goes into it, and what comes out."""

import warp as wp

from ..episodes import Worlds, end_step
from ..random import Purpose, uniform4
from ..rotations import down_in_body
from .contacts import peak_force
from .levels import follow_path
from .observation import base_quaternion, base_rate, base_velocity, write_proprioception
from .rewards import LEG_JOINTS, TERMS, LegMotion, linear_tracking, vec12, weighted_terms, yaw_tracking
from .state import (
    BASE_PART,
    CRASH_FORCE,
    FIRST_FOOT,
    FIRST_LIMB,
    FOOT_FORCE,
    LIMB_FORCE,
    NUM_COLUMNS,
    NUM_FEET,
    Joints,
    LeggedWorlds,
    LevelRule,
    LocomotionParams,
    LocomotionState,
    LocomotionStep,
    Simulation,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def push_is_due(worlds: Worlds, params: LocomotionParams, env: int, age: int) -> wp.bool:
    """True on the steps that a robot is pushed on; every world has a phase of its own."""
    if params.push_interval == 0 or age == 0:
        return False
    u = uniform4(worlds.seed, wp.static(int(Purpose.PUSH)), worlds.world_offset + env, 0, 0, 0)
    return (age + int(u[0] * float(params.push_interval))) % params.push_interval == 0


@wp.func
def bounded_action(worlds: Worlds, joints: Joints, env: int, j: int) -> float:
    """The action of a joint, within what the joint can do."""
    return wp.clamp(worlds.action[env, j], joints.action_low[j], joints.action_high[j])


@wp.kernel
def _apply_actions(
    # In and out
    worlds: Worlds,
    # In
    params: LocomotionParams,
    joints: Joints,
    # Out
    sim: Simulation,
):
    for env in range(wp.tid(), worlds.num_envs, worlds.num_threads):
        sim.overflow[env] = 0
        unsound = float(0.0)
        for j in range(worlds.action.shape[1]):
            a = worlds.action[env, j]
            unsound += a - a  # 0, or NaN for NaN and infinity
            sim.ctrl[env, j] = joints.pose[j] + joints.action_scale[j] * bounded_action(worlds, joints, env, j)
        if unsound != 0.0:
            wp.atomic_min(worlds.fault, 2, env)
        age = worlds.episode_step[env]
        if push_is_due(worlds, params, env, age):
            count = worlds.episode_count[env]
            u = uniform4(worlds.seed, wp.static(int(Purpose.PUSH)), worlds.world_offset + env, count, age, 0)
            sim.qvel[env, 0] = (2.0 * u[0] - 1.0) * params.push_speed
            sim.qvel[env, 1] = (2.0 * u[1] - 1.0) * params.push_speed


def apply_actions(legged: LeggedWorlds) -> None:
    """Turn actions into target angles, push the robots that are due, and clear the simulator's overflow bits.

    Actions are clipped to the joints' ranges. A push sets the horizontal velocity of the base, as in Legged Gym.
    ``worlds.fault[2]`` is lowered to the lowest world whose action is not finite.
    """
    legged.launch(_apply_actions, legged.worlds.num_threads, legged.joints, legged.sim)


@wp.func
def find_fault(worlds: Worlds, params: LocomotionParams, sim: Simulation, env: int) -> wp.vec2:
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
    for i in range(worlds.goal.shape[1]):
        aim += worlds.goal[env, i] - worlds.goal[env, i]
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
    worlds: Worlds, params: LocomotionParams, joints: Joints, sim: Simulation, env: int, state: LocomotionState
) -> LegMotion:
    """What the reward is made of; the air times move on."""
    m = LegMotion()
    m.velocity = base_velocity(sim.qpos, sim.qvel, env)
    m.rate = base_rate(sim.qvel, env)
    m.down = down_in_body(base_quaternion(sim.qpos, env))
    m.goal = wp.vec3(worlds.goal[env, 0], worlds.goal[env, 1], worlds.goal[env, 2])
    m.angle = load12(sim.qpos, env, 7)
    m.speed = load12(sim.qvel, env, 6)
    m.last_speed = load12(state.joint_speed, env, 0)
    m.torque = load12(sim.torque, env, 0)
    m.last_action = load12(state.action, env, 0)
    for j in range(wp.static(LEG_JOINTS)):
        m.action[j] = bounded_action(worlds, joints, env, j)
    m.soft_low = params.soft_low
    m.soft_high = params.soft_high
    m.collisions = count_collisions(sim.part_force, env)
    m.landed_air_time = update_air_time(params, sim.part_force, env, state)
    m.dt = params.dt
    return m


@wp.func
def write_reward(m: LegMotion, params: LocomotionParams, env: int, worlds: Worlds, out: LocomotionStep):
    """Write the terms, what clipping their sum at 0 adds, the reward, and how well the goal is met."""
    worlds.tracking[env, 0] = linear_tracking(m)
    worlds.tracking[env, 1] = yaw_tracking(m)
    terms = weighted_terms(m, params.weight)
    total = float(0.0)
    for k in range(wp.static(len(TERMS))):
        out.term[env, k] = terms[k]
        total += terms[k]
    for k in range(wp.static(NUM_COLUMNS), out.term.shape[1]):  # the arm's, written before
        total += out.term[env, k]
    reward = total - wp.min(total, 0.0)  # a maximum of NaN and 0 would be 0
    out.term[env, wp.static(len(TERMS))] = reward - total
    worlds.reward[env] = reward


@wp.func
def remember(worlds: Worlds, joints: Joints, sim: Simulation, env: int, state: LocomotionState):
    """Keep this step's action and joint velocities for the next."""
    for j in range(worlds.action.shape[1]):
        state.action[env, j] = bounded_action(worlds, joints, env, j)
        state.joint_speed[env, j] = sim.qvel[env, 6 + j]


@wp.func
def is_off(params: LocomotionParams, sim: Simulation, env: int) -> wp.bool:
    """True beyond the terrain."""
    x = sim.qpos[env, 0]
    y = sim.qpos[env, 1]
    return x < params.low[0] or y < params.low[1] or x > params.high[0] or y > params.high[1]


@wp.kernel
def _evaluate_step(
    # In and out
    worlds: Worlds,
    # In
    params: LocomotionParams,
    joints: Joints,
    sim: Simulation,
    # In and out
    state: LocomotionState,
    # Out
    out: LocomotionStep,
):
    for env in range(wp.tid(), worlds.num_envs, worlds.num_threads):
        found = find_fault(worlds, params, sim, env)
        crashed = peak_force(sim.part_force, env, wp.static(BASE_PART)) > wp.static(CRASH_FORCE)
        if found[0] > 0.0:
            # The last sound observation stays: what follows a broken state must not reach a learner.
            worlds.reward[env] = 0.0
            for k in range(out.term.shape[1]):
                out.term[env, k] = 0.0
            for k in range(worlds.tracking.shape[1]):
                worlds.tracking[env, k] = 0.0
            out.value[env] = found[1]
        else:
            m = leg_motion(worlds, params, joints, sim, env, state)
            write_reward(m, params, env, worlds, out)
            state.tracked[env] = state.tracked[env] + wp.vec2(worlds.tracking[env, 0], 1.0)
            remember(worlds, joints, sim, env, state)
            if params.level_rule == wp.static(int(LevelRule.DISPLACEMENT)):
                follow_path(env, worlds, params, sim, state)
            write_proprioception(env, worlds, joints, sim, state)
        end_step(env, crashed, is_off(params, sim, env), int(found[0]), worlds)


def evaluate_step(legged: LeggedWorlds) -> None:
    """Evaluate the simulator's step: faults, crash, reward, clocks, observation without heights and noise.

    Nothing is reset and no goal changes. A world whose state is no longer physical (not finite, too fast, or with
    contacts lost), or whose goal is not finite, is marked ``invalid`` and cut off: it gets a reward of 0, keeps the
    observation of the previous step, and no goal falls due in it. A crash on the same step still counts.

    What ``evaluate_arms`` wrote before is kept unless the world is invalid: terms from column ``NUM_COLUMNS`` on are
    added to the reward, and tracking beyond linear and yaw stays.
    """
    legged.launch(
        _evaluate_step, legged.worlds.num_threads, legged.joints, legged.sim, legged.state, legged.out
    )  # fmt: skip
