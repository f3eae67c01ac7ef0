"""The names of the methods: one table for ``--method``, studies, legends and benchmarks."""

from deimos.goals.selector import SelectorConfig
from deimos.goals.selectors import boltzmann, cl, director, grid, learnability, plr, rnd, schedule, uniform, vds

METHODS: dict[str, SelectorConfig] = {
    # The thesis's twelve.
    "uniform": uniform.Config(),
    "coop": director.Config(rule="argmin"),
    "p10": director.Config(percentile=10),
    "p25": director.Config(percentile=25),
    "p50": director.Config(percentile=50),
    "p75": director.Config(percentile=75),
    "p90": director.Config(percentile=90),
    "antagonist": director.Config(rule="argmax"),
    "rnd": rnd.Config(),
    "vds": vds.Config(),
    "cl": cl.Config(),
    # What its critics would ask for.
    "vds-auxiliary": vds.Config(role="auxiliary", data="share", epochs=2),
    "learnability": learnability.Config(),
    "learnability-top": learnability.Config(rule="percentile"),
    "band": learnability.Config(rule="band"),
    "boltzmann": boltzmann.Config(),
    "plr": plr.Config(),
    "plr-robust": plr.Config(robust=True),
    "grid": grid.Config(),
    # Controls.
    "shuffled": director.Config(percentile=75, control="shuffled"),
    "state-blind": director.Config(percentile=75, control="state-blind"),
}


def method(name: str) -> SelectorConfig:
    """The selector configuration of a method.

    Raises:
        ValueError: If there is no such method; the message lists those that there are.
    """
    if name not in METHODS:
        raise ValueError(f"There is no method '{name}'; there are: {', '.join(METHODS)}.")
    return METHODS[name]


METHODS["vds+p75"] = schedule.Config(first="vds", second="p75")  # the twelfth; it names others of the table
