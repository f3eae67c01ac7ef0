"""The three primary hypotheses of the reproduction in Particle Gym, one test each, corrected by Holm's rule.

    python -m reproduction.hypotheses FOLDER

H1: the best p is safer than Uniform. H2: it is safer than Uniform with the better crash penalty, at a score that is not
lower by 5 %. H3: over the delivered dose, score and safety rise at one end and fall at the other. The best ones were
chosen on seeds 0 to 9; H1 and H2 are tested on seeds 10 to 29. Safety is the mean rate of crashes per interaction under
the worst attacker, over policies.
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import stats as scipy_stats

from deimos.study import stats
from deimos.study.data import Data
from deimos.study.stats import POWER, Array, Interval
from reproduction.claims import ALPHA, LEAST, holm
from reproduction.measures import ATTACKED, DOSE, LITERAL, PENALTIES, SCORE, Evidence, Measure
from reproduction.thesis import DIRECTOR_METHODS, DIRECTORS

VARIANTS = ("directional", "absolute")
CHOOSING, TESTING = range(10), range(10, 30)
CANDIDATES = tuple(name + ending for name in DIRECTORS for ending in ("", LITERAL))
DOSED = ("uniform", *[name + ending for name in DIRECTOR_METHODS for ending in ("", LITERAL)])
LEAST_SCORE = 0.95  # of the penalised policies' score
PERMUTATIONS = 9999
RESAMPLES = 4000

Samples = Mapping[str, Array]
"""Values of one method: by variant, one per policy."""


@dataclass(frozen=True)
class Answer:
    """The answer to a hypothesis."""

    name: str
    """H1 to H3."""
    text: str
    """The hypothesis that was tested."""
    p: float
    """One-sided p-value."""
    effect: Interval | None
    """By how much the mean rate of crashes per interaction is lower, with its 95 % interval.

    For H3, the least certain slope."""
    detectable: float
    """Smallest effect that is found with a power of 80 % at the first step of Holm's rule."""
    condition: bool = True
    """Whether the hypothesis's further condition is met."""
    note: str = ""
    """The condition in numbers."""
    corrected: float = 1.0
    """The p-value by Holm's rule over the three."""

    @property
    def holds(self) -> bool:
        """Whether the data support it."""
        return self.condition and self.corrected <= ALPHA


def primary(evidence: Evidence) -> list[Answer]:
    """The answers to H1, H2 and H3; one without data counts as a p-value of 1.

    Args:
        evidence: Evidence of the study, with its own names of methods.
    """
    early, late = evidence.only(CHOOSING), evidence.only(TESTING)
    best, penalty = (safest(early, names) for names in (CANDIDATES, PENALTIES))
    answers = [
        safer("H1", late, best, "uniform"),
        _no_worse(safer("H2", late, best, penalty), late, best, penalty),
        hump(evidence),
    ]
    corrected = holm([each.p for each in answers])
    return [replace(each, corrected=p) for each, p in zip(answers, corrected, strict=True)]


def samples(evidence: Evidence, measure: Measure, method: str | None) -> dict[str, Array]:
    """A measure's values for a method by variant; none unless it has enough policies in each."""
    found = {
        place.environment: np.array([*measure(evidence, place, method or "").values()])
        for name in VARIANTS for place in evidence.places(name)[:1]
    }  # fmt: skip
    return found if len(found) == len(VARIANTS) and min(map(len, found.values())) >= LEAST else {}


def safest(evidence: Evidence, names: Iterable[str]) -> str | None:
    """The method with the lowest mean rate, variants counting equally; ``None`` if there are no data."""
    rates = {name: _mean(own) for name in names if (own := samples(evidence, ATTACKED, name))}
    return min(rates, key=rates.__getitem__) if rates else None


def _mean(values: Samples) -> float:
    return float(np.mean([x.mean() for x in values.values()]))


def safer(name: str, evidence: Evidence, best: str | None, rival: str | None) -> Answer:
    """Test whether a method has a lower mean rate than another: labels permuted within variants, one-sided."""
    text = f"{best or 'the best p'} is safer than {rival or 'the better penalty'}"
    own, others = (samples(evidence, ATTACKED, method) for method in (best, rival))
    if not own or not others:
        return Answer(name, f"{text}: no data", 1.0, None, np.inf)
    pairs = [(others[variant], own[variant]) for variant in VARIANTS]
    p, deviation = permuted(pairs)
    flat = [x for pair in pairs for x in pair]
    lower = stats.bootstrap(flat, lambda *x: np.mean(
        [a.mean(axis=-1) - b.mean(axis=-1) for a, b in zip(x[::2], x[1::2], strict=True)], axis=0
    ), resamples=RESAMPLES)  # fmt: skip
    return Answer(name, text, p, lower, _reach(deviation))


def permuted(pairs: Sequence[tuple[Array, Array]], seed: int = 0) -> tuple[float, float]:
    """Permutation test that the first samples' means are higher, averaged over strata, labels permuted within each.

    Exact if the two samples of each stratum come from one population.

    Returns:
        The one-sided p-value, and the standard deviation of the difference under permutation.
    """
    rng, total = np.random.default_rng(seed), np.zeros(PERMUTATIONS + 1)
    for x, y in pairs:
        pooled = np.tile(np.concatenate([x, y]), (PERMUTATIONS + 1, 1))
        pooled[1:] = rng.permuted(pooled[1:], axis=1)
        total += (pooled[:, : len(x)].mean(axis=1) - pooled[:, len(x) :].mean(axis=1)) / len(pairs)
    return float((total >= total[0] - 1e-12).mean()), float(total[1:].std())


def _reach(deviation: float) -> float:
    return float(scipy_stats.norm.ppf(1 - ALPHA / 3) + scipy_stats.norm.ppf(POWER)) * deviation


def _no_worse(answer: Answer, evidence: Evidence, best: str | None, rival: str | None) -> Answer:
    """The same under the condition that the score is not lower by 5 %."""
    own, others = (samples(evidence, SCORE, method) for method in (best, rival))
    if not own or not others:
        return replace(answer, condition=False, note="score: no data")
    flat = [x for variant in VARIANTS for x in (own[variant], others[variant])]
    ratio = stats.bootstrap(flat, lambda *x: (
        sum(z.mean(axis=-1) for z in x[::2]) / sum(z.mean(axis=-1) for z in x[1::2])
    ), resamples=RESAMPLES)  # fmt: skip
    return replace(answer, condition=ratio.low > LEAST_SCORE, note=f"ratio of scores {ratio:.3f}")


def hump(evidence: Evidence) -> Answer:
    """Test whether parabolas of score and safety over the delivered dose rise at its lowest and fall at its highest.

    One parabola for all variants, each with its own intercept; policies are resampled within methods and variants. All
    four slopes must have their sign (an intersection-union test): the largest of their p-values counts.
    """
    text = "score and safety rise over the lowest delivered dose and fall over the highest"
    groups: list[Array] = []  # (variant, dose, score, safety) of the policies of a method, shape (4, n)
    for i, variant in enumerate(VARIANTS):
        for place in evidence.places(variant)[:1]:
            for name in DOSED:
                dose, score, rate = (measure(evidence, place, name) for measure in (DOSE, SCORE, ATTACKED))
                seeds = sorted(dose.keys() & score.keys() & rate.keys())
                rows = [(i, dose[seed], score[seed], 1 - rate[seed]) for seed in seeds]
                if len(rows) >= LEAST:
                    groups.append(np.array(rows, float).T)
    if len(groups) < 4 or len({group[0, 0] for group in groups}) < len(VARIANTS):
        return Answer("H3", f"{text}: no data", 1.0, None, np.inf)
    ends = np.quantile(np.concatenate([group[1] for group in groups]), [0.0, 1.0])
    rng = np.random.default_rng(0)
    drawn = np.concatenate([group[:, rng.integers(0, group.shape[1], (RESAMPLES, group.shape[1]))]
                            for group in groups], axis=-1)  # fmt: skip
    own = slopes(np.concatenate(groups, axis=-1)[:, None], ends)[:, 0]
    found = slopes(drawn, ends)
    p = ((found <= 0).sum(axis=1) + 1) / (RESAMPLES + 1)
    worst = int(np.argmax(p))
    low, high = np.quantile(found[worst], stats.ENDS)
    sides = ("score at the lowest dose", "score at the highest", "safety at the lowest", "safety at the highest")
    note = ", ".join(f"{side} {slope:+.4f} (p = {each:.3g})" for side, slope, each in zip(sides, own, p, strict=True))
    effect = Interval(float(own[worst]), float(low), float(high))
    return Answer("H3", text, float(p.max()), effect, _reach(float(found[worst].std())), note=note)


def slopes(policies: Array, ends: Array) -> Array:
    """Inward slopes per percentile of score and of safety, at both ends of the dose.

    Args:
        policies: Variant, dose, score and safety, shape (4, studies, n).
        ends: Lowest and highest dose.

    Returns:
        Score at the lowest and at the highest dose, safety at both, shape (4, studies); all are positive on a hump.
    """
    variant, dose, *outcomes = policies
    middle, half = ends.mean(), max((ends[1] - ends[0]) / 2, 1e-9)
    x = (dose - middle) / half
    levels = [(variant == i).astype(float) for i in range(len(VARIANTS))]
    design = np.stack([x**2, x, *levels], axis=-1)
    inverse = np.linalg.pinv(design)  # (studies, columns, n)
    found = []
    for outcome in outcomes:
        square, line = (inverse @ outcome[..., None])[..., :2, 0].T
        found += [(line - 2 * square) / half, -(line + 2 * square) / half]
    return np.array(found)


def table(evidence: Evidence) -> list[str]:
    """Lines of Markdown: a row for each hypothesis."""
    lines = [
        "| | hypothesis | answer | p | by Holm | effect [95 %] | smallest that would be found | |", "|---" * 8 + "|",
    ]  # fmt: skip
    for each in primary(evidence):
        effect = "-" if each.effect is None else f"{each.effect:.3g}"
        lines.append(
            f"| {each.name} | {each.text} | {'holds' if each.holds else 'is not shown'} | {each.p:.3g} "
            f"| {each.corrected:.3g} | {effect} | {each.detectable:.3g} | {each.note} |"
        )
    return lines


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    print("\n".join(table(Evidence.of(Data.read(parser.parse_args().folder), renamed=False))))


if __name__ == "__main__":
    main()
