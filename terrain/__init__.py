"""Terrain for the legged robots; imports NumPy, trimesh and Warp only.

A shape builds a triangle mesh, a grid lays out tiles of many shapes, and the whole mesh becomes one height grid::

    ground = terrain.rough(seed=1)  # Legged Gym's grid with steps that a Go1 can climb
    ground = terrain.build(terrain.preset("legged-gym", levels=5))
    ground = terrain.build(terrain.read_grid("my.toml"))
    ground = terrain.import_file("quarry.stl", scale=0.001)
"""

# By the full name, so that ``python -m terrain`` in a checkout loads no module twice.
from deimos.terrain.grid import Terrain, flat, load
from deimos.terrain.importing import import_file
from deimos.terrain.presets import preset, read_grid, rough
from deimos.terrain.world import Grid, Share, build

__all__ = ["Grid", "Share", "Terrain", "build", "flat", "import_file", "load", "preset", "read_grid", "rough"]
