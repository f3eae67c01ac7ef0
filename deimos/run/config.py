"""Convert configurations to and from plain dictionaries, so that a run folder can rebuild its run."""

import dataclasses
import math
import numbers
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from deimos import plugins
from deimos.goals import selectors
from deimos.goals.selector import SelectorConfig
from deimos.sim import envs
from deimos.sim.env import EnvConfig

_PLUGINS = {EnvConfig: envs, SelectorConfig: selectors}
_PLAIN: dict[Any, tuple[str, Any]] = {
    bool: ("true or false", bool), int: ("a whole number", numbers.Integral), str: ("a text", str),
    float: ("a number", numbers.Real | str), Path: ("a path", str | Path),  # an infinity is a text in JSON
}  # fmt: skip
"""Types of fields: the word for such a value in messages, and the types that are converted to it."""


def to_dict(config: Any) -> dict:
    """A dataclass as a dictionary of JSON types; a plugin's configuration names its plugin in ``kind``."""
    named = {"kind": kind(config)} if isinstance(config, EnvConfig | SelectorConfig) else {}
    return named | {field.name: _plain(getattr(config, field.name)) for field in dataclasses.fields(config)}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and math.isinf(value):
        return str(value)  # JSON has no infinity
    return list(value) if isinstance(value, tuple) else value


def with_plain_numbers(value: Any) -> Any:
    """A configuration with Python's numbers in place of NumPy's, which neither JSON nor Warp accepts as numbers."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple):
        return tuple(with_plain_numbers(item) for item in value)
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    fields = [field.name for field in dataclasses.fields(value) if field.init]
    return dataclasses.replace(value, **{name: with_plain_numbers(getattr(value, name)) for name in fields})


def require_readable(config: Any) -> None:
    """Raise ``ValueError`` if a configuration could not be read back from a run's folder, naming the cause.

    Python does not check types: ``evaluation="no"`` is true, but a folder that says so could no longer be read.
    """
    from_dict(type(config), to_dict(config))


def kind(config: EnvConfig | SelectorConfig) -> str:
    """Name of the plugin that a configuration belongs to.

    Raises:
        ValueError: If it belongs to none.
    """
    package = next(package for base, package in _PLUGINS.items() if isinstance(config, base))
    name = plugins.name_of(package, type(config).__module__)  # without importing the others, one of which may be broken
    if name is None or plugins.load(package, name).Config is not type(config):
        raise ValueError(
            f"{type(config)} is not the Config of a plugin of {package.__name__}; register its module with "
            "deimos.plugins.register, or install it."
        )
    return name


def from_dict(cls: type, data: dict, *, stored: bool = False) -> Any:
    """Rebuild a dataclass from ``to_dict``.

    Args:
        cls: Its class.
        data: Its fields. A missing one takes its default.
        stored: Whether an earlier version may have written them. A missing field then takes the only value that there
            was before the field existed, ``before`` in its metadata, if that is not the default. A field that no
            longer exists is dropped if it has the only value that there is today, in the class's ``former``.

    Raises:
        ValueError: If a field is unknown or a value is not allowed.
    """
    if not isinstance(data, Mapping):
        raise ValueError(f"{cls.__name__} must be a table of its fields, got {data!r}.")
    data = dict(data)
    if cls in _PLUGINS:
        if not isinstance(data.get("kind"), str):
            raise ValueError(f"A configuration of {_PLUGINS[cls].__name__} must name its 'kind', got {data}.")
        cls = plugins.load(_PLUGINS[cls], data.pop("kind")).Config
    if stored:
        data = {f.name: f.metadata["before"] for f in dataclasses.fields(cls) if "before" in f.metadata} | data
        former = getattr(cls, "former", {})
        data = {name: value for name, value in data.items() if (name, value) not in former.items()}
    hints = typing.get_type_hints(cls)
    _check_fields(cls, data)
    return cls(**{name: _typed(name, hints[name], value, stored) for name, value in data.items()})


def _check_fields(cls: type, names: Iterable[str]) -> None:
    known = {field.name for field in dataclasses.fields(cls)}
    if unknown := sorted(set(names) - known):
        raise ValueError(
            f"{cls.__module__}.{cls.__name__} has no {', '.join(unknown)}; it has: {', '.join(sorted(known))}."
        )


def multiplied(config: Any, factors: Mapping[str, Any]) -> Any:
    """A configuration with some of its numbers multiplied.

    Args:
        config: A dataclass.
        factors: Numbers by the names of fields, or nested tables where a field is a configuration. A field of an
            environment that is ``None`` counts as what it stands for there, see ``EnvConfig.implied``.

    Raises:
        ValueError: If there is no such field, it holds no number, or a whole one would no longer be whole.
    """
    _check_fields(type(config), factors)
    return dataclasses.replace(config, **{name: _product(config, name, factor) for name, factor in factors.items()})


def _product(config: Any, name: str, factor: Any) -> Any:
    value = getattr(config, name)
    if value is None and isinstance(config, EnvConfig):
        value = config.implied(name)
    if isinstance(factor, Mapping) and dataclasses.is_dataclass(value):
        return multiplied(value, factor)
    numbers_only = all(isinstance(x, numbers.Real) and not isinstance(x, bool) for x in (value, factor))
    if not numbers_only:
        raise ValueError(f"{name} must be a number to be multiplied, and so must its factor, got {value} x {factor}.")
    product = value * factor
    if isinstance(value, numbers.Integral):
        if product % 1 != 0:  # neither is an infinity
            raise ValueError(f"{name} must stay a whole number, got {value} x {factor} = {product:g}.")
        return round(product)
    return product


def _typed(name: str, hint: Any, value: Any, stored: bool) -> Any:
    """The value of a field as the type that ``hint`` asks for, where JSON cannot express it."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        if value is None:
            return None
        hint = next(part for part in typing.get_args(hint) if part is not type(None))
    if hint in _PLUGINS or dataclasses.is_dataclass(hint):
        return from_dict(hint, value, stored=stored)
    if hint in _PLAIN:
        words, taken = _PLAIN[hint]
        try:
            if not isinstance(value, taken) or (isinstance(value, bool) and hint is not bool):
                raise ValueError
            return hint(value)
        except (OverflowError, ValueError) as error:
            raise ValueError(f"{name} must be {words}, got {value!r:.80}.") from error
    return tuple(value) if isinstance(value, list) else value
