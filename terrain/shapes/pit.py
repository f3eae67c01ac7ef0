"""A pit to climb out of."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..mesh import rings
from ..shape import Ramp, TileShape, at, check_ramp

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """A level middle with a vertical wall all around."""

    platform: float = 4.0
    """Side of the floor [m], positive and smaller than the tile."""
    depth: Ramp = (0.0, 1.0)
    """Height of the wall at difficulty 0 and at 1 [m], each at least 0; Legged Gym's 1.0 d."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ramp("depth", self.depth)

    def step(self, difficulty: float) -> float:
        """Height of the wall [m]."""
        return at(self.depth, difficulty)

    def surface(self, difficulty: float, generator: np.random.Generator) -> "Trimesh":
        """See ``TileShape.surface``."""
        return rings(np.array([self.tile, self.platform]) / 2, np.array([0.0, -self.step(difficulty)]))
