"""The ground of one world: tiles of rising level along x, a column for each shape along y, as one height grid."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from deimos.checks import check_positive
from deimos.files import UNREADABLE, first_line, load_arrays, write_whole

SCHEMA = 1  # of the file that ``Terrain.save`` writes
FARTHEST = 1e6  # [m] from the origin, and up and down; float32 resolves 6 cm there


@dataclass(frozen=True, eq=False)
class Terrain:
    """The ground of a world, interpolated between the samples of ``heights``."""

    heights: np.ndarray
    """Ground at x = corner[0] + i * cell and y = corner[1] + j * cell [m], float32, shape (nx, ny)."""
    cell: float
    """Distance between samples [m]."""
    corner: tuple[float, float]
    """World x and y of ``heights[0, 0]`` [m]."""
    origins: np.ndarray
    """Where robots start on each tile [m], z being the ground there, float32, shape (levels, columns, 3)."""
    shapes: tuple[str, ...]
    """Name of each column's shape, with its direction, such as ``stairs-up``."""
    tile: float
    """Side of a tile [m]."""
    difficulty: np.ndarray
    """Difficulty of each level, in [0, 1], float32, shape (levels,)."""

    def __post_init__(self) -> None:
        check_heights(self.heights)
        check_positive("cell", self.cell, finite=True)
        check_positive("tile", self.tile, finite=True)
        levels, columns = len(self.difficulty), len(self.shapes)
        shapes = {"origins": (levels, columns, 3), "difficulty": (levels,), "heights": self.heights.shape}
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.dtype != np.float32 or array.shape != shape:
                raise ValueError(f"{name} must be float32 of shape {shape}, got {array.dtype} of shape {array.shape}.")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite everywhere.")

    @property
    def size(self) -> tuple[float, float]:
        """Extent along x and y [m]."""
        nx, ny = self.heights.shape
        return (nx - 1) * self.cell, (ny - 1) * self.cell

    def save(self, path: str | Path) -> None:
        """Write everything to one ``.npz`` file, whole or not at all; equal terrains give equal bytes.

        Raises:
            RunError: If it cannot be written.
        """
        data = {field.name: getattr(self, field.name) for field in fields(self)}
        write_whole(Path(path), lambda file: np.savez_compressed(file, schema=SCHEMA, **data))

    @staticmethod
    def load(path: str | Path) -> "Terrain":
        """Read a file that ``save`` has written.

        Raises:
            OSError: If it cannot be read.
            ValueError: If it is not such a file.
        """
        try:
            data: dict[str, Any] = load_arrays(Path(path))
            if data.pop("schema") != SCHEMA:
                raise ValueError("it has another version")
            data["shapes"] = tuple(str(name) for name in data["shapes"])
            data["corner"] = tuple(float(value) for value in data["corner"])
            return Terrain(**data | {name: float(data[name]) for name in ("cell", "tile")})
        except OSError:
            raise
        except UNREADABLE as error:
            raise ValueError(
                f"{path} is not a terrain file of version {SCHEMA}, or it is broken ({first_line(error)}); "
                "import files of other programs first: deimos terrain import."
            ) from error


def flat(size: float = 8.0, cell: float = 0.05) -> Terrain:
    """A plain of one tile around the origin, at height 0.

    Args:
        size: Side [m], positive.
        cell: Distance between samples [m]; must divide ``size``.

    Raises:
        ValueError: If an argument is out of its range.
    """
    check_positive("size", size, finite=True)
    samples = cells("size", size, cell) + 1
    corner, origins, difficulty = (-size / 2, -size / 2), np.zeros((1, 1, 3), np.float32), np.zeros(1, np.float32)
    return Terrain(np.zeros((samples, samples), np.float32), cell, corner, origins, ("flat",), size, difficulty)


def check_heights(heights: np.ndarray) -> None:
    """Raise ``ValueError`` unless ``heights`` are a grid of at least 2 x 2 finite numbers within ``FARTHEST``."""
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise ValueError(f"heights must have at least 2 x 2 samples, got the shape {heights.shape}.")
    if not -FARTHEST <= heights.min() <= heights.max() <= FARTHEST:  # false for NaN
        raise ValueError(f"heights must be finite everywhere, and within {FARTHEST:g} m up or down.")


def on_ground(middles: np.ndarray, heights: np.ndarray, cell: float, corner: tuple[float, float]) -> np.ndarray:
    """Points on the samples' ground, float32, shape (..., 3), above each x and y [m] of ``middles``, shape (..., 2)."""
    i, j = np.moveaxis(np.rint((middles - corner) / cell).astype(int), -1, 0)
    return np.concatenate([middles, heights[i, j][..., None]], axis=-1).astype(np.float32)


def cells(name: str, length: float, cell: float) -> int:
    """Number of cells along ``length``.

    Raises:
        ValueError: Unless ``cell`` divides ``length``.
    """
    check_positive("cell", cell, finite=True)
    number = round(length / cell)
    if abs(number * cell - length) > 1e-6 * cell:
        nearest = length / max(1, number)
        raise ValueError(f"cell must divide {name} = {length:g} m, got {cell:g} m; {nearest:.6g} m would do.")
    return number


load = Terrain.load
