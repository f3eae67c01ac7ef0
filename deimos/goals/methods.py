"""The names of the methods: one table for ``--method``, studies, legends and benchmarks."""

import re
from typing import Any

from deimos import plugins
from deimos.goals import selectors
from deimos.goals.selector import SelectorConfig

METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    # The thesis's twelve.
    "uniform": ("uniform", {}),
    "coop": ("director", {"rule": "argmin"}),
    "p10": ("director", {"percentile": 10}),
    "p25": ("director", {"percentile": 25}),
    "p50": ("director", {"percentile": 50}),
    "p75": ("director", {"percentile": 75}),
    "p90": ("director", {"percentile": 90}),
    "antagonist": ("director", {"rule": "argmax"}),
    "rnd": ("rnd", {}),
    "vds": ("vds", {}),
    "cl": ("cl", {}),
    "vds+p75": ("schedule", {"first": "vds", "second": "p75"}),
    # What its critics would ask for.
    "vds-auxiliary": ("vds", {"role": "auxiliary", "data": "share", "epochs": 2}),
    "learnability": ("learnability", {}),
    "learnability-top": ("learnability", {"rule": "percentile"}),
    "band": ("learnability", {"rule": "band"}),
    "boltzmann": ("boltzmann", {}),
    "plr": ("plr", {}),
    "plr-robust": ("plr", {"robust": True}),
    "grid": ("grid", {}),
    # Controls.
    "shuffled": ("director", {"percentile": 75, "control": "shuffled"}),
    "state-blind": ("director", {"percentile": 75, "control": "state-blind"}),
}
"""Methods with names of their own: the selector, and its options where they are not the defaults."""


def method(name: str) -> SelectorConfig:
    """The selector configuration of a method.

    Args:
        name: One of ``METHODS``; or ``pNN``, the Director at that percentile, in [0, 100], such as p33 or p12.5; or
            the name of a selector, also one of another package, with its defaults.

    Raises:
        ValueError: If there is no such method; the message lists those that there are.
    """
    kind, options = _spelled_out(name)
    if kind not in plugins.names(selectors):
        others = ", ".join(other for other in plugins.names(selectors) if other not in METHODS)
        raise ValueError(
            f"There is no method '{name}'; there are: {', '.join(METHODS)}; any pNN from p0 to p100; {others}."
        )
    return plugins.load(selectors, kind).Config(**options)


def _spelled_out(name: str) -> tuple[str, dict[str, Any]]:
    """The selector that a name stands for, and its options."""
    if name in METHODS:
        return METHODS[name]
    if re.fullmatch(r"p\d{1,3}(\.\d+)?", name):
        percentile = float(name[1:])
        if percentile <= 100 and name == f"p{percentile:g}":  # no second spelling, such as p07
            return "director", {"percentile": percentile}
    return name, {}
