"""What all environments share, to be inlined into their own kernels: clocks, goals, faults, the end of a step.

A step kernel moves its worlds, rewards and observes them, and calls ``end_step``; a reset kernel places them and calls
``begin_episode``; both call ``write_goal`` for the goal's slot of the observation. Each loops over its worlds::

    for env in range(wp.tid(), worlds.num_envs, worlds.num_threads):

On a GPU each thread then has one world. On a CPU, where Warp copies the arguments again for every thread, one thread
has them all.
"""

from collections.abc import Sequence

import warp as wp

from .check import require
from .lanes import split
from .random import Purpose, uniform4
from .structs import StructTable

wp.set_module_options({"enable_backward": False})

ACTION = 1  # the bit of a cause that says that the action is not finite; an environment's own bits are above it


@wp.struct
class Worlds:
    """What every environment has for its worlds; arrays of shape (num_envs,) unless they say otherwise."""

    num_envs: int
    num_threads: int  # threads that share the worlds
    goal_period: int  # T: steps that a goal is active
    time_limit: int  # steps of an episode, 0 disables the limit
    stagger: wp.bool  # whether the goal clock of a world's first episode starts at a random step
    seed: wp.uint32  # of every draw
    world_offset: int  # global number of world 0
    goal_start: int  # where the goal starts in the observation
    crash_penalty: float  # what a crash takes from the reward of its step, at least 0
    goal_scale: wp.array[float]  # (goal_dim,): factors by which the policy sees goals
    # What the host writes before a launch.
    action: wp.array2d[float]  # (num_envs, action_dim)
    mask: wp.array[wp.bool]  # worlds to reset
    first_range: wp.array[float]  # (goal_dim,): half side of the box that first goals come from
    # All that a bit-exact resume needs.
    goal: wp.array2d[float]  # (num_envs, goal_dim), in physical units
    goal_clock: wp.array[int]  # steps that the goal has been active
    episode_step: wp.array[int]  # steps since the reset
    episode_count: wp.array[int]  # resets so far
    goal_count: wp.array[int]  # goals received so far, without first goals
    obs: wp.array2d[float]  # (num_envs, obs_dim)
    origin: wp.array2d[float]  # (num_envs, goal_dim): what goals are seen relative to; no rows if they are absolute
    # What a step returns.
    reward: wp.array[float]  # against the goal that was active, at least 0 except for the penalty of a crash
    tracking: wp.array2d[float]  # (num_envs, num_groups): how well each group of the goal is met, in [0, 1]
    terminated: wp.array[wp.bool]  # crashed
    truncated: wp.array[wp.bool]  # cut off without a crash
    goal_due: wp.array[wp.bool]  # the goal has been active for its whole period, and the state is valid
    invalid: wp.array[wp.bool]  # the action, the goal or the state is not physical
    fault: wp.array[int]  # (3,): invalid world-steps so far, lowest such world, lowest world with a broken action
    cause: wp.array[int]  # bits of what was wrong with a world when it was last invalid


WORLDS = StructTable(Worlds, {
    "goal_scale": ("goal_dim",), "action": ("num_envs", "action_dim"), "first_range": ("goal_dim",),
    "goal": ("num_envs", "goal_dim"), "obs": ("num_envs", "obs_dim"), "origin": ("num_origins", "goal_dim"),
    "tracking": ("num_envs", "num_groups"), "fault": (3,),
})  # fmt: skip
RESUMED = ("goal", "goal_clock", "episode_step", "episode_count", "goal_count", "obs")  # what a resume needs of Worlds


def make_worlds(
    num_envs: int, device: str, *, obs_dim: int, action_dim: int, goal_start: int, goal_scale: Sequence[float],
    goal_period: int, time_limit: int = 0, stagger: bool = False, seed: int = 0, world_offset: int = 0,
    crash_penalty: float = 0.0, num_groups: int = 0,
) -> Worlds:  # fmt: skip
    """Allocate worlds in which no episode has begun; the arguments are fields of ``Worlds`` and sizes of its arrays."""
    worlds = WORLDS.allocate(
        device, num_envs=num_envs, obs_dim=obs_dim, action_dim=action_dim, goal_dim=len(goal_scale),
        num_groups=num_groups, num_origins=0,
    )  # fmt: skip
    worlds.num_envs = num_envs
    worlds.num_threads = split(num_envs, wp.get_device(device))
    worlds.goal_period, worlds.time_limit, worlds.stagger = goal_period, time_limit, stagger
    worlds.seed, worlds.world_offset, worlds.goal_start = seed, world_offset, goal_start
    worlds.crash_penalty = crash_penalty
    worlds.goal_scale.assign(list(goal_scale))
    worlds.fault.assign([0, num_envs, num_envs])
    return worlds


def record(kernel: wp.Kernel, worlds: Worlds, *inputs: object, dim: int | tuple[int, ...] | None = None) -> wp.Launch:
    """Record a kernel with the arguments ``worlds`` and ``inputs``; over all worlds, or ``dim`` threads."""
    dim = worlds.num_threads if dim is None else dim
    return wp.launch(kernel, dim, inputs=[worlds, *inputs], device=worlds.goal.device, record_cmd=True)


@wp.func
def seen_goal(env: int, k: int, worlds: Worlds) -> float:
    """Component ``k`` of a world's goal as the policy sees it."""
    goal = worlds.goal[env, k]
    if worlds.origin.shape[0] > 0:
        goal -= worlds.origin[env, k]
    return goal * worlds.goal_scale[k]


@wp.func
def write_goal(env: int, worlds: Worlds):
    """Write the goal's slot of a world's observation; after the state that the goal may be relative to."""
    for k in range(worlds.goal.shape[1]):
        worlds.obs[env, worlds.goal_start + k] = seen_goal(env, k, worlds)


@wp.func
def begin_episode(env: int, worlds: Worlds) -> int:
    """Start a world's clocks and give it a uniform first goal; gives the episode's number, the address of its draws."""
    world = worlds.world_offset + env
    episode = worlds.episode_count[env]
    worlds.episode_count[env] = episode + 1
    worlds.episode_step[env] = 0
    clock = int(0)
    if worlds.stagger and episode == 0:
        u = uniform4(worlds.seed, wp.static(int(Purpose.RESET)), world, episode, 1, 0)
        clock = int(u[0] * float(worlds.goal_period))
    worlds.goal_clock[env] = clock
    goal_dim = worlds.goal.shape[1]
    for block in range((goal_dim + 3) // 4):
        u = uniform4(worlds.seed, wp.static(int(Purpose.FIRST_GOAL)), world, episode, 0, block)
        for lane in range(wp.min(4, goal_dim - 4 * block)):
            k = 4 * block + lane
            worlds.goal[env, k] = (2.0 * u[lane] - 1.0) * worlds.first_range[k]
    return episode


@wp.func
def end_step(env: int, crashed: wp.bool, over: wp.bool, cause: int, worlds: Worlds):
    """Advance a world's clocks and write how its step ended: the last thing that a step does with a world.

    The penalty of a crash is subtracted here, from the reward that was written before.

    Args:
        env: The world.
        crashed: Whether it crashed.
        over: Whether its episode is cut off, for a reason other than its time limit.
        cause: Bits of what is not physical (see ``ACTION``), 0 where all is well. Such a world is invalid: it is cut
            off, and no goal falls due in it.
        worlds: All worlds.
    """
    clock = worlds.goal_clock[env] + 1
    age = worlds.episode_step[env] + 1
    worlds.goal_clock[env] = clock
    worlds.episode_step[env] = age
    broken = cause != 0
    cut_off = over or broken or (worlds.time_limit > 0 and age >= worlds.time_limit)
    if crashed:
        worlds.reward[env] = worlds.reward[env] - worlds.crash_penalty
    worlds.terminated[env] = crashed
    worlds.truncated[env] = cut_off and not crashed
    worlds.goal_due[env] = clock >= worlds.goal_period and not broken
    worlds.invalid[env] = broken
    if worlds.origin.shape[0] > 0:
        write_goal(env, worlds)  # the origin has moved
    if broken:
        worlds.cause[env] = cause
        wp.atomic_add(worlds.fault, 0, 1)
        wp.atomic_min(worlds.fault, 1, env)
        if (cause & wp.static(ACTION)) != 0:
            wp.atomic_min(worlds.fault, 2, env)


@wp.kernel
def _set_goals(
    # In and out
    worlds: Worlds,
    # In
    row: wp.array[int],
    goal: wp.array2d[float],
):
    i = wp.tid()
    env = row[i]
    if env < 0 or env >= worlds.goal.shape[0]:
        return
    for k in range(goal.shape[1]):
        target = goal[i, k] / worlds.goal_scale[k]
        if worlds.origin.shape[0] > 0:
            target += worlds.origin[env, k]
        worlds.goal[env, k] = target
    worlds.goal_clock[env] = 0
    worlds.goal_count[env] = worlds.goal_count[env] + 1
    write_goal(env, worlds)


def set_goals(row: wp.array, goal: wp.array, worlds: Worlds) -> wp.Launch:
    """Record a launch that gives the listed worlds new goals, starts their clocks and shows them in the observations.

    Args:
        row: Worlds, int32, shape (n,), each at most once; outside [0, num_envs) for none.
        goal: Goals as the policy sees them, scaled, float32, shape (n, goal_dim).
        worlds: The worlds.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("row", row, dtype=wp.int32, shape=row.shape, like=worlds.goal)
    require("goal", goal, dtype=wp.float32, shape=(*row.shape, *worlds.goal.shape[1:]), like=row)
    return record(_set_goals, worlds, row, goal, dim=len(row))
