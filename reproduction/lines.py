"""Check that the thesis contains what clauses quote, line by line.

    python -m reproduction.lines THESIS.txt

The text is not part of this repository. Prints every clause whose words are not in its line.
"""

import argparse
from pathlib import Path

from reproduction.claim_list import CLAIMS


def wrong(lines: list[str]) -> list[str]:
    """Errors in the lines that clauses name, one text each."""
    found = []
    for claim in CLAIMS:
        for clause in claim.clauses:
            line = lines[clause.line - 1] if 0 < clause.line <= len(lines) else ""
            if clause.line and " ".join(clause.words.split()) not in " ".join(line.split()):
                found.append(f"{claim.id}: line {clause.line} does not say '{clause.words}'")
    return list(dict.fromkeys(found))


def main() -> int:
    """See the module's docstring; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("thesis", type=Path)
    found = wrong(parser.parse_args().thesis.read_text().split("\n"))
    print("\n".join(found) or "Every clause is where it says.")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
