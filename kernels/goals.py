"""Uniform candidates for goals."""

from typing import Any

import warp as wp

from .check import require, require_axes
from .lanes import WORDS, lanes, threads
from .random import Purpose, philox_lanes, unit

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _draw_candidates(
    # In
    lanes: Any,
    seed: wp.uint32,
    world_offset: int,
    row: wp.array[int],
    goal_count: wp.array[int],
    scale: wp.array[float],
    # Out
    candidate: wp.array3d[float],
):
    i, part = wp.tid()
    env = row[i]
    first = part * len(lanes)
    goal_dim = candidate.shape[2]
    index = type(lanes)()
    for lane in range(len(lanes)):
        index[lane] = wp.uint32(first + lane)
    for block in range((goal_dim + 3) // 4):
        x0, x1, x2, x3 = philox_lanes(
            type(lanes)(wp.uint32(world_offset + env)), type(lanes)(wp.uint32(goal_count[env])), index,
            type(lanes)(wp.uint32(block)), seed, wp.uint32(wp.static(int(Purpose.CANDIDATE))),
        )  # fmt: skip
        d = 4 * block
        for lane in range(len(lanes)):
            k = first + lane
            if k < candidate.shape[1]:
                candidate[i, k, d] = (2.0 * unit(x0[lane]) - 1.0) * scale[d]
                if d + 1 < goal_dim:
                    candidate[i, k, d + 1] = (2.0 * unit(x1[lane]) - 1.0) * scale[d + 1]
                if d + 2 < goal_dim:
                    candidate[i, k, d + 2] = (2.0 * unit(x2[lane]) - 1.0) * scale[d + 2]
                if d + 3 < goal_dim:
                    candidate[i, k, d + 3] = (2.0 * unit(x3[lane]) - 1.0) * scale[d + 3]


for _words in WORDS.values():
    wp.overload(_draw_candidates, {"lanes": _words})


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
        record: Return the launch, to be replayed with ``launch()``, instead of making it. For other rows, change the
            first axis of its threads alone: on a CPU one of the second draws many candidates.

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
        dim=threads(*candidate.shape[:2], row.device),
        inputs=[WORDS[lanes(candidate.shape[1], row.device)](), wp.uint32(seed), world_offset, row, goal_count, scale],
        outputs=[candidate],
        device=row.device,
        record_cmd=record,
    )
