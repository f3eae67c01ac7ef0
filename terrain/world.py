"""The layout of a world and how it is built: shapes, tiles, one mesh, one height grid."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from deimos.kernels.ray_cast import LARGEST

from deimos.checks import check_at_least, check_positive, check_range

from . import catalog
from .grid import Terrain, cells, on_ground
from .heightfield import rasterise
from .mesh import Mesh, from_quads, from_triangles, take_apart
from .shape import TileShape

Progress = Callable[[str, float], None]
"""Called with the current stage and the share of it that is done, in [0, 1]."""

BYTES_PER_SAMPLE = 12  # measured: 5 while a terrain is made, checked and saved, 9 while its files are written
BYTES_PER_TILE = 5 * 2**20  # measured: 4.5 MiB for the finest stepping stones, less for all else


@dataclass(frozen=True, kw_only=True)
class Share:
    """A shape and its share of the world."""

    shape: TileShape
    """The ground of the columns; its ``tile`` is that of the grid."""
    share: float = 1.0
    """Share of the columns, positive; relative to the sum of all."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Tiles of rising difficulty along x (levels), a column for each shape along y, and a flat border around."""

    shapes: tuple[Share, ...]
    """Shapes of the columns, in order, at least one."""
    levels: int = 10
    """Tiles along x, at least 1."""
    columns: int = 20
    """Tiles along y, at least 1."""
    tile: float = 8.0
    """Side of a tile [m], positive."""
    border: float = 25.0
    """Width of the flat border [m], at least 0."""
    cell: float = 0.05
    """Distance between samples of the height grid [m]; must divide tile and border."""
    easiest: float = 0.0
    """Difficulty of the first level, in [0, 1]."""
    hardest: float = 0.9
    """Difficulty of the last level, in [0, 1]; a single level has that of the first."""
    max_step: float = np.inf
    """Highest step that any shape may have at any level [m], at least 0."""
    seed: int = 0
    """Seed of every tile, at least 0."""

    def __post_init__(self) -> None:
        check_at_least("levels", self.levels, 1)
        check_at_least("columns", self.columns, 1)
        check_at_least("seed", self.seed, 0)
        check_positive("tile", self.tile, finite=True)
        check_range("border", self.border, 0, 1e6)
        check_range("easiest", self.easiest, 0, 1)
        check_range("hardest", self.hardest, 0, 1)
        if self.levels > 1 and self.hardest < self.easiest:  # robots that do well would be moved to easier tiles
            raise ValueError(f"hardest must be at least easiest = {self.easiest:g}, got {self.hardest:g}.")
        check_range("max_step", self.max_step, 0, np.inf)
        cells("tile", self.tile, self.cell)
        cells("border", self.border, self.cell)
        if not self.shapes:
            raise ValueError("shapes must have at least one entry.")
        for part in self.shapes:
            check_positive("share", part.share, finite=True)
        levels = np.linspace(self.easiest, self.hardest, self.levels)
        for shape in self.column_shapes:
            difficulty = max(levels, key=shape.step)
            if shape.step(difficulty) > self.max_step + 1e-9:
                raise ValueError(
                    f"max_step is {self.max_step:g} m, but {catalog.name_of(shape)} at difficulty {difficulty:g} has "
                    f"steps of {shape.step(difficulty):g} m; lower them or raise max_step."
                )

    @property
    def column_shapes(self) -> tuple[TileShape, ...]:
        """The shape of each column: column j has the shape at j / columns + 0.001 of the summed shares."""
        ends = np.cumsum([part.share for part in self.shapes])
        # The small shift is Legged Gym's: sums of shares such as 0.1 + 0.2 are not exact.
        choice = np.arange(self.columns) / self.columns + 0.001
        which = np.minimum(np.searchsorted(ends / ends[-1], choice, side="right"), len(ends) - 1)
        return tuple(_on_tile(self.shapes[k].shape, self.tile) for k in which)

    @property
    def difficulty(self) -> np.ndarray:
        """Difficulty of each level, float32, shape (levels,)."""
        return np.linspace(self.easiest, self.hardest, self.levels, dtype=np.float32)

    @property
    def corner(self) -> tuple[float, float]:
        """World x and y of the first sample [m]; the tiles are around the origin."""
        return -self.levels * self.tile / 2 - self.border, -self.columns * self.tile / 2 - self.border

    @property
    def num_samples(self) -> tuple[int, int]:
        """Samples of the height grid along x and y."""
        tile, border = cells("tile", self.tile, self.cell), cells("border", self.border, self.cell)
        return self.levels * tile + 2 * border + 1, self.columns * tile + 2 * border + 1

    @property
    def memory(self) -> int:
        """Approximate memory that building takes [B]."""
        nx, ny = self.num_samples
        return BYTES_PER_SAMPLE * nx * ny + BYTES_PER_TILE * self.levels * self.columns

    @property
    def centres(self) -> np.ndarray:
        """Middle of each tile at height 0 [m], shape (levels, columns, 3)."""
        level, column = np.indices((self.levels, self.columns))
        x = (level + 0.5 - self.levels / 2) * self.tile
        y = (column + 0.5 - self.columns / 2) * self.tile
        return np.stack([x, y, np.zeros_like(x)], axis=-1)


def _on_tile(shape: TileShape, tile: float) -> TileShape:
    """A shape on a tile with another side [m]; an error names the shape."""
    try:
        return replace(shape, tile=tile)
    except ValueError as error:
        raise ValueError(f"{catalog.name_of(shape)}: {error}") from error


def build(grid: Grid, *, device: str = "cpu", progress: Progress | None = None) -> Terrain:
    """Make a world; see ``build_with_mesh``."""
    terrain, mesh = build_with_mesh(grid, device=device, progress=progress)
    take_apart(mesh)
    return terrain


def build_with_mesh(grid: Grid, *, device: str = "cpu", progress: Progress | None = None) -> tuple[Terrain, Mesh]:
    """Make a world and the mesh that its height grid is made from.

    The same grid gives the same bytes, on any number of threads.

    Args:
        grid: The layout.
        device: Warp device that rasterises the mesh.
        progress: Called with the stage and the share of it that is done.

    Raises:
        ValueError: If it would not fit into memory.
    """
    require_memory(grid.num_samples, grid.memory, "cell", grid.cell)
    report = progress or (lambda stage, share: None)
    mesh = build_mesh(grid, report)
    heights = rasterise(
        mesh, grid.corner, grid.cell, grid.num_samples, device=device, progress=lambda share: report("rays", share)
    )
    origins = on_ground(grid.centres[..., :2], heights, grid.cell, grid.corner)
    names = tuple(catalog.name_of(shape) for shape in grid.column_shapes)
    return Terrain(heights, grid.cell, grid.corner, origins, names, grid.tile, grid.difficulty), mesh


def build_mesh(grid: Grid, progress: Progress | None = None) -> Mesh:
    """The mesh of a world [m]: all tiles and the border.

    Every tile has its own generator, seeded by (seed, level, column): none depends on another.
    """
    from trimesh.util import append_faces

    parts, centres = [], grid.centres
    for level, difficulty in enumerate(grid.difficulty):
        for column, shape in enumerate(grid.column_shapes):
            seed = np.random.SeedSequence(grid.seed, spawn_key=(level, column))
            vertices, faces = take_apart(shape.build(float(difficulty), np.random.default_rng(seed)))
            parts.append((vertices + centres[level, column], faces))
        if progress is not None:
            progress("tiles", (level + 1) / grid.levels)
    if grid.border > 0:
        parts.append(take_apart(_border(grid)))
    return from_triangles(*append_faces(*zip(*parts, strict=True)))


def require_memory(num_samples: tuple[int, int], need: int, name: str, cell: float) -> None:
    """Raise ``ValueError`` if a height grid has too many samples, or building it would not fit into memory.

    Args:
        num_samples: Samples along x and y.
        need: Memory that is needed [B].
        name: The caller's name for ``cell``, for the message.
        cell: Distance between samples [m].
    """
    most = max(num_samples) - 1
    if most > LARGEST:
        raise ValueError(
            f"{name} must be at least {cell * most / LARGEST:.3g} m for at most {LARGEST} cells along an axis, "
            f"got {cell:g} m, which makes {most}."
        )
    free = _free_memory()
    if need > free:
        nx, ny = num_samples
        raise ValueError(
            f"The grid of {nx} x {ny} samples needs about {need / 2**30:.1f} GiB of memory, but "
            f"{free / 2**30:.1f} GiB are free; enlarge {name}, or ask for less ground."
        )


def _free_memory() -> float:
    """Memory that a program can still get [B]; infinite where the system does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            return next(1024 * int(line.split()[1]) for line in file if line.startswith("MemAvailable"))
    except (OSError, StopIteration):  # not Linux
        sizes = getattr(os, "sysconf_names", {})  # missing on Windows
        if not {"SC_PAGE_SIZE", "SC_PHYS_PAGES"} <= set(sizes):
            return np.inf
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _border(grid: Grid) -> Mesh:
    outer = -np.asarray(grid.corner)
    inner = outer - grid.border
    ring = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    far, near = ring * [*outer, 0], ring * [*inner, 0]
    following = [1, 2, 3, 0]
    return from_quads(np.stack([far, far[following], near[following], near], axis=1))
