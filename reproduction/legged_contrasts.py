"""The effect of goal selection on policies that already walk: methods compared in pairs, base by base (legged.md).

    python -m reproduction.legged_contrasts FOLDER    # of the merged studies; the folder's report includes this

The contrasts of p75, vds+p75 and penalty-30 against uniform at T2 are primary; all others are exploratory, and those of
Quad+arm, of another engine and of T10 in training are estimates from a few bases.
"""

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from deimos.run.folder import RunFolder
from deimos.run.presets import preset
from deimos.study import permutation, stats
from deimos.study.data import Data
from deimos.study.document import Block, to_markdown
from deimos.study.results import Row
from deimos.study.stats import Array, Interval
from reproduction.claim_list import CLAIMS
from reproduction.claims import Clause
from reproduction.legged_bases import KEPT_IN, LONG, ROBOTS, SHORT, base_name
from reproduction.legged_on_warp import ENVIRONMENT as ON_WARP
from reproduction.measures import (
    DIVERSITY,
    DOSE,
    FPS,
    LEVEL,
    PENALTIES,
    RISK,
    SCORE,
    VARIANCE,
    Evidence,
    Measure,
    Numbers,
    Place,
)
from reproduction.thesis import LEGGED, LEGGED_METHODS, PARTICLE

REFERENCE = "uniform"
PRIMARY = ("p75", "vds+p75", "penalty-30")
CORE_HOURS = {"quad": 1.7, "quad_arm": 0.4}
"""Cost of one more method on all bases of a robot (legged.md)."""
WITH_PARTICLE = "rnd beside Particle Gym's, whose rows are docs/results/particle_[a-f]: to be merged into the folder"
LONGER_HOURS = {"quad": 3.2, "quad_arm": 0.7}
"""Cost of evaluating its policies at T10."""
WALKS = 0.3
"""Lowest score at T2 at which a base counts as walking."""
TITLES = {
    ("quad", 100): "Quad at T2", ("quad", 500): "Quad at T10, trained at T2",
    ("quad_long", 100): "Quad at T2, trained at T10", ("quad_long", 500): "Quad at T10, trained at T10",
    (ON_WARP, 100): "Quad at T2, evaluated on mujoco-warp",
    ("quad_warp", 100): "Quad at T2, trained and evaluated on mujoco-warp",
    ("quad_arm", 100): "Quad+arm at T2", ("quad_arm", 500): "Quad+arm at T10",
}  # fmt: skip
"""The places where methods are compared, in order."""
ENGINES = {
    "quad": "native", ON_WARP: "native, judged on mujoco-warp", "quad_warp": "mujoco-warp",
}  # fmt: skip
"""Environments of Quad by the engine of training and evaluation."""
UNTOLD = {"quad": (FPS,), "quad_arm": (FPS, RISK, DIVERSITY)}
"""What no further run of a study can show: speed; without audits, fear on stairs and the diversity of goals."""
TEXT = (
    "Paired differences, base by base, fine-tuned from common base policies, 12 M of the thesis's 295 M transitions. "
    "A log rate is log(crashes + 1/2) - log(interactions + 1), so that -0.69 is half as many crashes; worst is the "
    "worst of the attackers. p is that of flipped signs, exact and one-sided: that the method is better (a higher "
    "score, a lower rate), and near 1 where it is worse; five bases reach 1/32 at best. What would have been found "
    "is the smallest mean difference that the t interval of as many bases with this spread tells from 0 in 80 %. "
    "Nothing is corrected: of the nine p-values of the primary contrasts, 0.28 are 1/32 by chance alone, on average."
)
VDS_TEXT = (
    "Under vds and vds+p75 the ensemble of VDS, which begins from nothing, takes the place of the base's critic: their "
    "contrasts with uniform are of both, those with uniform-ensemble, where it ran, of the goals alone. The delivered "
    "dose of vds+p75 is that of its half under p75."
)


def log_rate(crashes: float, interactions: float) -> float:
    """Logarithm of crashes per interaction, defined even without crashes."""
    return math.log(crashes + 0.5) - math.log(interactions + 1.0)


def _naive(row: Row) -> float:
    return log_rate(row["interaction_crashes"], row["interactions"])


def _worst(row: Row) -> float:
    count = row.get("worst_interactions", math.nan)
    return math.nan if math.isnan(count) else log_rate(round(row["worst"] * count), count)


def _of_naive_rows(number: Callable[[Row], float]) -> Callable[[Evidence, Place, str], Numbers]:
    def numbers(evidence: Evidence, place: Place, method: str) -> Numbers:
        return {seed: number(row) for seed, row in evidence.evaluations(place, "naive", method).items()}

    return numbers


NAIVE = Measure("log rate (Naive)", _of_naive_rows(_naive))
WORST = Measure("log rate (worst)", _of_naive_rows(_worst))
OUTCOMES = {SCORE: 1, NAIVE: -1, WORST: -1}
"""The outcomes that are compared, and the sign of an improvement."""


def mean_difference(x: Array, y: Array) -> Array:
    """The difference of samples whose i-th values are paired."""
    return np.asarray((x - y).mean(axis=-1))


@dataclass(frozen=True)
class Contrast:
    """A method against another on the bases that both branched off, at least two."""

    method: str
    """The method."""
    reference: str
    """The reference."""
    measure: Measure
    """The outcome; one of ``OUTCOMES``."""
    bases: tuple[int, ...]
    """Their numbers."""
    values: Array
    """Values of the method and of the reference, shape (2, bases)."""

    @property
    def differences(self) -> Array:
        """Difference on every base, shape (bases,)."""
        return np.subtract(*self.values)

    @cached_property
    def mean(self) -> Interval:
        """The mean difference with Student's interval."""
        return stats.student(self.differences)

    @cached_property
    def p(self) -> float:
        """Exact one-sided p-value of the method being better, by flipping signs."""
        more, less = permutation.p_values_in_blocks([*self.values], mean_difference)
        return more if OUTCOMES[self.measure] > 0 else less

    @cached_property
    def detectable(self) -> float:
        """Smallest mean difference that as many bases with the observed spread would have shown in 80 % of studies."""
        return stats.detectable_mean(self.differences)

    def row(self, *, judged: bool) -> dict[str, str]:
        """Its line in a table; only estimates unless ``judged``."""
        verdict = {"p (better)": f"{self.p:.3g}", "would have been found": f"{self.detectable:.3g}"} if judged else {}
        return {
            "contrast": f"{self.method} - {self.reference}", "outcome": self.measure.name,
            "bases": str(len(self.bases)), "mean difference [95 %]": f"{self.mean:+.3g}",
            "of every base": ", ".join(f"{x:+.3g}" for x in self.differences), **verdict,
        }  # fmt: skip


def contrast(evidence: Evidence, place: Place, method: str, reference: str, measure: Measure) -> Contrast | None:
    """A contrast in a place; ``None`` unless two or more bases have both methods."""
    own, other = (measure(evidence, place, name) for name in (method, reference))
    bases = tuple(sorted(own.keys() & other.keys()))
    if len(bases) < 2:
        return None
    values = np.array([[each[base] for base in bases] for each in (own, other)])
    return Contrast(method, reference, measure, bases, values)


def contrasts(evidence: Evidence, place: Place, methods: Sequence[str], reference: str = REFERENCE) -> list[Contrast]:
    """The contrasts of some methods against one in a place, in all outcomes known there."""
    found = [contrast(evidence, place, name, reference, each) for name in methods for each in OUTCOMES]
    return [each for each in found if each is not None]


def blocks(evidence: Evidence) -> list[Block]:
    """The section of a report; empty unless a study has methods that branched off the same bases."""
    found: list[Block] = []
    for environment, period in TITLES:
        place = Place(environment, period)
        if evidence.paired(place) and period in [each.period for each in evidence.places(environment)]:
            found += _tables(evidence, place)
    if not found:
        return []
    return [
        "## Methods in pairs, base by base", TEXT, *found, *_of_walkers(evidence), *_engines(evidence),
        *_trainings(evidence), *bases(), *not_run(evidence),
    ]  # fmt: skip


def _of_walkers(evidence: Evidence, folder: Path = KEPT_IN) -> list[Block]:
    """The primary contrasts without bases that do not walk; nothing if all do, or fewer than two."""
    scores = {
        index + 1: row["score"] for index in range(len(ROBOTS["quad"].seeds))
        for row in RunFolder(folder / base_name("quad", index)).read_rows("evaluation.json")
        if row["goal_period"] == SHORT
    }  # fmt: skip
    walking = {base for base, score in scores.items() if score >= WALKS}
    if len(walking) < 2 or len(walking) == len(scores):
        return []
    found = contrasts(evidence.only(walking), Place("quad", SHORT), PRIMARY)
    return _table(f"The same without bases whose score at T2 is below {WALKS:g}", found, judged=True)


def _trainings(evidence: Evidence) -> list[Block]:
    """The effect of a method's goals on its own training: ground, critic and dose, base by base."""
    rows = [
        {"environment": environment, "method": name} | {
            each.name: ", ".join(f"{x:.3g}" for x in each(evidence, place, name).values()) or "-"
            for each in (LEVEL, VARIANCE, DOSE)
        }
        for environment in dict.fromkeys(name for name, _ in TITLES) for place in evidence.places(environment)[:1]
        if evidence.paired(place) and environment != ON_WARP  # whose training runs are Quad's
        for name in evidence.methods if evidence.trainings(place, name)
    ]  # fmt: skip
    return ["### Trainings, base by base", VDS_TEXT, rows] if rows else []


def _tables(evidence: Evidence, place: Place) -> list[Block]:
    """The contrasts of a place, the primary ones first if there are any."""
    known = [name for name in evidence.methods if evidence.evaluations(place, "naive", name) and name != REFERENCE]
    others = contrasts(evidence, place, sorted(set(known) - set(PRIMARY)))
    others += contrasts(evidence, place, ["vds+p75"], "vds")
    others += contrasts(evidence, place, ["vds", "vds+p75"], "uniform-ensemble")
    first, title = contrasts(evidence, place, PRIMARY), TITLES[place.environment, place.period]
    if place.environment != "quad":
        return _table(f"{title}: estimates", first + others, judged=False)
    if place.period != SHORT:
        first, others = [], first + others
    return [
        *_table(f"{title}: primary contrasts", first, judged=True),
        *_table(f"{title}: exploratory", others, judged=True),
    ]


def _table(title: str, found: Sequence[Contrast], *, judged: bool) -> list[Block]:
    return [f"### {title}", [each.row(judged=judged) for each in found]] if found else []


def _engines(evidence: Evidence) -> list[Block]:
    """p75 against uniform, base by base, on both engines; nothing if one of them was not used."""
    rows = []
    for measure in (SCORE, NAIVE):
        found = {
            title: dict(zip(each.bases, each.differences, strict=True)) for name, title in ENGINES.items()
            if (each := contrast(evidence, Place(name, SHORT), "p75", REFERENCE, measure)) is not None
        }  # fmt: skip
        if len(found) > 1:
            rows += [
                {"base": str(base), "outcome": measure.name}
                | {title: f"{own[base]:+.3g}" if base in own else "-" for title, own in found.items()}
                for base in sorted(set().union(*found.values()))
            ]
    return ["### p75 - uniform on both engines, at T2", rows] if rows else []


def bases(folder: Path = KEPT_IN) -> list[Block]:
    """The bases before anything branches off; nothing if they do not exist."""
    found: list[Block] = []
    for robot, own in ROBOTS.items():
        homes = [RunFolder(folder / base_name(robot, index)) for index in range(len(own.seeds))]
        judged = [(home, row) for home in homes for row in home.read_rows("evaluation.json")]
        rows, rough = [], preset(own.stages[-1][0]).env.terrain != "flat"  # flat ground has no levels
        for period in own.judged:
            numbers = {
                home.path.name: _of_base(home, row, rough) for home, row in judged if row["goal_period"] == period
            }
            rows += [
                {"base": name, "T": str(period)} | {what: f"{x:.3g}" for what, x in each.items()}
                for name, each in numbers.items()
            ]
            if len(numbers) > 1:
                columns = {what: [each[what] for each in numbers.values()] for what in next(iter(numbers.values()))}
                rows.append({"base": "mean ± standard deviation", "T": str(period)} | {
                    what: f"{np.mean(x):.3g} ± {np.std(x, ddof=1):.2g}" for what, x in columns.items()
                })  # fmt: skip
        found += [f"### The bases of {robot}", rows] if rows else []
    return found


def _of_base(home: RunFolder, row: Row, rough: bool) -> dict[str, float]:
    found = {"score": row["score"], "crashes per interaction [%]": 100 * row["crash_rate"], "log rate": _naive(row)}
    if rough:
        found["level at the end of training"] = float(home.read_csv("progress.csv")[-1]["level"])
    return found


def not_run(evidence: Evidence) -> list[Block]:
    """Subjects of the thesis's claims on robots that were not run, with their cost."""
    rows = []
    for robot in LEGGED:
        places = [place for place in evidence.places(robot) if evidence.paired(place)]
        ran = {name for name in evidence.methods for place in places if evidence.evaluations(place, "naive", name)}
        lacking = {
            name: (_claims(robot, partial(_of_robots, name)), CORE_HOURS[robot])
            for name in (*LEGGED_METHODS, *PENALTIES)
            if name not in ran
        }
        if LONG not in [place.period for place in places]:
            lacking["T10"] = _claims(robot, _at_t10), LONGER_HOURS[robot]
        if "rnd" not in ran or not any(evidence.places(name) for name in PARTICLE):
            lacking[WITH_PARTICLE] = _claims(robot, _beside_particle), CORE_HOURS[robot] * ("rnd" not in ran)
        rows += [
            {"robot": robot, "not run": name, "claims that speak of it": text, "would take [core-hours]": f"{hours:g}"}
            for name, (text, hours) in lacking.items() if text
        ]  # fmt: skip
    return ["### Not run", rows] if rows else []


def _of_robots(method: str, clause: Clause) -> bool:
    return method in clause.test.methods and not _beside_particle(clause)


def _beside_particle(clause: Clause) -> bool:
    return any(name.endswith("@ particle") for name in clause.test.methods)


def _at_t10(clause: Clause) -> bool:
    return LONG in clause.periods or any(name.endswith(f"@ {LONG}") for name in clause.test.methods)


def _claims(robot: str, about: Callable[[Clause], bool]) -> str:
    """The claims with clauses about something on a robot, except for what no further run can show."""
    return ", ".join(
        claim.id for claim in CLAIMS
        if any(robot in clause.environments and about(clause)
               and getattr(clause.test, "measure", None) not in UNTOLD[robot] for clause in claim.clauses)
    )  # fmt: skip


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    print(to_markdown(blocks(Evidence.of(Data.read(parser.parse_args().folder))), ""))


if __name__ == "__main__":
    main()
