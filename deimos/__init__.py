"""Deimos: goal-conditioned robot policies, trained under a Director that chooses their goals by fear."""

import importlib.util
from pathlib import Path
from typing import Any

from deimos._version import __version__

__all__ = ["GoalDirector", "__version__", "load_policy"]

# ``kernels`` and ``terrain`` are names that other distributions use too. A foreign one first on the path
# would fail much later and obscurely, so it is refused here.
_HOME = Path(__file__).resolve().parent.parent
for _name in ("kernels", "terrain"):
    _spec = importlib.util.find_spec(_name)
    if _spec is None or _spec.origin is None or Path(_spec.origin).resolve().parent.parent != _HOME:
        raise ImportError(
            f"Deimos needs its own package '{_name}' from {_HOME}, but Python found {_spec and _spec.origin}. "
            f"Another distribution is called '{_name}' too; install Deimos in an environment of its own."
        )


def __getattr__(name: str) -> Any:
    """Import what the package offers when it is first asked for; importing ``deimos`` alone stays light."""
    if name == "load_policy":
        from deimos.policy import load_policy

        return load_policy
    if name == "GoalDirector":
        from deimos.goal_director import GoalDirector

        return GoalDirector
    raise AttributeError(f"module 'deimos' has no attribute '{name}'")
