"""Tests that a single claim needs; each factory gives the function that a ``Claim`` holds."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise

import numpy as np
from scipy import stats as scipy_stats

from deimos.study import stats
from deimos.study.data import Data, Where
from deimos.study.stats import Array, Interval
from reproduction import claim_tests as tests
from reproduction import significance
from reproduction.claims import Finding
from reproduction.thesis import ACHIEVED, DIRECTOR_METHODS, DIRECTORS

Findings = Callable[[Data, str], list[Finding]]
CRASHES = "log_crashes"
PERMUTATIONS = 2000
SPLIT_SEEDS = 20  # fewer cannot be split into a half that chooses and a half that tests
NEARLY_NONE = 1e-6  # crashes per step


def _samples(data: Data, where: Where, methods: Sequence[str], metric: str = CRASHES) -> dict[str, Array]:
    found = {name: data.sample(where, name, metric) for name in methods}
    return {name: x for name, x in found.items() if len(x) >= tests.LEAST}


def kruskal(goals: str) -> Findings:
    """Crashes do not depend on p: Kruskal and Wallis, which can only contradict."""

    def findings(data: Data, environment: str) -> list[Finding]:
        found = []
        for where in data.places(environment, goals):
            samples = list(_samples(data, where, DIRECTORS).values())
            if len(samples) < 2:
                continue
            values = np.concatenate(samples)
            h, p = scipy_stats.kruskal(*samples) if np.ptp(values) > 0 else (0.0, 1.0)
            share = Interval(float(h / (len(values) - 1)), math.nan, math.nan)  # epsilon squared
            found.append(Finding(
                what="crashes differ between values of p", where=where, effect="epsilon^2", interval=share,
                p_for=1.0, p_against=float(p), detectable=tests.by_ranks(samples), wanted=tests.PROBABILITY,
                n=tuple(map(len, samples)), required=False,
            ))  # fmt: skip
        return found

    return findings


def highest_reward(goals: str, method: str) -> Findings:
    """The single highest reward belongs to a method: against each other method, whose policies reach higher."""

    def findings(data: Data, environment: str) -> list[Finding]:
        found = []
        for where in data.places(environment, goals):
            own = data.sample(where, method, "reward")
            for rival in data.methods(environment):
                if rival != method:
                    what = f"highest reward: {method} > {rival}"
                    found += tests.higher(what, where, own, data.sample(where, rival, "reward"))
        return found

    return findings


def nearly_none(data: Data, environment: str) -> list[Finding]:
    """Most of a method's policies crash less than once in 10^6 steps: sign test, policy by policy.

    A policy counts where at most half of the evaluations of a policy at that limit have as few crashes, by Poisson's
    distribution. Where more than half of them have none, the evaluation is too short: nothing is tested.
    """
    found = []
    for where in data.places(environment, "naive"):
        for method in data.methods(environment):
            crashes, steps, worlds = (data.sample(where, method, name) for name in ("crashes", "steps", "worlds"))
            at_limit = scipy_stats.poisson(NEARLY_NONE * steps * worlds)
            if (at_limit.pmf(0) <= 0.5).all():
                what = f"{method}: most policies crash less than once in 10^6 steps"
                found += tests.mostly(what, where, at_limit.cdf(crashes) <= 0.5)
    return found


def safe_more_unsafe_less(data: Data, environment: str) -> list[Finding]:
    """The safer half of all policies crashes more under attack, the least safe quarter less."""
    found = []
    for where in data.places(environment, "adversary"):
        pairs = [tests.both(data, environment, where.period, name, CRASHES) for name in data.methods(environment)]
        naive, attacked = (np.concatenate(part) for part in zip(*pairs, strict=True))
        if len(naive) < 4 * tests.LEAST:
            continue
        safe, unsafe = naive <= np.median(naive), naive >= np.quantile(naive, 0.75)
        found += tests.paired_more("safer half: crashes, Adversary > Naive", where, attacked[safe], naive[safe])
        what = "least safe quarter: crashes, Naive > Adversary"
        found += tests.paired_more(what, where, naive[unsafe], attacked[unsafe])
    return found


def _standing(samples: Sequence[Array]) -> Array:
    """P(the first has more) against each of the others, averaged; over leading axes."""
    first, others = samples[0][..., :, None], samples[1:]
    wins = [((first > x[..., None, :]) + 0.5 * (first == x[..., None, :])).mean(axis=(-2, -1)) for x in others]
    return np.mean(wins, axis=0)


def rnd_rank(particle: tuple[str, ...]) -> Findings:
    """RND stands worse among the methods in the particle environments than here."""

    def findings(data: Data, environment: str) -> list[Finding]:
        found = []
        others = ("uniform", "vds", *DIRECTORS)
        for where in data.places(environment, "naive"):
            here = _samples(data, where, ("rnd", *others))
            places = [place for name in particle for place in data.places(name, "naive")]
            there = [_samples(data, place, ("rnd", *others)) for place in places]
            groups = [list(each.values()) for each in [here, *there] if "rnd" in each and len(each) > 1]
            if len(groups) < 2 or "rnd" not in here:
                continue
            sizes = np.cumsum([0, *map(len, groups)])

            def statistic(*x: Array, sizes: Array = sizes) -> Array:
                standing = [_standing(x[low:high]) for low, high in pairwise(sizes)]
                return np.mean(standing[1:], axis=0) - standing[0]

            what = "P(rnd crashes more than another): Particle Gym > here"
            samples = [x for group in groups for x in group]
            found += tests.resampled(what, where, "difference in P", samples, statistic, 0.25)
        return found

    return findings


def wider_at(goals: str, methods: Sequence[str], more: int, less: int) -> Findings:
    """Crashes vary more at one T than at another, relative to their size."""

    def findings(data: Data, environment: str) -> list[Finding]:
        found = []
        for name in methods:
            x, y = (data.sample(Where(environment, goals, period), name, CRASHES) for period in (more, less))
            found += tests.spread(f"spread of crashes of {name}: T = {more} > T = {less}", environment, x, y)
        return found

    return findings


def _eta_squared(*samples: Array) -> Array:
    """Share of the variance that lies between the samples; over leading axes."""
    sizes = np.array([x.shape[-1] for x in samples])
    means = np.stack([x.mean(axis=-1) for x in samples], axis=-1)
    within = sum(x.var(axis=-1) * x.shape[-1] for x in samples)
    centre = (means * sizes).sum(-1, keepdims=True) / sizes.sum()
    between = (sizes * (means - centre) ** 2).sum(-1)
    total = between + within
    return np.where(total > 0, between / np.where(total > 0, total, 1.0), 0.0)


def influence(data: Data, environment: str) -> list[Finding]:
    """The method explains more of the variance of crashes under the Adversary than under Naive."""
    found = []
    for where in data.places(environment, "adversary"):
        methods = data.methods(environment)
        naive = _samples(data, Where(environment, "naive", where.period), methods)
        attacked = _samples(data, where, methods)
        names = [name for name in methods if name in naive and name in attacked]
        if len(names) < 3:
            continue
        samples = [group[name] for group in (attacked, naive) for name in names]

        def statistic(*x: Array) -> Array:
            return _eta_squared(*x[: len(x) // 2]) - _eta_squared(*x[len(x) // 2 :])

        what = "share of variance between methods: Adversary > Naive"
        found += tests.resampled(what, where, "difference in eta^2", samples, statistic, 0.2)
    return found


def _parabola(*samples: Array, x: Array) -> Array:
    """Coefficients of a least-squares parabola through all values of some samples; over leading axes."""
    centred = [(value - 50.0) / 50.0 for value in x]
    columns = np.concatenate([np.full(sample.shape[-1], value) for sample, value in zip(samples, centred, strict=True)])
    solve = np.linalg.pinv(np.vander(columns, 3))
    return np.einsum("kn,...n->...k", solve, np.concatenate(samples, axis=-1))


def _slope(c: Array, at: float) -> Array:
    """Of a parabola, at a place in half ranges from the middle."""
    return 2 * at * c[..., 0] + c[..., 1]


def vertex(samples: dict[str, Array], resamples: int | None = None) -> tuple[Interval, Array, Array]:
    """Where the parabola through log crashes over the achieved percentile has its vertex.

    Returns:
        The achieved percentile with its interval; and of every resample the slopes at Coop's and at Antagonist's
        percentile, per half of the range, shape (2, resamples), and the vertices, shape (resamples,).
    """
    x = np.array([ACHIEVED[name] for name in samples])

    def place(c: Array) -> Array:
        # A straight line has no vertex: it is put into the middle; the slopes say that there is none.
        offset = np.divide(c[..., 1], 2 * c[..., 0], out=np.zeros_like(c[..., 1]), where=c[..., 0] != 0)
        return np.clip(50.0 - 50.0 * offset, -1000.0, 1000.0)

    def resampled(number: Callable[[Array], Array]) -> Array:
        groups = list(samples.values())
        return stats.distribution(groups, lambda *s: number(_parabola(*s, x=x)), resamples=resamples)

    places = resampled(place)
    low, high = np.quantile(places, [0.025, 0.975])
    own = float(place(_parabola(*samples.values(), x=x)))
    ends = [(ACHIEVED[name] - 50.0) / 50.0 for name in ("coop", "antagonist")]
    slopes = np.stack([resampled(partial(_slope, at=end)) for end in ends])
    return Interval(own, float(low), float(high)), slopes, places


def hump(data: Data, environment: str) -> list[Finding]:
    """Crashes over the achieved percentile curve upwards, with the lowest point inside.

    It lies inside if the parabola falls at Coop's end and rises at Antagonist's: both, to support it (an
    intersection-union test); either of them significantly otherwise, by Bonferroni's rule, to contradict it.
    """
    found = []
    for where in [place for goals in ("naive", "adversary") for place in data.places(environment, goals)]:
        samples = _samples(data, where, DIRECTOR_METHODS)
        if len(samples) < 4 or not {"coop", "antagonist"} <= set(samples):
            continue
        x = np.array([ACHIEVED[name] for name in samples])
        curvature = "curvature of log crashes over the achieved percentile > 0"
        found += tests.resampled(curvature, where, "curvature", list(samples.values()),
                                 lambda *s, x=x: _parabola(*s, x=x)[..., 0], math.log(2))  # fmt: skip
        interval, slopes, places = vertex(samples)
        falls, rises = tests.above_zero(-slopes[0]), tests.above_zero(slopes[1])
        found += [Finding(
            what="the lowest point lies inside", where=where, effect="vertex [achieved percentile]", interval=interval,
            p_for=max(falls[0], rises[0]), p_against=min(1.0, 2 * min(falls[1], rises[1])),
            detectable=tests.by_error(float(places.std())), wanted=25.0, n=tuple(map(len, samples.values())),
        )]  # fmt: skip
    return found


def energy(a: str, b: str) -> Findings:
    """Two populations of (log crashes, reward) are the same: a permutation test, which can only contradict."""

    def findings(data: Data, environment: str) -> list[Finding]:
        found = []
        for where in [place for goals in ("naive", "adversary") for place in data.places(environment, goals)]:
            metrics = (CRASHES, "reward")
            x, y = (np.stack([data.sample(where, name, metric) for metric in metrics], axis=1) for name in (a, b))
            if min(len(x), len(y)) < tests.LEAST:
                continue
            distance, p = energy_test(x, y)
            found.append(Finding(
                what=f"crashes and rewards together: {a} differs from {b}", where=where, effect="energy distance",
                interval=Interval(distance, math.nan, math.nan), p_for=1.0, p_against=p,
                detectable=tests.by_ranks([x, y]), wanted=tests.PROBABILITY, n=(len(x), len(y)), required=False,
            ))  # fmt: skip
        return found

    return findings


def energy_test(x: Array, y: Array, seed: int = 0) -> tuple[float, float]:
    """Energy distance of two samples of points, each column scaled to unit variance, and its permutation p-value [1]_.

    Args:
        x: Points, shape (n, d).
        y: Points, shape (m, d).
        seed: Of the permutations.

    References:
        .. [1] Szekely and Rizzo, *Testing for Equal Distributions in High Dimension*, InterStat 5, 2004.
    """
    points = np.concatenate([x, y])
    scale = points.std(axis=0)
    points = points / np.where(scale > 0, scale, 1.0)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    n, m = len(x), len(y)
    rng = np.random.default_rng(seed)
    first = np.zeros((PERMUTATIONS + 1, n + m))
    first[0, :n] = 1.0
    for i in range(1, PERMUTATIONS + 1):
        first[i, rng.permutation(n + m)[:n]] = 1.0
    second = 1.0 - first
    across, own_x, own_y = (
        np.einsum("pi,ij,pj->p", u, apart, v, optimize=True)
        for u, v in ((first, second), (first, first), (second, second))
    )
    distance = 2 * across / (n * m) - own_x / n**2 - own_y / m**2
    return float(distance[0]), float((distance >= distance[0] - 1e-12).mean())


def best_baseline(method: str, rivals: Sequence[str]) -> Findings:
    """A baseline crashes less than each of its rivals over all goals and T: rank sums on the policies' mean ranks."""

    def findings(data: Data, environment: str) -> list[Finding]:
        found = []
        for rival in rivals:
            theirs, own = _mean_ranks(data, environment, rival, method)
            what = f"mean rank of crashes over goals and T: {rival} > {method}"
            found += tests.compare(what, environment, theirs, own)
        return found

    return findings


def _mean_ranks(data: Data, environment: str, *names: str) -> list[Array]:
    """Of every policy of some methods the rank of its crashes among them all, meaned over goals and T.

    Evaluations in which one of the methods has too few policies do not count, nor do policies without all others.
    """
    places = [place for goals in ("naive", "adversary") for place in data.places(environment, goals)]
    places = [place for place in places if len(_samples(data, place, names)) == len(names)]
    if not places:
        return [np.empty(0) for _ in names]
    seeds = {name: sorted(set.intersection(*(set(data.seeds(place, [name])) for place in places))) for name in names}
    pooled = [np.concatenate([data.sample(place, name, CRASHES, seeds[name]) for name in names]) for place in places]
    ranks = np.mean([scipy_stats.rankdata(values) for values in pooled], axis=0)
    return np.split(ranks, np.cumsum([len(seeds[name]) for name in names])[:-1])


def headline(directors: Sequence[str], baselines: Sequence[str]) -> Findings:
    """The best Director is at least as safe as the best baseline and varies less; chosen and tested on other seeds."""

    def findings(data: Data, environment: str) -> list[Finding]:
        found = []
        own = ("vds+p75",) if environment.startswith("quad") else directors
        for where in [place for goals in ("naive", "adversary") for place in data.places(environment, goals)]:
            names = [name for name in (*own, *baselines) if len(data.seeds(where, [name]))]
            seeds = data.seeds(where, names)
            if len(seeds) < SPLIT_SEEDS or not set(names) & set(own) or not set(names) & set(baselines):
                continue
            choosing, testing = seeds[::2], seeds[1::2]
            medians = {name: np.median(data.sample(where, name, CRASHES, choosing)) for name in names}
            best, rival = (min((n for n in names if n in group), key=medians.__getitem__) for group in (own, baselines))
            x, y = (data.sample(where, name, CRASHES, testing) for name in (rival, best))
            margin = math.log(tests.FACTOR)
            found += _not_inferior(f"crashes: {best} at most {tests.FACTOR:g} times {rival}'s", where, y, x, margin)
            found += tests.spread(f"spread of crashes: {rival} > {best}", where, x, y)
        return found

    return findings


def _not_inferior(what: str, where: Where, x: Array, y: Array, margin: float) -> list[Finding]:
    found = significance.equivalence(x, y, margin)
    lower = scipy_stats.ttest_ind(x - margin, y, equal_var=False, alternative="less").pvalue
    upper = scipy_stats.ttest_ind(x - margin, y, equal_var=False, alternative="greater").pvalue
    return [Finding(
        what=what, where=where, effect="difference in mean log crashes, 90 %",
        interval=Interval(found.difference, found.low, found.high), p_for=float(lower), p_against=float(upper),
        detectable=lambda alpha: significance.detectable_margin(x, y, alpha), wanted=margin, n=(len(x), len(y)),
    )]  # fmt: skip


def halfway(data: Data, environment: str) -> list[Finding]:
    """VDS's crashes halfway are below a tenth of those at the start of training."""

    def fall(crashes: Array) -> float:
        log = np.log1p(1000 * crashes)
        tenth = max(1, len(log) // 10)
        return float(log[:tenth].mean() - log[4 * tenth : max(6 * tenth, 4 * tenth + 1)].mean())

    falls = tests.of_curves(data, environment, "vds", fall)
    what = "vds: crashes halfway are below a tenth of those at the start"
    return tests.positive(what, environment, "fall of log crashes", falls, math.log(2), at=math.log(10))


def resistance(baselines: Sequence[str]) -> Findings:
    """Between Naive and Adversary, baselines gain more crashes and lose more reward than the thesis's best p."""

    def findings(data: Data, environment: str) -> list[Finding]:
        found = []
        best = "vds+p75" if environment.startswith("quad") else "p25"
        for where in data.places(environment, "adversary"):
            for rival in baselines:
                for metric, sign, name in ((CRASHES, 1.0, "gain in crashes"), ("reward", -1.0, "loss of reward")):
                    gaps = []
                    for method in (rival, best):
                        naive, attacked = tests.both(data, environment, where.period, method, metric)
                        gaps.append(sign * (attacked - naive))
                    found += tests.compare(f"{name}: {rival} > {best}", where, *gaps)
        return found

    return findings


def speed(directors: Sequence[str]) -> Findings:
    """Frames per second: Uniform above RND and the Directors, all of them above VDS."""

    def findings(data: Data, environment: str) -> list[Finding]:
        place = data.places(environment, "naive")[:1]
        pairs = [("uniform", "rnd"), *[("uniform", p) for p in directors], *[(p, "vds") for p in directors],
                 ("rnd", "vds"), ("uniform", "vds")]  # fmt: skip
        return [
            finding
            for where in place
            for a, b in pairs
            for finding in tests.compare(
                f"FPS: {a} > {b}", environment, data.sample(where, a, "fps"), data.sample(where, b, "fps")
            )
        ]

    return findings


def share_falls(directors: Sequence[str]) -> Findings:
    """The share of goals that the Director chose, which crashes lower, falls with p."""

    def findings(data: Data, environment: str) -> list[Finding]:
        found = {
            float(name[1:]): tests.of_curves(data, environment, name, np.mean, "selected_fraction")
            for name in directors
        }
        found = {p: x for p, x in found.items() if len(x) >= tests.LEAST}
        if len(found) < 3:
            return []
        dose = scipy_stats.rankdata(np.concatenate([np.full(len(x), p) for p, x in found.items()]))

        def statistic(*samples: Array) -> Array:
            ranks = scipy_stats.rankdata(np.concatenate(samples, axis=-1), axis=-1)
            a, b = ranks - ranks.mean(axis=-1, keepdims=True), dose - dose.mean()
            spread = np.sqrt((a**2).sum(-1) * (b**2).sum())
            return -np.where(spread > 0, (a * b).sum(-1) / np.where(spread > 0, spread, 1.0), 0.0)

        what = "the share of chosen goals falls with p"
        return tests.resampled(what, environment, "-Spearman's rho", list(found.values()), statistic, 0.3)

    return findings
