"""A height grid as the ground of a MuJoCo model."""

from typing import TYPE_CHECKING

import numpy as np

from deimos.checks import check_positive
from deimos.terrain.grid import check_heights

if TYPE_CHECKING:
    from mujoco import MjsGeom, MjSpec

BASE = 1.0  # [m] of solid ground below the lowest sample, so that nothing fast passes through


def add_height_field(
    spec: "MjSpec",
    heights: np.ndarray,
    cell: float,
    corner: tuple[float, float],
    *,
    name: str = "ground",
    base: float = BASE,
) -> "MjsGeom":
    """Add one height-field geom to the world of a model that is being built.

    MuJoCo stores a height field as numbers in [0, 1] times its extent, with rows along y; it scales what
    it is given by its own range. The geom is placed and scaled so that its surface passes through the
    samples, to float32's accuracy. Between them it is made of two triangles per cell.

    Args:
        spec: The model. Gets a height field and a geom of the world body, both called ``name``.
        heights: Ground at (corner[0] + i * cell, corner[1] + j * cell) [m], shape (nx, ny), at least 2 x 2, finite.
        cell: Distance of two samples [m], positive.
        corner: World x and y of ``heights[0, 0]`` [m].
        name: Name of the height field and of the geom.
        base: Thickness of the ground below its lowest sample [m], positive.

    Returns:
        The geom, for its friction, its contact masks and its looks.

    Raises:
        ValueError: If an argument is out of its range.
    """
    import mujoco

    check_positive("cell", cell, finite=True)
    check_positive("base", base, finite=True)
    heights = np.asarray(heights, np.float64)
    check_heights(heights)
    nx, ny = heights.shape
    low, extent = float(heights.min()), float(np.ptp(heights))
    shares = (heights - low) / extent if extent > 0 else np.zeros_like(heights)
    half_x, half_y = (nx - 1) * cell / 2, (ny - 1) * cell / 2
    spec.add_hfield(
        name=name,
        nrow=ny,
        ncol=nx,
        userdata=shares.T.reshape(-1).astype(np.float32),
        # MuJoCo refuses an extent of 0; the shares of level ground are 0 for any.
        size=[half_x, half_y, extent or 1.0, base],
    )
    return spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname=name,
        pos=[corner[0] + half_x, corner[1] + half_y, low],
    )
