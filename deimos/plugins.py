"""The file name is the registration: a module in a package of plug-ins *is* the plug-in of that name.

Packages outside this tree register a module through an entry-point group, one of ``HOLDS``.
"""

import importlib
import pkgutil
import warnings
from importlib.metadata import entry_points
from types import ModuleType

from deimos.checks import RunError

HOLDS = {"deimos.envs": "Config", "deimos.selectors": "Config", "deimos.robots": "build", "deimos.shapes": "Shape"}
"""What every plug-in of a group holds."""


def names(package: ModuleType) -> list[str]:
    """Names of the plug-ins of ``package``, sorted: its public modules and the registered entry points."""
    return sorted(_own(package) | set(entry_points(group=_group(package)).names))


def _group(package: ModuleType) -> str:
    return "deimos." + package.__name__.rpartition(".")[2]


def _own(package: ModuleType) -> set[str]:
    return {module.name for module in pkgutil.iter_modules(package.__path__) if not module.name.startswith("_")}


def load(package: ModuleType, name: str) -> ModuleType:
    """Import the plug-in ``name`` of ``package``; its own modules come before foreign ones of the same name.

    Raises:
        ValueError: If there is none; the message lists those that there are.
        RunError: If it is broken.
    """
    own = name in _own(package)
    entry = None if own else next(iter(entry_points(group=_group(package), name=name)), None)
    if not own and entry is None:
        raise ValueError(f"{package.__name__} has no '{name}'; it has: {', '.join(names(package))}.")
    module = entry.value if entry else f"{package.__name__}.{name}"
    try:
        found = entry.load() if entry else importlib.import_module(module)
        if not hasattr(found, HOLDS[_group(package)]):
            raise AttributeError(f"it holds no {HOLDS[_group(package)]}")
    except Exception as error:  # a foreign file may raise anything
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise RunError(f"The plug-in '{name}' of {_group(package)}, {module}, is broken ({reason}).") from error
    return found


def load_all(package: ModuleType) -> dict[str, ModuleType]:
    """All plug-ins of ``package`` by name, sorted; warns of each that is broken, and leaves it out."""
    found = {}
    for name in names(package):
        try:
            found[name] = load(package, name)
        except RunError as error:
            warnings.warn(str(error), stacklevel=2)
    return found


def name_of(package: ModuleType, module: str) -> str | None:
    """Name of the plug-in of ``package`` that a module is, by its full name; ``None`` if of none. Imports nothing."""
    parent, _, name = module.rpartition(".")
    if parent == package.__name__ and name in _own(package):
        return name
    return next((entry.name for entry in entry_points(group=_group(package)) if entry.module == module), None)
