"""A pit to climb out of."""

from dataclasses import dataclass

import numpy as np

from ..mesh import Mesh, rings
from ..shape import Ramp, TileShape, at


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """A flat middle with a vertical wall all around."""

    platform: float = 4.0
    """Side of the floor [m], positive and smaller than the tile."""
    depth: Ramp = (0.0, 1.0)
    """Height of the wall at difficulty 0 and at 1 [m], each at least 0; Legged Gym's 1.0 d."""

    def step(self, difficulty: float) -> float:
        """Height of the wall [m]."""
        return at(self.depth, difficulty)

    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``TileShape.surface``."""
        return rings(np.array([self.tile, self.platform]) / 2, np.array([0.0, -self.step(difficulty)]))
