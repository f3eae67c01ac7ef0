"""The report of a study of the thesis: first its claims on one page, then the generic one, then every clause."""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from deimos.checks import RunError
from deimos.study import figures as drawing
from deimos.study import report
from deimos.study.data import Data
from deimos.study.document import Block
from reproduction import claims, deviations, legged_contrasts, overview, shifted_goals
from reproduction.claim_list import CLAIMS
from reproduction.claim_tests import SETTLED_RATIO, SETTLED_SHARE
from reproduction.claims import LEAST, Outcome, Result
from reproduction.figures import STYLE, figures
from reproduction.legged_figures import ORIGIN
from reproduction.measures import Evidence

CLAUSES = "clauses"
"""Name of the figure on the first page."""
PAIRED = (
    "Policies that branched off the same base are compared with each other alone: clauses permute and resample "
    "within bases, and two methods have the exact interval of a share of bases. Two methods on five bases cannot be "
    "ordered by that, for even five of five is p = 1/16 on both sides; nor can it be decided what most policies do, "
    "or how much depends on the method. That two methods are alike could be held on five bases (p = 1/32), but not "
    "refused (1/16), so such clauses are undecided too. Clauses that order three methods or more can be decided: "
    "wrongly in at most 5 % of studies, also where one method varies more from run to run than up to six others; "
    "than more, in up to 17 %. Fewer than five bases give estimates without a verdict."
)


def write(folder: Path, out: Path, speeds: Path | None = None) -> Path:
    """Write the report; see ``deimos.study.report.write``.

    Args:
        folder: A study's folder, or one of exported tables; ``shifted_goals.csv`` in it is drawn too.
        out: Where to write; created if it does not exist.
        speeds: File of ``python -m benchmarks table41 --json``, on which the claim on speed is judged; ``None`` for
            none.

    Raises:
        RunError: If there are no results, or a file cannot be read.
    """
    rounds = _rounds(speeds)
    shifted = shifted_goals.read(folder)
    return report.write(folder, out, STYLE, partial(page, out=out, speeds=rounds), partial(figures, shifted=shifted))


def _rounds(path: Path | None) -> list[dict]:
    try:
        return json.loads(path.read_text())["table41"] if path else []
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise RunError(f"{path} is no file of `python -m benchmarks table41 --json` ({error}).") from error


def page(data: Data, pictures: report.Pictures, out: Path, speeds: Sequence[Mapping] = ()) -> list[Block]:
    """The claims on one page, the sections of every study, our choices, and the tests of all clauses."""
    evidence = Evidence.of(data, speeds)
    outcomes = [claims.test(claim, evidence) for claim in CLAIMS]
    figure = overview.draw(outcomes, data.environments)
    pairs = [f"Robots: {ORIGIN}"] if any(map(data.paired, data.environments)) else []
    first = drawing.write({CLAUSES: (" ".join([overview.CAPTION, *pairs]), figure)}, out / report.FIGURES)
    return [
        "# What the thesis claims, clause by clause", _summary(outcomes, data), *first,
        *_lines(outcomes), *report.environments(data, pictures), *report.over_all(data),
        *legged_contrasts.blocks(evidence), *report.what_was_run(data), *deviations.blocks(data.environments),
        *report.speed(data), *report.distributions(data),
        "## Every clause", *[block for outcome in outcomes for block in _details(outcome)],
        "## Limits", "\n".join(f"* {text}" for text in _limits(data)),
    ]  # fmt: skip


def _summary(outcomes: Sequence[Outcome], data: Data) -> str:
    """One sentence for all environments and one for each."""
    parts = [f"{_counted(outcomes)} over all environments"]
    for name in data.environments:
        own = [outcome.within(name) for outcome in outcomes]
        parts += [f"{_counted(own)} in {name}"] if any(each.results for each in own) else []
    without = ", ".join(each.claim.id for each in outcomes if not each.results)
    text = f"Clauses: {'; '.join(parts)}."
    undecided = [x.finding for each in outcomes for x in each.results if x.verdict == "undecided"]
    if beyond := sum(math.isinf(finding.detectable) for finding in undecided):
        text += f" For {beyond} of {len(undecided)} undecided there is no effect that so few policies show in 80 %."
    return text + (f" There are no data for {without}." if without else "")


def _counted(outcomes: Sequence[Outcome]) -> str:
    counts: Counter[str] = Counter(each.verdict for outcome in outcomes for each in outcome.results)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in claims.VERDICTS)


def _lines(outcomes: Sequence[Outcome]) -> list[Block]:
    rows = [{"claim": each.claim.id, "what the thesis says": each.claim.text, "clauses": each.line}
            for each in outcomes]  # fmt: skip
    return ["## Claims", rows]


def _details(outcome: Outcome) -> list[Block]:
    claim = outcome.claim
    rows = [_row(each) for each in outcome.results]
    without = "; ".join(clause.text for clause in outcome.without_data)
    return [
        f"### {claim.id}: {outcome.line}", f"{claim.text} {claim.note}".strip(),
        *([rows] if rows else []), *([f"Without data: {without}."] if without else []),
    ]  # fmt: skip


def _row(each: Result) -> dict[str, str]:
    finding = each.finding
    within, smallest = finding.equivalent_within, finding.detectable
    return {
        "where": str(each.place), "clause": each.clause.text, "line": str(each.clause.line or "-"),
        "n": " + ".join(map(str, finding.n.values())), "without": ", ".join(each.missing) or "-",
        "effect": finding.effect + (f" ({finding.chosen})" if finding.chosen else ""),
        "size [95 %; of equivalences 90 %]": f"{finding.interval:.3g}", "no difference": f"{finding.no_difference:g}",
        "equivalent within": "-" if within is None else _finite(within, ".3g"),
        "minimum detectable effect": _finite(smallest, ".2g"),
        "verdict": each.verdict,
    }  # fmt: skip


def _finite(number: float, form: str) -> str:
    return "none" if math.isinf(number) else format(number, form)


def _limits(data: Data) -> list[str]:
    """The notes of every study, and on the tests of claims."""
    pairs = [PAIRED] if any(map(data.paired, data.environments)) else []
    return [
        *report.limits(data),
        "A clause is one comparison. It holds where a test rejects its opposite, does not hold where it rejects the "
        "clause, each wrongly in at most 5 % of all studies, and is undecided otherwise. Nothing is corrected over "
        f"clauses, and nothing is tested below {LEAST} policies. An equivalence is settled within a ratio of "
        f"{SETTLED_RATIO:g}, or {SETTLED_SHARE:g} of the score.",
        *pairs,
        "`python -m reproduction coverage` measures again how often these intervals contain the truth.",
        "What the thesis measured its Table 4.1 on is not known; its claim on speed rests on `python -m benchmarks "
        "table41`, never on the clocks of a study.",
    ]
