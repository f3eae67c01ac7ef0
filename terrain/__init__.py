"""Terrain for the legged robots; imports NumPy, trimesh and Warp only.

A shape builds a triangle mesh, a grid lays tiles of many shapes out, and the whole mesh becomes one height grid::

    ground = terrain.rough(seed=1)  # Legged Gym's grid with steps that a Go1 can climb
    ground = terrain.build(terrain.preset("legged-gym", levels=5))
    ground = terrain.build(terrain.read_grid("my.toml"))
"""

from terrain.grid import Terrain, flat
from terrain.presets import preset, read_grid
from terrain.world import Grid, Share, build

load = Terrain.load

__all__ = ["Grid", "Share", "Terrain", "build", "flat", "load", "preset", "read_grid", "rough"]


def rough(
    seed: int = 0, levels: int = 10, columns: int = 20, *, cell: float = 0.05, border: float = 5.0, device: str = "cpu"
) -> Terrain:
    """Legged Gym's grid of slopes, stairs and rectangles of rising difficulty, with steps that a Go1 can climb.

    Args:
        seed: Seed of all tiles, at least 0.
        levels: Tiles along x, from the easiest to the hardest, at least 1.
        columns: Tiles along y, at least 1.
        cell: Distance of two samples of the height grid [m]; must divide the tile of 8 m and the border.
        border: Width of the level border [m], at least 0.
        device: Warp device that rasterises the mesh.

    Raises:
        ValueError: If an argument is out of its range, or the grid would not fit into memory.
    """
    grid = preset("go1", seed=seed, levels=levels, columns=columns, cell=cell, border=border)
    return build(grid, device=device)
