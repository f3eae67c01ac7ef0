"""Spheres and capsules in place of other collision shapes.

A simulator tests at most 50 prisms of a height field for each geom, so a box or a long capsule that lies on rough
ground falls through it (``docs/reference/quad.md``). Several short capsules do not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from deimos.sim.legged.robots import Vector

LARGEST_RADIUS = 0.06  # [m]; a Go1's head
# Largest half length [m], and half length times half width [m^2], of a capsule that a height field with cells of 0.05 m
# supports: those of a Go1's trunk, which a test presses onto stairs.
LARGEST_HALF_LENGTH, LARGEST_QUARTER = 0.13, 0.0065
THINNEST = 0.005  # [m]; thinner ones would slip between the samples of a height field
LEFT_OUT = 0.3  # of the radius, uncovered on either side of a box, for which a second row of capsules is not worth it
ROUNDING = 1e-6  # [m], of the box that MuJoCo computes for a geom


@dataclass(frozen=True)
class Piece:
    """A capsule from ``start`` to ``end`` [m], or a sphere where they are the same."""

    start: Vector
    end: Vector
    radius: float
    """[m]."""


def fill(half: Sequence[float]) -> list[Piece]:
    """Capsules that fill a box around the origin, along its longest side and next to each other along the others.

    For the bounding box of a sphere or a capsule that is the sphere or the capsule itself, unless it is too large.

    Args:
        half: Half of every side [m], shape (3,).
    """
    thin, wide, long = np.argsort(half, kind="stable")
    radius = float(np.clip(half[thin], THINNEST, LARGEST_RADIUS))
    longest = min(LARGEST_HALF_LENGTH, LARGEST_QUARTER / radius) - radius  # between the centres of a capsule's ends
    room = half[long] - radius
    room = room if room > ROUNDING else 0.0
    count = max(1, int(np.ceil(room / longest - ROUNDING)))
    ends = np.linspace(-room, room, count + 1)
    pieces = []
    for y in _spread(half[wide] - radius, radius):
        for z in _spread(half[thin] - radius, radius):
            for first, last in pairwise(ends):
                start, end = np.zeros(3), np.zeros(3)
                start[[long, wide, thin]], end[[long, wide, thin]] = (first, y, z), (last, y, z)
                pieces.append(Piece(_vector(start), _vector(end), radius))
    return pieces


def _spread(room: float, radius: float) -> np.ndarray:
    """Positions in [-room, room], neighbours overlapping; a single one if that leaves out little [m]."""
    count = 1 + int(np.ceil(max(room / radius - LEFT_OUT, 0.0)))
    return np.linspace(-room, room, count) if count > 1 else np.zeros(1)


def _vector(point: np.ndarray) -> Vector:
    x, y, z = point.tolist()
    return x, y, z
