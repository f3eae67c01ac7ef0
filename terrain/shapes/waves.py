"""Waves."""

from dataclasses import dataclass

import numpy as np

from deimos.checks import check_at_least, check_range

from ..mesh import Mesh, sheet
from ..shape import Ramp, TileShape, at


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """Round hills and hollows, the product of a sine along x and one along y, fading out around a flat middle."""

    platform: float = 1.0
    """Side of the flat middle [m], positive and smaller than the tile."""
    height: Ramp = (0.0, 0.2)
    """Height from a hollow to a hill at difficulty 0 and at 1 [m], each at least 0."""
    count: int = 4
    """Waves along a side, at least 1."""
    fade: float = 0.5
    """Width of the ring around the middle in which the waves rise to their full height [m], positive."""
    spacing: float = 0.1
    """Distance between points of the mesh [m], at least 0.01, at most an eighth of a wave."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("count", self.count, 1)
        check_range("spacing", self.spacing, 0.01, self.tile / self.count / 8)
        self.check_room("platform + 2 fade", self.platform + 2 * self.fade)

    def step(self, difficulty: float) -> float:
        """No step: no face is vertical."""
        return 0.0

    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``TileShape.surface``."""
        cells = round(self.tile / self.spacing)
        middle = self.platform / 2
        line = self.tile * (np.arange(cells + 1) / cells - 0.5)
        line = np.unique(np.concatenate([line, [-middle, middle]]).round(9))
        wave = np.sin(2 * np.pi * self.count * (line / self.tile + 0.5))
        wave[[0, -1]] = 0.0
        out = np.maximum(np.abs(line)[:, None], np.abs(line)[None, :]) - middle
        share = np.clip(out / self.fade, 0.0, 1.0)
        smooth = share * share * (3.0 - 2.0 * share)
        return sheet(line, line, at(self.height, difficulty) / 2 * smooth * np.outer(wave, wave))
