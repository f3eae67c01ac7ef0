"""The results of a study as samples: one value per policy, by environment, goals, T and method."""

import math
import re
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle
from pathlib import Path

import numpy as np

from deimos.study.results import Results, Row, settings, without_results
from deimos.study.stats import Array

_COLOURS = "#0072B2 #E69F00 #009E73 #CC79A7 #D55E00 #56B4E9 #7f7f7f #a6761d #332288 #e7298a".split()
_MARKERS = "ovs^D<P>X*hpdH8"


@dataclass(frozen=True)
class Style:
    """How methods are ordered and drawn; a caller says what the study's own methods should look like."""

    order: Sequence[str] = ()
    """Environments and methods as tables and figures show them; others follow, by name."""
    panels: Mapping[str, Sequence[str]] = field(default_factory=lambda: {"all methods": ()})
    """Titles of the panels that methods are drawn in, with their methods; others are in the last."""
    everywhere: str = ""
    """A method whose training curve is in every panel, to compare with; empty for none."""
    colours: Mapping[str, str] = field(default_factory=dict)
    """Hexadecimal colours of methods, the same in every figure; others get one of Okabe and Ito's or a similar one."""
    reference: str = "uniform"
    """The method that tables compare the others with."""

    def complete(self, methods: Sequence[str]) -> "Style":
        """The same with a colour for each of some methods."""
        free = cycle([colour for colour in _COLOURS if colour not in self.colours.values()] or _COLOURS)
        added = {name: next(free) for name in methods if name not in self.colours}
        return replace(self, colours={**self.colours, **added})

    def marker(self, method: str) -> str:
        """The marker of a method, the same in every figure."""
        return _MARKERS[[*self.colours].index(method) % len(_MARKERS)]

    def panel(self, method: str) -> str:
        """Title of the panel that a method is drawn in."""
        return next((title for title, names in self.panels.items() if method in names), [*self.panels][-1])


@dataclass(frozen=True)
class Where:
    """One evaluation: a panel of a figure."""

    environment: str
    """Name of the environment or variant."""
    goals: str
    """Who chose the goals: naive, or an attacker; ``adversary`` is the thesis's, which evaluations call argmax."""
    period: int
    """T [steps]."""

    def __str__(self) -> str:
        return f"{self.environment}, {self.goals.capitalize()}, T = {self.period}"


class Data:
    """The results of a study. All policies count, also those whose attacker found nothing to learn from.

    ``style`` says how methods are ordered and drawn; those without a colour get one. Raises ``RunError`` if the
    results are not those of one study; see ``Results.check``.
    """

    def __init__(
        self, results: Results, style: Style | None = None, settings: Mapping[str, Mapping] | None = None,
        lacking: Sequence[str] = (),
    ) -> None:  # fmt: skip
        results.check()
        self.settings = settings or {}
        """Configurations by environment, as JSON types; empty if there are only tables."""
        self.lacking = lacking
        """Names of cells that have no results: they were given up, or have not run yet."""
        self._results, self.rows = results, results.rows
        self.style = (style or Style()).complete(sorted({row["method"] for row in self.rows}))
        self._samples: dict[tuple[Where, str], dict[int, Row]] = defaultdict(dict)
        for row in self.rows:
            goals = "adversary" if row["goals"] == "argmax" else row["goals"]
            where = Where(row["environment"], goals, row["goal_period"])
            self._samples[where, row["method"]][row["seed"]] = row

    @classmethod
    def read(cls, folder: Path, style: Style | None = None) -> "Data":
        """The results of a folder; raises ``RunError`` if there are none, or as ``Results.read`` and ``check`` do."""
        results = Results.read(folder, may_be_empty=False)
        return cls(results, style, settings(folder), without_results(folder, results))

    def only(self, methods: Collection[str]) -> "Data":
        """The same results without those of other methods."""
        rows, curves = ([row for row in rows if row["method"] in methods] for rows in (self.rows, self._results.curves))
        return Data(Results(rows, curves), self.style, self.settings, self.lacking)

    @property
    def curve_rows(self) -> list[Row]:
        """The rows of all training curves."""
        return self._results.curves

    @property
    def environments(self) -> list[str]:
        """Names of the environments, in order."""
        return self._sorted({row["environment"] for row in self.rows})

    def periods(self, environment: str) -> list[int]:
        """The T that an environment's policies were evaluated at."""
        return sorted({row["goal_period"] for row in self.rows if row["environment"] == environment})

    @property
    def goals(self) -> list[str]:
        """Who chose the goals of evaluations: naive, adversary, and other attackers by name."""
        found = {where.goals for where, _ in self._samples}
        return sorted(found, key=lambda name: (name != "naive", name != "adversary", name))

    def places(self, environment: str, goals: str) -> list[Where]:
        """The evaluations of an environment under one kind of goals."""
        return [Where(environment, goals, period) for period in self.periods(environment)]

    def methods(self, environment: str, period: int | None = None) -> list[str]:
        """Methods that an environment has results for, at one T or at any, in order."""
        own = [row for row in self.rows if row["environment"] == environment and period in (None, row["goal_period"])]
        return self._sorted({row["method"] for row in own})

    def _sorted(self, names: Collection[str]) -> list[str]:
        """Names in the style's order; the others follow, with numbers in them sorted as numbers."""
        known = [name for name in self.style.order if name in names]
        parts = {name: [int(x) if x.isdigit() else x for x in re.split(r"(\d+)", name)] for name in names}
        return known + sorted(set(names) - set(known), key=parts.__getitem__)

    def seeds(self, where: Where, methods: Sequence[str]) -> list[int]:
        """Seeds for which all of some methods have a row."""
        found = [set(self._samples.get((where, name), {})) for name in methods]
        return sorted(set.intersection(*found)) if found else []

    def paired(self, environment: str) -> bool:
        """Whether methods are compared seed by seed: those of a seed began with the same files (``Cell.block``)."""
        return any(row["environment"] == environment and row.get("block") for row in self.rows)

    def sample(self, where: Where, method: str, metric: str, seeds: Sequence[int] | None = None) -> Array:
        """The values of a metric over the seeds of a method, in the seeds' order; NaN are left out.

        A metric is a column of the results, or ``log_crashes``, log(1 + crashes); ``tracking:2``, the mean tracking of
        the goal's group 2; ``errors:NAME``, the median of one of the environment's errors.
        """
        rows = self._samples.get((where, method), {})
        chosen = sorted(rows) if seeds is None else [seed for seed in seeds if seed in rows]
        values = np.array([_metric(rows[seed], metric) for seed in chosen], float)
        return values[~np.isnan(values)]

    def in_pairs(self, where: Where, methods: Sequence[str], metric: str) -> list[Array]:
        """The samples of some methods over the seeds for which all of them have the metric."""
        both = [
            [self.sample(where, name, metric, [seed]) for name in methods] for seed in self.seeds(where, methods)
        ]  # fmt: skip
        known = [[float(x[0]) for x in values] for values in both if all(map(len, values))]
        return [*np.array(known, float).reshape(-1, len(methods)).T]

    def parts(self, where: Where) -> dict[str, str]:
        """The metrics ``tracking:...`` and ``errors:...`` that an evaluation has, with what they are."""
        rows = [row for (place, _), seeds in self._samples.items() if place == where for row in seeds.values()]
        groups = max((len(row["tracking"]) for row in rows), default=0)
        errors = sorted({name for row in rows for name in row["errors"]})
        names = next((row["goal_groups"] for row in rows if len(row["goal_groups"]) == groups), None)
        tracking = {f"tracking:{i}": f"tracking of {names[i] if names else f'goal group {i}'}" for i in range(groups)}
        return tracking | {f"errors:{name}": f"{name}, median over goals" for name in errors}

    def curves(self, environment: str, method: str, column: str = "crashes_per_1000") -> list[Array]:
        """A column of the training curves of a method, see ``CURVE_COLUMNS``, seed by seed, each of shape (k,).

        Those that do not hold it are left out.
        """
        return [*self.curves_by_seed(environment, method, column).values()]

    def curves_by_seed(self, environment: str, method: str, column: str) -> dict[int, Array]:
        """The same by seed."""
        own = [row for row in self._results.curves if (row["environment"], row["method"]) == (environment, method)]
        found = {row["seed"]: np.array(row.get(column, ())) for row in sorted(own, key=lambda row: row["seed"])}
        return {seed: values for seed, values in found.items() if len(values)}

    def delivered(self, environment: str, method: str) -> dict[int, float]:
        """Delivered dose of every policy, by seed; see ``delivered_dose``. Those of unknown dose are left out."""
        ranked = self.curves_by_seed(environment, method, "goal_percentile")
        doses = {seed: delivered_dose(values) for seed, values in ranked.items()}
        return {seed: dose for seed, dose in doses.items() if not math.isnan(dose)}

    def dosed_late(self, environment: str) -> list[str]:
        """Methods whose delivered dose is that of the last part of their training, as the first part's is unknown."""
        return [
            name for name in self.methods(environment) if self.delivered(environment, name)
            and any(np.isnan(values).any() for values in self.curves(environment, name, "goal_percentile"))
        ]  # fmt: skip

    def trained_in(self, environment: str) -> str:
        """The environment that an environment's policies were trained in: another if they were only evaluated again."""
        weights = {name: {row.get("weights") for row in self.rows if row["environment"] == name}
                   for name in self.environments}  # fmt: skip
        own = weights[environment]
        # Where two have the same policies, the first is the one that they were trained in.
        others = [name for name in weights if None not in own and own <= weights[name]]
        return max(others, key=lambda name: len(weights[name]), default=environment)


def delivered_dose(percentiles: Array) -> float:
    """Mean percentile of fear of the goals of a training, shape (k,), since it has been known without a gap.

    First goals and the time before fear had learnt count. The goals of some selectors are not ranked, and of one that
    hands over to a Director (``vds+p75``) the Director's part counts. NaN where it is not known at the end.
    """
    unknown = np.flatnonzero(np.isnan(percentiles))
    known = percentiles[unknown[-1] + 1 :] if unknown.size else percentiles
    return float(known.mean()) if known.size else math.nan


def _metric(row: Row, name: str) -> float:
    if name == "log_crashes":
        return math.log1p(row["crashes"])
    column, _, part = name.partition(":")
    if not part:
        return row.get(name, math.nan)
    if column == "tracking":
        return row[column][int(part)] if int(part) < len(row[column]) else math.nan
    return row[column].get(part, math.nan)
