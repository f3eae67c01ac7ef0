"""One step and one reset of the arm on a legged robot: its tracking, and what the policy sees of it.

The positions of arm and goals are in ``arm_goals``, the terms of the reward in ``arm_rewards``.
"""

import warp as wp

from ..episodes import Worlds, write_goal
from ..random import Purpose
from .arm_goals import (
    GOAL_COMPONENT,
    Arm,
    active_goal,
    draw_again,
    find_spot,
    goal_of_place,
    place_of_end_effector,
    place_of_goal,
)
from .arm_rewards import ARM_TERMS, ArmMotion, reach, weighted_arm_terms
from .rewards import LEG_JOINTS
from .state import (
    NUM_COLUMNS,
    Ground,
    Joints,
    LeggedWorlds,
    LocomotionParams,
    LocomotionState,
    LocomotionStep,
    Simulation,
)
from .step import bounded_action, find_fault

wp.set_module_options({"enable_backward": False})

GROUP = 2  # of the goal's components: the arm's
SEEN_BOUND = 2.0  # the policy's view of the end effector is clipped to this, on either side


@wp.func
def write_end_effector(arm: Arm, seen: wp.vec3, env: int, obs: wp.array2d[float]):
    """Write where the end effector is, as a goal there would be written."""
    bound = wp.static(SEEN_BOUND)
    for i in range(3):
        obs[env, arm.obs_start + i] = wp.clamp(seen[i], -bound, bound)


@wp.func
def arm_effort(worlds: Worlds, joints: Joints, sim: Simulation, state: LocomotionState, env: int) -> wp.vec2:
    """(power [W], squared change of the action), summed over the arm's joints."""
    power = float(0.0)
    change = float(0.0)
    for j in range(wp.static(LEG_JOINTS), worlds.action.shape[1]):
        power += wp.abs(sim.torque[env, j] * sim.qvel[env, 6 + j])
        a = bounded_action(worlds, joints, env, j) - state.action[env, j]
        change += a * a
    return wp.vec2(power, change)


@wp.kernel
def _evaluate_arms(
    # In and out
    worlds: Worlds,
    # In
    params: LocomotionParams,
    joints: Joints,
    arm: Arm,
    ground: Ground,
    sim: Simulation,
    state: LocomotionState,
    # Out
    out: LocomotionStep,
):
    for env in range(wp.tid(), worlds.num_envs, worlds.num_threads):
        if find_fault(worlds, params, sim, env)[0] == 0.0:
            place = place_of_end_effector(params, arm, ground.heights, sim.qpos, env)
            seen = goal_of_place(place)
            goal = active_goal(worlds, env)
            effort = arm_effort(worlds, joints, sim, state, env)
            m = ArmMotion()
            m.error = seen - goal
            m.distance = wp.length(place - place_of_goal(goal))
            m.power = effort[0]
            m.action_change = effort[1]
            m.dt = params.dt
            terms = weighted_arm_terms(m, arm.weight)
            for k in range(wp.static(len(ARM_TERMS))):
                out.term[env, wp.static(NUM_COLUMNS) + k] = terms[k]
            worlds.tracking[env, wp.static(GROUP)] = reach(m)
            write_end_effector(arm, seen, env, worlds.obs)
            arm.error[env] = m.distance


def evaluate_arms(legged: LeggedWorlds, arm: Arm) -> None:
    """Evaluate a step of the arms: their terms, tracking and part of the observation, and ``arm.error``.

    Must be followed by ``evaluate_step``, which adds the terms to the legs' and clears them in worlds that are no
    longer physical; nothing else is written in such a world. The terms are written from column ``NUM_COLUMNS`` on,
    the tracking in column ``GROUP``, the observation at ``arm.obs_start``.
    """
    legged.launch(
        _evaluate_arms, legged.worlds.num_threads, legged.joints, arm, legged.ground, legged.sim, legged.state,
        legged.out,
    )  # fmt: skip


@wp.kernel
def _reset_arms(
    # In and out
    worlds: Worlds,
    # In
    params: LocomotionParams,
    arm: Arm,
    ground: Ground,
    sim: Simulation,
):
    env = wp.tid()
    if not worlds.mask[env]:
        return
    goal = draw_again(
        params, arm, ground.heights, find_spot(params, arm, ground.heights, sim.qpos, env), worlds.seed,
        wp.static(int(Purpose.FIRST_GOAL)), worlds.world_offset + env, worlds.episode_count[env] - 1, 0,
        worlds.first_range, active_goal(worlds, env),
    )  # fmt: skip
    for i in range(3):
        worlds.goal[env, wp.static(GOAL_COMPONENT) + i] = goal[i]
    write_goal(env, worlds)
    place = place_of_end_effector(params, arm, ground.heights, sim.qpos, env)
    write_end_effector(arm, goal_of_place(place), env, worlds.obs)
    arm.error[env] = wp.length(place - place_of_goal(goal))


def reset_arms(legged: LeggedWorlds, arm: Arm) -> None:
    """Finish what ``reset_worlds`` has begun in every world of ``worlds.mask``.

    The arm's part of the first goal becomes a valid one, and observation and ``arm.error`` describe the arm.
    """
    legged.launch(_reset_arms, legged.worlds.num_envs, arm, legged.ground, legged.sim)
