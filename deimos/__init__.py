"""Deimos: goal-conditioned robot policies, trained under a Director that chooses their goals by fear."""

import importlib.util
from pathlib import Path

__version__ = "0.1.0"

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
