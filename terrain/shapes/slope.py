"""Four slopes between the edge and a flat middle."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..mesh import Mesh, from_triangles
from ..shape import Ramp, TileShape, at

_RING = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """A pyramid with a flat top, or the same as a hollow.

    The gradient is Legged Gym's, 0.4 d. There the height is a product of two ramps, so its gradient
    falls towards the corners; here the four faces are planes.
    """

    direction: Literal["up", "down"] = "up"
    """Way out of the middle: up out of a hollow, or down a hill."""
    gradient: Ramp = (0.0, 0.4)
    """Rise over run at difficulty 0 and at 1, each at least 0."""

    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``TileShape.surface``."""
        rise = at(self.gradient, difficulty) * (self.tile - self.platform) / 2
        middle = -rise if self.direction == "up" else rise
        outer, inner = _RING * self.tile / 2, _RING * self.platform / 2
        vertices = np.concatenate([np.insert(outer, 2, 0.0, axis=1), np.insert(inner, 2, middle, axis=1)])
        faces = [[4, 5, 6], [4, 6, 7]]
        for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
            faces += [[a, b, b + 4], [a, b + 4, a + 4]]
        return from_triangles(vertices, np.array(faces))
