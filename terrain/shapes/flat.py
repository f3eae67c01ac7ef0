"""Flat ground."""

from dataclasses import dataclass

import numpy as np

from ..mesh import Mesh, rings
from ..shape import TileShape


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """Flat ground at every difficulty."""

    def step(self, difficulty: float) -> float:
        """No step: no face is vertical."""
        return 0.0

    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``TileShape.surface``."""
        return rings(np.array([self.tile / 2]), np.zeros(1))
