"""The file name is the registration: a module in ``deimos.envs`` or ``deimos.selectors`` *is* the plugin.

Packages outside this tree register a module through the entry-point group of the same name
(``deimos.envs`` or ``deimos.selectors``).
"""

import importlib
import pkgutil
from importlib.metadata import entry_points
from types import ModuleType


def names(package: ModuleType) -> list[str]:
    """Names of the plugins of ``package``, sorted: its public modules and the registered entry points."""
    own = {module.name for module in pkgutil.iter_modules(package.__path__) if not module.name.startswith("_")}
    return sorted(own | set(entry_points(group=package.__name__).names))


def load(package: ModuleType, name: str) -> ModuleType:
    """Import the plugin ``name`` of ``package``.

    Raises:
        ValueError: If there is none; the message lists those that there are.
    """
    if name not in names(package):
        raise ValueError(f"{package.__name__} has no '{name}'; it has: {', '.join(names(package))}.")
    foreign = entry_points(group=package.__name__, name=name)
    if foreign:
        return next(iter(foreign)).load()
    return importlib.import_module(f"{package.__name__}.{name}")
