"""The file name is the registration: a module in ``terrain.shapes`` is the shape of that name."""

from collections.abc import Mapping
from dataclasses import replace
from types import ModuleType
from typing import Any, get_args, get_type_hints

from deimos import plugins

from . import shapes
from .shape import TileShape


def names() -> list[str]:
    """Names of all shapes, such as ``flat``, ``stairs-up`` and ``stairs-down``, sorted."""
    return sorted(_defaults())


def make(name: str, parameters: Mapping[str, Any] | None = None) -> TileShape:
    """The shape of this name.

    Args:
        name: One of ``names()``.
        parameters: Values of its fields; the others keep their defaults.

    Raises:
        ValueError: If there is no such shape or parameter, or a value is out of its range.
    """
    known = _defaults()
    if name not in known:
        raise ValueError(f"Unknown shape '{name}'; choose from: {', '.join(sorted(known))}.")
    given, hints = dict(parameters or {}), known[name].parameters()
    if unknown := sorted(set(given) - set(hints)):
        raise ValueError(f"{name} has no parameter '{unknown[0]}'; it has: {', '.join(hints)}.")
    try:
        return replace(known[name], **{key: convert(key, value, hints[key]) for key, value in given.items()})
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def name_of(shape: TileShape) -> str:
    """The name that ``make`` knows a shape by."""
    stem = plugins.name_of(shapes, type(shape).__module__) or type(shape).__name__
    return "-".join([stem.replace("_", "-"), *filter(None, [getattr(shape, "direction", None)])])


def _defaults() -> dict[str, TileShape]:
    """Every shape with its default parameters, by its name."""
    return {name_of(shape): shape for found in plugins.load_all(shapes, _of_module).values() for shape in found}


def _of_module(module: ModuleType) -> list[TileShape]:
    """The shapes of a module: one for each of its directions."""
    directions = get_args(get_type_hints(module.Shape).get("direction"))
    return [module.Shape(direction=way) for way in directions] or [module.Shape()]


def convert(name: str, value: Any, hint: Any) -> Any:
    """Convert a value from a file to its field's type: whole numbers may stand for others, lists for tuples.

    Raises:
        ValueError: If it is of another type.
    """
    if parts := get_args(hint):
        if not isinstance(value, list | tuple) or len(value) != len(parts):
            raise ValueError(f"{name} must be {len(parts)} numbers, got {value!r}.")
        return tuple(convert(name, item, part) for item, part in zip(value, parts, strict=True))
    if isinstance(value, bool) or not isinstance(value, int if hint is int else int | float):
        raise ValueError(f"{name} must be a {'whole ' if hint is int else ''}number, got {value!r}.")
    return hint(value)
