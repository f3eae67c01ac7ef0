"""Deimos: goal-conditioned robot policies, trained under a Director that chooses their goals by fear."""

import importlib
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
"""What the package offers, and the module that holds it."""

__all__ = ["__version__", *_OFFERED]

# Installed, ``kernels`` and ``terrain`` lie inside this package; in a checkout they lie beside it.
_HOME = Path(__file__).resolve().parent
if not (_HOME / "kernels").is_dir():
    __path__.append(str(_HOME.parent))


def __getattr__(name: str) -> Any:
    """Import what the package offers when it is first asked for; importing ``deimos`` alone stays light."""
    if name not in _OFFERED:
        raise AttributeError(f"module 'deimos' has no attribute '{name}'")
    try:
        return getattr(importlib.import_module(_OFFERED[name]), name)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("deimos"):
            raise
        raise ImportError(f"deimos.{name} needs {error.name}: pip install 'deimos-rl[sim]'") from error
