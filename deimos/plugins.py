"""The file name is the registration: a module in a package of plug-ins *is* the plug-in of that name.

Packages outside this tree register a module through an entry-point group, one of ``HOLDS``; a module that is not
installed does it itself, when it is imported, by ``register``.
"""

import dataclasses
import importlib
import pkgutil
import warnings
from collections.abc import Callable
from importlib.metadata import entry_points
from types import ModuleType
from typing import Any

from deimos.checks import RunError

HOLDS = {
    "deimos.envs": ("dataclass", "Config"), "deimos.selectors": ("dataclass", "Config"),
    "deimos.attackers": ("dataclass", "Config"),
    "deimos.robots": ("function", "build"), "deimos.shapes": ("dataclass", "Shape"),
}  # fmt: skip
"""What every plug-in of a group holds, and its name."""

_registered: dict[str, dict[str, str]] = {}  # by group: names of plug-ins and modules, in this process


def register(package: ModuleType, name: str, module: str) -> None:
    """Make a module, by its full name, the plug-in ``name`` of ``package`` in this process."""
    _registered.setdefault(_group(package), {})[name] = module


def names(package: ModuleType) -> list[str]:
    """Names of the plug-ins of ``package``, sorted: its public modules and what was registered."""
    return sorted(_own(package) | set(entry_points(group=_group(package)).names) | set(_here(package)))


def has(package: ModuleType, name: str) -> bool:
    """Whether ``package`` has a plug-in of this name; its own come first, for entry points take long to read."""
    return name in _own(package) or name in _here(package) or name in names(package)


def _group(package: ModuleType) -> str:
    return "deimos." + package.__name__.rpartition(".")[2]


def _here(package: ModuleType) -> dict[str, str]:
    return _registered.get(_group(package), {})


def _own(package: ModuleType) -> set[str]:
    return {module.name for module in pkgutil.iter_modules(package.__path__) if not module.name.startswith("_")}


def load(package: ModuleType, name: str, use: Callable[[ModuleType], Any] = lambda module: module) -> Any:
    """Import the plug-in ``name`` of ``package``; its own modules come before foreign ones of the same name.

    Args:
        package: Where it is.
        name: Its name.
        use: What the caller makes of the module: an error in it is the plug-in's too.

    Returns:
        What ``use`` has made of it; by default the module.

    Raises:
        ValueError: If there is none; the message lists those that there are.
        RunError: If it is broken.
    """
    group, own = _group(package), name in _own(package)
    entry = None if own else next(iter(entry_points(group=group, name=name)), None)
    module = f"{package.__name__}.{name}" if own else entry.value if entry else _here(package).get(name)
    if module is None:
        raise ValueError(f"{package.__name__} has no '{name}'; it has: {', '.join(names(package))}.")
    kind, held = HOLDS[group]
    try:
        found = entry.load() if entry else importlib.import_module(module)
        thing = getattr(found, held, None)
        if not (callable(thing) if kind == "function" else dataclasses.is_dataclass(thing)):
            raise TypeError(f"it holds no {kind} {held}")
        return use(found)
    except Exception as error:  # a foreign file may raise anything
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise RunError(f"The plug-in '{name}' of {group}, {module}, is broken ({reason}).") from error


def load_all(package: ModuleType, use: Callable[[ModuleType], Any] = lambda module: module) -> dict[str, Any]:
    """``load`` for every plug-in of ``package``, by its name; warns of each that is broken, and leaves it out."""
    found = {}
    for name in names(package):
        try:
            found[name] = load(package, name, use)
        except RunError as error:
            warnings.warn(str(error), stacklevel=2)
    return found


def name_of(package: ModuleType, module: str) -> str | None:
    """Name of the plug-in of ``package`` that a module is, by its full name; ``None`` if of none. Imports nothing."""
    parent, _, name = module.rpartition(".")
    if parent == package.__name__ and name in _own(package):
        return name
    foreign = {entry.module: entry.name for entry in entry_points(group=_group(package))}
    return (foreign | {value: key for key, value in _here(package).items()}).get(module)
