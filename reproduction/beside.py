"""Every method against one, over the variants of the hypotheses: a table of uncorrected tests.

    python -m reproduction.beside FOLDER --rival uniform --seeds 0-9

For each method: the mean rate of crashes per interaction under the worst attacker and the score, Uniform's = 1,
variants counting equally, with 95 % bootstrap intervals; by how many percentage points its rate is lower than the
rival's; and the one-sided p-value of H1's test (uncorrected, exploratory).
"""

import argparse
from pathlib import Path

from deimos.checks import RunError
from deimos.study.data import Data
from deimos.study.plan import parse_seeds
from reproduction.hypotheses import safer
from reproduction.measures import Evidence
from reproduction.mechanism import ORDER
from reproduction.particle_picture import points


def table(evidence: Evidence, rival: str = "uniform") -> list[str]:
    """Lines of Markdown: a row for each method that has policies in every variant, as the rival must have.

    Raises:
        RunError: If it has not.
    """
    found = points(evidence, ORDER)
    if rival not in found:
        raise RunError(f"The rival must be one of {', '.join(found) or 'no methods: there are none'}, got {rival}.")
    lines = [f"| method | `worst` [%] | score, Uniform = 1 | lower than `{rival}`'s by | p |", "|---" * 5 + "|"]
    for name, (score, rate) in found.items():
        answer = safer(name, evidence, name, rival)
        tested = "- | -" if name == rival else f"{answer.effect:.1%} | {answer.p:.3g}"
        lines.append(f"| `{name}` | {rate:.1f} | {score:.2f} | {tested} |")
    return lines


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rival", default="uniform", help="the method that the others are tested against")
    parser.add_argument("--seeds", type=parse_seeds, help="those that count, as in a study's file; by default all")
    options = parser.parse_args()
    evidence = Evidence.of(Data.read(options.folder), renamed=False)
    print("\n".join(table(evidence.only(options.seeds) if options.seeds else evidence, options.rival)))


if __name__ == "__main__":
    main()
