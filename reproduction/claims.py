"""Claims of the thesis as lists of clauses, and their verdicts, which can go either way.

A clause is one comparison with one number. It *holds* if a test rejects its opposite, *does not hold* if the test
rejects the clause itself, and is *undecided* otherwise, including when one of the two is out of reach. Either verdict
is wrong in at most 5 % of all studies, as ``python -m reproduction.verdicts`` measures. Nothing is corrected over
clauses, except where one of several is enough.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

from deimos.study.stats import Interval
from reproduction.measures import Evidence, Place

ALPHA = 0.05
LEAST = 3  # policies of a method, below which it is excluded
LEAST_BASES = 5  # bases that policies branched off, below which a number is an estimate without a verdict (legged.md)
Verdict = Literal["holds", "does not hold", "undecided"]
VERDICTS: tuple[Verdict, ...] = ("holds", "does not hold", "undecided")


@dataclass(frozen=True)
class Finding:
    """The result of a clause's test in one place."""

    effect: str
    """Name of the measured number; the higher it is, the more the clause holds."""
    interval: Interval
    """The number with its 95 % interval; for an equivalence the 90 % interval, that of two one-sided tests."""
    no_difference: float
    """The number if nothing differs."""
    p_for: float
    """p-value against the clause being false: at most 5 % if it holds."""
    p_against: float
    """p-value against the clause being true: at most 5 % if it does not hold."""
    detectable: float
    """Smallest effect that the test finds with a power of 80 %; infinite if it can find none."""
    n: Mapping[str, int]
    """Policies of every method."""
    equivalent_within: float | None = None
    """For an equivalence: the smallest ratio, or difference, within which it holds at 95 %."""
    chosen: str = ""
    """For a choice made on other seeds: what was chosen."""
    reachable: tuple[float, float] = (0.0, 0.0)
    """Smallest p-values, for and against, that any policies in so few blocks can have."""

    @property
    def verdict(self) -> Verdict:
        """The verdict; none if only one of the two verdicts could have been reached, whatever the policies did."""
        if max(self.reachable) > ALPHA:
            return "undecided"
        if self.p_for <= ALPHA:
            return "holds"
        return "does not hold" if self.p_against <= ALPHA else "undecided"


class Test(Protocol):
    """How a clause is tested."""

    @property
    def methods(self) -> tuple[str, ...]:
        """Those that it compares."""

    def __str__(self) -> str:
        """A description of the comparison."""

    def find(self, evidence: Evidence, place: Place) -> Finding | None:
        """Its result; ``None`` if there are no data for it."""


@dataclass(frozen=True)
class Clause:
    """One comparison that a claim makes."""

    line: int
    """Line of the thesis's text that states it; 0 if the workshop paper does."""
    words: str
    """Some of its words there, by which ``python -m reproduction.lines`` finds the line."""
    test: Test
    """How it is tested."""
    environments: tuple[str, ...]
    """The places where it is said to hold."""
    periods: tuple[int, ...] = ()
    """The T [steps] at which it is said to hold; empty for all."""
    once: bool = False
    """Whether it is about training, which all T of an environment share, so that one of them is enough."""

    @property
    def text(self) -> str:
        """The clause in words, as it is tested."""
        return str(self.test)

    def places(self, evidence: Evidence) -> list[Place]:
        """The places where it can be tested."""
        own = [evidence.places(name)[: 1 if self.once else None] for name in self.environments]
        found = [place for places in own for place in places]
        return [place for place in found if not self.periods or place.period in self.periods]


@dataclass(frozen=True)
class Claim:
    """What the thesis says about one thing."""

    id: str
    """C1 to C37."""
    text: str
    """The claim in short."""
    clauses: tuple[Clause, ...]
    """Its clauses, comparison by comparison."""
    one_is_enough: bool = False
    """Whether it says only that some of its clauses hold, not which: their p-values are corrected by Holm's rule."""
    note: str = ""
    """What is not tested, and why."""


@dataclass(frozen=True)
class Result:
    """A clause in one place."""

    clause: Clause
    """The clause."""
    place: Place
    """Where."""
    finding: Finding
    """The finding."""

    @property
    def verdict(self) -> Verdict:
        """What it says."""
        return self.finding.verdict

    @property
    def missing(self) -> tuple[str, ...]:
        """Methods of the clause that have too few policies; none if it chose among them."""
        if self.finding.chosen:
            return ()
        return tuple(name for name in self.clause.test.methods if name not in self.finding.n)


@dataclass(frozen=True)
class Outcome:
    """A claim after its test."""

    claim: Claim
    """The claim."""
    results: tuple[Result, ...]
    """Results of every clause with data, wherever it can be tested."""
    without_data: tuple[Clause, ...] = ()
    """Clauses without data anywhere."""

    @property
    def counts(self) -> Counter[Verdict]:
        """How many of its results have each verdict."""
        return Counter(each.verdict for each in self.results)

    @property
    def line(self) -> str:
        """How many of its clauses hold, in words."""
        if not self.results:
            return "no data"
        holds, does_not, undecided = (self.counts[name] for name in VERDICTS)
        number, enough = len(self.results), " (one is enough)" if self.claim.one_is_enough else ""
        told = f"{holds} of {number} clause{'s' * ((holds, number) != (1, 1))} hold{'s' * (holds == 1)}{enough}"
        rest = [f"{does_not} do{'es' * (does_not == 1)} not"] * bool(does_not) + [f"{undecided} undecided"] * bool(
            undecided
        )
        return told + (f"; {', '.join(rest)}" if rest else "")

    def within(self, environment: str) -> "Outcome":
        """Its results in one environment."""
        return replace(self, results=tuple(each for each in self.results if each.place.environment == environment))


def test(claim: Claim, evidence: Evidence) -> Outcome:
    """Test every clause of a claim wherever there are data for it."""
    results, without = [], []
    for clause in claim.clauses:
        found = [(place, _find(clause.test, evidence, place)) for place in clause.places(evidence)]
        own = [Result(clause, place, finding) for place, finding in found if finding is not None]
        results += own
        if not own:
            without.append(clause)
    if claim.one_is_enough:
        corrected = holm([each.finding.p_for for each in results])
        results = [
            replace(each, finding=replace(each.finding, p_for=p)) for each, p in zip(results, corrected, strict=True)
        ]
    return Outcome(claim, tuple(results), tuple(without))


def _find(test: Test, evidence: Evidence, place: Place) -> Finding | None:
    """The result of a test; with few bases it is an estimate, with no evidence for or against it."""
    found = test.find(evidence, place)
    if found is not None and evidence.paired(place) and min(found.n.values()) < LEAST_BASES:
        return replace(found, p_for=1.0, p_against=1.0, detectable=math.inf)
    return found


def holm(p: Sequence[float]) -> list[float]:
    """p-values adjusted for testing all of them, by Holm's step-down rule [1]_.

    References:
        .. [1] Holm, *A Simple Sequentially Rejective Multiple Test Procedure*, Scand. J. Statistics 6, 1979.
    """
    adjusted, largest = [0.0] * len(p), 0.0
    for rank, i in enumerate(sorted(range(len(p)), key=p.__getitem__)):
        largest = max(largest, min(1.0, (len(p) - rank) * p[i]))
        adjusted[i] = largest
    return adjusted
