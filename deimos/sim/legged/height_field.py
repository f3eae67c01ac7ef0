"""A terrain as the ground of a MuJoCo model."""

from typing import TYPE_CHECKING

import numpy as np

from deimos.terrain import Terrain

if TYPE_CHECKING:
    from mujoco import MjsGeom, MjSpec

BASE = 1.0  # [m] of solid ground below the lowest sample, so that nothing fast passes through


def add_height_field(spec: "MjSpec", terrain: Terrain) -> "MjsGeom":
    """Add a height field, and a geom of the world body, both called ``ground``, to a model that is being built.

    MuJoCo stores a height field as numbers in [0, 1] times its extent, with rows along y; it scales what it is given by
    its own range. The geom is placed and scaled so that its surface passes through the samples, to float32's accuracy.
    Between them it is made of two triangles per cell.

    Returns:
        The geom, whose friction, contact masks and appearance the caller sets.
    """
    import mujoco

    heights = terrain.heights.astype(np.float64)
    nx, ny = heights.shape
    low, extent = float(heights.min()), float(np.ptp(heights))
    shares = (heights - low) / (extent or 1.0)  # MuJoCo refuses an extent of 0
    half_x, half_y = (side / 2 for side in terrain.size)
    spec.add_hfield(
        name="ground", nrow=ny, ncol=nx, userdata=shares.T.reshape(-1).astype(np.float32),
        size=[half_x, half_y, extent or 1.0, BASE],
    )  # fmt: skip
    return spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground",
        pos=[terrain.corner[0] + half_x, terrain.corner[1] + half_y, low],
    )  # fmt: skip
