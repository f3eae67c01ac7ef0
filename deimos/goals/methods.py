"""The names of the methods: one table for ``--method``, studies, legends and benchmarks."""

import re
from typing import Any

from deimos import plugins
from deimos.goals import selectors
from deimos.goals.fear import FearConfig
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
    "fear-novelty": ("novelty", {}),
    "q-fear": ("q_fear", {}),
    "weighted": ("weighted", {}),
    # Controls.
    "shuffled": ("director", {"percentile": 75, "control": "shuffled"}),
    "state-blind": ("director", {"percentile": 75, "control": "state-blind"}),
    "swapped": ("swapped", {}),
    "p75-penalty": ("penalty", {"base": "p75"}),
    "uniform-ensemble": ("vds", {"rule": "uniform"}),
    "vds-argmax": ("vds", {"rule": "argmax"}),
    "rnd-raw": ("rnd", {"whiten": False}),
    "penalty-30": ("penalty", {"size": 30.0}),
    "penalty-100": ("penalty", {"size": 100.0}),
}
"""The methods that have names: the selector, and its options where they are not the defaults."""

DATA: dict[str, dict[str, Any]] = {
    "literal": {"memory": 0},
    "threshold": {"memory": 0, "fear": FearConfig(min_per_class=32)},
}
"""What a Director's fear learns from if it has no crash memory: the last 2 T steps as in the thesis, or, as in
version 0.1.0, only if they hold 32 of each class."""


def method(name: str) -> SelectorConfig:
    """The selector configuration of a method.

    Args:
        name: One of ``METHODS``; or ``pNN``, the Director at that percentile, in [0, 100], such as p33 or p12.5; or
            any Director's name with one of ``DATA``, such as p75-literal or coop-threshold; or else the name of a
            selector, also one of another package, with its defaults.

    Raises:
        ValueError: If there is no such method; the message lists the methods.
    """
    kind, options = _spelled_out(name)
    if not plugins.has(selectors, kind):
        others = ", ".join(other for other in plugins.names(selectors) if other not in METHODS)
        raise ValueError(
            f"Unknown method '{name}'; choose from: {', '.join(METHODS)}; any pNN from p0 to p100; "
            f"a Director's with -{' or -'.join(DATA)}; {others}."
        )
    return plugins.load(selectors, kind).Config(**options)


def _spelled_out(name: str) -> tuple[str, dict[str, Any]]:
    """The selector that a name stands for, and its options; a suffix is one of ``DATA``, once."""
    base, _, data = name.rpartition("-")
    kind, options = _without_suffix(base)
    if data in DATA and kind == "director":
        return kind, options | DATA[data]
    return _without_suffix(name)


def _without_suffix(name: str) -> tuple[str, dict[str, Any]]:
    if name in METHODS:
        return METHODS[name]
    if re.fullmatch(r"p\d{1,3}(\.\d+)?", name):
        percentile = float(name[1:])
        if percentile <= 100 and name == f"p{percentile:g}":  # no second spelling, such as p07
            return "director", {"percentile": percentile}
    return name, {}
