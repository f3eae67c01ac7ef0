"""Vertical rays through a triangle mesh: the height of its top above every sample of a grid.

Lengths along x and y are in cells here, so a sample is a pair of whole numbers. Where vertices are multiples of
1/4096 cell and within 16384 cells, the products of the test below take at most 53 bits and float64 evaluates it
without rounding: whether a ray meets a triangle, its edges and corners included, is decided exactly, and no ray slips
between two triangles. (A ray that is tested against float32 boxes by division, as in ``wp.mesh_query_ray``, results in
0 x inf on their sides. Here a box without width queries the same search tree, which only compares.)
"""

import warp as wp

from .check import require, require_axes
from .lanes import split

wp.set_module_options({"enable_backward": False})

LARGEST = 2**14  # cells along an axis
SNAP = 2**12  # vertices are multiples of 1 / SNAP cells


@wp.func
def edge_side(a: wp.vec3, b: wp.vec3, x: float, y: float) -> wp.float64:
    """Twice the signed area of a, b and (x, y): positive where the point is to the left of the way from a to b."""
    ax = wp.float64(a[0]) - wp.float64(x)
    ay = wp.float64(a[1]) - wp.float64(y)
    bx = wp.float64(b[0]) - wp.float64(x)
    by = wp.float64(b[1]) - wp.float64(y)
    return ax * by - ay * bx


@wp.func
def top_of_triangle(a: wp.vec3, b: wp.vec3, c: wp.vec3, x: float, y: float, miss: float) -> float:
    """Height of a triangle at (x, y), its edges included, or ``miss`` beside it and where it is upright."""
    u = edge_side(b, c, x, y)
    v = edge_side(c, a, x, y)
    w = edge_side(a, b, x, y)
    zero = wp.float64(0.0)
    area = u + v + w
    inside = (u >= zero and v >= zero and w >= zero) or (u <= zero and v <= zero and w <= zero)
    if area == zero or not inside:
        return miss
    return float((u * wp.float64(a[2]) + v * wp.float64(b[2]) + w * wp.float64(c[2])) / area)


@wp.kernel
def _cast_rays(
    # In
    mesh: wp.uint64,
    low: float,
    high: float,
    miss: float,
    first: int,
    count: int,
    num_threads: int,
    # Out
    height: wp.array2d[float],
):
    points = wp.mesh_get(mesh).points
    indices = wp.mesh_get(mesh).indices
    columns = height.shape[1]
    for k in range(first + wp.tid(), first + count, num_threads):
        i = k // columns
        j = k - i * columns
        x = float(i)
        y = float(j)
        top = miss
        face = int(0)
        query = wp.mesh_query_aabb(mesh, wp.vec3(x, y, low), wp.vec3(x, y, high))
        while wp.mesh_query_aabb_next(query, face):
            a = points[indices[3 * face]]
            b = points[indices[3 * face + 1]]
            c = points[indices[3 * face + 2]]
            top = wp.max(top, top_of_triangle(a, b, c, x, y, miss))
        height[i, j] = top


def cast_rays(
    mesh: wp.Mesh, height: wp.array, *, low: float, high: float, miss: float, first: int = 0, count: int | None = None
) -> None:
    """Write the height of the highest face of a mesh above every sample (i, j) of a grid.

    Edges and corners belong to their faces; upright faces only count through the faces that they join.

    Args:
        mesh: Triangles; x and y in cells, multiples of 1 / ``SNAP`` in [-``LARGEST``, ``LARGEST``] for exactness.
        height: Heights, float32, shape (nx, ny), each axis at most ``LARGEST`` + 1. Written.
        low: A height below the whole mesh.
        high: A height above the whole mesh.
        miss: The result of a ray that meets nothing, at most ``low``.
        first: First sample to write, in rows of y, at least 0.
        count: Samples to write; ``None`` for all that follow.

    Raises:
        ValueError: If an argument is out of its range, or an array has another dtype or device.
    """
    require("mesh.points", mesh.points, dtype=wp.vec3)
    require("height", height, dtype=wp.float32, shape=height.shape, like=mesh.points)
    require_axes("height", height, 2)
    if not 1 <= min(height.shape) <= max(height.shape) <= LARGEST + 1:
        raise ValueError(f"height must have from 1 to {LARGEST + 1} samples along each axis, got {height.shape}.")
    if not miss <= low < high:
        raise ValueError(f"miss, low and high must rise, got {miss}, {low} and {high}.")
    count = height.size - first if count is None else count
    if not 0 <= first <= first + count <= height.size:
        raise ValueError(f"first and count must stay within {height.size} samples, got {first} and {count}.")
    num_threads = split(count, height.device)
    wp.launch(
        _cast_rays,
        dim=num_threads,
        inputs=[mesh.id, low, high, miss, first, count, num_threads],
        outputs=[height],
        device=height.device,
    )
