"""Heights of the ground around a robot, looked up in the height grid that it stands on."""

import numpy as np
import warp as wp

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


def scan_points(length: float = 1.6, width: float = 1.0, spacing: float = 0.1) -> np.ndarray:
    """Legged Gym's points: a rectangle around the robot, x in the outer loop.

    Args:
        length: Extent along x [m], a multiple of ``spacing``.
        width: Extent along y [m], a multiple of ``spacing``.
        spacing: Distance between neighbouring points [m], positive.

    Returns:
        Points in the frame of the robot's yaw [m], float32, shape (num_points, 2); (187, 2) by default.
    """
    along, across = round(length / spacing), round(width / spacing)
    x = (np.arange(along + 1) - along / 2) * spacing
    y = (np.arange(across + 1) - across / 2) * spacing
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.float32)
