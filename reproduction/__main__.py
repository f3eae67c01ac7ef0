"""``python -m reproduction``: the commands of the thesis's reproduction."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from deimos.app.console import parse
from deimos.checks import RunError, check_at_least
from deimos.study.cli import ReportOptions
from reproduction import coverage
from reproduction.multiverse_page import MultiverseOptions
from reproduction.multiverse_page import write as write_multiverse
from reproduction.report import write


@dataclass(frozen=True, kw_only=True)
class ClaimOptions(ReportOptions):
    """Write the report of a study with the thesis's claims."""

    speeds: Path | None = None
    """File of ``python -m benchmarks table41 --json``, which the claim on speed rests on."""


@dataclass(frozen=True, kw_only=True)
class CoverageOptions:
    """Simulate how often the intervals of the report contain the truth."""

    seeds: int = 10
    """Size of every simulated population, at least 4."""
    populations: int = 2000
    """Simulated populations, at least 100."""
    resamples: int = 2000
    """Bootstrap resamples of each, at least 1000."""
    seed: int = 0
    """Seed of it all."""

    def __post_init__(self) -> None:
        for name, least in (("seeds", 4), ("populations", 100), ("resamples", 1000), ("seed", 0)):
            check_at_least(name, getattr(self, name), least)


def report_claims(options: ClaimOptions) -> None:
    """Write the report of a study with the thesis's claims.

    Raises:
        RunError: If there are no results, or the folder cannot be written.
    """
    print(write(options.folder, options.out or options.folder, options.speeds))


def report_multiverse(options: MultiverseOptions) -> None:
    """Write the page of the map; for the errors see ``reproduction.multiverse_page.write``."""
    print(write_multiverse(options))


def print_coverage(options: CoverageOptions) -> None:
    """Print the table of coverages."""
    table = Table(title=f"Coverage of 95 % intervals, n = {options.seeds}", title_justify="left")
    for name in ("statistic", "interval", *coverage.POPULATIONS):
        table.add_column(name, justify="left" if name in ("statistic", "interval") else "right")
    for row in coverage.simulate(options.seeds, options.populations, options.resamples, options.seed):
        shares = (f"{100 * getattr(row, name):.1f} %" for name in coverage.POPULATIONS)
        table.add_row(row.statistic, row.interval, *shares)
    Console().print(table)


COMMANDS: dict[str, tuple[type, Callable[..., None]]] = {
    "report": (ClaimOptions, report_claims),
    "multiverse": (MultiverseOptions, report_multiverse),
    "coverage": (CoverageOptions, print_coverage),
}
"""Options and function of every command."""


def main(arguments: list[str]) -> int:
    """Run the command line; returns the exit code."""
    name = arguments[0] if arguments else "--help"
    if name not in COMMANDS:
        print(f"usage: python -m reproduction {{{','.join(COMMANDS)}}} [OPTIONS]")
        return 0 if name in ("-h", "--help") else 2
    options, command = COMMANDS[name]
    try:
        command(parse(options, arguments[1:], f"python -m reproduction {name}"))
    except (RunError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
