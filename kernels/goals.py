"""Uniform candidate goals."""

import warp as wp

from .check import require, require_axes
from .episodes import Worlds, record
from .lanes import WIDE, WORDS, lanes, threads
from .random import Purpose, philox_lanes, unit


def _kernel(size: int, module: str | None) -> wp.Kernel:
    """The kernel whose threads draw ``size`` candidates each, in a separate Warp module or in that of this file."""
    words = WORDS[size]

    @wp.kernel(module=module, enable_backward=False)
    def _draw_candidates(
        # In
        worlds: Worlds,
        row: wp.array[int],
        scale: wp.array[float],
        # Out
        candidate: wp.array3d[float],
    ):
        i, part = wp.tid()
        env = row[i]
        first = part * size
        goal_dim = candidate.shape[2]
        index = words()
        for lane in range(size):
            index[lane] = wp.uint32(first + lane)
        for block in range((goal_dim + 3) // 4):
            x0, x1, x2, x3 = philox_lanes(
                words(wp.uint32(worlds.world_offset + env)), words(wp.uint32(worlds.goal_count[env])), index,
                words(wp.uint32(block)), worlds.seed, wp.uint32(wp.static(int(Purpose.CANDIDATE))),
            )  # fmt: skip
            d = 4 * block
            for lane in range(size):
                k = first + lane
                if k < candidate.shape[1]:
                    candidate[i, k, d] = (2.0 * unit(x0[lane]) - 1.0) * scale[d]
                    if d + 1 < goal_dim:
                        candidate[i, k, d + 1] = (2.0 * unit(x1[lane]) - 1.0) * scale[d + 1]
                    if d + 2 < goal_dim:
                        candidate[i, k, d + 2] = (2.0 * unit(x2[lane]) - 1.0) * scale[d + 2]
                    if d + 3 < goal_dim:
                        candidate[i, k, d + 3] = (2.0 * unit(x3[lane]) - 1.0) * scale[d + 3]

        if worlds.origin.shape[0] > 0:
            for k in range(first, wp.min(first + size, candidate.shape[1])):
                for d in range(goal_dim):
                    candidate[i, k, d] = candidate[i, k, d] - worlds.origin[env, d] * worlds.goal_scale[d]

    return _draw_candidates


# A module is compiled as a whole, and a GPU never launches the wide one.
_draw_candidates, _draw_wide_candidates = _kernel(1, None), _kernel(WIDE, f"{__name__}.wide")


def check_candidates(row: wp.array, scale: wp.array, candidate: wp.array, worlds: Worlds) -> None:
    """Raise ``ValueError`` unless the arrays are as ``draw_candidates`` requires."""
    goal = worlds.goal
    require("row", row, dtype=wp.int32, shape=row.shape, like=goal)
    require("scale", scale, dtype=wp.float32, shape=goal.shape[1:], like=goal)
    require_axes("candidate", candidate, 3)
    require("candidate", candidate, shape=(len(row), candidate.shape[1], goal.shape[1]), like=goal)


def draw_candidates(row: wp.array, scale: wp.array, candidate: wp.array, worlds: Worlds) -> wp.Launch:
    """Record a launch that draws independent candidate goals, uniform in a box, for every listed world.

    Candidate k of a world's i-th goal depends only on (seed, world, i, k), and on the world's origin if goals are
    relative to one: asking for fewer candidates gives the first ones of a longer list.

    Args:
        row: Worlds that need a goal, int32, shape (n,), each in [0, num_envs).
        scale: Half side of the box along every component, as the policy sees it, float32, shape (goal_dim,).
        candidate: Goals as the policy sees them, float32, shape (n, count, goal_dim). Written.
        worlds: The worlds; only read.

    Returns:
        The launch. For other rows, change only the first axis of its threads: on a CPU one of the second draws many
        candidates.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    check_candidates(row, scale, candidate, worlds)
    count = candidate.shape[1]
    kernel = _draw_candidates if lanes(count, row.device) == 1 else _draw_wide_candidates
    return record(kernel, worlds, row, scale, candidate, dim=threads(len(row), count, row.device))
