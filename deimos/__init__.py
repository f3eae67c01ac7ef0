"""Deimos: goal-conditioned robot policies, trained under a Director that chooses their goals by fear."""

import importlib
import sys
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

from deimos._version import __version__

_OFFERED = {
    "Env": "deimos.sim.env",
    "GoalDirector": "deimos.goals.director",
    "GoalSelector": "deimos.goals.selector",
    "TrainConfig": "deimos.run.trainer",
    "check_env": "deimos.sim.check_env",
    "evaluate": "deimos.run.api",
    "load_policy": "deimos.learn.policy",
    "train": "deimos.run.api",
}
"""The public names, and the module that each is in."""

__all__ = ["__version__", *_OFFERED]

_HOME = Path(__file__).resolve().parent


class _Beside:
    """Finds ``deimos.kernels`` and ``deimos.terrain`` next to this package, and nothing else there."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        beside = name in ("deimos.kernels", "deimos.terrain")
        return PathFinder.find_spec(name, [str(_HOME.parent)]) if beside else None


if not (_HOME / "kernels").is_dir():  # in a checkout; installed, both are inside
    sys.meta_path.insert(0, _Beside)  # before an editable install of another checkout


def __dir__() -> list[str]:
    return sorted(__all__)


def __getattr__(name: str) -> Any:
    """Import a public name on first use; ``import deimos`` alone stays light."""
    if name not in _OFFERED:
        raise AttributeError(f"module 'deimos' has no attribute '{name}'")
    try:
        return getattr(importlib.import_module(_OFFERED[name]), name)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("deimos"):
            raise
        raise ImportError(f"deimos.{name} needs {error.name}: pip install 'deimos-rl[sim]'") from error
