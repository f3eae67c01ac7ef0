"""The file name is the registration: a module in a package of plug-ins *is* the plug-in of that name.

Packages outside this tree register a module through an entry-point group, one of ``HOLDS``; a module that is not
installed registers itself, when it is imported, with ``register``.
"""

import dataclasses
import importlib
import importlib.util
import pkgutil
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import entry_points
from types import ModuleType
from typing import Any

from deimos.checks import RunError

HOLDS = {
    "deimos.envs": ("dataclass", "Config"), "deimos.selectors": ("dataclass", "Config"),
    "deimos.attackers": ("dataclass", "Config"),
    "deimos.robots": ("function", "build"), "deimos.shapes": ("dataclass", "Shape"),
}  # fmt: skip
"""What every plug-in of a group defines, and the name of that."""

_registered: dict[str, dict[str, str]] = {}  # by group: names of plug-ins and modules, in this process


def register(package: ModuleType, name: str, module: str) -> None:
    """Make a module, by its full name, the plug-in ``name`` of ``package`` in this process.

    Raises:
        ValueError: If another module is the plug-in of that name, or there is no such module.
    """
    taken = _found(package, name)
    if taken and taken[0] != module:
        raise ValueError(f"name must be free in {package.__name__}, got '{name}', which is {taken[0]}.")
    if not _exists(module):
        raise ValueError(f"module must be the full name of a module that can be imported, got '{module}'.")
    _registered.setdefault(_group(package), {})[name] = module


def names(package: ModuleType) -> list[str]:
    """Names of the plug-ins of ``package``, sorted: its public modules, what was registered, and entry points."""
    return sorted(name for name, _, _ in _known(package))


def has(package: ModuleType, name: str) -> bool:
    """Whether ``package`` has a plug-in of this name."""
    return _found(package, name) is not None


def _group(package: ModuleType) -> str:
    return "deimos." + package.__name__.rpartition(".")[2]


def _exists(module: str) -> bool:
    """Whether a module exists; imports nothing but the packages that contain it."""
    if module in sys.modules:
        return True
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):  # no such package, or not a module name
        return False


def _known(package: ModuleType) -> Iterator[tuple[str, str, Callable[[], ModuleType]]]:
    """Name, module and importer of every plug-in of ``package``, each name once.

    Its own come first, and entry points last: they take long to read, and a search stops at the name it wants.
    """
    own = {
        module.name: f"{package.__name__}.{module.name}"
        for module in pkgutil.iter_modules(package.__path__)
        if not module.name.startswith("_")
    }
    here = _registered.get(_group(package), {}) | own
    for name, module in here.items():
        yield name, module, partial(importlib.import_module, module)
    told = set(here)
    for entry in entry_points(group=_group(package)):
        if entry.name not in told:
            told.add(entry.name)
            yield entry.name, entry.module, entry.load


def _found(package: ModuleType, name: str) -> tuple[str, Callable[[], ModuleType]] | None:
    """Module and importer of the plug-in of this name."""
    return next(((module, importer) for known, module, importer in _known(package) if known == name), None)


def load(package: ModuleType, name: str, use: Callable[[ModuleType], Any] = lambda module: module) -> Any:
    """Import the plug-in ``name`` of ``package``; its own module comes before a foreign one of that name.

    Args:
        package: Where it is.
        name: Its name.
        use: What the caller does with the module: an error in it counts as the plug-in's too.

    Returns:
        The result of ``use``; by default the module.

    Raises:
        ValueError: If there is none; the message lists those that exist.
        RunError: If it is broken.
    """
    plugin = _found(package, name)
    if plugin is None:
        raise ValueError(f"{package.__name__} has no '{name}'; it has: {', '.join(names(package))}.")
    group, (module, importer) = _group(package), plugin
    kind, held = HOLDS[group]
    try:
        found = importer()
        thing = getattr(found, held, None)
        if not (callable(thing) if kind == "function" else dataclasses.is_dataclass(thing)):
            raise TypeError(f"it holds no {kind} {held}")
        return use(found)
    except Exception as error:  # a foreign file may raise anything
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise RunError(f"The plug-in '{name}' of {group}, {module}, is broken ({reason}).") from error


def load_all(package: ModuleType, use: Callable[[ModuleType], Any] = lambda module: module) -> dict[str, Any]:
    """``load`` for every plug-in of ``package``, by name; warns about each that is broken, and leaves it out."""
    found = {}
    for name in names(package):
        try:
            found[name] = load(package, name, use)
        except RunError as error:
            warnings.warn(str(error), stacklevel=2)
    return found


def name_of(package: ModuleType, module: str) -> str | None:
    """Name of the plug-in that a module, by its full name, is in ``package``; ``None`` if not one. Imports nothing."""
    return next((name for name, known, _ in _known(package) if known == module), None)
