"""The map over what the thesis leaves open: its settings, headline clauses, selection and confirmation (multiverse.md).

The unit is a setting: one policy of each method, all with the same seed. Rates are crashes per interaction; ``worst``
is the rate under the worst attacker.
"""

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from deimos.checks import RunError
from deimos.study import stats
from deimos.study.data import Data
from deimos.study.effects import factor_effects, instrumented_slope
from deimos.study.outcomes import settings_of
from deimos.study.permutation import p_values
from deimos.study.results import Row
from deimos.study.stats import Array, Interval
from reproduction.claims import LEAST, holm
from reproduction.measures import PENALTIES, SAFE

UNIFORM, RND = "uniform", "rnd"
NEW = ("weighted", "fear-novelty", "q-fear")
"""The new selectors."""
LEARNT, MOST_CRASHES = 0.3, 0.1  # score, and crashes per interaction under uniform goals, of a learnt task
HEADROOM = 0.01  # of interactions: Uniform's ``worst`` exceeds it in a setting with headroom
LEAST_SCORE = 0.95  # share of Uniform's score that the best selector must have
HIDDEN = 2.0  # times as many crashes under attack: uniform evaluation hides danger
AIM, AIM_SCORE = 2.0, 0.97  # aims of the confirmation: Uniform's rate over the new selector's, and the ratio of scores
CONFIDENCE = 1 - 0.05 / len(NEW)  # level of intervals in confirmation: Bonferroni over the selectors that were tried


@dataclass(frozen=True)
class Policy:
    """The outcome of a method in a setting."""

    naive: float
    """Crashes per interaction under uniform goals."""
    worst: float
    """The same under the worst attacker."""
    score: float
    """Score under uniform goals."""


@dataclass(frozen=True)
class Setting:
    """A point of the design."""

    name: str
    """Name of its environment."""
    levels: Mapping[str, Any]
    """Level of every factor."""
    screened: Policy
    """Uniform, with the screening's seed."""
    policies: Mapping[str, Policy] = field(default_factory=dict)
    """Policies of the map by method, without those that failed; none before it has run."""

    @property
    def learnt(self) -> bool:
        """Whether the screening's policy follows its goals and seldom crashes under uniform ones."""
        return self.screened.score >= LEARNT and self.screened.naive <= MOST_CRASHES

    @property
    def has_headroom(self) -> bool:
        """Whether a policy that has learnt the task has danger left to remove."""
        return self.learnt and self.screened.worst > HEADROOM

    @property
    def compares_scores(self) -> bool:
        """Whether scores can be divided by that of the map's Uniform: near 0, any ratio is possible."""
        return self.learnt and self.policies[UNIFORM].score >= LEARNT

    def score(self, method: str) -> float:
        """A method's score over Uniform's."""
        return self.policies[method].score / self.policies[UNIFORM].score


def read(screening: Path, map_: Path | None = None) -> list[Setting]:
    """The settings of a screening, in order, with the map's results there.

    Args:
        screening: Folder of the study.
        map_: Folder of the map; ``None`` if it has not run.

    Raises:
        RunError: If there are no results, not exactly one policy of Uniform for each setting, or no complete setting.
    """
    data = Data.read(screening)
    levels, screened = settings_of(data), _policies(data.rows)
    methods: list[str] = []
    found: dict[str, dict[str, Policy]] = {}
    if map_ is not None:
        rows = Data.read(map_).rows
        methods, found = sorted({row["method"] for row in rows}), _policies(rows)
    if lacking := [name for name, own in screened.items() if UNIFORM not in own]:
        raise RunError(f"{screening} must hold a policy of {UNIFORM} for every setting; {lacking[0]} has none.")
    settings = [Setting(name, levels[name], screened[name][UNIFORM], found.get(name, {})) for name in sorted(screened)]
    if not having(settings, methods):
        raise RunError(f"{map_} has no setting yet in which all of {', '.join(methods)} have finished.")
    return settings


def methods_of(settings: Sequence[Setting]) -> list[str]:
    """The methods of which the map has a policy somewhere."""
    return sorted({name for each in settings for name in each.policies})


def having(settings: Sequence[Setting], methods: Collection[str]) -> list[Setting]:
    """The settings that have a policy of every given method."""
    return [each for each in settings if {*methods} <= each.policies.keys()]


def missing(settings: Sequence[Setting]) -> dict[str, list[str]]:
    """By setting, the methods of the map of which it has no policy; complete settings are omitted."""
    names = methods_of(settings)
    lacking = {each.name: [name for name in names if name not in each.policies] for each in settings}
    return {name: own for name, own in lacking.items() if own}


def _policies(rows: Sequence[Row]) -> dict[str, dict[str, Policy]]:
    """Rows by environment and method; ``RunError`` if there is more than one."""
    found: dict[str, dict[str, Policy]] = {}
    for row in rows:
        if row["goals"] == "naive":
            own = found.setdefault(row["environment"], {})
            if row["method"] in own:
                raise RunError(f"The map has one seed; {row['environment']} has several of {row['method']}.")
            if math.isnan(row["worst"]):
                raise RunError(f"No attacker has met all policies of {row['environment']}, so none is the worst.")
            own[row["method"]] = Policy(row["crash_rate"], row["worst"], row["score"])
    return found


@dataclass(frozen=True)
class Roles:
    """The methods that the populations of Particle Gym chose for the map."""

    best_p: str
    """A Director, such as p75."""
    penalty: str
    """Uniform with a crash penalty."""

    @classmethod
    def of(cls, settings: Sequence[Setting]) -> "Roles":
        """The choice of the map; ``RunError`` unless it has one Director and one penalty."""
        names = methods_of(settings)
        directors = [name for name in names if re.fullmatch(r"p\d+(\.\d+)?", name)]
        found = [directors, [name for name in names if name in PENALTIES]]
        if [*map(len, found)] != [1, 1] or not {UNIFORM, RND, *NEW} <= {*names}:
            wanted = f"{UNIFORM}, {RND}, {', '.join(NEW)}, one pNN and one penalty"
            raise RunError(f"The map must have the methods {wanted}; it has: {', '.join(names) or 'none'}.")
        return cls(found[0][0], found[1][0])


@dataclass(frozen=True)
class Headline:
    """A clause that holds or does not hold in a setting."""

    name: str
    """In a word or two."""
    text: str
    """The clause in words."""
    methods: tuple[str, str]
    """The methods that it is about."""
    margin: Callable[[Setting], float]
    """By how much it holds in a setting; above 0 if it holds."""
    of_scores: bool = False
    """Whether it compares scores, and so applies only where these can be compared."""

    def counts_in(self, settings: Sequence[Setting]) -> list[Setting]:
        """The settings to which it applies."""
        own = having(settings, self.methods)
        return [each for each in own if each.compares_scores] if self.of_scores else own


def headlines(roles: Roles) -> list[Headline]:
    """The eight clauses of the plan: five of the thesis, and one for each new selector."""
    p, penalty = roles.best_p, roles.penalty

    def safer(own: str, other: str) -> tuple[tuple[str, str], Callable[[Setting], float]]:
        return (own, other), lambda each: each.policies[other].worst - each.policies[own].worst

    return [
        Headline("danger is hidden", "uniform crashes more than twice as often under attack", (UNIFORM, UNIFORM),
                 lambda each: each.policies[UNIFORM].worst - HIDDEN * each.policies[UNIFORM].naive),
        Headline("p is safer", f"{p} crashes less than uniform", *safer(p, UNIFORM)),
        Headline("p is free", f"{p} has more than {LEAST_SCORE:g} of uniform's score", (p, UNIFORM),
                 lambda each: each.score(p) - LEAST_SCORE, of_scores=True),
        Headline("p beats a penalty", f"{p} crashes less than {penalty}", *safer(p, penalty)),
        Headline("rnd is unsafe", "rnd crashes more than uniform", *safer(UNIFORM, RND)),
        *[Headline(f"{name} is safer", f"{name} crashes less than uniform", *safer(name, UNIFORM)) for name in NEW],
    ]  # fmt: skip


def margins(settings: Sequence[Setting], clause: Headline) -> Array:
    """By how much a clause holds in each of the settings that it counts in, shape (n,)."""
    return np.array([clause.margin(each) for each in clause.counts_in(settings)])


def share_that_holds(settings: Sequence[Setting], clause: Headline) -> Interval | None:
    """The share of settings with headroom in which a clause holds; ``None`` if none has headroom."""
    found = margins([each for each in settings if each.has_headroom], clause)
    return stats.share(found > 0.0) if len(found) else None


def coded(settings: Sequence[Setting]) -> tuple[dict[str, list[Any]], Array]:
    """The levels of every factor, numbers first, and that of each setting as -1 or 1, shape (n, k)."""
    levels = {
        name: sorted({each.levels[name] for each in settings}, key=lambda level: (isinstance(level, str), level))
        for name in settings[0].levels
    }
    if other := [name for name, own in levels.items() if len(own) > 2]:
        raise RunError(f"The factors of the map must have two levels; {', '.join(other)} has more.")
    table = [[2.0 * own.index(each.levels[name]) - 1.0 for name, own in levels.items()] for each in settings]
    return levels, np.array(table)


def moved_by(settings: Sequence[Setting], outcome: Array) -> dict[str, Interval]:
    """Effect of every factor on an outcome of the settings, the strongest first; see ``factor_effects``.

    None if there are too few settings to separate the factors, as before all of them have finished.
    """
    if not settings:
        return {}
    levels, design = coded(settings)
    try:
        found = dict(zip(levels, factor_effects(design, outcome), strict=True))
    except ValueError:
        return {}
    return dict(sorted(found.items(), key=lambda each: -abs(each[1].estimate)))


def gain_slope(settings: Sequence[Setting], method: str) -> Interval:
    """The slope of a method's gain, Uniform's ``worst`` less its own, over Uniform's.

    1 if how often it crashes does not depend on Uniform's danger, as where it never crashes; 0 if it gains the same
    everywhere, possibly nothing. The noise of the map's Uniform is on both sides; the screening's Uniform, of another
    seed, is the instrument. Settings that lack one of the two policies are excluded.
    """
    settings = having(settings, [UNIFORM, method])
    base = np.array([each.policies[UNIFORM].worst for each in settings])
    own = np.array([each.policies[method].worst for each in settings])
    return instrumented_slope(base - own, base, np.array([each.screened.worst for each in settings]))


@dataclass(frozen=True)
class Standing:
    """How a method did over the map."""

    method: str
    """Its name."""
    safe: Interval
    """Share of its policies whose ``worst`` is below 1 %."""
    worst: Interval
    """Mean of ``worst``."""
    score: Interval
    """Mean of its score over Uniform's, over the settings where scores can be compared; NaN if there is none."""


def standings(settings: Sequence[Setting]) -> list[Standing]:
    """Standings of all methods, the safest first, over the settings that have a policy of each of them."""
    names = methods_of(settings)
    whole = having(settings, names)
    scored = [each for each in whole if each.compares_scores] if names else []
    found = []
    for name in names:
        worst = np.array([each.policies[name].worst for each in whole])
        score = np.array([each.score(name) for each in scored])
        found.append(Standing(name, stats.share(worst < SAFE), mean(worst), mean(score)))
    return sorted(found, key=lambda each: (-each.safe.estimate, each.worst.estimate))


def mean(values: Array) -> Interval:
    """Interval over settings, which the bootstrap resamples; none for a single setting, NaN for no setting."""
    if len(values) < 2:
        return Interval(float(values.mean()) if len(values) else np.nan, np.nan, np.nan)
    return stats.bootstrap([values], lambda x: x.mean(axis=-1))


def best_new(found: Sequence[Standing]) -> str:
    """The new selector with the highest share of safe policies among those with ``LEAST_SCORE`` of Uniform's score.

    Ties go to the lowest mean rate; if none reaches the score, the one nearest to it is taken; if scores can be
    compared nowhere, the safest.
    """
    own = [each for each in found if each.method in NEW]
    able = [each for each in own if each.score.estimate >= LEAST_SCORE]
    return (able[0] if able else max(own, key=lambda each: each.score.estimate)).method


def most_headroom(settings: Sequence[Setting]) -> Setting | None:
    """The setting where the screening's policy crashes most under attack, of those with headroom."""
    room = [each for each in settings if each.has_headroom]
    return max(room, key=lambda each: each.screened.worst, default=None)


@dataclass(frozen=True)
class Contrast:
    """The best new selector compared with another method, in confirmation."""

    rival: str
    """The other one."""
    n: tuple[int, int]
    """Policies of the new one and of the other."""
    lower: Interval
    """By how much the new one's mean ``worst`` is lower."""
    ratio: Interval
    """The other's mean ``worst`` over the new one's."""
    score: Interval
    """The new one's mean score over the other's."""
    p: float
    """One-sided p-value for the mean rate being lower; by Holm's rule over the rivals, times the selectors that were
    tried."""

    @property
    def is_winner(self) -> bool:
        """Whether the aims of the plan are met against Uniform: beyond chance, and in the estimates."""
        return (
            self.p <= 0.05 and self.ratio.estimate >= AIM
            and self.score.estimate >= AIM_SCORE and self.score.low > LEAST_SCORE
        )  # fmt: skip


def contrasts(data: Data, environment: str, new: str) -> list[Contrast]:
    """The new selector compared with every other method of a confirmation that has enough policies."""
    found = {name: [row for row in data.rows if (row["environment"], row["method"], row["goals"]) ==
                    (environment, name, "naive")] for name in data.methods(environment)}  # fmt: skip
    worst, score = (
        {name: np.array([row[column] for row in rows]) for name, rows in found.items()} for column in ("worst", "score")
    )
    rivals = [name for name, rows in found.items() if name != new and len(rows) >= LEAST]
    if len(found.get(new, ())) < LEAST or not rivals:
        return []
    results = []
    for rival in rivals:
        pair = [worst[rival], worst[new]]
        p, _ = p_values(pair, [(0, 1)], "mean")
        results.append(Contrast(
            rival, (len(worst[new]), len(worst[rival])), _interval(pair, np.subtract), _interval(pair, _ratio),
            _interval([score[new], score[rival]], _ratio), float(p),
        ))  # fmt: skip
    corrected = [min(1.0, len(NEW) * p) for p in holm([each.p for each in results])]
    return [replace(each, p=p) for each, p in zip(results, corrected, strict=True)]


def _interval(pair: Sequence[Array], compare: Callable[[Array, Array], Array]) -> Interval:
    """Interval for a comparison of two means, at the level that accounts for the selectors that were tried."""
    return stats.bootstrap(pair, lambda x, y: compare(x.mean(axis=-1), y.mean(axis=-1)), level=CONFIDENCE)


def _ratio(x: Array, y: Array) -> Array:
    """Their ratio; infinite over zero, 1 if both are zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((x == 0.0) & (y == 0.0), 1.0, np.divide(x, y))
