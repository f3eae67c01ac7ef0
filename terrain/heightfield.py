"""Turns a mesh into a height grid, with one exact vertical ray for every sample."""

from collections.abc import Callable

import numpy as np
import warp as wp
from deimos.kernels.ray_cast import LARGEST, SNAP, cast_rays

from deimos.checks import check_positive

from .mesh import Mesh

STRIP = 2**20  # samples per launch, about 0.2 s on a CPU


def rasterise(
    mesh: Mesh,
    corner: tuple[float, float],
    cell: float,
    shape: tuple[int, int],
    *,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> np.ndarray:
    """Height of the highest face above every sample of a grid, by exact ray casts.

    Vertices are moved to multiples of 1/4096 cell along x and y; rays then miss no face, edge or corner
    (see ``deimos.kernels.ray_cast``). A sample on a riser gets its upper edge: the upper tread keeps its whole depth,
    and the riser is crossed within the first cell of the lower one.

    Args:
        mesh: Ground [m]; must cover the grid.
        corner: World x and y of the first sample [m].
        cell: Distance between samples [m].
        shape: Number of samples along x and y, each from 2 to 16385.
        device: Warp device that casts the rays.
        progress: Called with the share that is done, in (0, 1].

    Returns:
        Heights [m], float32, shape ``shape``.

    Raises:
        ValueError: If an argument is out of its range, or the mesh does not cover the grid.
    """
    check_positive("cell", cell, finite=True)
    if min(shape) < 2 or max(shape) > LARGEST + 1:
        raise ValueError(f"shape must be from 2 to {LARGEST + 1} samples along each axis, got {shape}.")
    vertices = np.array(mesh.vertices)
    if not np.isfinite(vertices).all():
        raise ValueError("mesh must have finite vertices.")
    vertices[:, :2] = np.round((vertices[:, :2] - corner) / cell * SNAP) / SNAP
    low, high = float(vertices[:, 2].min()) - 1.0, float(vertices[:, 2].max()) + 1.0
    ground = wp.Mesh(
        wp.array(vertices.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(np.asarray(mesh.faces, np.int32).reshape(-1), dtype=wp.int32, device=device),
    )
    height = wp.empty(shape, dtype=wp.float32, device=device)
    for first in range(0, height.size, STRIP):
        count = min(STRIP, height.size - first)
        cast_rays(ground, height, low=low, high=high, miss=low, first=first, count=count)
        if progress is not None:
            wp.synchronize_device(device)
            progress((first + count) / height.size)
    result = height.numpy()
    missed = np.argwhere(result <= low)
    if len(missed):
        x, y = np.asarray(corner) + cell * missed[0]
        raise ValueError(f"mesh must cover the grid, but there is nothing above x = {x:g} m, y = {y:g} m.")
    return result
