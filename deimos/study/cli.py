"""The command line of a study: ``deimos study run | show | merge | report | presets | coverage``."""

import contextlib
import math
import re
import shutil
import statistics
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from deimos.checks import check_at_least
from deimos.run.folder import RunError
from deimos.study import plan
from deimos.study.folder import StudyFolder, identity
from deimos.study.presets import PRESETS
from deimos.study.results import check_comparable, merge, results
from deimos.study.runner import Progress, Runner

USAGE = """usage: deimos study COMMAND [OPTIONS]

commands:
  run        train and evaluate a grid of environments, methods and seeds; goes on where it was stopped
  show       where a study stands
  merge      add the results of other studies to one
  report     statistics, figures, claims: one HTML page and its Markdown twin
  presets    the ready-made studies
  coverage   how often the intervals of the report contain the truth, on simulated data

Every command explains its options with --help."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Train and evaluate every cell of a study that is not finished yet."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study. Machines that share it share the work."""
    preset: str | None = None
    """A ready-made study; deimos study presets lists them."""
    file: Path | None = None
    """A study in a TOML file (docs/study.md)."""
    seeds: str | None = None
    """Seeds in place of the study's: a number of them (10), a range (10-19) or a list (0,3,5)."""
    methods: list[str] | None = None
    """Methods in place of the study's."""
    environments: list[str] | None = None
    """Those of the study's environments that are wanted. By default all."""
    num_envs: int | None = None
    """Parallel worlds of the training, in place of the study's."""
    env_steps: int | None = None
    """Steps of every world, in place of the study's."""
    device: Literal["auto", "cpu", "cuda"] | None = None
    """Where to simulate and learn, in place of the study's. Part of what fixes a cell's numbers."""
    threads: int | None = None
    """CPU threads of every worker, in place of the study's, which is 1 unless said. Part of what fixes its numbers."""
    workers: int = 1
    """Cells at a time, at least 1."""
    retry_failed: bool = False
    """Whether to try the cells again that were given up."""

    def __post_init__(self) -> None:
        check_at_least("workers", self.workers, 1)
        if self.preset is not None and self.file is not None:
            raise ValueError("preset and file exclude each other; a file can name its preset.")
        changes = ("seeds", "methods", "environments", "num_envs", "env_steps", "device", "threads")
        given = [name for name in changes if getattr(self, name) is not None]
        if given and self.preset is None and self.file is None:
            raise ValueError(f"{', '.join(given)} change a preset or a file; give one of them too.")


@dataclass(frozen=True, kw_only=True)
class ShowOptions:
    """Print where a study stands."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study."""


@dataclass(frozen=True, kw_only=True)
class MergeOptions:
    """Add the results of other study folders to one: their rows and training curves, not their runs."""

    folder: tyro.conf.Positional[Path]
    """The folder that grows."""
    sources: tyro.conf.Positional[list[Path]]
    """The folders that are read."""

    def __post_init__(self) -> None:
        if not self.sources:
            raise ValueError("sources must be one or more study folders, got none.")


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """Write report.html, report.md and the figures of a study."""

    folder: tyro.conf.Positional[Path]
    """Folder with results.csv and, for training curves, curves.csv."""
    out: Path | None = None
    """Where to write. By default the folder itself."""
    resamples: int = 10_000
    """Bootstrap resamples, at least 1000."""
    seed: int = 0
    """Seed of the bootstrap."""

    def __post_init__(self) -> None:
        check_at_least("resamples", self.resamples, 1000)
        check_at_least("seed", self.seed, 0)


@dataclass(frozen=True, kw_only=True)
class PresetsOptions:
    """List the ready-made studies."""


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


def run(options: RunOptions, stopped: Callable[[], bool] = lambda: False) -> None:
    """Work on a study until it is finished.

    Raises:
        RunError: If the study is not well described, or if a cell has failed; the rest are finished then.
        SystemExit: With 130, if it was stopped before the end.
    """
    study = StudyFolder(options.folder)
    if options.preset is not None or options.file is not None:
        cells = _described(options)
        check_comparable([*study.results.read(), *map(identity, [*study.cells(), *cells])])
        study.add(cells)
    if not study.cells():
        raise RunError(f"{study.path} holds no study; begin one with --preset or --file.")
    if options.retry_failed:
        study.forget_failures()
    with _live() as report:
        end = Runner(study, options.workers).run(report, stopped)
    if end.finished + len(end.failed) < end.total:
        print(f"Stopped with {end.finished} of {end.total} cells finished; go on with: "
              f"deimos study run {study.path}", file=sys.stderr)  # fmt: skip
        raise SystemExit(130)
    if end.failed:
        name, error = next(iter(end.failed.items()))
        raise RunError(
            f"{len(end.failed)} of {end.total} cells failed, {name} first: {error}. See log.txt in their folders; "
            f"--retry-failed tries them again."
        )
    print(study.path)


def _described(options: RunOptions) -> list[plan.Cell]:
    description = plan.read(options.file) if options.file is not None else plan.preset(options.preset or "")
    names = ("num_envs", "env_steps", "device", "threads")
    train = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    seeds = None if options.seeds is None else parse_seeds(options.seeds)
    return plan.expand(
        description, seeds=seeds, methods=options.methods, environments=options.environments, train=train
    )


def parse_seeds(text: str) -> list[int]:
    """Seeds of ``10`` (the first ten), ``10-19`` or ``0,3,5``.

    Raises:
        RunError: If it is none of these.
    """
    if re.fullmatch(r"[1-9]\d*", text):
        return list(range(int(text)))
    seeds: list[int] = []
    for part in text.split(","):
        if not (found := re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())):
            raise RunError(f"seeds must be a number of seeds, a range like 10-19 or a list like 0,3,5, got '{text}'.")
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise RunError(f"seeds must be a range that rises, got '{text}'.")
        seeds += range(first, last + 1)
    return seeds


def show(options: ShowOptions) -> None:
    """Print the medians of a study and what has failed or is open.

    Raises:
        RunError: If there is no study.
    """
    study = StudyFolder(options.folder)
    cells, rows = study.cells(), study.results.read()
    if not cells and not rows:
        raise RunError(f"{study.path} holds no study and no results.")
    table = Table(title="Medians over seeds", title_justify="left")
    for name in ("environment", "method", "goals", "T", "seeds", "crashes/1000", "score", "reward", "FPS"):
        table.add_column(name, justify="left" if name in ("environment", "method", "goals") else "right")
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault((row["environment"], row["goals"], row["goal_period"], row["method"]), []).append(row)
    for (environment, goals, period, name), group in sorted(groups.items()):
        numbers = [_median(row[column] for row in group) for column in ("crashes_per_1000", "score", "reward", "fps")]
        cellsof = [f"{numbers[0]:.3g}", f"{numbers[1]:.3f}", f"{numbers[2]:.4f}", f"{numbers[3]:.0f}"]
        table.add_row(environment, name, goals, str(period), str(len(group)), *cellsof)
    Console().print(table)
    if cells:
        finished = study.finished(cells)
        print(f"{len(finished)} of {len(cells)} cells are finished.")
        for cell in cells:
            for error in study.failures(cell) if cell.digest not in finished else []:
                print(f"{cell.name} failed: {error}")


def _median(values: Iterator[float]) -> float:
    kept = [value for value in values if not math.isnan(value)]
    return statistics.median(kept) if kept else math.nan


def merge_folders(options: MergeOptions) -> None:
    """Merge study folders and say what was added.

    Raises:
        RunError: If one holds no results or has another schema, or they do not make one study.
    """
    added, present, differing = merge(options.folder, options.sources)
    print(f"{added} rows added, {present} were there already.")
    if differing:
        print(f"{differing} of those have other numbers in the source; the first ones stay. Cells repeat bit for bit "
              f"only on the same kind of device with the same versions.")  # fmt: skip


def report(options: ReportOptions) -> None:
    """Write the report.

    Raises:
        RunError: If there are no results, or the folder cannot be written.
    """
    from deimos.study.report import write

    if not results(options.folder).read():
        raise RunError(f"{options.folder} holds no results; it is empty, or no study folder.")
    print(write(options.folder, options.out or options.folder, resamples=options.resamples, seed=options.seed))


def presets(options: PresetsOptions) -> None:
    """Print the ready-made studies."""
    table = Table(title="Presets", title_justify="left")
    for name in ("preset", "what", "environments", "methods", "seeds"):
        table.add_column(name)
    for name, preset in PRESETS.items():
        environments = ", ".join(each["name"] for each in preset["environment"])
        table.add_row(name, preset["about"], environments, ", ".join(preset["methods"]), str(preset["seeds"]))
    Console().print(table)


def coverage(options: CoverageOptions) -> None:
    """Print the table of coverages."""
    from deimos.study.coverage import simulate

    table = Table(title=f"Coverage of 95 % intervals, n = {options.seeds}", title_justify="left")
    for name in ("statistic", "interval", "normal", "lognormal"):
        table.add_column(name, justify="left" if name in ("statistic", "interval") else "right")
    for row in simulate(options.seeds, options.populations, options.resamples, options.seed):
        table.add_row(row.statistic, row.interval, f"{100 * row.normal:.1f} %", f"{100 * row.lognormal:.1f} %")
    Console().print(table)


COMMANDS: dict[str, tuple[type, Callable[..., None]]] = {
    "run": (RunOptions, run),
    "show": (ShowOptions, show),
    "merge": (MergeOptions, merge_folders),
    "report": (ReportOptions, report),
    "presets": (PresetsOptions, presets),
    "coverage": (CoverageOptions, coverage),
}
"""Options and function of every command."""


@contextlib.contextmanager
def _live() -> Iterator[Callable[[Progress], None]]:
    """Show a study's progress: a table that lives on a terminal, lines of what has ended elsewhere."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _Lines(console)
        return
    with Live(console=console, auto_refresh=False) as live:
        yield lambda progress: live.update(_picture(progress), refresh=True)


class _Lines:
    def __init__(self, console: Console) -> None:
        self._console = console
        self._said: Any = None

    def __call__(self, progress: Progress) -> None:
        state = (progress.finished, len(progress.failed))
        if state != self._said:
            self._said = state
            self._console.print(_summary(progress), highlight=False, soft_wrap=True)


def _picture(progress: Progress) -> Group:
    table = Table(box=None)
    for name in ("cell", "iteration", "FPS"):
        table.add_column(name, justify="left" if name == "cell" else "right")
    for cell in progress.running:
        state = f"{cell.iteration}/{cell.iterations}" if cell.iteration < cell.iterations else "evaluating"
        table.add_row(cell.name, state, f"{cell.fps:.0f}" if cell.fps else "-")
    width = shutil.get_terminal_size().columns
    failed = [Text(f"{name} failed: {error}"[:width], style="red") for name, error in progress.failed.items()]
    return Group(Text(_summary(progress)), table, *failed)


def _summary(progress: Progress) -> str:
    parts = [f"{progress.finished} of {progress.total} cells finished"]
    if progress.failed:
        parts.append(f"{len(progress.failed)} failed")
    if progress.elsewhere:
        parts.append(f"{progress.elsewhere} on other machines")
    training = [cell for cell in progress.running if cell.iteration < cell.iterations]
    if training:
        parts.append(f"{sum(cell.fps for cell in training):.0f} FPS")
    if progress.seconds_left:
        hours, rest = divmod(int(progress.seconds_left), 3600)
        parts.append(f"{hours}:{rest // 60:02d}:{rest % 60:02d} left")
    return ", ".join(parts)
