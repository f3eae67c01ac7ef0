"""The outcome of a claim: findings, Holm's correction, verdicts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from deimos.study.data import Data, Where
from deimos.study.stats import Interval
from reproduction.significance import holm

ALPHA = 0.05
VERDICTS = ("supported", "contradicted", "undecided", "underpowered", "not testable")
Verdict = Literal["supported", "contradicted", "undecided", "underpowered", "not testable"]


@dataclass(frozen=True)
class Finding:
    """One test of a claim."""

    what: str
    """What the claim says here, in symbols."""
    where: Where | str
    """The evaluation or environment."""
    effect: str
    """Name of the effect that is measured."""
    interval: Interval
    """The effect with its 95 % interval."""
    p_for: float
    """p-value against the claim being false: small supports it."""
    p_against: float
    """p-value against the claim being true: small contradicts it."""
    detectable: Callable[[float], float]
    """Smallest effect that the test finds with a power of 80 %, by the level of the test."""
    wanted: float
    """Smallest effect of interest, declared beforehand: with less than it detectable, a miss says something."""
    n: tuple[int, ...]
    """Policies in every sample."""
    required: bool = True
    """Whether the claim is supported only if this is; otherwise it can only contradict it."""


@dataclass(frozen=True)
class Assessed:
    """A finding with what it says after the correction for the number of tests of its claim."""

    finding: Finding
    """The test."""
    verdict: Verdict
    """What it says."""
    p: float
    """The smaller of its two p-values, corrected as ``assess`` says."""
    detectable: float
    """Smallest effect that it could have found with a power of 80 %, at the corrected level."""


@dataclass(frozen=True)
class Claim:
    """A claim of the thesis and its predeclared test."""

    id: str
    """C1 to C32."""
    text: str
    """What the thesis says."""
    environments: tuple[str, ...]
    """Where it says so."""
    test: str
    """How it is tested, for the reader."""
    findings: Callable[[Data, str], list[Finding]]
    """Makes the tests in one environment; those whose data are missing are left out."""
    planned: int
    """Required tests when every method has results everywhere: with fewer, the verdict holds only in part."""
    combine: Literal["all", "any"] = "all"
    """Whether every required finding must support the claim, or one is enough."""
    note: str = ""
    """What is not tested, and why."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a claim."""

    claim: Claim
    """The claim."""
    verdict: Verdict
    """What its findings say together."""
    assessed: list[Assessed] = field(default_factory=list)
    """Its findings."""
    missing: tuple[str, ...] = ()
    """Environments that it speaks of and that have no data for it."""

    @property
    def made(self) -> int:
        """Required tests that there were data for."""
        return sum(each.finding.required for each in self.assessed)

    @property
    def in_part(self) -> bool:
        """Whether some of the claim's tests could not be made."""
        return 0 < self.made < self.claim.planned


def test(claim: Claim, data: Data) -> Outcome:
    """Test a claim wherever there are data for it."""
    found = {environment: claim.findings(data, environment) for environment in claim.environments}
    findings = [finding for part in found.values() for finding in part]
    missing = tuple(environment for environment, part in found.items() if not part)
    assessed = assess(findings, claim.combine)
    return Outcome(claim, combined(assessed, claim.combine, claim.planned), assessed, missing)


def assess(findings: Sequence[Finding], combine: Literal["all", "any"] = "all", alpha: float = ALPHA) -> list[Assessed]:
    """Say what each finding of a claim means, with p-values corrected so that the claim's verdicts have level alpha.

    A claim that needs all its findings is supported only if every test rejects the opposite at level alpha. Such an
    intersection-union test has level alpha as it is [1]_. One of its findings is enough to contradict it: there the
    p-values are corrected by Holm's rule. Where one finding is enough to support, it is the other way round.

    A finding that neither supports nor contradicts is ``undecided`` if its test would probably have found the
    smallest effect of interest at the stricter of the two levels, and ``underpowered`` if not.

    References:
        .. [1] Berger, *Multiparameter Hypothesis Testing and Acceptance Sampling*, Technometrics 24, 1982.
    """
    if not findings:
        return []
    for_claim, against = ([getattr(f, name) for f in findings] for name in ("p_for", "p_against"))
    if combine == "all":
        against = holm(against).tolist()
    else:
        for_claim = holm(for_claim).tolist()
    assessed = []
    for finding, p_for, p_against in zip(findings, for_claim, against, strict=True):
        detectable = finding.detectable(alpha / len(findings))
        verdict: Verdict = "undecided" if detectable <= finding.wanted else "underpowered"
        if p_for < alpha:
            verdict = "supported"
        elif p_against < alpha:
            verdict = "contradicted"
        assessed.append(Assessed(finding, verdict, float(min(p_for, p_against)), detectable))
    return assessed


def combined(assessed: Sequence[Assessed], how: Literal["all", "any"] = "all", planned: int = 1) -> Verdict:
    """The verdict over all findings of a claim.

    With ``all``, one contradicted finding contradicts the claim, and every required one must support it. With
    ``any``, one supported finding is enough, and the claim is contradicted only if all that were planned are.
    """
    required = [each.verdict for each in assessed if each.finding.required]
    verdicts = [each.verdict for each in assessed]
    if not required:
        return "contradicted" if "contradicted" in verdicts else "not testable"
    if how == "any":
        decided: Verdict | None = "supported" if "supported" in required else None
        every = len(required) >= planned and set(required) == {"contradicted"}
        decided = decided or ("contradicted" if every else None)
    else:
        decided = "contradicted" if "contradicted" in verdicts else None
        decided = decided or ("supported" if set(required) == {"supported"} else None)
    open_ones = {verdict for verdict in required if verdict in ("undecided", "underpowered")}
    return decided or ("underpowered" if "underpowered" in open_ones else "undecided")
