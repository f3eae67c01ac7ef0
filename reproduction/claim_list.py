"""The claims C1 to C32 of the thesis's chapter 4, each with its test: fixed before the runs, or else it is noted."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

from deimos.study.data import Data, Where
from reproduction import claim_custom as custom
from reproduction import claim_tests as tests
from reproduction.claim_tests import more, same, wider
from reproduction.claims import Claim, Finding
from reproduction.thesis import DIRECTORS, ENVIRONMENTS, LEGGED, PARTICLE

BASELINES = ("uniform", "rnd", "vds", "cl")
CRASHES, REWARD = "log_crashes", "reward"
GOALS = ("naive", "adversary")
SHORT, LONG = 100, 500  # T = 2 s and 10 s of the legged environments [steps]

Findings = Callable[[Data, str], list[Finding]]
PairTest = Callable[[Data, Where, str, str, str], list[Finding]]


def _pairs(
    test: PairTest, goals: str, metric: str, pairs: Sequence[tuple[str, str]], periods: Sequence[int] = ()
) -> Findings:
    """The test of every pair of methods, at every T or at those of ``periods``."""

    def findings(data: Data, environment: str) -> list[Finding]:
        places = [place for place in data.places(environment, goals) if not periods or place.period in periods]
        return [finding for place in places for a, b in pairs for finding in test(data, place, metric, a, b)]

    return findings


def _all(*parts: Findings) -> Findings:
    return lambda data, environment: [finding for part in parts for finding in part(data, environment)]


def _in(environments: Sequence[str], part: Findings) -> Findings:
    """Only in some of a claim's environments."""
    return lambda data, environment: part(data, environment) if environment in environments else []


def _cross(first: Sequence[str], second: Sequence[str]) -> list[tuple[str, str]]:
    return [(a, b) for a in first for b in second if a != b]


def _late(first: Sequence[str], second: Sequence[str]) -> Findings:
    """More crashes in the last tenth of training."""

    def findings(data: Data, environment: str) -> list[Finding]:
        return [
            finding
            for a, b in _cross(first, second)
            for finding in tests.compare(
                f"crashes in the last 10 % of training: {a} > {b}", environment,
                tests.of_curves(data, environment, a, tests.late_crashes),
                tests.of_curves(data, environment, b, tests.late_crashes),
            )
        ]  # fmt: skip

    return findings


def _not_reduced(data: Data, environment: str) -> list[Finding]:
    found = []
    for name in ("coop", "antagonist"):
        change = tests.of_curves(data, environment, name, tests.change)
        what = f"{name}: crashes fall by less than half from the first to the last fifth of training"
        limit = -math.log(tests.FACTOR)
        found += tests.positive(what, environment, "change of log crashes", change, -limit, at=limit)
    late = {
        name: tests.of_curves(data, environment, name, tests.late_crashes) for name in ("p90", "coop", "antagonist")
    }
    for name in ("coop", "antagonist"):
        what = f"crashes in the last 10 % of training: p90 = {name}"
        found += tests.alike(what, environment, late["p90"], late[name], math.log(tests.FACTOR))
    return found


def _unconverged(data: Data, environment: str) -> list[Finding]:
    found = []
    for name in data.methods(environment):
        slopes = tests.of_curves(data, environment, name, tests.final_slope)
        what = f"{name}: crashes still fall in the last fifth of training"
        found += tests.positive(what, environment, "fall of log crashes", -slopes, math.log(tests.FACTOR))
    return found


def _attack_hurts(data: Data, environment: str) -> list[Finding]:
    found = []
    for place in data.places(environment, "adversary"):
        for name in data.methods(environment):
            naive, attacked = tests.both(data, environment, place.period, name, CRASHES)
            found += tests.paired_more(f"{name}: crashes, Adversary > Naive", place, attacked, naive)
    return found


_REPLACED = "The test that was fixed before the runs had no known level; this one took its place afterwards."
_WITHOUT_P25 = ("p10", "p50", "p75", "p90")
_DIRECTORS_ARE_ALIKE = list(pairwise(DIRECTORS))

CLAIMS: tuple[Claim, ...] = (
    Claim("C1", "Particle training: RND has the worst crash curves.", PARTICLE,
        "rank sums on the crashes in the last tenth of training, RND against each other method",
        _late(["rnd"], ["coop", *DIRECTORS, "antagonist", "uniform", "vds"]),
        note="Training curves belong to different goal distributions.",
        planned=27),
    Claim("C2", "Coop and Antagonist do not reduce crashes in training, and p90 resembles both.", PARTICLE,
        "t test on the change of log crashes; equivalence within a factor of 2", _not_reduced,
        planned=12),
    Claim("C3", "Some selectors have not converged by the end of training.", PARTICLE,
        "t test on the slope of log crashes in the last fifth, each method", _unconverged, combine="any",
        planned=30),
    Claim("C4", "Absolute, Naive: p hardly matters for crashes; p25 and p75 match VDS and Uniform.", ("absolute",),
        "equivalence within a factor of 2; Kruskal and Wallis over p can only contradict",
        _all(_pairs(same, "naive", CRASHES, _DIRECTORS_ARE_ALIKE + _cross(["p25", "p75"], ["vds", "uniform"])),
             custom.kruskal("naive")),
        planned=8),
    Claim("C5", "Absolute, Naive: Uniform's reward is clearly above VDS's at equal crashes.", ("absolute",),
        "rank sums on rewards, equivalence of crashes within a factor of 2",
        _all(_pairs(more, "naive", REWARD, [("uniform", "vds")]),
             _pairs(same, "naive", CRASHES, [("uniform", "vds")])),
        planned=2),
    Claim("C6", "Absolute, Naive: p50 has high rewards and slightly more crashes.", ("absolute",),
        "rank sums: p50's rewards above VDS's, its crashes above Uniform's",
        _all(_pairs(more, "naive", REWARD, [("p50", "vds")]), _pairs(more, "naive", CRASHES, [("p50", "uniform")])),
        planned=2),
    Claim("C7", "Absolute: every method crashes much more under the Adversary.", ("absolute",),
        "Wilcoxon's signed ranks, policy by policy", _attack_hurts,
        planned=10),
    Claim("C8", "Absolute, Adversary: p25 matches Uniform and VDS; Uniform and p25 are the best.", ("absolute",),
        "equivalence within a factor of 2; rank sums, each other method against these two",
        _all(_pairs(same, "adversary", CRASHES, _cross(["p25"], ["uniform", "vds"])),
             _pairs(more, "adversary", CRASHES,
                    _cross(["coop", *_WITHOUT_P25, "antagonist", "rnd", "vds"], ["uniform", "p25"]))),
        note=_REPLACED,
        planned=18),
    Claim("C9", "The single highest reward is Antagonist's (Absolute; Relative under Naive).",
        ("absolute", "relative"),
        "Rosenbaum's test against each other method: how many policies of one lie above all of the other; an extreme "
        "value, so take it lightly",
        _all(custom.highest_reward("naive", "antagonist"),
             _in(["absolute"], custom.highest_reward("adversary", "antagonist"))),
        note=_REPLACED,
        planned=27),
    Claim("C10", "Relative, Naive: RND crashes most of the baselines at low reward; p10 to p50 match VDS and Uniform; "
        "p90 is worse.", ("relative",), "rank sums; equivalence within a factor of 2",
        _all(_pairs(more, "naive", CRASHES, _cross(["rnd"], ["uniform", "vds"])),
             _pairs(more, "naive", REWARD, _cross(["uniform", "vds"], ["rnd"])),
             _pairs(same, "naive", CRASHES, _cross(["p10", "p25", "p50"], ["vds", "uniform"])),
             _pairs(more, "naive", CRASHES, _cross(["p90"], ["p10", "p25", "p50"]))),
        planned=13),
    Claim("C11", "Relative: some methods reach about 0 crashes.", ("relative",),
        "sign test for each method: most of its policies crash less than once in 10^6 steps", custom.nearly_none,
        combine="any",
        note=f"{_REPLACED} An evaluation of fewer than 0.7 x 10^6 steps (the logarithm of 2) is too short for it: more "
        "than half of those of a policy at the limit are without a crash.",
        planned=10),
    Claim("C12", "Relative: safe policies crash more under the Adversary than under Naive, unsafe ones less.",
        ("relative",), "signed ranks in the safer half and in the least safe quarter of all policies",
        custom.safe_more_unsafe_less,
        note="The classes are made by the Naive crashes themselves, so part of it is regression to the mean.",
        planned=2),
    Claim("C13", "Relative, Adversary: VDS crashes least of the baselines; Uniform has more reward and more crashes; "
        "p50 is best, with little variance.", ("relative",), "rank sums; Brown and Forsythe",
        _all(_pairs(more, "adversary", CRASHES, _cross(["uniform", "rnd"], ["vds"])),
             _pairs(more, "adversary", REWARD, [("uniform", "vds")]),
             _pairs(more, "adversary", CRASHES, _cross(["p10", "p25", "p75", "p90", "uniform", "vds"], ["p50"])),
             _pairs(wider, "adversary", CRASHES, _cross(["uniform", "vds"], ["p50"]))),
        planned=11),
    Claim("C14", "Directional, Naive: Coop and Antagonist are worst in both metrics, RND is worst and most variable "
        "of the baselines; p10 to p50 match VDS and Uniform.", ("directional",),
        "rank sums; Brown and Forsythe; equivalence within a factor of 2",
        _all(_pairs(more, "naive", CRASHES, _cross(["coop", "antagonist"], [*DIRECTORS, "uniform", "vds"])),
             _pairs(more, "naive", REWARD, _cross([*DIRECTORS, "uniform", "vds"], ["coop", "antagonist"])),
             _pairs(more, "naive", CRASHES, _cross(["rnd"], ["uniform", "vds"])),
             _pairs(wider, "naive", CRASHES, _cross(["rnd"], ["uniform", "vds"])),
             _pairs(same, "naive", CRASHES, _cross(["p10", "p25", "p50"], ["vds", "uniform"]))),
        note="The explanation (they learnt not to move) is not tested: no speeds are recorded.",
        planned=38),
    Claim("C15", "Directional, Adversary: p25 has the fewest crashes at the reward of Uniform and VDS, with little "
        "variance.", ("directional",), "rank sums; equivalence of rewards within 5 %; Brown and Forsythe",
        _all(_pairs(more, "adversary", CRASHES, _cross(["uniform", "vds", "rnd", *_WITHOUT_P25], ["p25"])),
             _pairs(same, "adversary", REWARD, _cross(["p25"], ["uniform", "vds"])),
             _pairs(wider, "adversary", CRASHES, _cross(["uniform", "vds"], ["p25"]))),
        planned=11),
    Claim("C16", "Quad, Naive: nearly all methods crash equally; VDS has slightly more reward, VDS+p75 about VDS's; "
        "Coop and Antagonist have poor rewards.", ("quad",), "equivalence within a factor of 2, rank sums",
        _all(_pairs(same, "naive", CRASHES, _cross([*DIRECTORS, "rnd", "vds", "cl", "vds+p75"], ["uniform"])),
             _pairs(more, "naive", REWARD, _cross(["vds"], ["uniform", "rnd", "cl"])),
             _pairs(same, "naive", REWARD, [("vds+p75", "vds")]),
             _pairs(more, "naive", REWARD, _cross([*DIRECTORS, "uniform"], ["coop", "antagonist"]))),
        planned=50),
    Claim("C17", "Quad, Naive, 2 s: DEIMOS varies more than the baselines for almost all p.", ("quad",),
        "Brown and Forsythe, every p against every baseline",
        _pairs(wider, "naive", CRASHES, _cross(DIRECTORS, BASELINES), [SHORT]),
        planned=20),
    Claim("C18", "RND does far better in Quad than in Particle Gym.", ("quad",),
        "P(RND crashes more) in the particle environments minus that in Quad, bootstrap", custom.rnd_rank(PARTICLE),
        planned=2),
    Claim("C19", "Quad, Adversary: Coop is worst; p75 and p90 are the best p; little variance at 2 s, much at 10 s.",
        ("quad",), "rank sums; Brown and Forsythe between the two T",
        _all(_pairs(more, "adversary", CRASHES, _cross(["coop"], [*DIRECTORS, *BASELINES])),
             _pairs(more, "adversary", CRASHES, _cross(["p10", "p25", "p50"], ["p75", "p90"])),
             custom.wider_at("adversary", ("p75", "p90"), LONG, SHORT)),
        planned=32),
    Claim("C20", "Quad, Adversary: VDS+p75 is best: fewest crashes, little variance, much reward.", ("quad",),
        "rank sums against VDS; Brown and Forsythe",
        _all(_pairs(more, "adversary", CRASHES, [("vds", "vds+p75")]),
             _pairs(more, "adversary", REWARD, [("vds+p75", "vds")]),
             _pairs(wider, "adversary", CRASHES, [("vds", "vds+p75")])),
        planned=6),
    Claim("C21", "Quad+arm, Naive: baselines but VDS are poor and variable; the best p is about 50; VDS and VDS+p75 "
        "are best in median and spread.", ("quad_arm",), "rank sums; Brown and Forsythe",
        _all(_pairs(more, "naive", CRASHES, _cross(["uniform", "rnd", "cl"], ["vds", "vds+p75"])),
             _pairs(wider, "naive", CRASHES, _cross(["uniform", "rnd", "cl"], ["vds", "vds+p75"])),
             _pairs(more, "naive", CRASHES, _cross(["p10", "p25", "p75", "p90"], ["p50"]))),
        planned=32),
    Claim("C22", "Quad+arm, Adversary: p50 is the best p; more variance at 2 s than at 10 s; VDS+p75 beats VDS in "
        "reward, crashes and variance.", ("quad_arm",), "rank sums; Brown and Forsythe",
        _all(_pairs(more, "adversary", CRASHES, _cross(["p10", "p25", "p75", "p90"], ["p50"])),
             custom.wider_at("adversary", DIRECTORS, SHORT, LONG),
             _pairs(more, "adversary", REWARD, [("vds+p75", "vds")]),
             _pairs(more, "adversary", CRASHES, [("vds", "vds+p75")]),
             _pairs(wider, "adversary", CRASHES, [("vds", "vds+p75")])),
        planned=19),
    Claim("C23", "Quad+arm: all DEIMOS versions (2 s) or almost all (10 s) beat all baselines but VDS.", ("quad_arm",),
        "rank sums, every p against every baseline but VDS",
        _all(*[_pairs(more, goals, CRASHES, _cross(["uniform", "rnd", "cl"], DIRECTORS)) for goals in GOALS]),
        planned=60),
    Claim("C24", "The training's goals matter little under Naive and a lot under the Adversary.", ENVIRONMENTS,
        "share of the variance of log crashes between methods, Adversary minus Naive, bootstrap", custom.influence,
        planned=7),
    Claim("C25", "Over p, safety is a hump: best inside, worst at Coop and Antagonist.", ENVIRONMENTS,
        "quadratic fit of log crashes on the achieved percentile: curvature above 0, falling at Coop's end and rising "
        "at Antagonist's, bootstrap",
        custom.hump,
        note=f"Of the vertex: {_REPLACED[0].lower()}{_REPLACED[1:]}",
        planned=28),
    Claim("C26", "Coop and Antagonist produce similar populations.", ENVIRONMENTS,
        "equivalence of crashes within a factor of 2 and of rewards within 5 %; the energy distance's permutation "
        "test can only contradict",
        _all(*[_pairs(same, goals, metric, [("coop", "antagonist")]) for goals in GOALS
               for metric in (CRASHES, REWARD)], custom.energy("coop", "antagonist")),
        planned=28),
    Claim("C27", "VDS is the best baseline over all environments; Uniform ties it in Particle Gym.", ENVIRONMENTS,
        "rank sums on the policies' mean ranks over goals and T, each other baseline against VDS; in Particle Gym, "
        "in place of that against Uniform, equivalence within a factor of 2",
        _all(_in(LEGGED, custom.best_baseline("vds", ("uniform", "rnd", "cl"))),
             _in(PARTICLE, custom.best_baseline("vds", ("rnd",))),
             _in(PARTICLE, _all(*[_pairs(same, goals, CRASHES, [("uniform", "vds")]) for goals in GOALS]))),
        note=f"Of the ranks: {_REPLACED[0].lower()}{_REPLACED[1:]}",
        planned=15),
    Claim("C28", "Headline: the best DEIMOS (legged: VDS+p75) is at least as safe as the best baseline, with "
        "less spread.", ENVIRONMENTS,
        "the best on one half of the seeds, tested on the other: one-sided non-inferiority within a factor of 2 in "
        "mean log crashes, Brown and Forsythe; from 20 seeds on", custom.headline(DIRECTORS, BASELINES),
        planned=28),
    Claim("C29", "Halfway through training, VDS's policies crash rarely.", LEGGED,
        "t test: crashes between 40 % and 60 % of training below a tenth of those in the first tenth",
        custom.halfway,
        planned=2),
    Claim("C30", "Under attack, policies trained by DEIMOS lose less reward and gain fewer crashes than "
        "baselines'.", ENVIRONMENTS,
        "rank sums on Adversary minus Naive, the thesis's best p (p25 in Particle Gym, VDS+p75 legged) against "
        "every baseline", custom.resistance(BASELINES),
        note="Not repeated with a goal generator as attacker.",
        planned=50),
    Claim("C31", "Speed: Uniform > RND, DEIMOS > VDS; VDS is slowest everywhere.", ENVIRONMENTS,
        "rank sums on the median frames per second of every training", custom.speed(DIRECTORS),
        note="Workers that share a machine slow each other; only ratios within one machine mean something.",
        planned=65),
    Claim("C32", "The Director's share and the diversity of goals fall with p.", ENVIRONMENTS,
        "Spearman's correlation of p with the mean share of goals that the Director chose, bootstrap",
        custom.share_falls(DIRECTORS),
        note="The diversity of the chosen goals is not recorded, so only the share is tested.",
        planned=5),
)  # fmt: skip
"""In the thesis's order."""
