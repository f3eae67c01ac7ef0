"""Pyramid stairs."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..mesh import Mesh, rings
from ..shape import Ramp, TileShape, at


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """Square steps around a flat middle, with vertical risers.

    The first tread is at height 0 along the edge of the tile. As many steps follow as fit around the platform.
    """

    platform: float = 2.6
    """Least side of the flat middle [m], positive and smaller than the tile. Legged Gym asks for 3 m, but its
    loop ends at 2.6 m."""
    direction: Literal["up", "down"] = "up"
    """Way out of the middle: up out of a hollow, or down a hill."""
    height: Ramp = (0.05, 0.23)
    """Height of a step at difficulty 0 and at 1 [m], each at least 0; Legged Gym's 0.05 + 0.18 d."""
    tread: float = 0.3
    """Depth of a step [m], positive; at least one fits between edge and platform."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self._count < 1:
            room = self.platform + 2 * self.tread
            raise ValueError(f"tile must be at least platform + 2 tread = {room:g} m, got {self.tile:g} m.")

    @property
    def _count(self) -> int:
        """Steps from the edge to the middle."""
        return math.floor((self.tile - self.platform) / (2 * self.tread) + 1e-9)

    def step(self, difficulty: float) -> float:
        """Height of every step [m]."""
        return at(self.height, difficulty)

    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``TileShape.surface``."""
        k = np.arange(self._count + 1)
        rise = k * self.step(difficulty)
        return rings(self.tile / 2 - k * self.tread, -rise if self.direction == "up" else rise)
