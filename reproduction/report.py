"""The report of a study of the thesis: the generic one, with the thesis's claims and its Table 4.1."""

from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from deimos.study import report
from deimos.study.data import Data
from deimos.study.document import Block
from reproduction import claims, deviations, shifted_goals
from reproduction.claim_list import CLAIMS
from reproduction.claim_tests import SETTLED_RATIO, SETTLED_SHARE
from reproduction.claims import LEAST, Outcome
from reproduction.figures import STYLE, figures
from reproduction.measures import Evidence
from reproduction.thesis import RATIOS_4_1


def write(folder: Path, out: Path) -> Path:
    """Write the report; see ``deimos.study.report.write``."""
    shifted = shifted_goals.read(folder)
    return report.write(folder, out, STYLE, page, partial(figures, shifted=shifted))


def page(data: Data, pictures: report.Pictures) -> list[Block]:
    """The sections of every study, the claims after what was run, and their tests at the end."""
    evidence = Evidence.of(data)
    outcomes = [claims.test(claim, evidence) for claim in CLAIMS]
    return [
        "# A study of goal selection", *_verdicts(outcomes), *report.environments(data, pictures),
        *report.over_all(data), *report.what_was_run(data), *deviations.blocks(),
        *_speed(data), *report.distributions(data), *[block for outcome in outcomes for block in _details(outcome)],
        "## Limits", "\n".join(f"* {text}" for text in _limits(data)),
    ]  # fmt: skip


def _verdicts(outcomes: Sequence[Outcome]) -> list[Block]:
    rows = [{"claim": each.claim.id, "what the thesis says": each.claim.text, "clauses": each.line}
            for each in outcomes]  # fmt: skip
    counts = sum((each.counts for each in outcomes), Counter())
    summary = ", ".join(f"{counts[verdict]} {verdict}" for verdict in claims.VERDICTS)
    return ["## Claims", f"Clauses of the thesis's {len(outcomes)} claims: {summary}. The test of each is below.", rows]


def _speed(data: Data) -> list[Block]:
    """That of every study, beside the thesis's Table 4.1."""
    blocks = report.speed(data)
    for row in (row for block in blocks if isinstance(block, list) for row in block):
        theirs = RATIOS_4_1.get(row["environment"], {}).get(row["method"])
        row["published ratio"] = "-" if theirs is None else f"{theirs:.2f}"
    return blocks


def _details(outcome: Outcome) -> list[Block]:
    claim = outcome.claim
    rows = [
        {
            "where": str(each.place), "clause": each.clause.text, "line": str(each.clause.line or "-"),
            "n": " + ".join(map(str, each.finding.n.values())), "effect": each.finding.effect,
            "size [95 %]": f"{each.finding.interval:.3g}",
            "equivalent within": "-" if each.finding.equivalent_within is None
            else f"{each.finding.equivalent_within:.3g}",
            "minimum detectable effect": f"{each.finding.detectable:.2g}", "verdict": each.verdict,
        }
        for each in outcome.results
    ]  # fmt: skip
    return [f"### {claim.id}: {outcome.line}", f"{claim.text} {claim.note}".strip(), rows or "There are no data."]


def _limits(data: Data) -> list[str]:
    """Those of every study, and of the tests of claims."""
    unit, power, *rest = report.limits(data)
    return [
        unit,
        f"{power} Nothing is tested below {LEAST} policies.",
        "A clause is one comparison. It holds where a test rejects its opposite, does not hold where it rejects the "
        "clause, each wrongly in at most 5 % of all studies, and is undecided otherwise. Nothing is corrected over "
        f"clauses. An equivalence is settled within a ratio of {SETTLED_RATIO:g}, or {SETTLED_SHARE:g} of the score.",
        *rest,
        "`python -m reproduction coverage` measures again how often these intervals contain the truth.",
        "What the thesis measured its Table 4.1 on is not known.",
    ]
