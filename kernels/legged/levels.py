"""Levels of the legged robots' terrain: robots that do well go to harder tiles, others to easier ones.

An episode's worth is a number in [0, 1]: the mean linear tracking, or, by the rule of displacements, the mean over the
episode's goals of how well the robot's displacement agrees with that of the commanded path (the smaller of the two over
the larger). The path of a goal (v_x, v_y, w) is an arc if yaw is asked for; in t seconds it leads |v| t away if w = 0,
and |v| |2 sin(w t / 2) / w| otherwise. Goals that lead less than ``SHORTEST`` away do not count. (Legged Gym compares
with half of the straight distance that the last goal would ask for in a whole episode: a robot that walks in circles,
as commanded, goes down.)
"""

import warp as wp

from ..episodes import Worlds
from ..random import Purpose, uniform4
from .state import Ground, LeggedWorlds, LevelRule, LocomotionParams, LocomotionState, Simulation

wp.set_module_options({"enable_backward": False})

PROMOTED, DEMOTED = 0.8, 0.5  # worth of an episode from which it raises a world's level, and below which it lowers it
SHORTEST = 0.3  # [m], least displacement that counts
STRAIGHT = 1.0e-3  # [rad]; a smaller arc is a line


@wp.func
def commanded_displacement(goal: wp.vec3, time: float) -> float:
    """Distance between the ends of the path of a goal (v_x, v_y, yaw rate) after some time [s]."""
    speed = wp.sqrt(goal[0] * goal[0] + goal[1] * goal[1])
    half_turn = 0.5 * goal[2] * time
    if wp.abs(half_turn) < wp.static(STRAIGHT):
        return speed * time
    return speed * time * wp.abs(wp.sin(half_turn) / half_turn)


@wp.func
def begin_path(env: int, worlds: Worlds, sim: Simulation, state: LocomotionState):
    """Remember where an episode's first goal began, and forget the episode before."""
    state.goal_start[env] = wp.vec3(sim.qpos[env, 0], sim.qpos[env, 1], float(worlds.goal_clock[env]))
    state.progress[env] = wp.vec4(0.0)


@wp.func
def follow_path(env: int, worlds: Worlds, params: LocomotionParams, sim: Simulation, state: LocomotionState):
    """Compare a robot's displacement under its goal with that of the path; before the clock of the goal moves on.

    A goal begins where its first step ends: nothing here runs between two steps.
    """
    progress = state.progress[env]  # agreement of this goal, 1 if it counts, and the sums of both over those before
    clock = worlds.goal_clock[env] + 1
    if clock == 1:
        state.goal_start[env] = wp.vec3(sim.qpos[env, 0], sim.qpos[env, 1], 1.0)
        state.progress[env] = wp.vec4(0.0, 0.0, progress[2] + progress[0], progress[3] + progress[1])
        return
    start = state.goal_start[env]
    goal = wp.vec3(worlds.goal[env, 0], worlds.goal[env, 1], worlds.goal[env, 2])
    wanted = commanded_displacement(goal, (float(clock) - start[2]) * params.dt)
    found = wp.length(wp.vec2(sim.qpos[env, 0] - start[0], sim.qpos[env, 1] - start[1]))
    agreement = float(0.0)
    counts = float(0.0)
    if wanted >= wp.static(SHORTEST):
        agreement = wp.min(found, wanted) / wp.max(found, wanted)
        counts = 1.0
    state.progress[env] = wp.vec4(agreement, counts, progress[2], progress[3])


@wp.func
def change_of_level(crashed: wp.bool, worth: float) -> int:
    """By how much an episode that was worth so much, or ended in a crash, moves its world's level: 1, 0 or -1."""
    if crashed or worth < wp.static(DEMOTED):
        return -1
    if worth >= wp.static(PROMOTED):
        return 1
    return 0


@wp.func
def next_level(
    worlds: Worlds, params: LocomotionParams, num_levels: int, num_columns: int, state: LocomotionState, env: int
) -> int:
    """The level that a world's next episode is played on.

    A reset in the middle of an episode, or of an invalid world, says nothing about how it went: the level stays. So
    does an episode without a goal that counts, unless it ended in a crash.
    """
    world = worlds.world_offset + env
    episode = worlds.episode_count[env]
    if params.level_rule == wp.static(int(LevelRule.FROZEN)):
        return (world // num_columns) % num_levels
    u = uniform4(worlds.seed, wp.static(int(Purpose.LEVEL)), world, episode, 0, 0)
    if episode == 0:
        return int(u[0] * float(wp.min(params.start_levels, num_levels)))
    level = state.level[env]
    crashed = worlds.terminated[env]
    if worlds.invalid[env] or not (crashed or worlds.truncated[env]):
        return level
    seen = state.tracked[env]
    if params.level_rule == wp.static(int(LevelRule.DISPLACEMENT)):
        progress = state.progress[env]
        seen = wp.vec2(progress[0] + progress[2], progress[1] + progress[3])
    if seen[1] == 0.0 and not crashed:
        return level
    level += change_of_level(crashed, seen[0] / wp.max(seen[1], 1.0))
    if level >= num_levels:  # who has passed the last level is not kept there
        return wp.min(int(u[0] * float(num_levels)), num_levels - 1)
    return wp.max(level, 0)


@wp.kernel
def _update_levels(
    # In
    worlds: Worlds,
    params: LocomotionParams,
    ground: Ground,
    # In and out
    state: LocomotionState,
):
    env = wp.tid()
    if worlds.mask[env]:
        state.level[env] = next_level(worlds, params, ground.origin.shape[0], ground.origin.shape[1], state, env)


def update_levels(legged: LeggedWorlds) -> None:
    """Give every world of ``worlds.mask`` the level due to its last episode; call it before anything is reset.

    Worlds whose last step did not end the episode, or was not physical, keep their level.
    """
    legged.launch(_update_levels, legged.worlds.num_envs, legged.ground, legged.state)
