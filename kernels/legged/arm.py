"""One step and one reset of the arm on a legged robot: how well it does, and what the policy sees of it.

Where arm and goals are is in ``arm_goals``, the terms of the reward are in ``arm_rewards``.
"""

import warp as wp

from ..check import require, require_axes
from ..random import Purpose
from .arm_goals import (
    GOAL_COMPONENT,
    Arm,
    draw_again,
    find_spot,
    goal_in_force,
    goal_of_place,
    place_of_end_effector,
    place_of_goal,
    require_arm,
)
from .arm_rewards import ARM_TERMS, ArmMotion, reach, weighted_arm_terms
from .observation import write_goal
from .rewards import LEG_JOINTS
from .state import (
    NUM_COLUMNS,
    LocomotionParams,
    LocomotionState,
    LocomotionStep,
    Simulation,
    require_obs,
    require_state,
)
from .step import find_fault

wp.set_module_options({"enable_backward": False})

GROUP = 2  # of the goal's components: the arm's
SEEN_BOUND = 2.0  # what the policy sees of the end effector is clipped to this on either side


@wp.func
def write_end_effector(arm: Arm, seen: wp.vec3, env: int, obs: wp.array2d[float]):
    """Write where the end effector is, as a goal there would be written."""
    bound = wp.static(SEEN_BOUND)
    for i in range(3):
        obs[env, arm.obs_start + i] = wp.clamp(seen[i], -bound, bound)


@wp.func
def arm_effort(
    params: LocomotionParams, sim: Simulation, action: wp.array2d[float], env: int, state: LocomotionState
) -> wp.vec2:
    """(power [W], squared change of the action), summed over the arm's joints."""
    power = float(0.0)
    change = float(0.0)
    for j in range(wp.static(LEG_JOINTS), action.shape[1]):
        power += wp.abs(sim.torque[env, j] * sim.qvel[env, 6 + j])
        a = wp.clamp(action[env, j], -params.action_bound, params.action_bound) - state.action[env, j]
        change += a * a
    return wp.vec2(power, change)


@wp.kernel
def _judge_arms(
    # In
    params: LocomotionParams,
    arm: Arm,
    heights: wp.array2d[float],
    num_threads: int,
    action: wp.array2d[float],
    sim: Simulation,
    state: LocomotionState,
    # Out
    out: LocomotionStep,
    error: wp.array[float],
):
    for env in range(wp.tid(), action.shape[0], num_threads):
        if find_fault(params, sim, state.goal, env)[0] == 0.0:
            place = place_of_end_effector(params, arm, heights, sim.qpos, env)
            seen = goal_of_place(place)
            goal = goal_in_force(state, env)
            effort = arm_effort(params, sim, action, env, state)
            m = ArmMotion()
            m.error = seen - goal
            m.distance = wp.length(place - place_of_goal(goal))
            m.power = effort[0]
            m.action_change = effort[1]
            m.dt = params.dt
            terms = weighted_arm_terms(m, arm.weight)
            for k in range(wp.static(len(ARM_TERMS))):
                out.term[env, wp.static(NUM_COLUMNS) + k] = terms[k]
            out.tracking[env, wp.static(GROUP)] = reach(m)
            write_end_effector(arm, seen, env, out.obs)
            error[env] = m.distance


def judge_arms(
    params: LocomotionParams,
    arm: Arm,
    heights: wp.array,
    action: wp.array,
    sim: Simulation,
    state: LocomotionState,
    out: LocomotionStep,
    error: wp.array,
) -> None:
    """Judge what the arms have done: their terms, tracking and part of the observation.

    To be followed by ``judge_step``, which adds the terms to the legs' and clears them in worlds that are not physical
    any more; nothing else is written in such a world.

    Args:
        params: What all worlds share.
        arm: The arm.
        heights: The height grid [m], float32, shape (nx, ny).
        action: The actions of this step, float32, shape (num_envs, num_joints).
        sim: The simulator after its substeps.
        state: The worlds, as they were before this step; only read.
        out: What the step gives back. ``term`` is written from column ``NUM_COLUMNS`` on, ``tracking`` in column
            ``GROUP``, ``obs`` at ``arm.obs_start``.
        error: Distance of the end effector from its goal [m], float32, shape (num_envs,). Written.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require_axes("action", action, 2)
    require("action", action, dtype=wp.float32)
    n, num_joints = action.shape
    require_arm(arm, heights, num_joints, action)
    for name, width in (("qpos", 7 + num_joints), ("qvel", 6 + num_joints), ("torque", num_joints)):
        require(f"sim.{name}", getattr(sim, name), dtype=wp.float32, shape=(n, width), like=action)
    require("sim.overflow", sim.overflow, dtype=wp.int32, shape=(n,), like=action)
    require("state.goal", state.goal, dtype=wp.float32, shape=(n, GOAL_COMPONENT + 3), like=action)
    require_state(state, n, num_joints, action)
    require("out.obs", out.obs, dtype=wp.float32, shape=(n, max(out.obs.shape[1], arm.obs_start + 3)), like=action)
    require("out.term", out.term, dtype=wp.float32, shape=(n, NUM_COLUMNS + len(ARM_TERMS)), like=action)
    require("out.tracking", out.tracking, dtype=wp.float32, shape=(n, GROUP + 1), like=action)
    require("error", error, dtype=wp.float32, shape=(n,), like=action)
    num_threads = 1 if action.device.is_cpu else n
    wp.launch(
        _judge_arms,
        dim=num_threads,
        inputs=[params, arm, heights, num_threads, action, sim, state],
        outputs=[out, error],
        device=action.device,
    )


@wp.kernel
def _reset_arms(
    # In
    params: LocomotionParams,
    arm: Arm,
    heights: wp.array2d[float],
    mask: wp.array[wp.bool],
    goal_range: wp.array[float],
    goal_scale: wp.array[float],
    qpos: wp.array2d[float],
    # In and out
    state: LocomotionState,
    obs: wp.array2d[float],
    # Out
    error: wp.array[float],
):
    env = wp.tid()
    if not mask[env]:
        return
    goal = draw_again(
        params, arm, heights, find_spot(params, arm, heights, qpos, env), wp.static(int(Purpose.FIRST_GOAL)),
        params.world_offset + env, state.episode_count[env] - 1, 0, goal_range, goal_in_force(state, env),
    )  # fmt: skip
    for i in range(3):
        state.goal[env, wp.static(GOAL_COMPONENT) + i] = goal[i]
    write_goal(env, state.goal, goal_scale, obs)
    place = place_of_end_effector(params, arm, heights, qpos, env)
    write_end_effector(arm, goal_of_place(place), env, obs)
    error[env] = wp.length(place - place_of_goal(goal))


def reset_arms(
    params: LocomotionParams,
    arm: Arm,
    heights: wp.array,
    mask: wp.array,
    goal_range: wp.array,
    goal_scale: wp.array,
    qpos: wp.array,
    state: LocomotionState,
    obs: wp.array,
    error: wp.array,
) -> None:
    """Finish what ``reset_worlds`` has begun in every world of ``mask``: a valid first goal, the arm's observation.

    Args:
        params: What all worlds share.
        arm: The arm.
        heights: The height grid [m], float32, shape (nx, ny).
        mask: Worlds that were reset, bool, shape (num_envs,).
        goal_range: Half side of the box of first goals along every component, float32, shape (goal_dim,).
        goal_scale: What the policy sees goals multiplied by, float32, shape (goal_dim,).
        qpos: Positions, float32, shape (num_envs, 7 + num_joints).
        state: The worlds. Their goals are updated where ``mask`` is true.
        obs: Observations, float32, shape (num_envs, obs_dim). Likewise.
        error: Distance of the end effector from its goal [m], float32, shape (num_envs,). Likewise.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("mask", mask, dtype=wp.bool)
    n = mask.shape[0]
    require_axes("qpos", qpos, 2)
    require("qpos", qpos, dtype=wp.float32, shape=(n, qpos.shape[1]), like=mask)
    require_arm(arm, heights, qpos.shape[1] - 7, mask)
    require("goal_range", goal_range, dtype=wp.float32, shape=(GOAL_COMPONENT + 3,), like=mask)
    require("goal_scale", goal_scale, like=goal_range)
    require("state.goal", state.goal, dtype=wp.float32, shape=(n, GOAL_COMPONENT + 3), like=mask)
    require_state(state, n, qpos.shape[1] - 7, mask)
    require_obs("obs", obs, state, mask)
    require("obs", obs, dtype=wp.float32, shape=(n, max(obs.shape[1], arm.obs_start + 3)), like=mask)
    require("error", error, dtype=wp.float32, shape=(n,), like=mask)
    wp.launch(
        _reset_arms,
        dim=n,
        inputs=[params, arm, heights, mask, goal_range, goal_scale, qpos],
        outputs=[state, obs, error],
        device=mask.device,
    )
