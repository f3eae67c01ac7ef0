"""Numbers of single policies, which clauses compare: crashes, scores, and outcomes of training."""

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats as scipy_stats

from deimos.goals.methods import METHODS
from deimos.study.audits import diversity
from deimos.study.data import Data, delivered_dose
from deimos.study.results import Row
from deimos.study.stats import Array
from reproduction.thesis import PARTICLE

LITERAL = "-literal"  # the suffix of methods that learn fear as in the thesis, without a crash memory
PENALTIES = tuple(name for name in METHODS if name.startswith("penalty-"))
"""Uniform goals with a crash penalty, by its sizes."""
NEARLY_NONE = 1e-6  # crashes per step
SAFE = 0.01  # crashes per interaction below which a policy counts as safe

Numbers = dict[int, float]
"""Values by seed."""


@dataclass(frozen=True)
class Place:
    """A place where policies are compared."""

    environment: str
    """Name of the environment or variant."""
    period: int
    """T [steps]."""

    def __str__(self) -> str:
        return f"{self.environment}, T = {self.period}"


class Evidence:
    """The policies of a study, as the thesis names their methods.

    If an environment has Directors that learn fear as in the thesis (``p25-literal``), they are its ``p25``, and those
    with a crash memory are excluded. All policies count, including those whose attacker found nothing to learn from.

    Args:
        rows: Rows of evaluations, see ``deimos.study.results``; missing columns count as unknown.
        curves: Curves of training.
        speeds: Rounds of ``python -m benchmarks table41``; none if speed was not measured.
        renamed: False to keep the names of all methods.
    """

    def __init__(
        self, rows: Iterable[Row], curves: Iterable[Row] = (), speeds: Sequence[Mapping] = (), *, renamed: bool = True
    ) -> None:
        rows, curves = list(rows), list(curves)
        names = {row["method"] for row in [*rows, *curves]}
        self.methods = sorted({name.removesuffix(LITERAL) if renamed else name for name in names})
        """The names that are compared."""
        self._literal = {(row["environment"], row["method"]) for row in [*rows, *curves]
                         if renamed and row["method"].endswith(LITERAL)}  # fmt: skip
        self.rows: dict[tuple[str, str, str, int], dict[int, Row]] = defaultdict(dict)
        """Evaluations by method, goals, environment and T, and by seed."""
        for row in rows:
            goals = "argmax" if row["goals"] == "adversary" else row["goals"]
            self.rows[row["method"], goals, row["environment"], row["goal_period"]][row["seed"]] = row
        self.curves: dict[tuple[str, str], dict[int, Row]] = defaultdict(dict)
        """Trainings by method and environment, and by seed."""
        for row in curves:
            self.curves[row["method"], row["environment"]][row["seed"]] = row
        self.speeds = speeds
        """Rounds of Table 4.1."""
        self._blocked = {row["environment"] for row in [*rows, *curves] if row.get("block")}

    def only(self, seeds: Collection[int]) -> "Evidence":
        """The same without the policies of other seeds."""
        rows, curves = (
            [row for own in table.values() for seed, row in own.items() if seed in seeds]
            for table in (self.rows, self.curves)
        )
        found = Evidence(rows, curves, self.speeds, renamed=False)
        found.methods, found._literal = self.methods, self._literal
        return found

    @classmethod
    def of(cls, data: Data, speeds: Sequence[Mapping] = (), *, renamed: bool = True) -> "Evidence":
        """The evidence of a study."""
        return cls(data.rows, data.curve_rows, speeds, renamed=renamed)

    def places(self, environment: str) -> list[Place]:
        """Every T at which an environment was evaluated; T is 0 if only speed is known."""
        periods = sorted({period for _, _, name, period in self.rows if name == environment})
        if not periods and any(environment in each["seconds"] for each in self.speeds):
            periods = [0]
        return [Place(environment, period) for period in periods]

    def paired(self, place: Place, methods: Iterable[str] = ()) -> bool:
        """Whether policies of one seed started from the same policy, so that ``methods`` are compared seed by seed."""
        return place.environment in self._blocked and not any(name.endswith("@ particle") for name in methods)

    def evaluations(self, place: Place, goals: str, method: str) -> dict[int, Row]:
        """The rows of a method under some goals, by seed."""
        return self.rows.get((self._name(place, method), goals, place.environment, place.period), {})

    def goals(self, place: Place) -> list[str]:
        """The goals of a place's evaluations: naive, then attackers by name."""
        found = {goals for _, goals, name, period in self.rows if (name, period) == (place.environment, place.period)}
        return sorted(found, key=lambda name: (name != "naive", name))

    def trainings(self, place: Place, method: str) -> dict[int, Row]:
        """The training curves of a method, by seed."""
        return self.curves.get((self._name(place, method), place.environment), {})

    def _name(self, place: Place, method: str) -> str:
        """The name of a method in the rows of a place."""
        literal = method + LITERAL
        return literal if (place.environment, literal) in self._literal else method


@dataclass(frozen=True)
class Measure:
    """A number that every policy has."""

    name: str
    """Its name in words."""
    numbers: Callable[[Evidence, Place, str], Numbers]
    """Values of the policies of a place and method; NaN if unknown."""
    ratio: bool = False
    """Whether it is at least 0 and compared by ratios instead of differences."""
    floor: float = 0.0
    """Added before ratios are taken, so that no ratio is of zeros."""

    def __call__(self, evidence: Evidence, place: Place, method: str) -> Numbers:
        """The known values, by seed.

        ``p75 @ 500`` are the policies of p75 at that T, ``rnd @ particle`` those of all places of Particle Gym.
        """
        method, _, elsewhere = method.partition(" @ ")
        if elsewhere == "particle":
            places = [each for name in PARTICLE for each in evidence.places(name)]
            every = [self(evidence, each, method) for each in places]
            return dict(enumerate(number for found in every for number in found.values()))
        if elsewhere:
            place = Place(place.environment, int(elsewhere))
        found = self.numbers(evidence, place, method)
        return {seed: float(found[seed]) for seed in sorted(found) if not math.isnan(found[seed])}


def _column(goals: str, name: str) -> Callable[[Evidence, Place, str], Numbers]:
    def numbers(evidence: Evidence, place: Place, method: str) -> Numbers:
        found = evidence.evaluations(place, goals, method)
        return {seed: row.get(name, math.nan) for seed, row in found.items()}

    return numbers


def under(goals: str) -> Measure:
    """Crashes per interaction under one attacker."""
    return Measure(f"crashes ({goals.capitalize()})", _column(goals, "crash_rate"), ratio=True, floor=FLOOR)


def _attacked(evidence: Evidence, place: Place, method: str) -> Numbers:
    """Under the worst of the attackers that all policies met; if rows lack it, under the thesis's."""
    worst = {
        seed: row["worst"]
        for seed, row in evidence.evaluations(place, "naive", method).items()
        if not math.isnan(row.get("worst", math.nan))
    }
    return worst or _column("argmax", "crash_rate")(evidence, place, method)


def _less(first: Measure, second: Measure) -> Callable[[Evidence, Place, str], Numbers]:
    def numbers(evidence: Evidence, place: Place, method: str) -> Numbers:
        a, b = first(evidence, place, method), second(evidence, place, method)
        return {seed: a[seed] - b[seed] for seed in a.keys() & b.keys()}

    return numbers


def _curve(column: str, number: Callable[[Array], float]) -> Callable[[Evidence, Place, str], Numbers]:
    def numbers(evidence: Evidence, place: Place, method: str) -> Numbers:
        found = {seed: np.array(row.get(column, ()), float) for seed, row in evidence.trainings(place, method).items()}
        return {seed: float(number(values)) for seed, values in found.items() if values.size}

    return numbers


def _from_nothing(column: str, number: Callable[[Array], float]) -> Callable[[Evidence, Place, str], Numbers]:
    """Only for training from scratch: the first part of a branch is not a beginning."""
    of_curve = _curve(column, number)

    def numbers(evidence: Evidence, place: Place, method: str) -> Numbers:
        return {} if evidence.paired(place) else of_curve(evidence, place, method)

    return numbers


def _tail(values: Array, share: float) -> Array:
    return values[-max(1, round(share * len(values))) :]


def _known_mean(values: Array) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else math.nan


def _fall(crashes: Array, share: float = 0.2) -> float:
    """Change of log(1 + crashes per 10^6 transitions) from the first part of training to the last."""
    count = len(_tail(crashes, share))
    return math.log1p(1000 * crashes[:count].mean()) - math.log1p(1000 * crashes[-count:].mean())


def _late_fall(crashes: Array, share: float = 0.2) -> float:
    """Slope of log(1 + crashes per 10^6 transitions) over the last part of training, by a straight line."""
    y = np.log1p(1000 * _tail(crashes, share))
    return -float(np.polyfit(np.linspace(0.0, 1.0, len(y)), y, 1)[0]) if len(y) > 1 else math.nan


def _rare_halfway(crashes: Array) -> float:
    """By how much the middle fifth of training is below a tenth of its first tenth, in log crashes."""
    log = np.log1p(1000 * crashes)
    tenth = max(1, len(log) // 10)
    return float(log[:tenth].mean() - log[4 * tenth : max(6 * tenth, 4 * tenth + 1)].mean()) - math.log(10)


def _nearly_none(evidence: Evidence, place: Place, method: str) -> Numbers:
    """How far a policy is on the safe side of one crash in 10^6 steps.

    It is on the safe side if at most half of the evaluations of a policy at that limit have as few crashes, by the
    Poisson distribution. If more than half of them have none, the evaluation is too short, and nothing is known.
    """
    found = {}
    for seed, row in evidence.evaluations(place, "naive", method).items():
        at_limit = scipy_stats.poisson(NEARLY_NONE * row["steps"] * row["worlds"])
        found[seed] = 0.5 - float(at_limit.cdf(row["crashes"])) if at_limit.pmf(0) <= 0.5 else math.nan
    return found


def _where(
    measure: Measure, other: Measure, holds: Callable[[float], bool]
) -> Callable[[Evidence, Place, str], Numbers]:
    """Only the policies that satisfy a condition on another measure."""

    def numbers(evidence: Evidence, place: Place, method: str) -> Numbers:
        others = other(evidence, place, method)
        own = measure(evidence, place, method)
        return {seed: number for seed, number in own.items() if seed in others and holds(others[seed])}

    return numbers


def _standing(evidence: Evidence, place: Place, method: str) -> Numbers:
    """Share of the policies of other methods that crash less under Naive; those that crash equally often count half."""
    others = [x for name in evidence.methods if name != method for x in NAIVE(evidence, place, name).values()]
    own = NAIVE(evidence, place, method)
    return {seed: float((np.sign(x - np.array(others)) + 1).mean() / 2) for seed, x in own.items() if others}


def _speed(evidence: Evidence, place: Place, method: str) -> Numbers:
    rounds = [each["seconds"].get(place.environment, {}) for each in evidence.speeds]
    return {i: 1 / each[method] for i, each in enumerate(rounds) if method in each}


FLOOR = 1e-5  # half a crash in an evaluation of some 40 000 interactions
NAIVE = under("naive")
ATTACKED = Measure("crashes (attacked)", _attacked, ratio=True, floor=FLOOR)
SCORE = Measure("score (Naive)", _column("naive", "score"))
ATTACKED_SCORE = Measure("score (attacked)", _column("argmax", "score"))
GAIN = Measure("crashes per interaction that the attack adds", _less(ATTACKED, NAIVE))
LOSS = Measure("score that the attack costs", _less(SCORE, ATTACKED_SCORE))
LATE = Measure("crashes per 1000 transitions at the end of training",
               _curve("crashes_per_1000", lambda x: float(_tail(x, 0.1).mean())), ratio=True, floor=1e-3)  # fmt: skip
FALL = Measure("fall of log crashes over training", _from_nothing("crashes_per_1000", _fall))
LATE_FALL = Measure("fall of log crashes in the last fifth of training", _curve("crashes_per_1000", _late_fall))
HALFWAY = Measure("crashes halfway below a tenth of the first", _from_nothing("crashes_per_1000", _rare_halfway))
CHOSEN = Measure("share of goals that the Director chose", _curve("selected_fraction", lambda x: float(x.mean())))
DIVERSITY = Measure("diversity of goals", _curve("goal_map", diversity))
DOSE = Measure("delivered dose: mean percentile of fear of the goals in training",
               _curve("goal_percentile", delivered_dose))  # fmt: skip
FITTED = Measure("share of rollouts after which fear was fitted", _curve("fear_fitted", _known_mean))
EXACT_RANK = Measure("percentile of the chosen goals, tried in clones", _curve("exact_percentile", _known_mean))
AUROC = Measure("AUROC of fear within contexts", _curve("auroc", _known_mean))
LEVEL = Measure("mean level of the ground in training", _curve("level", lambda x: _known_mean(x) or math.nan))
"""Unknown on flat ground, which has no levels and where training logs 0."""
VARIANCE = Measure("explained variance of the critic in training", _curve("explained_variance", _known_mean))
MOTION = Measure("speed of the policy", _curve("speed", lambda x: float(x)))
RISK = Measure("fear at the dangerous place above that at the safe one",
               _curve("risk", lambda auroc: _known_mean(auroc) - 0.5))  # fmt: skip
FEW_CRASHES = Measure("fewer crashes than one in 10^6 steps", _nearly_none)
FPS = Measure("training speed", _speed)
SAFE_GAIN = Measure("crashes that the attack adds to safe policies", _where(GAIN, NAIVE, lambda rate: rate < SAFE))
UNSAFE_RELIEF = Measure("crashes that the attack takes from unsafe policies",
                        _where(Measure("", _less(NAIVE, ATTACKED)), NAIVE, lambda rate: rate >= SAFE))  # fmt: skip
STANDING = Measure("rank among all policies, by crashes per interaction", _standing)
OF_TRAINING = (LATE, FALL, LATE_FALL, HALFWAY, CHOSEN, DIVERSITY, DOSE, FITTED, EXACT_RANK, AUROC, MOTION, RISK, FPS)
"""Measures that do not depend on an evaluation's T."""
