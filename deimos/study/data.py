"""The results of a study as samples: one value per policy, by environment, goals, T and method."""

import copy
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from deimos.goals.methods import METHODS
from deimos.run.folder import RunError
from deimos.study.presets import DIRECTORS
from deimos.study.results import check_one_population, curves, results
from deimos.study.stats import Array

DIRECTOR_METHODS = ("coop", *DIRECTORS, "antagonist")
ENVIRONMENTS = ("absolute", "relative", "directional", "quad", "quad_arm")
"""The thesis's, in its order."""


@dataclass(frozen=True)
class Where:
    """One evaluation: a panel of a figure."""

    environment: str
    """Name of the environment or variant."""
    goals: str
    """Who chose the goals: naive, adversary or oracle."""
    period: int
    """T [steps]."""

    def __str__(self) -> str:
        return f"{self.environment}, {self.goals.capitalize()}, T = {self.period}"


@dataclass(frozen=True)
class Curve:
    """Means over stretches of one training run."""

    env_steps: Array
    """Parallel steps at the end of every stretch, shape (k,)."""
    reward: Array
    """Mean reward per transition, shape (k,)."""
    crashes: Array
    """Crashes per 1000 transitions, shape (k,)."""
    selected_share: Array
    """Share of the worlds whose goal the selector chose, shape (k,)."""


class Data:
    """All rows of a study folder. Rows of a weak adversary are counted, and left out of every sample."""

    def __init__(self, rows: list[dict[str, Any]], lines: list[dict[str, Any]]) -> None:
        check_one_population(rows, lines)
        self.rows = rows
        self.weak = [row for row in rows if row["weak_adversary"]]
        self._samples: dict[tuple[Where, str], dict[int, dict[str, Any]]] = {}
        for row in rows:
            if not row["weak_adversary"]:
                where = Where(row["environment"], row["goals"], row["goal_period"])
                self._samples.setdefault((where, row["method"]), {})[row["seed"]] = row
        self._curves: dict[tuple[str, str], dict[int, Curve]] = {}
        for line in lines:
            columns = (np.array(line[name]) for name in ("env_steps", "reward", "crashes_per_1000", "selected_share"))
            self._curves.setdefault((line["environment"], line["method"]), {})[line["seed"]] = Curve(*columns)

    @classmethod
    def read(cls, folder: Path) -> "Data":
        """Read the tables of a study folder.

        Raises:
            RunError: If there are no results, a table has another schema, the cells of an environment were run with
                different settings or those of a method with different selectors, or a policy stands there twice.
        """
        rows = results(folder).read()
        if not rows:
            raise RunError(f"{folder} holds no results; it is empty, or no study folder.")
        return cls(rows, curves(folder).read())

    def only(self, methods: Collection[str]) -> "Data":
        """The same results without those of other methods."""
        found = copy.copy(self)
        found.rows = [row for row in self.rows if row["method"] in methods]
        found.weak = [row for row in self.weak if row["method"] in methods]
        found._samples = {key: seeds for key, seeds in self._samples.items() if key[1] in methods}
        found._curves = {key: seeds for key, seeds in self._curves.items() if key[1] in methods}
        return found

    @property
    def environments(self) -> list[str]:
        """Their names: the thesis's in its order, then the others."""
        found = {row["environment"] for row in self.rows}
        return [name for name in ENVIRONMENTS if name in found] + sorted(found - set(ENVIRONMENTS))

    def periods(self, environment: str) -> list[int]:
        """The T that an environment's policies were evaluated at."""
        return sorted({row["goal_period"] for row in self.rows if row["environment"] == environment})

    def places(self, environment: str, goals: str) -> list[Where]:
        """The evaluations of an environment under one kind of goals."""
        return [Where(environment, goals, period) for period in self.periods(environment)]

    def methods(self, environment: str) -> list[str]:
        """Methods that an environment has results of: the Directors by rising p, then the others."""
        found = {row["method"] for row in self.rows if row["environment"] == environment}
        order = [*DIRECTOR_METHODS, *(name for name in METHODS if name not in DIRECTOR_METHODS)]
        return [name for name in order if name in found] + sorted(found - set(order))

    def seeds(self, where: Where, methods: Sequence[str]) -> list[int]:
        """Seeds that all of some methods have a row of."""
        found = [set(self._samples.get((where, name), {})) for name in methods]
        return sorted(set.intersection(*found)) if found else []

    def sample(self, where: Where, method: str, metric: str, seeds: Sequence[int] | None = None) -> Array:
        """The values of a metric over the seeds of a method, in the seeds' order; NaN are left out.

        ``log_crashes`` is log(1 + crashes), ``tracking:2`` the mean tracking of the goal's group 2, ``errors:NAME`` the
        median of one of the environment's errors.

        Args:
            where: The evaluation.
            method: The method.
            metric: A column of the results, or one of these.
            seeds: Which; ``None`` for all.
        """
        rows = self._samples.get((where, method), {})
        chosen = sorted(rows) if seeds is None else [seed for seed in seeds if seed in rows]
        values = np.array([_metric(rows[seed], metric) for seed in chosen], float)
        return values[~np.isnan(values)]

    def parts(self, where: Where) -> list[str]:
        """The metrics ``tracking:...`` and ``errors:...`` that an evaluation has."""
        rows = [row for (place, _), seeds in self._samples.items() if place == where for row in seeds.values()]
        groups = max((len(row["tracking"]) for row in rows), default=0)
        errors = sorted({name for row in rows for name in row["errors"]})
        return [f"tracking:{i}" for i in range(groups)] + [f"errors:{name}" for name in errors]

    def curves(self, environment: str, method: str) -> list[Curve]:
        """The training curves of a method, seed by seed."""
        found = self._curves.get((environment, method), {})
        return [found[seed] for seed in sorted(found)]


def _metric(row: dict[str, Any], name: str) -> float:
    if name == "log_crashes":
        return math.log1p(row["crashes"])
    column, _, part = name.partition(":")
    if not part:
        return row[name]
    if column == "tracking":
        return row[column][int(part)] if int(part) < len(row[column]) else math.nan
    return row[column].get(part, math.nan)
