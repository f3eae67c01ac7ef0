"""What every environment shares about goals: their clocks and their uniform candidates."""

import warp as wp

from kernels.check import require, require_axes
from kernels.random import Purpose, uniform4

wp.set_module_options({"enable_backward": False})


@wp.func
def goal_is_due(goal_clock: int, goal_period: int) -> wp.bool:
    """True when a goal has been in force for its whole period (T steps)."""
    return goal_clock >= goal_period


@wp.func
def time_is_up(episode_step: int, time_limit: int) -> wp.bool:
    """True when an episode has reached its time limit; a limit of 0 never comes."""
    return time_limit > 0 and episode_step >= time_limit


@wp.func
def count_events(goal_due: wp.bool, done: wp.bool, count: wp.array[int]):
    """Add one world's events to ``count``: [goal due and not done, done].

    The host reads these two numbers once per step; they size everything that follows, so that
    nothing else of the step has to wait for the device.
    """
    if done:
        wp.atomic_add(count, 1, 1)
    elif goal_due:
        wp.atomic_add(count, 0, 1)


@wp.kernel
def _draw_candidates(
    # In
    seed: wp.uint32,
    world_offset: int,
    row: wp.array[int],
    goal_count: wp.array[int],
    scale: wp.array[float],
    # Out
    candidate: wp.array3d[float],
):
    i, k = wp.tid()
    env = row[i]
    goal_dim = candidate.shape[2]
    for block in range((goal_dim + 3) // 4):
        u = uniform4(seed, wp.static(int(Purpose.CANDIDATE)), world_offset + env, goal_count[env], k, block)
        for lane in range(4):
            component = 4 * block + lane
            if component < goal_dim:
                candidate[i, k, component] = (2.0 * u[lane] - 1.0) * scale[component]


def draw_candidates(
    row: wp.array,
    goal_count: wp.array,
    scale: wp.array,
    candidate: wp.array,
    *,
    seed: int,
    world_offset: int,
    record: bool = False,
) -> wp.Launch | None:
    """Draw independent candidate goals, uniform in a box, for every listed world.

    Candidate k of a world's i-th goal depends on (seed, world, i, k) alone: asking for fewer
    candidates gives the first ones of a longer list.

    Args:
        row: Worlds that need a goal, int32, shape (n,), each in [0, num_envs).
        goal_count: Goals that each world has received so far, int32, shape (num_envs,).
        scale: Half side of the box along every component, float32, shape (goal_dim,).
        candidate: Candidates in [-scale, scale), float32, shape (n, count, goal_dim). Written.
        seed: Seed of the run, in [0, 2^32).
        world_offset: Global number of world 0, at least 0.
        record: Return the launch, to be replayed with ``launch()``, instead of making it.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("row", row, dtype=wp.int32)
    require_axes("candidate", candidate, 3)
    require("goal_count", goal_count, dtype=wp.int32, shape=goal_count.shape, like=row)
    require("scale", scale, dtype=wp.float32, shape=candidate.shape[2:], like=row)
    require("candidate", candidate, dtype=wp.float32, shape=(*row.shape, *candidate.shape[1:]), like=row)
    return wp.launch(
        _draw_candidates,
        dim=candidate.shape[:2],
        inputs=[wp.uint32(seed), world_offset, row, goal_count, scale],
        outputs=[candidate],
        device=row.device,
        record_cmd=record,
    )
