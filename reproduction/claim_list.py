"""The claims C1 to C37 of the thesis's chapter 4, clause by clause, each with the line that states it.

A clause about a group of methods compares averages over the group; where the thesis sets a method against a few others
by name, there is a clause for each. C37 is the earlier workshop paper's.
"""

from collections.abc import Sequence
from itertools import combinations, pairwise

from reproduction.claim_tests import Alike, Best, Highest, Matters, Mostly, Ordered, falling, versus
from reproduction.claims import Claim, Clause, Test
from reproduction.measures import (
    ATTACKED,
    ATTACKED_SCORE,
    CHOSEN,
    DIVERSITY,
    FALL,
    FEW_CRASHES,
    FPS,
    GAIN,
    HALFWAY,
    LATE,
    LATE_FALL,
    LOSS,
    MOTION,
    NAIVE,
    OF_TRAINING,
    PENALTIES,
    RISK,
    SAFE_GAIN,
    SCORE,
    STANDING,
    UNSAFE_RELIEF,
    Measure,
)
from reproduction.thesis import DIRECTORS, ENVIRONMENTS, LEGGED, LEGGED_METHODS, PARTICLE, PARTICLE_METHODS

BASELINES = ("uniform", "rnd", "vds", "cl")
SHORT, LONG = 100, 500  # T = 2 s and 10 s of the legged environments [steps]
ENDS = ("coop", "antagonist")


def _say(
    line: int, words: str, environments: Sequence[str], *tests: Test | Sequence[Test], periods: Sequence[int] = ()
) -> list[Clause]:
    """Clauses that one sentence makes."""
    flat = [test for each in tests for test in (each if isinstance(each, Sequence) else [each])]
    return [
        Clause(
            line, words, test, tuple(environments), tuple(periods), once=getattr(test, "measure", None) in OF_TRAINING
        )
        for test in flat
    ]


def _more(measure: Measure, first: str, second: str) -> Ordered:
    """One group of methods has more than another; names are separated by blanks."""
    return Ordered(measure, versus(first.split(), second.split()))


def _wider(measure: Measure, first: str, second: str) -> Ordered:
    return Ordered(measure, versus(first.split(), second.split()), spread=True)


def _each(measure: Measure, first: str, second: str) -> list[Ordered]:
    """One method has more than each of some others, or each of some more than one: a test for each pair."""
    return [Ordered(measure, (pair,)) for pair in versus(first.split(), second.split())]


def _alike(measure: Measure, first: str, second: str) -> list[Alike]:
    return [Alike(measure, a, b) for a, b in versus(first.split(), second.split())]


def _others(name: str, methods: Sequence[str] = PARTICLE_METHODS) -> str:
    return " ".join(method for method in methods if method != name)


def _mostly(measure: Measure, *groups: Sequence[str]) -> list[Mostly]:
    return [Mostly(measure, tuple(group)) for group in groups]


_P = " ".join(DIRECTORS)
_INSIDE = "p10 p25 p50 p75 uniform vds"

TRAINING = (
    Claim("C1", "RND does badly in training.", (
        *_say(550, "RND does not lend itself well", PARTICLE, _each(LATE, "rnd", "uniform vds p25")),
    ), note="Training curves belong to different goal distributions."),
    Claim("C2", "Coop and Antagonist are not good at reducing crashes in training, and p90 resembles both.", (
        *_say(552, "are not good at reducing crashes", PARTICLE,
              [_more(LATE, name, _INSIDE) for name in ENDS], [_more(FALL, _INSIDE, name) for name in ENDS]),
        *_say(552, "remarkably similar behavior", PARTICLE, _alike(LATE, "p90", "coop antagonist")),
    )),
    Claim("C3", "Some methods have not converged by the end of training.", (
        *_say(547, "some methods seem not to have reached convergence", PARTICLE,
              _mostly(LATE_FALL, *[[name] for name in PARTICLE_METHODS])),
    ), one_is_enough=True),
)  # fmt: skip
"""Figure 4.4."""

ABSOLUTE = (
    Claim("C4", "Naive: p matters little; p25 and p75 match VDS and Uniform.", (
        *_say(558, "Most versions of DEIMOS produce similar policies", ["absolute"],
              [Alike(NAIVE, a, b) for a, b in pairwise(DIRECTORS)]),
        *_say(565, "DEIMOS matches VDS and Uniform", ["absolute"], _alike(NAIVE, "p25 p75", "vds uniform")),
    )),
    Claim("C5", "Naive: Uniform has a higher score than VDS at equal crashes; RND crashes and varies most.", (
        *_say(558, "Uniform policies receive markedly higher rewards", ["absolute"], _more(SCORE, "uniform", "vds")),
        *_say(558, "VDS and Uniform produce similar policies in terms of crashes", ["absolute"],
              _alike(NAIVE, "uniform", "vds")),
        *_say(558, "RND-trained policies experience the most crashes", ["absolute"],
              _each(NAIVE, "rnd", "uniform vds"), _wider(NAIVE, "rnd", "uniform vds")),
    )),
    Claim("C6", "Naive: p50 has a high score and slightly more crashes.", (
        *_say(565, "we obtain high rewards but slightly higher median crashes", ["absolute"],
              _more(SCORE, "p50", "p25 p75 vds uniform"), _more(NAIVE, "p50", "p25 p75 vds uniform")),
    )),
    Claim("C7", "Every method crashes more under the Adversary.", (
        *_say(567, "Every method experiences significantly more crashes", ["absolute"],
              _mostly(GAIN, *[[name] for name in PARTICLE_METHODS])),
    )),
    Claim("C8", "Adversary: p25 matches Uniform and VDS; Uniform and p25 are the best.", (
        *_say(567, "obtains the same amount of crashes as VDS", ["absolute"],
              _alike(ATTACKED, "uniform", "vds"), _more(ATTACKED_SCORE, "uniform", "vds")),
        *_say(567, "matches Uniform and VDS", ["absolute"], _alike(ATTACKED, "p25", "uniform vds")),
        *_say(569, "we identify Uniform and DEIMOS with", ["absolute"],
              [_more(ATTACKED, "coop p10 p50 p75 p90 antagonist rnd vds", best) for best in ("uniform", "p25")]),
    )),
    Claim("C9", "The single highest score is Antagonist's (Absolute; Relative under Naive).", (
        *_say(565, "The single highest possible rewards", ["absolute"],
              Highest(SCORE, "antagonist", tuple(_others("antagonist").split()))),
        *_say(567, "the single highest possible rewards", ["absolute"],
              Highest(ATTACKED_SCORE, "antagonist", tuple(_others("antagonist").split()))),
        *_say(586, "The single highest rewards", ["relative"],
              Highest(SCORE, "antagonist", tuple(_others("antagonist").split()))),
    ), note="An extreme value: take it lightly."),
)  # fmt: skip
"""Figure 4.5."""

RELATIVE = (
    Claim("C10", "Naive: RND crashes most of the baselines at a low score; p10 to p50 match VDS and Uniform; p90 "
          "is worse; Antagonist looks safe at a poor score.", (
        *_say(586, "RND-trained policies experienced the most crashes", ["relative"],
              _each(NAIVE, "rnd", "uniform vds"), _wider(NAIVE, "rnd", "uniform vds"),
              _each(SCORE, "uniform vds", "rnd")),
        *_say(586, "VDS and Uniform produce similar policies", ["relative"],
              _alike(NAIVE, "vds", "uniform"), _alike(SCORE, "vds", "uniform")),
        *_say(586, "DEIMOS matches VDS and Uniform", ["relative"], _alike(NAIVE, "p10 p25 p50", "vds uniform")),
        *_say(579, "Most versions of DEIMOS produce similar policies, except for", ["relative"],
              _more(NAIVE, "p90", "p10 p25 p50")),
        *_say(581, "Its policies obtained very poor rewards", ["relative"],
              _more(SCORE, _others("antagonist"), "antagonist"), _more(NAIVE, _others("antagonist"), "antagonist")),
    )),
    Claim("C11", "Some methods reach about 0 crashes.", (
        *_say(575, "crashes.", ["relative"], _mostly(FEW_CRASHES, *[[name] for name in PARTICLE_METHODS])),
    ), one_is_enough=True,
        note="An evaluation of fewer than 0.7 x 10^6 steps (the logarithm of 2) is too short for it."),
    Claim("C12", "Safe policies crash more under the Adversary than under Naive, unsafe ones less.", (
        *_say(588, "an increase in crashes for the policies that experienced few crashes", ["relative"],
              _mostly(SAFE_GAIN, PARTICLE_METHODS)),
        *_say(588, "a decrease for the policies that were less safe", ["relative"],
              _mostly(UNSAFE_RELIEF, PARTICLE_METHODS)),
    ), note="Unsafe is a policy that crashes in 1 % of its interactions or more under Naive."),
    Claim("C13", "Adversary: VDS crashes least of the baselines; Uniform has a higher score and more crashes; p50 is "
          "best, with little variance.", (
        *_say(590, "obtain more rewards than VDS", ["relative"],
              _more(ATTACKED_SCORE, "uniform", "vds"), _each(ATTACKED, "uniform rnd", "vds")),
        *_say(590, "obtains great rewards with low variance, and very few crashes", ["relative"],
              _more(ATTACKED_SCORE, "p50", "p10 p25 p75 p90 uniform vds"),
              _more(ATTACKED, "p10 p25 p75 p90 uniform vds", "p50"), _wider(ATTACKED, "uniform vds", "p50")),
    )),
)  # fmt: skip
"""Figure 4.6."""

DIRECTIONAL = (
    Claim("C14", "Naive: Coop and Antagonist are worst in score and crashes, RND is worst and varies most of the "
          "baselines; p10 to p50 match VDS and Uniform.", (
        *_say(605, "both the poorest rewards and the most crashes", ["directional"],
              [_more(SCORE, f"{_P} uniform vds rnd", name) for name in ENDS],
              [_more(NAIVE, name, f"{_P} uniform vds rnd") for name in ENDS]),
        *_say(607, "RND-trained policies also experienced the worst rewards", ["directional"],
              _each(SCORE, "uniform vds", "rnd"), _each(NAIVE, "rnd", "uniform vds"),
              _wider(NAIVE, "rnd", "uniform vds")),
        *_say(607, "VDS and Uniform again produce similar policies", ["directional"],
              _alike(NAIVE, "vds", "uniform"), _alike(SCORE, "vds", "uniform")),
        *_say(607, "DEIMOS matches VDS and Uniform", ["directional"], _alike(NAIVE, "p10 p25 p50", "vds uniform")),
    )),
    Claim("C15", "Adversary: p25 has the fewest crashes at the score of Uniform and VDS, with little variance.", (
        *_say(610, "obtains the highest rewards", ["directional"], _alike(ATTACKED_SCORE, "p25", "uniform vds")),
        *_say(610, "the least crashes", ["directional"],
              _each(ATTACKED, "uniform vds rnd", "p25"), _more(ATTACKED, "p10 p50 p75 p90", "p25")),
        *_say(610, "The variance for both metrics is also great", ["directional"],
              _wider(ATTACKED, "uniform vds", "p25"), _wider(ATTACKED_SCORE, "uniform vds", "p25")),
    )),
)  # fmt: skip
"""Figure 4.7."""

QUAD = (
    Claim("C16", "Naive: nearly all methods crash equally; VDS has a slightly higher score, VDS+p75 is like VDS; Coop "
          "and Antagonist have poor scores.", (
        *_say(626, "almost all the methods in study obtain similar amounts of crashes", ["quad"],
              _alike(NAIVE, f"{_P} rnd vds cl", "uniform")),
        *_say(626, "VDS slightly outperforms the baselines", ["quad"], _each(SCORE, "vds", "uniform rnd cl")),
        *_say(626, "policies that are similar to VDS alone", ["quad"],
              _alike(NAIVE, "vds+p75", "vds"), _alike(SCORE, "vds+p75", "vds")),
        *_say(631, "perform poorly in terms of rewards", ["quad"],
              [_more(SCORE, f"{_P} uniform", name) for name in ENDS], [_more(NAIVE, name, _P) for name in ENDS]),
    )),
    Claim("C17", "Naive, 2 s: DEIMOS varies more than the baselines for almost all p.", (
        *_say(626, "DEIMOS experiences high variance for almost all", ["quad"],
              [_wider(NAIVE, name, " ".join(BASELINES)) for name in DIRECTORS], periods=[SHORT]),
    )),
    Claim("C18", "RND does far better than in Particle Gym.", (
        *_say(626, "We find that RND does much", ["quad"], Ordered(STANDING, (("rnd @ particle", "rnd"),))),
    ), note="By the rank of its policies among all of a place."),
    Claim("C19", "Adversary: Coop is worst; all baselines are alike; p75 and p90 are the best p; little variance at "
          "2 s, much at 10 s.", (
        *_say(634, "Coop produces the worst policies both", ["quad"],
              _more(ATTACKED, "coop", _others("coop", LEGGED_METHODS)),
              _more(ATTACKED_SCORE, _others("coop", LEGGED_METHODS), "coop")),
        *_say(634, "All baseline methods produce similar policies", ["quad"],
              [Alike(ATTACKED, a, b) for a, b in combinations(BASELINES, 2)]),
        *_say(634, "produce policies with fairly safe and performant behaviour", ["quad"],
              _more(ATTACKED, "p10 p25 p50", "p75 p90"), _more(ATTACKED_SCORE, "p75 p90", "p10 p25 p50")),
        *_say(634, "variance is quite high, which is not desirable", ["quad"],
              [Ordered(ATTACKED, ((f"{name} @ {LONG}", name),), spread=True) for name in ("p75", "p90")],
              periods=[SHORT]),
    )),
    Claim("C20", "Adversary: VDS+p75 is best: fewest crashes, little variance, high score.", (
        *_say(634, "VDS+p75 obtains the best policies for both timings", ["quad"],
              _more(ATTACKED, "vds", "vds+p75"), _more(ATTACKED, f"{_P} uniform rnd cl", "vds+p75"),
              _more(ATTACKED_SCORE, "vds+p75", "vds"), _wider(ATTACKED, "vds", "vds+p75")),
    )),
)  # fmt: skip
"""Figures 4.8 and 4.9."""

QUAD_ARM = (
    Claim("C21", "Naive: baselines but VDS are poor and variable; the best p is about 50; VDS and VDS+p75 are best.", (
        *_say(650, "all baseline methods produce poor policies with very high variance", ["quad_arm"],
              [_more(NAIVE, "uniform rnd cl", best) for best in ("vds", "vds+p75")],
              [_wider(NAIVE, "uniform rnd cl", best) for best in ("vds", "vds+p75")]),
        *_say(650, "of around 50 as the best version of DEIMOS", ["quad_arm"], _more(NAIVE, "p10 p25 p75 p90", "p50")),
    )),
    Claim("C22", "Adversary: p50 is the best p; more variance at 2 s than at 10 s; VDS+p75 beats VDS in score, "
          "crashes and variance.", (
        *_say(652, "as the best", ["quad_arm"], _more(ATTACKED, "p10 p25 p75 p90", "p50")),
        *_say(652, "timing is higher than the variance for the", ["quad_arm"],
              Ordered(ATTACKED, tuple((name, f"{name} @ {LONG}") for name in DIRECTORS), spread=True),
              periods=[SHORT]),
        *_say(654, "with VDS+p75 obtaining more rewards, less crashes, and less variance than VDS", ["quad_arm"],
              _more(ATTACKED_SCORE, "vds+p75", "vds"), _more(ATTACKED, "vds", "vds+p75"),
              _wider(ATTACKED, "vds", "vds+p75")),
    )),
    Claim("C23", "All DEIMOS versions (2 s) or almost all (10 s) beat all baselines but VDS.", (
        *[clause for line, words, period in (
            (642, "All DEIMOS versions produce better policy populations", SHORT),
            (646, "almost all DEIMOS versions produce better policy populations", LONG),
        ) for clause in _say(line, words, ["quad_arm"],
                             [_more(measure, "uniform rnd cl", name) for measure in (NAIVE, ATTACKED)
                              for name in DIRECTORS], periods=[period])],
    )),
)  # fmt: skip
"""Figures 4.10 and 4.11."""


def _hump(best: str, environments: Sequence[str]) -> list[Clause]:
    """The best p, in the interior, is better than either end."""
    words = "improve until the best"
    return _say(666, words, environments, [_more(measure, end, best) for measure in (NAIVE, ATTACKED) for end in ENDS],
                [_more(measure, best, end) for measure in (SCORE, ATTACKED_SCORE) for end in ENDS],
                [_wider(ATTACKED, end, best) for end in ENDS])  # fmt: skip


def _headline(line: int, words: str, measure: Measure, *, spread: bool = False) -> list[Clause]:
    """The best of DEIMOS against the best baseline, chosen and tested on different seeds."""

    def then(best: str, rival: str) -> Test:
        return Ordered(measure, ((rival, best),), spread=True) if spread else Alike(measure, best, rival, at_most=True)

    return [
        *_say(line, words, PARTICLE, Best(measure, DIRECTORS, BASELINES[:3], then)),
        *_say(line, words, LEGGED, Best(measure, ("vds+p75",), BASELINES, then)),
    ]


DISCUSSION = (
    Claim("C24", "The goals of training matter little under Naive and a lot under the Adversary.", (
        *_say(662, "the goal distribution during training holds more importance", PARTICLE,
              Matters(ATTACKED, NAIVE, PARTICLE_METHODS)),
        *_say(662, "the goal distribution during training holds more importance", LEGGED,
              Matters(ATTACKED, NAIVE, LEGGED_METHODS)),
    ), note="By ranks, so that it does not depend on the scale: omega^2 of log crashes and of crashes disagree."),
    Claim("C25", "Over p, safety, score and variance are a hump: best inside, worse at Coop and Antagonist.", (
        *_hump("p25", PARTICLE), *_hump("p50", LEGGED),
    )),
    Claim("C26", "Coop and Antagonist produce similar populations.", (
        *_say(666, "Coop and Antagonist produce policies with similar metrics", ENVIRONMENTS,
              [_alike(measure, *ENDS)[0] for measure in (NAIVE, ATTACKED, SCORE, ATTACKED_SCORE)]),
    )),
    Claim("C27", "VDS is the best baseline over all environments; Uniform ties it in Particle Gym.", (
        *_say(660, "we identify VDS as the best baseline method", PARTICLE,
              [_more(measure, "rnd", "vds") for measure in (NAIVE, ATTACKED)]),
        *_say(660, "also obtains similar results for", PARTICLE,
              [_alike(measure, "uniform", "vds")[0] for measure in (NAIVE, ATTACKED)]),
        *_say(662, "VDS has a noticeable edge over the other baselines", LEGGED,
              [test for measure in (NAIVE, ATTACKED) for test in _each(measure, "uniform rnd cl", "vds")]),
    )),
    Claim("C28", "Headline: the best DEIMOS (legged: VDS+p75) is at least as safe as the best baseline, with less "
          "spread.", (
        *_headline(660, "either matches or bests the best baseline method", NAIVE),
        *_headline(662, "produces better policy populations than the baseline methods", ATTACKED),
        *_headline(711, "improves trained policy population variance", ATTACKED, spread=True),
    ), note="The best are chosen on every other seed and tested on the rest; five bases are too few for both."),
    Claim("C29", "Halfway through training, VDS's policies crash rarely.", (
        *_say(505, "VDS-trained policies start experiencing very few crashes", LEGGED, _mostly(HALFWAY, ["vds"])),
    ), note="Rarely: less than a tenth of what they did in the first tenth. Nothing is told of policies that branched "
          "off others, which walked from the beginning."),
    Claim("C30", "Under attack, policies trained by DEIMOS lose less score and gain fewer crashes than baselines'.", (
        *[clause for best, places in (("p25", PARTICLE), ("vds+p75", LEGGED))
          for clause in _say(662, "produces better policy populations than the baseline methods", places,
                             [_more(measure, " ".join(BASELINES), best) for measure in (GAIN, LOSS)])],
    )),
    Claim("C31", "Speed: DEIMOS is slower than the simpler baselines; VDS is the slowest.", (
        *_say(682, "DEIMOS is slower than the simpler baseline methods", ENVIRONMENTS,
              _each(FPS, "uniform rnd", "p25")),
        *_say(682, "The slowest method in study is VDS", ENVIRONMENTS, _each(FPS, "uniform rnd p25 cl", "vds")),
    ), note="From `python -m benchmarks table41`; the unit is a round of it. Clocks of study cells say nothing."),
    Claim("C32", "The Director's share and the diversity of goals fall with p.", (
        *_say(552, "because of a lack of goal diversity", ENVIRONMENTS, Ordered(DIVERSITY, falling(DIRECTORS))),
        *_say(487, "the first goal issued during an episode is selected randomly", ENVIRONMENTS,
              Ordered(CHOSEN, falling(DIRECTORS))),
    ), note="The share follows from crashes, after each of which the first goal is random."),
    Claim("C33", "Coop and Antagonist learn not to move (Relative, Directional).", (
        *_say(581, "the policies learned not to move", ["relative"], _more(MOTION, "uniform", "antagonist")),
        *_say(583, "its results are similar to the Antagonist", ["relative"], _more(MOTION, "uniform", "coop")),
        *_say(605, "the policies learned to not move at all", ["directional"],
              _each(MOTION, "uniform", "coop antagonist")),
    )),
    Claim("C34", "In training, Antagonist varies much (Quad, Quad+arm), and so does Coop (Quad+arm).", (
        *_say(733, "Reward and safety training curves for Quad", ["quad"],
              _wider(LATE, "antagonist", f"{_P} {' '.join(BASELINES)}")),
        *_say(737, "Reward and safety training curves for Quad+arm", ["quad_arm"],
              [_wider(LATE, name, f"{_P} {' '.join(BASELINES)}") for name in ENDS]),
    ), note="Read from the figures' bands."),
    Claim("C35", "Fear is higher near the wall than at the origin, and on stairs than on flat ground.", (
        *_say(485, "would receive higher fear scores than the goals for point", PARTICLE, _mostly(RISK, DIRECTORS)),
        *_say(395, "in a stairway than if the robot is on flat terrain", LEGGED, _mostly(RISK, DIRECTORS)),
    )),
    Claim("C36", "Penalties for crashing are detrimental.", (
        *_say(284, "often detrimental to the policy", ENVIRONMENTS, _each(SCORE, "uniform", " ".join(PENALTIES))),
    )),
    Claim("C37", "The signs of the workshop paper's tables: on the bare robot Uniform and RND beat DEIMOS, which beats "
          "CL; with the arm DEIMOS beats Uniform, CL and RND in this order; argmax is the worst.", (
        *_say(0, "", ["quad"], _each(NAIVE, "p50", "uniform rnd"), _each(NAIVE, "cl antagonist", "p50"),
              periods=[SHORT]),
        *_say(0, "", ["quad_arm"], [_more(NAIVE, a, b) for b, a in pairwise(("p50", "uniform", "cl", "rnd",
                                                                            "antagonist"))], periods=[SHORT]),
    ), note="T = 2 s, medium terrain. Its DEIMOS chose above a fixed level of fear, which is not recorded: p50 stands "
            "for it."),
)  # fmt: skip
"""The thesis's section 4.5.7, its other chapters, and the workshop paper."""

CLAIMS: tuple[Claim, ...] = (*TRAINING, *ABSOLUTE, *RELATIVE, *DIRECTIONAL, *QUAD, *QUAD_ARM, *DISCUSSION)
"""In the thesis's order."""
