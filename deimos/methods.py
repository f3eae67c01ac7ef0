"""The names of the methods: one table for ``--method``, studies, legends and benchmarks."""

from deimos.selector import SelectorConfig
from deimos.selectors import director, uniform

METHODS: dict[str, SelectorConfig] = {
    "uniform": uniform.Config(),
    "coop": director.Config(rule="argmin"),
    "p10": director.Config(percentile=10),
    "p25": director.Config(percentile=25),
    "p50": director.Config(percentile=50),
    "p75": director.Config(percentile=75),
    "p90": director.Config(percentile=90),
    "antagonist": director.Config(rule="argmax"),
}


def method(name: str) -> SelectorConfig:
    """The selector configuration of a method.

    Raises:
        ValueError: If there is no such method; the message lists those that there are.
    """
    if name not in METHODS:
        raise ValueError(f"There is no method '{name}'; there are: {', '.join(METHODS)}.")
    return METHODS[name]
