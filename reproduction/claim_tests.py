"""The kinds of tests that clauses are made of. The unit is one trained policy; every test is a permutation test.

``Ordered`` compares methods by P(X > Y), or by their spread; ``Alike`` asks within which ratio two are equivalent;
``Mostly`` looks at each policy separately; ``Highest`` only at the best policies; ``Matters`` at how much depends on
the method; ``Best`` chooses the methods on half of the seeds and applies another test on the others.

If policies of one seed started from the same policy, the seed is a block: methods are compared within blocks, labels
are permuted within them, and resamples are of blocks.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy import stats as scipy_stats

from deimos.study import permutation, stats
from deimos.study.permutation import Pairs
from deimos.study.stats import POWER, Array, Interval
from reproduction.claims import ALPHA, LEAST, LEAST_BASES, Finding, Test
from reproduction.measures import Evidence, Measure, Numbers, Place

SETTLED_RATIO = 1.5  # an equivalence is settled within this ratio,
SETTLED_SHARE = 0.05  # or, for quantities without ratios, within this share of the score's range from 0 to 1
RESAMPLES = 2000


@dataclass(frozen=True)
class Ordered:
    """The first method of each pair has more than the second: P(X > Y), averaged over the pairs."""

    measure: Measure
    pairs: tuple[tuple[str, str], ...]
    """Names of methods; a pair counts where both have enough policies."""
    spread: bool = False
    """Whether the first varies more, instead of having more."""

    @property
    def methods(self) -> tuple[str, ...]:
        """See ``Test``."""
        return tuple(dict.fromkeys(name for pair in self.pairs for name in pair))

    def __str__(self) -> str:
        first, second = (dict.fromkeys(names) for names in zip(*self.pairs, strict=True))
        order = self.methods if first.keys() & second.keys() else (", ".join(first), ", ".join(second))
        return f"{'spread of ' if self.spread else ''}{self.measure.name}: {' > '.join(order)}"

    def find(self, evidence: Evidence, place: Place) -> Finding | None:
        """See ``Test``."""
        samples = samples_of(self.measure, evidence, place, self.methods)
        pairs = [pair for pair in self.pairs if set(pair) <= samples.keys()]
        if not pairs:
            return None
        names = [name for name in samples if any(name in pair for pair in pairs)]
        numbers = [(names.index(a), names.index(b)) for a, b in pairs]
        values, paired = [samples[name] for name in names], evidence.paired(place, self.methods)
        if self.spread:
            statistic, effect, at = permutation.log_spread_ratio(numbers), "ratio of spreads", 1.0
        else:
            order = permutation.superiority_in_blocks if paired else permutation.superiority
            statistic, effect, at = order(numbers), "P(X > Y)", 0.5
        if paired:
            centred = [x - np.median(x) for x in values] if self.spread else values
            more, less = permutation.p_values_in_blocks(centred, statistic)
        else:
            more, less = map(float, self.p_values(values, numbers))
        if paired and not self.spread and len(pairs) == 1:  # a bootstrap of bases that agree has no width
            found = stats.share_of_pairs(*values)
        else:
            found = stats.bootstrap(values, statistic, resamples=RESAMPLES, paired=paired)
        return Finding(
            effect=effect, interval=_exp(found) if self.spread else found, no_difference=at,
            p_for=min(1.0, 2 * more), p_against=min(1.0, 2 * less), detectable=self._detectable(samples, pairs, paired),
            n={name: len(samples[name]) for name in names},
        )  # fmt: skip

    def _detectable(self, samples: Mapping[str, Array], pairs: Sequence[tuple[str, str]], paired: bool) -> float:
        """In blocks as for independent policies, but nothing if even n of n signs are not significant."""
        sizes = [sum(len(samples[name]) for name in dict.fromkeys(side)) for side in zip(*pairs, strict=True)]
        if paired and len(pairs) == 1 and math.isinf(stats.detectable_share(sizes[0])):
            return math.inf
        return permutation.detectable_spread(*sizes) if self.spread else stats.detectable_probability(*sizes)

    def p_values(self, samples: Sequence[Array], pairs: Pairs, permutations: int | None = None) -> tuple[Array, Array]:
        """One-sided p-values for and against, of samples of shape (studies, n)."""
        kind: permutation.Kind = "spread" if self.spread else "superiority"
        return permutation.p_values(samples, pairs, kind, permutations=permutations)


@dataclass(frozen=True)
class Alike:
    """Policies of two methods are alike: the ratio, or difference, within which neither has more than the other.

    The ratio r is the smallest for which both P(X > r Y) and P(Y > r X) are significantly below 1/2: two one-sided
    tests [1]_ of level 5 %. Half of the time it separates a policy of one from a policy of the other.

    References:
        .. [1] Schuirmann, *A comparison of the two one-sided tests procedure and the power approach*,
           J. Pharmacokinetics and Biopharmaceutics 15, 1987.
    """

    measure: Measure
    first: str
    second: str
    at_most: bool = False
    """Whether only the first must not have more than the second."""

    @property
    def methods(self) -> tuple[str, ...]:
        """See ``Test``."""
        return self.first, self.second

    def __str__(self) -> str:
        return f"{self.measure.name}: {self.first} {'at most' if self.at_most else '='} {self.second}"

    @property
    def settled(self) -> float:
        """The margin within which it is settled, as a difference of the results of ``values``."""
        return math.log(SETTLED_RATIO) if self.measure.ratio else SETTLED_SHARE

    def values(self, x: Array) -> Array:
        """The values whose differences are taken."""
        return np.log(x + self.measure.floor) if self.measure.ratio else x

    def find(self, evidence: Evidence, place: Place) -> Finding | None:
        """See ``Test``."""
        samples = samples_of(self.measure, evidence, place, self.methods)
        if len(samples) < 2:
            return None
        x, y = (self.values(samples[name]) for name in self.methods)
        sides = _sides_in_blocks if evidence.paired(place, self.methods) else _sides
        # Without blocks Hodges and Lehmann's estimate of the shift.
        middle = float(np.median(x - y if sides is _sides_in_blocks else x[:, None] - y))
        interval = Interval(middle, -_furthest(y, x, sides), _furthest(x, y, sides))
        reachable = self._reachable(len(x)) if sides is _sides_in_blocks else (0.0, 0.0)
        within = max(interval.high, 0.0 if self.at_most else -interval.low)
        p_for, p_against = map(float, self.p_values(x, y, sides=sides))
        error = (interval.high - interval.low) / (2 * scipy_stats.norm.ppf(1 - ALPHA))
        power = POWER if self.at_most else (1 + POWER) / 2  # of two one-sided tests each must find it
        reach = float(scipy_stats.norm.ppf(1 - ALPHA) + scipy_stats.norm.ppf(power)) * error
        effect, within = "difference", max(within, 0.0)
        if self.measure.ratio:
            effect, interval = "ratio", _exp(interval)
            with np.errstate(over="ignore"):
                within, reach = np.exp([within, reach]).tolist()
        return Finding(
            effect=effect, interval=interval, no_difference=1.0 if self.measure.ratio else 0.0, p_for=p_for,
            p_against=p_against, detectable=math.inf if max(reachable) > ALPHA else reach,
            n={name: len(samples[name]) for name in self.methods}, equivalent_within=within, reachable=reachable,
        )  # fmt: skip

    def _reachable(self, blocks: int) -> tuple[float, float]:
        """Smallest p-values for and against in so many blocks: if no policy differs, and if all differ alike."""
        same, sides = np.zeros(blocks), _sides_in_blocks
        p_for, _ = self.p_values(same, same, sides=sides)
        return float(p_for), float(self.p_values(same + 2 * self.settled, same, sides=sides)[1])

    def p_values(
        self, x: Array, y: Array, permutations: int | None = None, *, sides: "Sides | None" = None
    ) -> tuple[Array, Array]:
        """p-values for and against being settled, for ``values`` of shape (..., n); ``sides`` as in ``_sides``."""
        sides = sides or _sides
        above, below = sides(x, y, self.settled, permutations)
        if self.at_most:
            return below, above
        back_above, back_below = sides(y, x, self.settled, permutations)
        return np.maximum(below, back_below), np.minimum(1.0, 2 * np.minimum(above, back_above))


Sides = Callable[[Array, Array, float, int | None], tuple[Array, Array]]


def _sides(x: Array, y: Array, margin: float, permutations: int | None = None) -> tuple[Array, Array]:
    """p-values for x being above y + margin more often than not, and for being below."""
    return permutation.p_values([x, y + margin], [(0, 1)], "superiority", permutations=permutations)


def _sides_in_blocks(x: Array, y: Array, margin: float, permutations: int | None = None) -> tuple[Array, Array]:
    """The same for paired values, shapes (n,)."""
    order = permutation.superiority_in_blocks([(0, 1)])
    more, less = permutation.p_values_in_blocks([x, y + margin], order, permutations=permutations)
    return np.asarray(more), np.asarray(less)


def _furthest(x: Array, y: Array, sides: Sides) -> float:
    """Smallest shift d, to 1 %, for which P(x > y + d) is significantly below 1/2, at 5 % on this side."""
    low, high = float(x.min() - y.max()) - 0.01, float(x.max() - y.min()) + 0.01
    if sides(x, y, high, None)[1] > ALPHA:
        return math.inf
    while high - low > 0.01:
        middle = (low + high) / 2
        low, high = (low, middle) if sides(x, y, middle, None)[1] <= ALPHA else (middle, high)
    return high


@dataclass(frozen=True)
class Mostly:
    """Most policies of some methods have a positive number: the exact sign test. Policies at 0 count half."""

    measure: Measure
    methods: tuple[str, ...]
    """See ``Test``; their policies are pooled."""

    def __str__(self) -> str:
        return f"{self.measure.name}: for most policies of {', '.join(self.methods)}"

    def find(self, evidence: Evidence, place: Place) -> Finding | None:
        """See ``Test``."""
        numbers = {name: found for name in self.methods if (found := self.measure(evidence, place, name))}
        if evidence.paired(place):  # a block counts once, by the mean of its policies
            seeds = sorted({seed for own in numbers.values() for seed in own})
            x = np.array([np.mean([own[seed] for own in numbers.values() if seed in own]) for seed in seeds])
        else:
            x = np.array([number for own in numbers.values() for number in own.values()])
        if (n := len(x)) < LEAST:
            return None
        positive = round(n * (np.sign(x) + 1).mean() / 2)
        p_for, p_against = (min(1.0, 2 * float(p)) for p in self.p_values(x))
        return Finding(
            effect="share of policies", interval=stats.share(np.arange(n) < positive), no_difference=0.5,
            p_for=p_for, p_against=p_against, detectable=stats.detectable_share(n),
            n={name: len(own) for name, own in numbers.items()},
        )  # fmt: skip

    def p_values(self, x: Array) -> tuple[Array, Array]:
        """One-sided p-values for and against, of samples of shape (..., n)."""
        up, down = (x > 0).sum(axis=-1), (x < 0).sum(axis=-1)
        coin = scipy_stats.binom(up + down, 0.5)
        return coin.sf(up - 1), coin.sf(down - 1)


@dataclass(frozen=True)
class Highest:
    """The highest value of all belongs to a method: how many of its policies are above all of another's [1]_.

    It must exceed each of the others; a single one that exceeds it, by Bonferroni's rule, is enough against it. The
    number is that of its policies above all others', or, negative, of the others' above all of its own.

    References:
        .. [1] Rosenbaum, *Tables for a Nonparametric Test of Location*, Annals of Mathematical Statistics 25, 1954.
    """

    measure: Measure
    method: str
    rivals: tuple[str, ...]

    @property
    def methods(self) -> tuple[str, ...]:
        """See ``Test``."""
        return (self.method, *self.rivals)

    def __str__(self) -> str:
        return f"highest {self.measure.name}: {self.method}"

    def find(self, evidence: Evidence, place: Place) -> Finding | None:
        """See ``Test``."""
        samples = samples_of(self.measure, evidence, place, self.methods)
        own = samples.pop(self.method, None)
        if own is None or not samples:
            return None
        rivals = list(samples.values())
        p_for, p_against = (min(1.0, 2 * float(p[0])) for p in self.p_values(own[None], [x[None] for x in rivals]))
        top = max(float(x.max()) for x in rivals)
        above = (own > top).sum() or -max((x > own.max()).sum() for x in rivals)
        sizes = len(own), len(rivals[0])
        enough = next((k for k in range(1, len(own) + 1) if 2 * _on_top(*sizes, k) <= ALPHA), math.inf)
        return Finding(
            effect="policies above all others'", interval=Interval(float(above), math.nan, math.nan), no_difference=0.0,
            p_for=p_for, p_against=p_against, detectable=float(enough),
            n={name: len(x) for name, x in {self.method: own, **samples}.items()},
        )  # fmt: skip

    def p_values(self, own: Array, rivals: Sequence[Array]) -> tuple[Array, Array]:
        """One-sided p-values for and against, of samples of shape (studies, n)."""
        ahead = [_rosenbaum(own, x) for x in rivals]
        behind = [_rosenbaum(x, own) for x in rivals]
        return np.max(ahead, axis=0), np.minimum(1.0, len(rivals) * np.min(behind, axis=0))


def _rosenbaum(x: Array, y: Array) -> Array:
    count = (x > y.max(axis=-1, keepdims=True)).sum(axis=-1)
    return _on_top(x.shape[-1], y.shape[-1], count)


def _on_top(n: int, m: int, count: Array | int) -> Array:
    """Probability that the ``count`` highest of n + m exchangeable values are all of the n."""
    return scipy_stats.hypergeom(n + m, n, count).pmf(count)


@dataclass(frozen=True)
class Matters:
    """One measure depends more on the method than another.

    The number is the share of the variance of ranks between methods: omega^2 [1]_, not biased by the number of methods,
    over the policies that have both. Under the null hypothesis every policy might as well have its two ranks exchanged.

    References:
        .. [1] Hays, *Statistics for Psychologists*, 1963, chapter 12.
    """

    more: Measure
    less: Measure
    methods: tuple[str, ...]
    """See ``Test``."""

    def __str__(self) -> str:
        return f"variance between methods: {self.more.name} > {self.less.name}"

    def find(self, evidence: Evidence, place: Place) -> Finding | None:
        """See ``Test``."""
        more, less, paired = {}, {}, evidence.paired(place)
        for name in self.methods:
            a, b = (measure(evidence, place, name) for measure in (self.more, self.less))
            more[name], less[name] = ({seed: x[seed] for seed in a.keys() & b.keys()} for x in (a, b))
        both = [*_enough(more, paired).items()]
        if len(both) < 3:
            return None
        sizes = [len(x) for _, x in both]
        values = np.array([np.concatenate([*_enough(own, paired).values()]) for own in (more, less)])
        p_for, p_against = (min(1.0, 2 * float(p[0])) for p in self.p_values(values[None], sizes, paired=paired))
        ranks = scipy_stats.rankdata(values, axis=-1)
        interval, error = self._interval(ranks, sizes, paired)
        reach = float(scipy_stats.norm.ppf(1 - ALPHA / 2) + scipy_stats.norm.ppf(POWER)) * error
        if paired and math.isinf(stats.detectable_share(sizes[0])):  # blocks are exchanged like signs are flipped
            reach = math.inf
        return Finding(
            effect="difference in omega^2", interval=interval, no_difference=0.0, p_for=p_for, p_against=p_against,
            detectable=reach, n={name: len(x) for name, x in both},
        )  # fmt: skip

    def p_values(
        self, values: Array, sizes: Sequence[int], permutations: int = 999, *, paired: bool = False
    ) -> tuple[Array, Array]:
        """One-sided p-values for and against, of values of shape (studies, 2, policies).

        If they are ``paired``, sizes are equal, and the policies of a block are exchanged together; if there are no
        more ways to do so than ``permutations``, the p-values are exact.
        """
        ranks = scipy_stats.rankdata(values, axis=-1)
        number = sizes[0] if paired else sum(sizes)
        if paired and 2**number <= permutations:
            swapped = np.array([*product((False, True), repeat=number)])[:, None]  # the first of them is the identity
        else:
            swapped = np.random.default_rng(0).random((permutations + 1, 1, number)) < 0.5
            swapped[0] = False
        swapped = np.tile(swapped, len(sizes)) if paired else swapped
        found = []
        for own in ranks:
            mixed = np.where(swapped, own[::-1], own)
            share = omega_squared(mixed, sizes)
            difference = share[:, 0] - share[:, 1]
            found.append([(side * difference >= side * difference[0] - 1e-9).mean() for side in (1, -1)])
        more, less = np.array(found).T
        return more, less

    def _interval(self, ranks: Array, sizes: Sequence[int], paired: bool) -> tuple[Interval, float]:
        ends = np.cumsum(sizes)
        drawn = [np.random.default_rng(0 if paired else i).integers(end - n, end, (RESAMPLES, n))
                 for i, (end, n) in enumerate(zip(ends, sizes, strict=True))]  # fmt: skip
        share = omega_squared(ranks[:, np.concatenate(drawn, axis=1)], sizes)
        difference = share[0] - share[1]
        low, high = np.quantile(difference, stats.ENDS)
        own = omega_squared(ranks, sizes)
        return Interval(float(own[0] - own[1]), float(low), float(high)), float(difference.std())


def omega_squared(values: Array, sizes: Sequence[int]) -> Array:
    """Share of the variance between consecutive groups along the last axis, less what chance explains."""
    groups = np.split(values, np.cumsum(sizes)[:-1], axis=-1)
    total = ((values - values.mean(axis=-1, keepdims=True)) ** 2).sum(axis=-1)
    within = sum(((x - x.mean(axis=-1, keepdims=True)) ** 2).sum(axis=-1) for x in groups)
    error = within / (values.shape[-1] - len(groups))
    over = np.where(total > 0, total + error, 1)
    return np.where(total > 0, (total - within - (len(groups) - 1) * error) / over, 0.0)


@dataclass(frozen=True)
class Best:
    """A test between the best of some methods and the best of others.

    The best are those with the lowest mean on every other seed; they are tested on the rest.
    """

    measure: Measure
    directors: tuple[str, ...]
    rivals: tuple[str, ...]
    then: Callable[[str, str], Test]
    """The test of the two that were chosen."""

    @property
    def methods(self) -> tuple[str, ...]:
        """See ``Test``."""
        return self.directors + self.rivals

    def __str__(self) -> str:
        return f"on other seeds: {self.then('the best Director', 'the best baseline')}"

    def find(self, evidence: Evidence, place: Place) -> Finding | None:
        """See ``Test``."""
        numbers = {name: self.measure(evidence, place, name) for name in self.methods}
        seeds = sorted({seed for own in numbers.values() for seed in own})
        choosing, testing = (set(seeds[start::2]) for start in (0, 1))
        chosen = []
        for group in (self.directors, self.rivals):
            own = {name: [numbers[name][seed] for seed in choosing & numbers[name].keys()] for name in group}
            means = {name: float(np.mean(x)) for name, x in own.items() if len(x) >= LEAST}
            if not means:
                return None
            chosen.append(min(means, key=means.__getitem__))
        found = self.then(*chosen).find(evidence.only(testing), place)
        return None if found is None else replace(found, chosen=f"{chosen[0]} against {chosen[1]}")


def samples_of(measure: Measure, evidence: Evidence, place: Place, methods: Sequence[str]) -> dict[str, Array]:
    """The samples of the methods that have enough policies; in blocks, only of the blocks that all of them have.

    Methods that lack blocks needed for a verdict are excluded if two or more others have them.
    """
    return _enough({name: measure(evidence, place, name) for name in methods}, evidence.paired(place, methods))


def _enough(numbers: Mapping[str, Numbers], paired: bool) -> dict[str, Array]:
    found = {name: own for name, own in numbers.items() if len(own) >= LEAST}
    if paired and found:
        whole = {name: own for name, own in found.items() if len(own) >= LEAST_BASES}
        found = whole if len(whole) > 1 else found
        shared = set.intersection(*map(set, found.values()))
        found = {name: {seed: own[seed] for seed in own if seed in shared} for name, own in found.items()}
    return {name: np.array([own[seed] for seed in sorted(own)]) for name, own in found.items() if len(own) >= LEAST}


def _exp(interval: Interval) -> Interval:
    with np.errstate(over="ignore"):
        return Interval(*np.exp([interval.estimate, interval.low, interval.high]).tolist())


def versus(first: Sequence[str], second: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """All pairs of two groups of methods."""
    return tuple((a, b) for a in first for b in second if a != b)


def falling(methods: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """All pairs of an order, whose first has more, as in the Jonckheere-Terpstra test."""
    return tuple((a, b) for i, a in enumerate(methods) for b in methods[i + 1 :])
