"""Terrain for the legged robots; imports NumPy, trimesh and Warp only.

A shape builds a triangle mesh, a grid lays tiles of many shapes out, and the whole mesh becomes one height grid::

    ground = terrain.rough(seed=1)  # Legged Gym's grid with steps that a Go1 can climb
    ground = terrain.build(terrain.preset("legged-gym", levels=5))
    ground = terrain.build(terrain.read_grid("my.toml"))
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .grid import Terrain as Terrain
    from .grid import flat as flat
    from .grid import load as load
    from .presets import preset as preset
    from .presets import read_grid as read_grid
    from .presets import rough as rough
    from .world import Grid as Grid
    from .world import Share as Share
    from .world import build as build

_OFFERED = {
    "Grid": "world", "Share": "world", "Terrain": "grid", "build": "world", "flat": "grid", "load": "grid",
    "preset": "presets", "read_grid": "presets", "rough": "presets",
}  # fmt: skip
"""What the package offers, and the module that holds it."""

__all__ = ["Grid", "Share", "Terrain", "build", "flat", "load", "preset", "read_grid", "rough"]


def __getattr__(name: str) -> Any:
    """Import what the package offers when it is first asked for, under one name also in ``python -m terrain``."""
    if name not in _OFFERED:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"deimos.terrain.{_OFFERED[name]}"), name)
