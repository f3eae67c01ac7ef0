"""The file name is the registration: a module in ``terrain.shapes`` is the shape of that name."""

import importlib
import pkgutil
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, get_args, get_type_hints

from . import shapes
from .shape import TileShape


def names() -> list[str]:
    """Names of all shapes, such as ``flat``, ``stairs-up`` and ``stairs-down``, sorted."""
    return sorted(_classes())


def shape_class(name: str) -> type[TileShape]:
    """The class behind a name.

    Raises:
        ValueError: If there is none; the message lists those that there are.
    """
    return _find(name)[0]


def make(name: str, parameters: Mapping[str, Any] | None = None) -> TileShape:
    """The shape of this name.

    Args:
        name: One of ``names()``.
        parameters: Values of its fields; the others keep their defaults.

    Raises:
        ValueError: If there is no such shape or parameter, or a value is out of its range.
    """
    cls, fixed = _find(name)
    given = dict(parameters or {})
    known = [field.name for field in fields(cls) if field.name not in fixed]
    if unknown := sorted(set(given) - set(known)):
        raise ValueError(f"{name} has no parameter '{unknown[0]}'; it has: {', '.join(known)}.")
    hints = get_type_hints(cls)
    try:
        return cls(**fixed, **{key: convert(key, value, hints[key]) for key, value in given.items()})
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def name_of(shape: TileShape) -> str:
    """The name that ``make`` knows a shape by."""
    stem = type(shape).__module__.rpartition(".")[2].replace("_", "-")
    direction = getattr(shape, "direction", None)
    return stem if direction is None else f"{stem}-{direction}"


def _classes() -> dict[str, tuple[type[TileShape], dict[str, Any]]]:
    found: dict[str, tuple[type[TileShape], dict[str, Any]]] = {}
    for module in pkgutil.iter_modules(shapes.__path__):
        if module.name.startswith("_"):
            continue
        cls = importlib.import_module(f"{shapes.__name__}.{module.name}").Shape
        stem = module.name.replace("_", "-")
        directions = get_args(get_type_hints(cls).get("direction"))
        found |= {f"{stem}-{way}": (cls, {"direction": way}) for way in directions} or {stem: (cls, {})}
    return found


def _find(name: str) -> tuple[type[TileShape], dict[str, Any]]:
    classes = _classes()
    if name not in classes:
        raise ValueError(f"There is no shape '{name}'; there are: {', '.join(sorted(classes))}.")
    return classes[name]


def convert(name: str, value: Any, hint: Any) -> Any:
    """A value from a file as its field wants it: whole numbers may stand for others, lists for tuples.

    Raises:
        ValueError: If it is of another kind.
    """
    parts = get_args(hint)
    if parts:
        if not isinstance(value, list | tuple) or len(value) != len(parts):
            raise ValueError(f"{name} must be {len(parts)} numbers, got {value!r}.")
        return tuple(convert(name, item, part) for item, part in zip(value, parts, strict=True))
    if isinstance(value, bool) or not isinstance(value, int if hint is int else int | float):
        raise ValueError(f"{name} must be a {'whole ' if hint is int else ''}number, got {value!r}.")
    return hint(value)
