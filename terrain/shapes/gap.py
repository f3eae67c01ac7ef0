"""A gap around the middle."""

from dataclasses import dataclass

import numpy as np

from ..mesh import Mesh, rings
from ..shape import Ramp, TileShape, at


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """A flat middle, cut off by a trench."""

    width: Ramp = (0.0, 1.0)
    """Width of the trench at difficulty 0 and at 1 [m], each at least 0; Legged Gym's 1.0 d."""
    depth: float = 1.0
    """Depth of the trench [m], positive."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_room("platform + 2 width", self.platform + 2 * max(self.width))

    def step(self, difficulty: float) -> float:
        """The trench is crossed, not stepped into: no step."""
        return 0.0

    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``TileShape.surface``."""
        middle = self.platform / 2
        half_sides = np.array([self.tile / 2, middle + at(self.width, difficulty), middle])
        return rings(half_sides, np.array([0.0, -self.depth, 0.0]))
