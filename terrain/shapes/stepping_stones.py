"""Stepping stones."""

from dataclasses import dataclass

import numpy as np

from ..mesh import Mesh, blocks, rings
from ..shape import Ramp, TileShape, at, check_ramp


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """Rows of square stones over a deep floor, each row shifted at random, around a flat middle."""

    side: Ramp = (1.575, 0.075)
    """Side of a stone at difficulty 0 and at 1 [m], each positive; Legged Gym's 1.5 (1.05 - d). Changed as little
    as needed for whole rows to fill the tile."""
    gap: Ramp = (0.05, 0.1)
    """Distance between stones at difficulty 0 and at 1 [m], each positive. Legged Gym's is 0.05 m at 0, then 0.1 m."""
    depth: float = 1.0
    """Depth of the floor [m], positive."""
    rim: float = 0.5
    """Width of the flat rim along the edge [m], positive."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("side", "gap"):
            check_ramp(name, getattr(self, name), least=0.01)
        self.check_room("platform + 2 rim + 4 gap", self.platform + 2 * self.rim + 4 * max(self.gap))

    def step(self, difficulty: float) -> float:
        """The floor between the stones is crossed, not stepped into: no step."""
        return 0.0

    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``TileShape.surface``."""
        gap = at(self.gap, difficulty)
        bed = self.tile / 2 - self.rim  # half side of the floor around the stones
        count = max(1, round((2 * bed - gap) / (at(self.side, difficulty) + gap)))
        pitch = (2 * bed - gap) / count
        first = -bed + gap + pitch * np.arange(count)
        x, y = [], []
        for front in first:
            left = (np.arange(-1, count) + generator.uniform(1 / 3, 2 / 3)) * pitch - bed + gap
            ends = np.stack([np.maximum(left, -bed + gap), np.minimum(left + pitch - gap, bed - gap)], axis=1)
            ends = ends[ends[:, 1] - ends[:, 0] > (pitch - gap) / 4]  # smaller ones are no foothold
            x.append(ends)
            y.append(np.broadcast_to([front, front + pitch - gap], ends.shape))
        middle = np.array([[-self.platform / 2, self.platform / 2]])
        stones = blocks(np.concatenate([*x, middle]), np.concatenate([*y, middle]), -self.depth, 0.0)
        return rings(np.array([self.tile / 2, bed]), np.array([0.0, -self.depth])) + stones
