"""The report of a study of the thesis: the generic one, with the thesis's claims and its Table 4.1."""

import math
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from deimos.study import report
from deimos.study.data import Data
from deimos.study.document import Block
from reproduction import claims, deviations, shifted_goals
from reproduction.claim_list import CLAIMS
from reproduction.claim_tests import FACTOR, LEAST, PROBABILITY, REWARD_SHARE, SPREAD
from reproduction.claims import Outcome
from reproduction.figures import STYLE, figures
from reproduction.significance import detectable_spread
from reproduction.thesis import LEGGED_METHODS, RATIOS_4_1


def write(folder: Path, out: Path) -> Path:
    """Write the report; see ``deimos.study.report.write``."""
    shifted = shifted_goals.read(folder)
    return report.write(folder, out, STYLE, page, partial(figures, shifted=shifted))


def page(data: Data, pictures: report.Pictures) -> list[Block]:
    """The sections of every study, the claims after what was run, and their tests at the end."""
    tested = data.only(LEGGED_METHODS)
    outcomes = [claims.test(claim, tested) for claim in CLAIMS]
    return [
        "# A study of goal selection", *_verdicts(outcomes), *report.environments(data, pictures),
        *report.over_all(data), *report.what_was_run(data), *deviations.blocks(),
        *_speed(data), *report.distributions(data), *[block for outcome in outcomes for block in _details(outcome)],
        "## Limits", "\n".join(f"* {text}" for text in _limits(data)),
    ]  # fmt: skip


def _verdicts(outcomes: Sequence[Outcome]) -> list[Block]:
    counts: Counter[str] = Counter(outcome.verdict for outcome in outcomes)
    summary = ", ".join(f"{counts[verdict]} {verdict}" for verdict in claims.VERDICTS)
    rows = [
        {"claim": each.claim.id, "what the thesis says": each.claim.text, "verdict": _verdict(each),
         "tests made": f"{each.made} of {each.claim.planned}", "what they say": _tally(each),
         "without data": ", ".join(each.missing)}
        for each in outcomes
    ]  # fmt: skip
    return [
        "## Claims",
        f"Of the thesis's {len(outcomes)} claims: {summary}. They are tested on the thesis's own methods; the "
        "tests of each, with effects, are below.",
        rows,
    ]


def _speed(data: Data) -> list[Block]:
    """That of every study, beside the thesis's Table 4.1."""
    blocks = report.speed(data)
    for row in (row for block in blocks if isinstance(block, list) for row in block):
        theirs = RATIOS_4_1.get(row["environment"], {}).get(row["method"])
        row["published ratio"] = "-" if theirs is None else f"{theirs:.2f}"
    return blocks


def _verdict(outcome: Outcome) -> str:
    return outcome.verdict + (", in part" if outcome.in_part else "")


def _tally(outcome: Outcome) -> str:
    counts: Counter[str] = Counter(each.verdict for each in outcome.assessed)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in claims.VERDICTS if counts[verdict])


def _details(outcome: Outcome) -> list[Block]:
    claim = outcome.claim
    blocks: list[Block] = [f"### {claim.id}: {_verdict(outcome)}", claim.text]
    blocks.append(f"Test: {claim.test}." + (f" {claim.note}" if claim.note else ""))
    rows = [
        {
            "where": str(each.finding.where), "what": each.finding.what, "n": " + ".join(map(str, each.finding.n)),
            "effect": each.finding.effect, "size [95 %]": f"{each.finding.interval:.3g}", "p": f"{each.p:.2g}",
            "minimum detectable effect": f"{'none' if math.isinf(each.detectable) else format(each.detectable, '.2g')} "
            f"(wanted {each.finding.wanted:.2g})",
            "verdict": each.verdict + ("" if each.finding.required else " (can only contradict)"),
        }
        for each in outcome.assessed
    ]  # fmt: skip
    return [*blocks, rows or "There are no data for it here."]


def _limits(data: Data) -> list[str]:
    """Those of every study, and of the tests of claims."""
    unit, power, *rest = report.limits(data)
    r10, r30 = (detectable_spread(n, n) for n in (10, 30))
    return [
        unit,
        f"{power} A ratio of standard deviations must be {r10:.1f} and {r30:.1f} to be found. Nothing is tested below "
        f"{LEAST} policies.",
        f"Declared beforehand: of interest are P = {PROBABILITY} and ratios of spread of {SPREAD:g}; equivalent are "
        f"crashes within a factor of {FACTOR:g} and rewards within {100 * REWARD_SHARE:.0f} % of Uniform's median. "
        "`Undecided` is a test that would probably have found such an effect and did not; `underpowered` one that "
        "would not have.",
        "A claim that needs all its tests is supported only if each of them rejects the opposite at 5 % by itself (an "
        "intersection-union test, of level 5 % as it is); one of them is enough to contradict it, so there the "
        "p-values are corrected by Holm's rule over the claim's tests. For a claim that needs only one of its tests "
        "it is the other way round. The p that is printed is the smaller one. Nothing is corrected over all claims "
        "together. A minimum detectable effect of `none` is that of a test that cannot reject with so few policies "
        "at the level that contradicts.",
        "The best p is chosen on one half of the seeds and tested on the other, from 20 seeds on.",
        *rest,
        "`python -m reproduction coverage` measures again how often these intervals contain the truth.",
        "What the thesis measured its Table 4.1 on is not known.",
    ]
