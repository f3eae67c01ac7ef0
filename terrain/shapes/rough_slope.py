"""Slopes with uniform noise on them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from deimos.checks import check_range

from ..mesh import Mesh, sheet
from ..noise import draw_noise, interpolate
from ..shape import Ramp, TileShape, at


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """A pyramid with a flat top, or a hollow, roughened by noise; formulas of Legged Gym."""

    direction: Literal["up", "down"] = "up"
    """Way out of the middle: up out of a hollow, or down a hill."""
    gradient: Ramp = (0.0, 0.4)
    """Rise over run of the slopes at difficulty 0 and at 1, each at least 0."""
    amplitude: Ramp = (0.05, 0.05)
    """Noise is in [-amplitude, amplitude], at difficulty 0 and at 1 [m], each at least 0."""
    quantum: float = 0.005
    """Noise is a multiple of this [m], positive."""
    spacing: float = 0.2
    """Distance between noise values [m], bilinear between them; positive, at most a quarter of the tile."""
    room: float = 1.0
    """Side of the square in the middle without noise [m], positive, at most the platform."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("spacing", self.spacing, 0.01, self.tile / 4)
        if self.room > self.platform:
            raise ValueError(f"room must be at most platform = {self.platform:g} m, got {self.room:g} m.")

    def step(self, difficulty: float) -> float:
        """No step: no face is vertical."""
        return 0.0

    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``TileShape.surface``."""
        amplitude = at(self.amplitude, difficulty)
        coarse, noise = draw_noise(generator, self.tile, self.spacing, amplitude, self.quantum, self.room)
        edge = self.platform / 2
        line = np.unique(np.concatenate([coarse, (coarse[:-1] + coarse[1:]) / 2, [-edge, edge]]).round(9))
        out = np.maximum(np.abs(line)[:, None], np.abs(line)[None, :])  # distance from the middle, by the larger axis
        rise = at(self.gradient, difficulty) * (self.tile / 2 - np.maximum(out, edge))
        slope = -rise if self.direction == "up" else rise
        return sheet(line, line, slope + interpolate(coarse, noise, line))
