"""How often verdicts are wrong, and how often right: every kind of test on simulated studies whose truth is known.

    python -m reproduction.verdicts FILE.json    # measures what the file lacks, then prints its tables

The first table shows the worst of many kinds of studies, and the largest of many shares is an overestimate. So the
second one shows every share of wrong verdicts above 5 % again, measured in different and more studies.

Policies come from four populations: ``normal``; ``lognormal``, whose logarithm has a standard deviation of 1;
``bimodal``, of which 45 % do not crash and the others crash in some 10 % of their interactions; and ``rows``, the ten
Uniform policies of Relative under attack of version 0.1.0, with a little noise. If a clause is neither clearly true nor
false, it is put on the border between the two, where both kinds of wrong verdicts are most frequent.
"""

import argparse
import json
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats as scipy_stats

from deimos.run.folder import RunFolder
from deimos.study.results import Results
from deimos.study.stats import Array
from reproduction.claim_list import CLAIMS
from reproduction.claim_tests import SETTLED_RATIO, SETTLED_SHARE, Alike, Best, Highest, Matters, Mostly, Ordered
from reproduction.claims import ALPHA, Test
from reproduction.measures import FLOOR

ROWS = Path(__file__).parent.parent / "docs/results/particle_0.1.0"
SIZES = (10, 30)
PERMUTATIONS = 199  # 5 of 200 are exactly 2.5 %
POPULATIONS = ("normal", "lognormal", "bimodal", "rows")
LARGE = 3.0  # odds of X > Y when power is measured: P = 0.75
AGAIN = ", again"  # marks, in the file, what was measured again
SPREAD = 3.0  # ratio of spreads when power is measured
OTHER_SHAPES = (("bimodal", "normal"), ("rows", "lognormal"))  # populations that differ, but not in the tested aspect


@cache
def population(name: str) -> Array:
    """A large population's crashes per interaction, the lowest first, as logarithms."""
    share = (np.arange(20_000) + 0.5) / 20_000
    if name == "normal":
        return scipy_stats.norm.ppf(share)
    if name == "lognormal":
        return -3.0 + scipy_stats.norm.ppf(share)
    rng = np.random.default_rng(0)
    if name == "bimodal":
        rate = np.where(share < 0.45, 0.0, 0.1 * np.exp(0.8 * rng.normal(size=share.shape)))
    else:
        found = [
            row["crash_rate"] for row in Results.read(ROWS).rows
            if (row["environment"], row["method"], row["goals"]) == ("relative", "uniform", "adversary")
        ]  # fmt: skip
        rate = rng.choice(found, share.shape) * np.exp(0.1 * rng.normal(size=share.shape))
    return np.sort(np.log(rate + FLOOR))


@dataclass(frozen=True)
class Policies:
    """The policies of one method."""

    population: str
    """One of ``POPULATIONS``."""
    odds: float = 1.0
    """Odds that one of them exceeds one of the population, whose powers they are (Lehmann's alternative)."""
    shift: float = 0.0
    """Added to each, after that."""
    factor: float = 1.0
    """Each is multiplied by it, before the shift."""
    rates: bool = False
    """Whether they are crashes per interaction, not their logarithms; ``normal`` ones are scores."""

    def drawn(self, rng: np.random.Generator, shape: tuple[int, int]) -> Array:
        """Draw some of them."""
        own = population(self.population)
        if self.rates and self.population != "normal":
            own = np.exp(own)
        return self.factor * own[(rng.random(shape) ** (1 / self.odds) * len(own)).astype(int)] + self.shift


Cast = Sequence[Policies]
"""The policies of every method."""


@dataclass(frozen=True)
class Scene:
    """Simulated studies of one kind."""

    name: str
    """The truth in them."""
    holds: bool | None
    """Whether the clause holds; ``None`` on the border, where both verdicts are wrong."""
    cast: Cast
    """The methods that the test compares."""


@cache
def apart(first: str, second: str) -> float:
    """The difference that separates values of one population from those of another half of the time."""
    a, b = (np.random.default_rng(i).choice(population(name), 20_000) for i, name in enumerate((first, second)))
    return float(np.median(a - b))


def scenes(test: Test) -> list[Scene]:
    """The simulated studies for a test."""
    match test:
        case Ordered(spread=False):
            return _ordered(_numbers(test))
        case Ordered():
            return _spread(_numbers(test))
        case Alike():
            return _alike(test)
        case Mostly():
            cases = (("half of the policies", None, 0.5), ("90 %", True, 0.9), ("10 %", False, 0.1))
            return [Scene(name, holds, [Policies("normal", shift=float(scipy_stats.norm.ppf(share)))])
                    for name, holds, share in cases]  # fmt: skip
        case Highest():
            return _highest(len(test.rivals))
        case Matters():
            return _matters(len(test.methods))
    raise ValueError(f"test must be one of a clause's, got {test}.")


def _numbers(test: Ordered) -> list[tuple[int, int]]:
    return [(test.methods.index(a), test.methods.index(b)) for a, b in test.pairs]


def _places(pairs: Sequence[tuple[int, int]]) -> list[float]:
    """For every method: 1 if it is claimed to have more than the others, 0 if less; in an order, by its position."""
    count = 1 + max(max(pair) for pair in pairs)
    wins, losses = ([sum(pair[side] == i for pair in pairs) for i in range(count)] for side in (0, 1))
    return [win / (win + loss) for win, loss in zip(wins, losses, strict=True)]


def _ordered(pairs: Sequence[tuple[int, int]]) -> list[Scene]:
    places, found = _places(pairs), []
    side = max(([i for i, x in enumerate(places) if x == end] for end in (0.0, 1.0)), key=len)
    half = side[: len(side) // 2 * 2]
    mixed = [LARGE ** (1 - 2 * (half.index(i) % 2)) if i in half else 1.0 for i in range(len(places))]
    for one in POPULATIONS if len(pairs) == 1 else ("normal", "rows"):
        found.append(Scene(f"all alike, {one}", None, [Policies(one)] * len(places)))
        if one == "normal" and half and set(places) == {0.0, 1.0}:  # half of the larger side is better, half is worse
            found.append(Scene(f"better and worse ones, {one}", None, [Policies(one, odds) for odds in mixed]))
        for holds, odds in ((True, LARGE), (False, 1 / LARGE)):
            found.append(Scene(f"P = 0.75, {one}", holds, [Policies(one, odds**x) for x in places]))
    for one, other in OTHER_SHAPES:
        cast = [Policies(one, shift=-apart(one, other)) if x == 1.0 else Policies(other) for x in places]
        found.append(Scene(f"{one} against {other}", None, cast))
    return found


def _spread(pairs: Sequence[tuple[int, int]]) -> list[Scene]:
    places, found = _places(pairs), []
    for one in POPULATIONS:
        cases = (("all alike", None, 1.0, 0.0), ("apart", None, 1.0, 1.0), (f"ratio {SPREAD:g}", True, SPREAD, 0.0),
                 (f"ratio {SPREAD:g}", False, 1 / SPREAD, 0.0))  # fmt: skip
        for name, holds, factor, shift in cases:
            cast = [Policies(one, factor=factor**x, shift=shift * x, rates=True) for x in places]
            found.append(Scene(f"{name}, {one}", holds, cast))
    return found


def _alike(test: Alike) -> list[Scene]:
    found = []
    scale = 1.0 if test.measure.ratio else 0.05  # for scores, whose standard deviation is some 0.05
    for one in POPULATIONS:
        for name, holds, margins in (("at the margin", None, 1), ("equal", True, 0), ("5 margins apart", False, 5)):
            cast = [Policies(one, shift=margins * test.settled, factor=scale), Policies(one, factor=scale)]
            found.append(Scene(f"{name}, {one}", holds, cast))
    for one, other in OTHER_SHAPES:
        shift = test.settled - scale * apart(one, other)
        cast = [Policies(one, shift=shift, factor=scale), Policies(other, factor=scale)]
        found.append(Scene(f"at the margin, {one} against {other}", None, cast))
    return found


def _highest(rivals: int) -> list[Scene]:
    cases = (("all alike", None, 1.0, 1.0), ("one other as good", None, 1.0, 0.1), ("far ahead", True, 20.0, 1.0),
             ("far behind", False, 0.05, 1.0))  # fmt: skip
    return [
        Scene(f"{name}, {one}", holds, [Policies(one, own), Policies(one), *[Policies(one, others)] * (rivals - 1)])
        for one in ("normal", "lognormal") for name, holds, own, others in cases
    ]  # fmt: skip


def _matters(methods: int) -> list[Scene]:
    """The policies of all methods in the one measure, and then in the other."""

    def cast(one: str, more: float, less: float) -> Cast:
        return [Policies(one, strength ** (2 * i / (methods - 1) - 1)) for strength in (more, less)
                for i in range(methods)]  # fmt: skip

    cases = (("neither", None, 1.0, 1.0), ("equally", None, LARGE, LARGE), ("more", True, 2 * LARGE, 1.0),
             ("less", False, 1.0, 2 * LARGE))  # fmt: skip
    return [Scene(f"{name}, {one}", holds, cast(one, more, less))
            for one in POPULATIONS for name, holds, more, less in cases]  # fmt: skip


def judged(test: Test, samples: Sequence[Array]) -> tuple[Array, Array]:
    """p-values for and against in simulated studies, two-sided if the test is, each of shape (studies,)."""
    match test:
        case Ordered():
            found = test.p_values(samples, _numbers(test), PERMUTATIONS)
        case Alike():
            return test.p_values(samples[0], samples[1], PERMUTATIONS)
        case Mostly():
            found = test.p_values(samples[0])
        case Highest():
            found = test.p_values(samples[0], samples[1:])
        case Matters():
            count = len(test.methods)
            both = np.stack([np.concatenate(part, axis=-1) for part in (samples[:count], samples[count:])], axis=1)
            found = test.p_values(both, [samples[0].shape[-1]] * count, PERMUTATIONS)
        case _:
            raise ValueError(f"test must be one of a clause's, got {test}.")
    more, less = found
    return np.minimum(1.0, 2 * more), np.minimum(1.0, 2 * less)


def kinds() -> dict[str, tuple[Test, list[str]]]:
    """The kinds of tests that clauses have, by name: one of each, and the claims that use it.

    A test of one group against a larger one is that of the larger against the one, the other way round.
    """
    found: dict[str, tuple[Test, list[str]]] = {}
    for claim, test in [(each, clause.test) for each in CLAIMS for clause in each.clauses]:
        halved = isinstance(test, Best)
        own = test.then("a", "b") if isinstance(test, Best) else test
        match own:
            case Ordered():
                first, second = ({*side} for side in zip(*own.pairs, strict=True))
                if len(first) > len(second):
                    first, second = second, first
                    own = replace(own, pairs=tuple((b, a) for a, b in own.pairs))
                order = ", an order" if first & second else ""
                name = f"{'spread' if own.spread else 'more'}: {len(first)} against {len(second)}{order}"
            case Alike():
                name = ("at most" if own.at_most else "alike") + f", {'ratio' if own.measure.ratio else 'difference'}"
            case Highest():
                name = f"highest of {len(own.methods)}"
            case Matters():
                name = f"matters more, {len(own.methods)} methods"
            case _:
                name = "most policies"
        name += ", half of the seeds" if halved else ""
        _, ids = found.setdefault(name, (own, []))
        if claim.id not in ids:
            ids.append(claim.id)
    return found


def measure(test: Test, scene: Scene, n: int, studies: int, seed: Sequence[int]) -> tuple[float, float]:
    """Shares of studies with n policies a method in which the clause holds, and in which it does not."""
    rng = np.random.default_rng([*seed, n])
    samples = [policies.drawn(rng, (studies, n)) for policies in scene.cast]
    p_for, p_against = judged(test, samples)
    holds = p_for <= ALPHA
    return float(holds.mean()), float((~holds & (p_against <= ALPHA)).mean())


def run(path: Path, studies: int, again: int) -> dict[str, list]:
    """Measure the shares of both verdicts in every scene that a file lacks.

    If more than ``ALPHA`` of the studies reach a wrong verdict, the scene is measured again, in other studies.
    """
    known: dict[str, list] = json.loads(path.read_text()) if path.exists() else {}

    def measured(key: str, *asked: Any) -> list:
        if key not in known:
            known[key] = [*measure(*asked)]
            RunFolder(path.parent).write_json(path.name, known)
        return known[key]

    for n, (name, (test, _)) in product(SIZES, kinds().items()):
        size = n // 2 if name.endswith("half of the seeds") else n
        for number, scene in enumerate(scenes(test)):
            first = measured(_key(name, n, scene, studies), test, scene, size, studies, [number])
            if max(_wrong(scene, first)) > ALPHA:
                measured(_key(name, n, scene, again, AGAIN), test, scene, size, again, [number, again])
    return known


def _wrong(scene: Scene, shares: Sequence[float]) -> tuple[float, float]:
    """Shares of wrong verdicts, of those that a clause holds and does not hold; 0 for a verdict that is right."""
    holds, does_not = shares
    return 0.0 if scene.holds else holds, 0.0 if scene.holds is False else does_not


def _key(name: str, n: int, scene: Scene, studies: int, series: str = "") -> str:
    return f"{name}; {n}; {scene.name}; {scene.holds}; {studies}{series}"


def table(known: dict[str, list], studies: int) -> list[str]:
    """Lines of Markdown: a row for every kind of test and number of policies that is complete, its worst scenes."""
    lines = [
        "| test | in | n | holds, wrongly | does not hold, wrongly | worst case | holds, rightly | does not, rightly |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (name, (test, ids)), n in product(kinds().items(), SIZES):
        rates: dict[bool | None, list[tuple[float, float, str]]] = defaultdict(list)
        keys = {_key(name, n, scene, studies): scene for scene in scenes(test)}
        if not keys.keys() <= known.keys():
            continue
        for key, scene in keys.items():
            rates[scene.holds].append((*known[key], scene.name))
        border, true, false = rates[None], rates[True], rates[False]
        yes, no = max(border + false, key=lambda x: x[0]), max(border + true, key=lambda x: x[1])
        where = yes[2] if yes[0] >= no[1] else no[2]
        rightly = [f"{min(x[i] for x in part):.0%} to {max(x[i] for x in part):.0%}"
                   for i, part in ((0, true), (1, false))]  # fmt: skip
        lines.append(
            f"| {name} | {', '.join(ids)} | {n} | {yes[0]:.1%} | {no[1]:.1%} | {where} | {' | '.join(rightly)} |"
        )
    return lines


def table_again(known: dict[str, list], studies: int, again: int) -> list[str]:
    """Lines of Markdown: a row for every share of wrong verdicts above ``ALPHA``, and the result of other studies."""
    lines = ["| test | n | case | wrong verdict | first | again | 95 % |", "|---|---|---|---|---|---|---|"]
    for (name, (test, _)), n in product(kinds().items(), SIZES):
        for scene in scenes(test):
            keys = _key(name, n, scene, studies), _key(name, n, scene, again, AGAIN)
            if not {*keys} <= known.keys():
                continue
            first, second = (_wrong(scene, known[key]) for key in keys)
            for verdict, one, other in zip(("holds", "does not hold"), first, second, strict=True):
                if one > ALPHA:
                    bounds = scipy_stats.binomtest(round(other * again), again).proportion_ci(method="exact")
                    span = f"{bounds.low:.1%} to {bounds.high:.1%}"
                    lines.append(f"| {name} | {n} | {scene.name} | {verdict} | {one:.1%} | {other:.1%} | {span} |")
    return lines


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--studies", type=int, default=500, help="simulated studies of each kind")
    parser.add_argument("--again", type=int, default=2000, help="studies where 5 %% of the first ones went wrong")
    options = parser.parse_args()
    known = run(options.file, options.studies, options.again)
    print("\n".join(table(known, options.studies)))
    error = math.sqrt(ALPHA * (1 - ALPHA) / options.studies)
    print(f"\n{options.studies} studies of each kind: a rate of 5 % has a standard error of {error:.1%}. Alike is "
          f"settled within a ratio of {SETTLED_RATIO:g}, or {SETTLED_SHARE:g} of the score.\n")  # fmt: skip
    print("\n".join(table_again(known, options.studies, options.again)))


if __name__ == "__main__":
    main()
