"""Raised and sunk rectangles."""

from dataclasses import dataclass

import numpy as np

from deimos.checks import check_at_least

from ..mesh import Mesh, terraces
from ..shape import Ramp, TileShape, at


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """Rectangles at random positions, later ones over earlier ones; the middle stays level.

    Each is at -h, -h/2, h/2 or h. Where two of them meet, the step is up to 2 h.
    """

    height: Ramp = (0.05, 0.25)
    """h at difficulty 0 and at 1 [m], each at least 0; Legged Gym's 0.05 + 0.2 d."""
    count: int = 20
    """Number of rectangles, at least 0."""
    sides: tuple[float, float] = (1.0, 2.0)
    """Shortest and longest side of a rectangle [m], positive, at most the tile minus two ``raster``."""
    raster: float = 0.4
    """Positions, and sides minus the shortest, are multiples of this [m], positive."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("count", self.count, 0)
        shortest, longest = self.sides
        room = self.tile - 2 * self.raster
        if not 0 < shortest <= longest <= room:
            raise ValueError(f"sides must rise, from above 0 to at most {room:g} m, got {self.sides}.")

    def step(self, difficulty: float) -> float:
        """From a sunk rectangle to a raised one [m]."""
        return 2 * at(self.height, difficulty)

    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``TileShape.surface``."""
        h = at(self.height, difficulty)
        x, y = (self._spans(generator) for _ in range(2))
        level = generator.choice([-h, -h / 2, h / 2, h], size=self.count)
        clear = np.array([[-self.platform / 2, self.platform / 2]])
        x, y, level = np.concatenate([x, clear]), np.concatenate([y, clear]), np.append(level, 0.0)

        edge = [-self.tile / 2, self.tile / 2]
        lines_x, lines_y = (np.unique(np.append(spans, edge).round(9)) for spans in (x, y))
        height = np.zeros((len(lines_x) - 1, len(lines_y) - 1))
        for (left, right), (front, back), z in zip(x.round(9), y.round(9), level, strict=True):
            i, j = np.searchsorted(lines_x, (left, right)), np.searchsorted(lines_y, (front, back))
            height[i[0] : i[1], j[0] : j[1]] = z
        return terraces(lines_x, lines_y, height)

    def _spans(self, generator: np.random.Generator) -> np.ndarray:
        """Where each rectangle begins and ends along one axis [m], shape (count, 2)."""
        shortest, longest = self.sides
        lengths = np.arange(shortest, longest + 1e-9, self.raster)
        length = generator.choice(lengths, size=self.count)
        places = np.floor((self.tile - length) / self.raster - 1 + 1e-9)  # the edge of the tile stays free
        start = self.raster * np.floor(1 + places * generator.random(self.count)) - self.tile / 2
        return np.stack([start, start + length], axis=1)
