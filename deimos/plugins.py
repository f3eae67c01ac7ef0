"""The file name is the registration: a module in the package of environments, selectors or robots *is* the plugin.

Packages outside this tree register a module through an entry-point group: ``deimos.envs``, ``deimos.selectors`` or
``deimos.robots``; a module that is not installed does it itself, when it is imported, by ``register``.
"""

import importlib
import pkgutil
import sys
from importlib.metadata import entry_points
from types import ModuleType

_registered: dict[str, dict[str, ModuleType]] = {}  # by package: what was registered in this process


def register(package: ModuleType, name: str, module: str) -> None:
    """Make the module of a full name, which is being imported, the plugin ``name`` of ``package`` in this process."""
    _registered.setdefault(package.__name__, {})[name] = sys.modules[module]


def names(package: ModuleType) -> list[str]:
    """Names of the plugins of ``package``, sorted: its public modules and what was registered."""
    return sorted(_own(package) | set(entry_points(group=_group(package)).names) | set(_here(package)))


def _group(package: ModuleType) -> str:
    return "deimos." + package.__name__.rpartition(".")[2]


def _here(package: ModuleType) -> dict[str, ModuleType]:
    return _registered.get(package.__name__, {})


def _own(package: ModuleType) -> set[str]:
    return {module.name for module in pkgutil.iter_modules(package.__path__) if not module.name.startswith("_")}


def load(package: ModuleType, name: str) -> ModuleType:
    """Import the plugin ``name`` of ``package``; its own modules come before foreign ones of the same name.

    Raises:
        ValueError: If there is none; the message lists those that there are.
    """
    if name not in names(package):
        raise ValueError(f"{package.__name__} has no '{name}'; it has: {', '.join(names(package))}.")
    if name in _own(package):
        return importlib.import_module(f"{package.__name__}.{name}")
    if name in _here(package):
        return _here(package)[name]
    return next(iter(entry_points(group=_group(package), name=name))).load()


def name_of(package: ModuleType, module: str) -> str | None:
    """Name of the plugin of ``package`` that a module is, by its full name; ``None`` if it is none. Imports nothing."""
    own = {f"{package.__name__}.{name}": name for name in _own(package)}
    foreign = {entry.module: entry.name for entry in entry_points(group=_group(package))}
    here = {plugin.__name__: name for name, plugin in _here(package).items()}
    return (foreign | here | own).get(module)
