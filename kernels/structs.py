"""Tables of the arrays in a struct: each shape is declared once; memory, checks and tests' builders follow from it.

Warp's structs know the dtype and the number of axes of their arrays, but not the axes' lengths. A table adds these, by
name: a field that it does not mention has one element for every world.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from .check import require

Shape = tuple[int | str, ...]
"""Lengths of the axes: numbers, or names of sizes that the caller knows."""


@dataclass(frozen=True)
class StructTable:
    """The arrays of a Warp struct and their shapes.

    Args:
        struct: Made by ``@wp.struct``; its fields that are not arrays are left alone.
        shapes: Shape of every array that is not ``("num_envs",)``, by name.
    """

    struct: Any
    shapes: Mapping[str, Shape] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if unknown := sorted(set(self.shapes) - set(self.names)):
            raise ValueError(f"shapes must name arrays of {self.struct.key}, got {', '.join(unknown)}.")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arrays, in the struct's order."""
        return tuple(name for name, var in self.struct.vars.items() if wp.types.is_array(var.type))

    def dtype(self, name: str) -> type:
        """The dtype of an array."""
        return self.struct.vars[name].type.dtype

    def shape(self, name: str, **sizes: int) -> tuple[int, ...]:
        """Shape of an array for given sizes.

        Raises:
            ValueError: If it needs a size that is not given.
        """
        shape = self.shapes.get(name, ("num_envs",))
        if missing := [size for size in shape if isinstance(size, str) and size not in sizes]:
            raise ValueError(f"{self.struct.key}.{name} has the shape {shape}; {', '.join(missing)} must be given.")
        return tuple(sizes[size] if isinstance(size, str) else size for size in shape)

    def allocate(self, device: str, **sizes: int) -> Any:
        """A struct whose arrays are allocated, all zeros."""
        struct = self.struct()
        for name in self.names:
            setattr(struct, name, wp.zeros(self.shape(name, **sizes), self.dtype(name), device=device))
        return struct

    def rows(self, struct: Any, rows: slice) -> Any:
        """The struct of some of the worlds: arrays with an element per world are views, the rest is shared."""
        part = self.struct()
        for name in self.struct.vars:
            value = getattr(struct, name)
            if name in self.names and "num_envs" in (shape := self.shapes.get(name, ("num_envs",))):
                value = value[tuple([*[slice(None)] * shape.index("num_envs"), rows])]
            setattr(part, name, value)
        return part

    def require(self, label: str, struct: Any, like: wp.array, **sizes: int) -> None:
        """Raise ``ValueError`` unless every array of ``struct`` is as the table requires.

        Args:
            label: The caller's name for the struct, for the message.
            struct: The struct.
            like: An array whose device all must be on.
            sizes: The sizes that the shapes name.
        """
        for name in self.names:
            expected = {"dtype": self.dtype(name), "shape": self.shape(name, **sizes)}
            require(f"{label}.{name}", getattr(struct, name), **expected, like=like)
