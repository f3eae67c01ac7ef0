"""Four slopes between the edge and a flat middle."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..mesh import Mesh, sheet
from ..shape import Ramp, TileShape, at


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """A pyramid with a flat top, or a hollow of that shape.

    The gradient is Legged Gym's, 0.4 d. There the height is a product of two ramps, so its gradient
    decreases towards the corners; here the four faces are planes.
    """

    direction: Literal["up", "down"] = "up"
    """Way out of the middle: up out of a hollow, or down a hill."""
    gradient: Ramp = (0.0, 0.4)
    """Rise over run at difficulty 0 and at 1, each at least 0."""

    def step(self, difficulty: float) -> float:
        """No step: no face is vertical."""
        return 0.0

    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``TileShape.surface``."""
        rise = at(self.gradient, difficulty) * (self.tile - self.platform) / 2
        line = np.array([-self.tile, -self.platform, self.platform, self.tile]) / 2
        height = np.zeros((4, 4))
        height[1:3, 1:3] = -rise if self.direction == "up" else rise
        return sheet(line, line, height)
