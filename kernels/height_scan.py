"""Heights of the ground around a robot, looked up in the height grid that it stands on."""

import math
from typing import Literal

import numpy as np
import warp as wp

from kernels.check import require, require_axes
from kernels.rotations import heading, rotate_by_heading

wp.set_module_options({"enable_backward": False})


@wp.func
def cell_below(u: float, last: int) -> int:
    """The cell that holds ``u``, which counts in cells, from 0 to ``last``; beyond the grid the nearest, 0 for NaN."""
    if u > 0.0:
        return int(wp.min(u, float(last)))
    return 0


@wp.func
def share_of_cell(u: float, cell: int) -> float:
    """Where in its cell ``u`` is, in [0, 1]."""
    return wp.min(wp.max(u - float(cell), 0.0), 1.0)


@wp.func
def sample_height(heights: wp.array2d[float], cell: float, corner: wp.vec2, x: float, y: float) -> float:
    """Ground at the world position (x, y) [m], bilinear; beyond the grid as on its edge, NaN for NaN."""
    if x != x or y != y:
        return x + y
    u = (x - corner[0]) / cell
    v = (y - corner[1]) / cell
    i = cell_below(u, heights.shape[0] - 2)
    j = cell_below(v, heights.shape[1] - 2)
    s = share_of_cell(u, i)
    t = share_of_cell(v, j)
    near = heights[i, j] + t * (heights[i, j + 1] - heights[i, j])
    far = heights[i + 1, j] + t * (heights[i + 1, j + 1] - heights[i + 1, j])
    return near + s * (far - near)


@wp.func
def sample_minimum(heights: wp.array2d[float], cell: float, corner: wp.vec2, x: float, y: float) -> float:
    """Least of the samples (i, j), (i + 1, j) and (i, j + 1) of the cell that holds (x, y) [m]; NaN for NaN.

    Legged Gym's rule: it sees the foot of a riser up to a cell too early, never an edge that is not there.
    """
    if x != x or y != y:
        return x + y
    i = cell_below((x - corner[0]) / cell, heights.shape[0] - 2)
    j = cell_below((y - corner[1]) / cell, heights.shape[1] - 2)
    return wp.min(wp.min(heights[i, j], heights[i + 1, j]), heights[i, j + 1])


@wp.kernel
def _scan_heights(
    # In
    heights: wp.array2d[float],
    cell: float,
    corner: wp.vec2,
    position: wp.array[wp.vec3],
    quaternion: wp.array[wp.vec4],
    point: wp.array[wp.vec2],
    minimum: wp.bool,
    env_stride: int,
    point_stride: int,
    # Out
    out: wp.array2d[float],
):
    # On a GPU each thread has one point; on a CPU one thread has them all, and turns each robot once.
    first_env, first_point = wp.tid()
    for env in range(first_env, position.shape[0], env_stride):
        base = position[env]
        direction = heading(quaternion[env])
        for k in range(first_point, point.shape[0], point_stride):
            offset = rotate_by_heading(direction, point[k][0], point[k][1])
            x = base[0] + offset[0]
            y = base[1] + offset[1]
            if minimum:
                out[env, k] = sample_minimum(heights, cell, corner, x, y)
            else:
                out[env, k] = sample_height(heights, cell, corner, x, y)


def scan_heights(
    heights: wp.array,
    cell: float,
    corner: tuple[float, float],
    position: wp.array,
    quaternion: wp.array,
    points: wp.array,
    out: wp.array,
    *,
    rule: Literal["bilinear", "minimum"] = "bilinear",
    record: bool = False,
) -> wp.Launch | None:
    """Look up the ground under a grid of points around every robot, turned with its yaw alone.

    Beyond the height grid the ground goes on as at its edge. A NaN position gives NaN.

    Args:
        heights: Ground at (corner[0] + i * cell, corner[1] + j * cell) [m], float32, shape (nx, ny), at least 2 x 2.
        cell: Distance of two samples [m], positive.
        corner: World x and y of ``heights[0, 0]`` [m].
        position: World positions [m], vec3, shape (num_envs,).
        quaternion: Orientations, MuJoCo's unit quaternions (w, x, y, z), vec4, shape (num_envs,).
        points: Points in the frame of the robot's yaw [m], vec2, shape (num_points,).
        out: Heights of the ground in the world [m], float32, shape (num_envs, num_points). Written.
        rule: ``bilinear`` interpolates; ``minimum`` is Legged Gym's least of three neighbours [1]_.
        record: Return the launch, to be replayed with ``launch()``, instead of making it.

    Raises:
        ValueError: If a number is out of its range, or an array has another shape, dtype or device.

    References:
        .. [1] Rudin et al., *Learning to Walk in Minutes Using Massively Parallel Deep Reinforcement Learning*,
           CoRL 2021, and its program ``legged_gym``.
    """
    if not 0.0 < cell < math.inf:
        raise ValueError(f"cell must be finite and positive, got {cell}.")
    if rule not in ("bilinear", "minimum"):
        raise ValueError(f"rule must be bilinear or minimum, got '{rule}'.")
    require("position", position, dtype=wp.vec3)
    require("quaternion", quaternion, dtype=wp.vec4, like=position)
    require("heights", heights, dtype=wp.float32, shape=heights.shape, like=position)
    require_axes("heights", heights, 2)
    if min(heights.shape) < 2:
        raise ValueError(f"heights must have at least 2 x 2 samples, got the shape {heights.shape}.")
    require("points", points, dtype=wp.vec2, shape=points.shape, like=position)
    require_axes("points", points, 1)
    require("out", out, dtype=wp.float32, shape=(position.shape[0], points.shape[0]), like=position)
    threads = (1, 1) if position.device.is_cpu else out.shape
    return wp.launch(
        _scan_heights,
        dim=threads,
        inputs=[heights, cell, wp.vec2(*corner), position, quaternion, points, rule == "minimum", *threads],
        outputs=[out],
        device=position.device,
        record_cmd=record,
    )


def scan_points(length: float = 1.6, width: float = 1.0, spacing: float = 0.1) -> np.ndarray:
    """Legged Gym's points: a rectangle around the robot, x in the outer loop.

    Args:
        length: Extent along x [m], a multiple of ``spacing``.
        width: Extent along y [m], a multiple of ``spacing``.
        spacing: Distance of two points [m], positive.

    Returns:
        Points in the frame of the robot's yaw [m], float32, shape (num_points, 2); (187, 2) by default.
    """
    along, across = round(length / spacing), round(width / spacing)
    x = (np.arange(along + 1) - along / 2) * spacing
    y = (np.arange(across + 1) - across / 2) * spacing
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.float32)
