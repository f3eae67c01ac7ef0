"""The interface of all shapes of ground."""

import abc
import math
from dataclasses import dataclass, fields
from typing import Any, get_type_hints

import numpy as np

from deimos.checks import check_positive, check_range

from .mesh import Mesh

Ramp = tuple[float, float]
"""A number at difficulty 0 and at difficulty 1, linear in between."""
TOLERANCE = 1e-6  # [m]


@dataclass(frozen=True, kw_only=True)
class TileShape(abc.ABC):
    """A square of ground around the origin, at height 0 along its edge, with a flat middle to stand on.

    A file of ``terrain.shapes`` holds one, named ``Shape``; its fields are its parameters. Every number must be
    positive, and both ends of a ramp at least 0; further checks belong in ``__post_init__``. A field ``direction``
    makes two shapes of it. It is the direction for the robot, which starts in the middle: ``up`` is the way out
    of a hollow, ``down`` the way off a hill.
    """

    tile: float = 8.0
    """Side of the square [m], positive."""
    platform: float = 3.0
    """Side of the flat middle [m], positive and smaller than the tile."""

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))  # a field's type is a string if annotations are
        for field in fields(self):
            if hints[field.name] is float:
                check_positive(field.name, getattr(self, field.name), finite=True)
            elif hints[field.name] == Ramp:
                check_ramp(field.name, getattr(self, field.name))
        if self.platform >= self.tile:
            raise ValueError(f"platform must be smaller than tile = {self.tile:g} m, got {self.platform:g} m.")

    def check_room(self, what: str, room: float) -> None:
        """Raise ``ValueError`` unless the tile is larger than ``room`` [m], the sum that ``what`` spells out."""
        if room >= self.tile:
            raise ValueError(f"tile must be larger than {what} = {room:g} m, got {self.tile:g} m.")

    @classmethod
    def parameters(cls) -> dict[str, Any]:
        """Names and types of the fields that a caller may set: all except ``direction``, part of the shape's name."""
        return {name: hint for name, hint in get_type_hints(cls).items() if name != "direction"}

    @abc.abstractmethod
    def surface(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """Make the mesh; use ``build``, which checks the difficulty.

        Args:
            difficulty: From 0, the easiest, to 1.
            generator: The only source of randomness: its state decides the mesh, to the bit.

        Returns:
            A mesh [m] that covers the square and nothing else, normals up or, on risers, outwards.
        """

    def build(self, difficulty: float, generator: np.random.Generator) -> Mesh:
        """See ``surface``; raises ``ValueError`` if ``difficulty`` is out of its range, or the mesh is wrong."""
        check_range("difficulty", difficulty, 0, 1)
        mesh = self.surface(difficulty, generator)
        across = np.abs(mesh.vertices[:, :2])
        if not np.allclose(mesh.bounds[:, :2], [[-self.tile / 2] * 2, [self.tile / 2] * 2], rtol=0, atol=TOLERANCE):
            raise ValueError(f"{type(self).__module__}: its mesh must extend over the tile of {self.tile:g} m.")
        edge = mesh.vertices[across.max(axis=1) > self.tile / 2 - TOLERANCE, 2]
        if not (np.abs(edge) <= TOLERANCE).all():
            off = edge[np.abs(edge).argmax()]
            raise ValueError(f"{type(self).__module__}: its mesh must be at height 0 along its edge, got {off:g} m.")
        return mesh

    @abc.abstractmethod
    def step(self, difficulty: float) -> float:
        """Highest step that a robot may have to take up or down [m]; gaps are crossed, not stepped into."""


def at(ramp: Ramp, difficulty: float) -> float:
    """Value of a ramp at a difficulty in [0, 1]."""
    easiest, hardest = ramp
    return (1.0 - difficulty) * easiest + difficulty * hardest


def check_ramp(name: str, value: Ramp, least: float = 0.0) -> None:
    """Raise ``ValueError`` unless ``value`` is a pair of finite numbers of at least ``least``."""
    if len(value) != 2 or not all(least <= end < math.inf for end in value):
        raise ValueError(
            f"{name} must be two finite numbers of at least {least:g}, at difficulty 0 and at 1, got {value}."
        )
