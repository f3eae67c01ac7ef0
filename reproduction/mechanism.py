"""Is fear too weak, or is the principle? Tables of each Director's goals, the quality of its fear, and the outcomes.

    python -m reproduction.mechanism FOLDER --environment directional --methods uniform p75 oracle swapped --seeds 0-9

A row is a method, and its numbers are means over policies:

* *delivered dose*: percentile of fear of the active goal among its candidates, over all steps of training;
* *exact rank*: percentile of the chosen goal among its candidates when each is tried in a clone of the world;
* *AUROC*: how well fear ranks candidates that crash the policy above those that do not, within a context. This and the
  exact rank are from five moments in the last quarter of training;
* *fitted*: share of the rollouts after which fear was fitted;
* crashes per interaction in percent under every attacker that policies of all these methods met, over the policies that
  met it; for *worst* also the 95 % interval (bootstrap over policies), and how many policies are below 1 %;
* *score* under uniform goals, with its interval;
* *better in both*: which methods of the table have a higher score and a lower worst rate.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from deimos.checks import RunError
from deimos.study import stats
from deimos.study.data import Data
from deimos.study.plan import parse_seeds
from deimos.study.stats import Array
from reproduction.figures import STYLE
from reproduction.measures import (
    ATTACKED,
    AUROC,
    DOSE,
    EXACT_RANK,
    FITTED,
    SAFE,
    SCORE,
    Evidence,
    Measure,
    Place,
    under,
)

NO_NUMBER = "-"
ORDER = ("uniform", *[name for name in STYLE.order if name != "uniform"])
"""All methods, beginning with the one that every other is compared with."""


def table(evidence: Evidence, environment: str, methods: Sequence[str] = ORDER) -> list[str]:
    """Lines of Markdown: a row for each of the methods that has policies in an environment.

    Args:
        evidence: Evidence of a study, with its own names of methods.
        environment: Name of an environment; if it has several T, the first is used.
        methods: In the order of the rows.

    Raises:
        RunError: If the environment does not exist.
    """
    if not evidence.places(environment):
        there = sorted({name for _, _, name, _ in evidence.rows})
        raise RunError(f"environment must be one of {', '.join(there) or 'none, for want of rows'}, got {environment}.")
    place = evidence.places(environment)[0]
    known = [name for name in methods if SCORE(evidence, place, name)]
    attackers = [goals for goals in evidence.goals(place) if all(evidence.evaluations(place, goals, m) for m in known)]
    both = {name: (_mean(SCORE, evidence, place, name), _mean(ATTACKED, evidence, place, name)) for name in known}
    head = ["method", "n", "delivered dose", "exact rank", "AUROC", "fitted", *attackers, "worst", "below 1 %", "score",
            "better in both"]  # fmt: skip
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for name in known:
        rates = [f"{100 * _mean(under(goals), evidence, place, name):.2f}" for goals in attackers]
        worst = _values(ATTACKED, evidence, place, name)
        parts = [
            f"`{name}`", str(len(worst)), _number(DOSE, evidence, place, name, ".1f"),
            _number(EXACT_RANK, evidence, place, name, ".1f"), _number(AUROC, evidence, place, name, ".2f"),
            _number(FITTED, evidence, place, name, ".0%"), *rates, _interval(100 * worst, ".2f"),
            f"{(worst < SAFE).sum()} of {len(worst)}",
            _interval(_values(SCORE, evidence, place, name), ".3f"), ", ".join(better(both, name)) or NO_NUMBER,
        ]  # fmt: skip
        lines.append(f"| {' | '.join(parts)} |")
    return lines


def better(both: Mapping[str, tuple[float, float]], method: str) -> list[str]:
    """Methods with a higher score and a lower crash rate than one; none for a method on the Pareto front."""
    score, rate = both[method]
    return [name for name, (other, lower) in both.items() if other > score and lower < rate]


def _values(measure: Measure, evidence: Evidence, place: Place, method: str) -> Array:
    return np.array([*measure(evidence, place, method).values()])


def _mean(measure: Measure, evidence: Evidence, place: Place, method: str) -> float:
    return float(_values(measure, evidence, place, method).mean())


def _number(measure: Measure, evidence: Evidence, place: Place, method: str, form: str) -> str:
    values = _values(measure, evidence, place, method)
    return f"{values.mean():{form}}" if values.size else NO_NUMBER


def _interval(values: Array, form: str) -> str:
    if len(values) < 2:
        return f"{values.mean():{form}}"
    return f"{stats.bootstrap([values], lambda x: x.mean(axis=-1)):{form}}"


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--environment", required=True)
    parser.add_argument("--methods", nargs="+", default=ORDER, help="in the order of the rows; by default all")
    parser.add_argument("--seeds", type=parse_seeds, help="those that count, as in a study's file; by default all")
    options = parser.parse_args()
    evidence = Evidence.of(Data.read(options.folder), renamed=False)
    if options.seeds:
        evidence = evidence.only(options.seeds)
    print("\n".join(table(evidence, options.environment, options.methods)))


if __name__ == "__main__":
    main()
