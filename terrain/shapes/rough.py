"""Ground with uniform noise."""

from dataclasses import dataclass

import numpy as np

from deimos.checks import check_range

from ..mesh import Mesh, sheet
from ..noise import draw_noise
from ..shape import Ramp, TileShape, at


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """Independent uniform heights on a lattice, with planes between them."""

    platform: float = 1.0
    """Side of the middle without noise [m], positive and smaller than the tile."""
    amplitude: Ramp = (0.01, 0.05)
    """Heights are in [-amplitude, amplitude], at difficulty 0 and at 1 [m], each at least 0.
    Legged Gym's 0.05 m is reached at difficulty 1."""
    quantum: float = 0.005
    """Heights are multiples of this [m], positive."""
    spacing: float = 0.2
    """Distance between heights [m], positive, at most a quarter of the tile."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("spacing", self.spacing, 0.01, self.tile / 4)

    def step(self, difficulty: float) -> float:
        """No step: no face is vertical."""
        return 0.0

    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``TileShape.surface``."""
        amplitude = at(self.amplitude, difficulty)
        line, height = draw_noise(generator, self.tile, self.spacing, amplitude, self.quantum, self.platform)
        return sheet(line, line, height)
