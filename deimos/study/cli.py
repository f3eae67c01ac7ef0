"""The commands of ``deimos study``: the options of each, and its ``run``."""

import math
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from statistics import median
from typing import Any, Literal

import tyro
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from deimos.checks import RunError, check_at_least, check_range
from deimos.run import training
from deimos.study import archive, factors, plan
from deimos.study import cell as worker
from deimos.study.engine import Engine, LocalProcesses
from deimos.study.estimate import estimate
from deimos.study.folder import StudyFolder
from deimos.study.pools import POOLS, given_up, require_trained, write_pools
from deimos.study.results import check_cells, check_comparable, identity, merge
from deimos.study.rounds import AttackRound, check_rounds, rounds
from deimos.study.runner import Progress, Runner
from deimos.study.source import check_sources, code

WIDEST = 10_000  # columns of a table


@dataclass(frozen=True, kw_only=True)
class _FolderOptions:
    folder: tyro.conf.Positional[Path]
    """Folder of the study."""


@dataclass(frozen=True, kw_only=True)
class _WorkOptions(_FolderOptions):
    """What works on the cells."""

    engine: Literal["local", "ray"] = "local"
    """What works on the cells: processes of this machine, or the machines of a Ray cluster (docs/cluster.md)."""
    workers: int | None = None
    """Cells at a time, at least 1. By default 1, and with ray as many as its cluster has room for."""
    gpus: float | None = None
    """GPUs per cell with ray, at least 0; 0.25 puts four on one. By default 1 for cells whose device is cuda."""
    allow_uncommitted: bool = False
    """Whether sources may differ from the commit that is checked out; their hash then takes its place."""

    def __post_init__(self) -> None:
        if self.workers is not None:
            check_at_least("workers", self.workers, 1)
        if self.gpus is not None:
            check_range("gpus", self.gpus, 0.0, math.inf, finite=True)
        if self.gpus is not None and self.engine != "ray":
            raise ValueError("gpus are given to cells by a Ray cluster; add --engine ray.")

    def _work(
        self, study: StudyFolder, stopped: Callable[[], bool], report: Callable[[str, float], None],
        seconds: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:  # fmt: skip
        """Work on a study until it is finished; see ``RunOptions.run``, and ``Runner`` for ``seconds``."""
        engine: Engine = LocalProcesses(study)
        workers = self.workers or 1
        if self.engine == "ray":
            from deimos.study.on_ray import OnRay

            engine = cluster = OnRay(study, self.gpus)
            finished = study.finished(cells := study.cells())
            if lacking := cluster.lacking([cell for cell in cells if cell.digest not in finished]):
                print(f"{lacking}: it waits until one joins (see --device, --gpus, --threads).", file=sys.stderr)
            workers = self.workers or cluster.room(cells)
        runner = Runner(study, engine, workers, seconds or {})
        end = runner.run(lambda progress: report(_summary(progress), progress.share), stopped)
        if end.finished + len(end.failed) < end.total:
            print(f"Stopped with {end.finished} of {end.total} cells finished; continue with: "
                  f"deimos study run {study.path}", file=sys.stderr)  # fmt: skip
            raise SystemExit(130)
        if end.failed:
            name, error = next(iter(end.failed.items()))
            raise RunError(
                f"{len(end.failed)} of {end.total} cells failed, {name} first: {error.rstrip('.')}. See log.txt in "
                f"their folders; --retry-failed tries them again."
            )
        print(study.path)
        print(f"Next: deimos study report {study.path}", file=sys.stderr)


@dataclass(frozen=True, kw_only=True)
class RunOptions(_WorkOptions):
    """Train and evaluate every cell of a study that is not finished yet.

    One process works on a folder at a time.
    """

    file: Path | None = None
    """The study, as a TOML file (docs/how_to/study.md). By default the one that was begun in the folder."""
    seeds: str | None = None
    """Seeds in place of the file's: a number of them (10), a range (10-19) or a list (0,3,5)."""
    methods: list[str] | None = None
    """Methods in place of the file's."""
    environments: list[str] | None = None
    """Which of the file's environments to run, each with all points of its design, or with one (fast.3). By default
    all."""
    num_envs: int | None = None
    """Parallel worlds of the training, in place of the file's."""
    env_steps: int | None = None
    """Steps of every world, in place of the file's."""
    device: str | None = None
    """Where to simulate and learn, in place of the file's. A cell's numbers depend on it."""
    threads: int | None = None
    """CPU threads of every worker, in place of the file's, by default 1. A cell's numbers do not depend on them, but
    its name does: keep them the same throughout a study."""
    retry_failed: bool = False
    """Whether to retry cells that have failed."""
    estimate: bool = False
    """Whether to print how long the study would take, and start nothing."""

    def __post_init__(self) -> None:
        super().__post_init__()
        changes = ("seeds", "methods", "environments", "num_envs", "env_steps", "device", "threads")
        given = [name for name in changes if getattr(self, name) is not None]
        if given and self.file is None:
            raise ValueError(f"{', '.join(given)} change a file; give one too.")

    def run(
        self,
        stopped: Callable[[], bool] = lambda: False,
        report: Callable[[str, float], None] = lambda said, share: None,
    ) -> None:
        """Work on a study until it is finished.

        Args:
            stopped: Called now and then; true lets the running cells end.
            report: Called a few times per second with the state of the study and the share of its cells that are done.

        Raises:
            RunError: If the study's description is wrong or another process works on it, or if a cell has failed; the
                rest are finished then.
            SystemExit: With 130, if it was stopped before the end.
        """
        study = StudyFolder(self.folder)
        if self.file is not None:
            self._add(study, plan.read(self.file))
        if not study.cells():
            raise RunError(f"{study.path} holds no study; begin one with --file.")
        _say_strays(study)
        if self.retry_failed:
            study.forget_failures()
        seconds = None
        if open_ := _open(study):
            takes = estimate(study, open_, elsewhere=self.engine == "ray" or self.estimate, stopped=stopped)
            if stopped():
                print(f"Stopped before any cell; continue with: deimos study run {study.path}", file=sys.stderr)
                raise SystemExit(130)
            print(takes.text, file=sys.stderr, flush=True)
            seconds = takes.seconds
        elif self.estimate:
            print("All cells are finished.", file=sys.stderr)
        if not self.estimate:
            self._work(study, stopped, report, seconds)

    def _add(self, study: StudyFolder, description: dict) -> None:
        """Add what a file describes to a study, after checking everything that can be wrong with it."""
        train = {name: getattr(self, name) for name in ("num_envs", "env_steps", "device", "threads")}
        cells = plan.expand(
            description, seeds=self.seeds, methods=self.methods, environments=self.environments,
            train={name: x for name, x in train.items() if x is not None},
        )  # fmt: skip
        attacks = rounds(description)
        found, there = study.results(), study.cells()
        plan.check_settings(there, cells)
        for check in (check_comparable, check_cells):
            check([*found.rows, *found.curves, *map(identity, [*there, *cells])])
        check_rounds([*study.rounds(), *attacks], [*there, *cells])
        _check_committed(self.allow_uncommitted)
        if description.get("factors"):
            print(factors.describe(description["factors"], description.get("design", {})), file=sys.stderr)
        study.add(cells)
        study.add_rounds(attacks)


def _check_committed(allowed: bool) -> None:
    """Say what stands for the code of new rows where no commit does; ``RunError`` unless that is ``allowed``."""
    here = code()
    if here.changed and not allowed:
        raise RunError(
            f"{len(here.changed)} source file(s) differ from commit {here.commit} ({here.changed[0]} first), so no "
            f"commit says what made the rows. Commit them, or use a hash of them with --allow-uncommitted."
        )
    if here.name == here.sources:
        print(f"No commit identifies this code; a hash does: {here.name}.", file=sys.stderr)


def _say_strays(study: StudyFolder) -> None:
    if strays := study.strays():
        print(
            f"{len(strays)} folder(s) in {study.path / 'cells'} hold no cell.json ({strays[0]} first) and are left "
            f"out; give the study's --file again to make such cells again.", file=sys.stderr,
        )  # fmt: skip


def _open(study: StudyFolder) -> list[plan.Cell]:
    """The cells of a study that are not finished; raises ``RunError`` if one is to be trained by other code."""
    cells = study.cells()
    finished = study.finished(cells)
    left = [cell for cell in cells if cell.digest not in finished]
    untrained = [cell for cell in left if not (study.cell_path(cell) / "result.json").exists()]
    for cell in {tuple(sorted(cell.sources.items())): cell for cell in untrained}.values():
        check_sources(f"Cell {cell.name}", cell.sources, cell.plugins, cell.files)
    return left


@dataclass(frozen=True, kw_only=True)
class AttackOptions(_WorkOptions):
    """Evaluate the policies of a finished study under further attackers.

    If killed, it continues when the command is repeated, or by ``run``. Policies that are no longer in the folder come
    from its archive.
    """

    attackers: tuple[str, ...]
    """Names of the attackers."""
    seeds: str | None = None
    """Seeds of the policies that meet them. By default all."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._round()

    def _round(self) -> AttackRound:
        seeds = () if self.seeds is None else tuple(plan.parse_seeds(self.seeds))
        return AttackRound(attackers=self.attackers, seeds=seeds)

    def run(
        self,
        stopped: Callable[[], bool] = lambda: False,
        report: Callable[[str, float], None] = lambda said, share: None,
    ) -> None:
        """Attack what has not met all of them yet; for the arguments and errors see ``RunOptions.run``."""
        study = StudyFolder(self.folder)
        archive.unpack(study)
        cells = study.cells()
        if not cells:
            raise RunError(f"{study.path} holds no policies: neither cells nor {archive.FILE}.")
        require_trained(study, cells)
        check_rounds([self._round()], cells)
        if not any(map(self._round().meets, cells)):
            print(f"No policy has one of the seeds {self.seeds} yet, so nothing is attacked now.", file=sys.stderr)
        if lost := {row["hash"] for row in study.results().rows} - {cell.digest for cell in cells}:
            print(f"{len(lost)} policies of the tables are lost and stay as they are.", file=sys.stderr)
        _check_committed(self.allow_uncommitted)
        study.add_rounds([self._round()])
        self._work(study, stopped, report)


@dataclass(frozen=True, kw_only=True)
class CellOptions(_FolderOptions):
    """Train and evaluate one cell of a study, by its number: a task of a Slurm array (docs/cluster.md).

    Any number of these may work on a study at a time, on any machine that sees its folder.
    """

    number: tyro.conf.Positional[int]
    """Number of the cell, from 0; cells are ordered by seed, then by name."""

    def run(
        self,
        stopped: Callable[[], bool] = lambda: False,
        report: Callable[[str, float], None] = lambda said, share: None,
    ) -> None:
        """Work on the cell from wherever it is; one that is finished stays as it is.

        For the arguments see ``RunOptions.run``.

        Raises:
            RunError: If there is no such cell, or it cannot be worked on; see ``deimos.study.cell.run``.
            SimulationError: If a number is not finite.
            SystemExit: With 130, if it was stopped before the end.
        """
        study = StudyFolder(self.folder)
        cells = study.cells()
        if not 0 <= self.number < len(cells):
            raise RunError(f"number must be in [0, {len(cells)}), the cells of {study.path}; got {self.number}.")
        cell = cells[self.number]
        report(cell.name, 0.0)
        if not study.finished([cell]) and not worker.run(study, cell, stopped):
            print(f"{cell.name} was stopped and can be continued.", file=sys.stderr)
            raise SystemExit(130)
        print(study.cell_path(cell))


@dataclass(frozen=True, kw_only=True)
class PoolOptions(_FolderOptions):
    """Make a file for the attacker pooled for every environment, from the policies of a finished study.

    Existing files stay as they are, so a command that was killed continues when repeated. Environments with a failed
    cell are skipped and named.
    """

    out: Path | None = None
    """Folder of the files NAME.pt, the ``pools`` of another study's file. By default the study's own ``pools``."""
    device: str = "cpu"
    """Where to simulate: cpu, cuda or cuda:N."""

    def run(self) -> None:
        """Write them, and a line for each; for the errors see ``deimos.study.pools.write_pools``."""
        study, device = StudyFolder(self.folder), training.resolve_device(self.device)
        for path, facts in write_pools(study, self.out or self.folder / POOLS, device):
            if facts is None:
                said = "exists already"
            elif facts["uninformed"]:
                said = "no crashes, or only crashes: the attacker's goals are uniform"
            else:
                said = f"{facts['adversary_interactions']:,} goals, {facts['adversary_crashes']:,} crashes"
            print(f"{path}: {said}", flush=True)
        for name in sorted({cell.environment for cell in given_up(study)}):
            print(f"{name}: no file, since a cell of it was given up", file=sys.stderr)


@dataclass(frozen=True, kw_only=True)
class PackOptions(_FolderOptions):
    """Add the policies of the finished cells to policies.zip."""

    def run(self) -> None:
        """Write the archive; ``RunError`` if there is no policy."""
        path, count = archive.pack(StudyFolder(self.folder))
        print(f"{path}: {count} policies, {path.stat().st_size / 1024 / count:.1f} kB each")


@dataclass(frozen=True, kw_only=True)
class UnpackOptions(_FolderOptions):
    """Put the policies of policies.zip back into folders of cells, to look at them or to attack them."""

    def run(self) -> None:
        """Write them; ``RunError`` if there is no archive."""
        study = StudyFolder(self.folder)
        if not (study.path / archive.FILE).exists():
            raise RunError(f"{study.path} holds no {archive.FILE}.")
        print(f"{archive.unpack(study)} policies put back into {study.path / 'cells'}")


@dataclass(frozen=True, kw_only=True)
class ShowOptions(_FolderOptions):
    """Print the state of a study."""

    def run(self) -> None:
        """Print the medians of a study and what has failed or is open; ``RunError`` if there is no study."""
        study = StudyFolder(self.folder)
        cells, rows = study.cells(), study.results().rows
        if not cells and not rows:
            raise RunError(f"{study.path} holds no study and no results.")
        table = Table(title="Medians over seeds", title_justify="left")
        for name in ("environment", "method", "goals", "T", "seeds", "crashes/1000", "score", "reward", "FPS"):
            is_text = name in ("environment", "method", "goals")
            table.add_column(name, justify="left" if is_text else "right", no_wrap=True)
        groups: dict[tuple, list[dict]] = defaultdict(list)
        for row in rows:
            groups[row["environment"], row["goals"], row["goal_period"], row["method"]].append(row)
        columns = {"crashes_per_1000": ".3g", "score": ".3f", "reward": ".4f", "fps": ".0f"}
        for (environment, goals, period, name), group in sorted(groups.items()):
            values = {column: [row[column] for row in group if not math.isnan(row[column])] for column in columns}
            medians = [
                format(median(values[column]), form) if values[column] else "-" for column, form in columns.items()
            ]
            table.add_row(environment, name, goals, str(period), str(len(group)), *medians)
        screen = Console(markup=False, emoji=False)  # names are data
        needed = Measurement.get(screen, screen.options.update(width=WIDEST), table).maximum
        screen.width = max(screen.width, needed)  # the terminal wraps what does not fit; nothing is cut
        screen.print(table)
        _say_strays(study)
        if cells:
            finished = study.finished(cells)
            print(f"{len(finished)} of {len(cells)} cells are finished.")
            for cell in cells:
                for error in study.failures(cell) if cell.digest not in finished else []:
                    print(f"{cell.name} failed: {error}")


@dataclass(frozen=True, kw_only=True)
class MergeOptions:
    """Add the results of other study folders to the tables of one: their rows and training curves, not their runs."""

    folder: tyro.conf.Positional[Path]
    """The folder to add to."""
    sources: tyro.conf.Positional[list[Path]]
    """The folders to read."""

    def __post_init__(self) -> None:
        if not self.sources:
            raise ValueError("sources must be one or more study folders, got none.")

    def run(self) -> None:
        """Merge them and say what was added; see ``deimos.study.results.merge``."""
        added, present, differing = merge(self.folder, self.sources)
        print(f"{added} rows added, {present} were there already.")
        if differing:
            print(f"{differing} of those have different numbers in the source, or are of a policy with other weights; "
                  f"what was there first stays. Cells repeat bit for bit only on the same kind of device with the same "
                  f"versions.")  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ExportOptions(_FolderOptions):
    """Write results.csv and curves.csv into the folder of a study."""

    def run(self) -> None:
        """Write them; ``RunError`` if there are no results."""
        merge(self.folder, [self.folder])  # refuses a folder without results
        print(self.folder / "results.csv")


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """Write report.html, report.md and the figures of a study."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study, or of its exported tables."""
    out: Path | None = None
    """Where to write. By default the folder itself."""

    def run(self) -> None:
        """Write them; ``RunError`` if there are no results."""
        from deimos.study.report import write

        print(write(self.folder, self.out or self.folder))


COMMANDS: dict[str, Any] = {
    "run": RunOptions, "cell": CellOptions, "show": ShowOptions, "attack": AttackOptions, "pool": PoolOptions,
    "pack": PackOptions, "unpack": UnpackOptions, "merge": MergeOptions, "export": ExportOptions,
    "report": ReportOptions,
}  # fmt: skip
"""The options of every command, whose ``run`` executes it; those of ``LONG`` can be stopped and show progress."""
LONG = (RunOptions, CellOptions, AttackOptions)


def _summary(progress: Progress) -> str:
    parts = [f"{progress.finished} of {progress.total} cells finished"]
    if progress.failed:
        parts.append(f"{len(progress.failed)} failed")
    for name, (trained, evaluated) in progress.running.items():
        parts.append(f"{name} {trained:.0%}" if trained < 1 else f"{name} evaluating {evaluated:.0%}")
    if progress.seconds_left:
        parts.append(f"{timedelta(seconds=int(progress.seconds_left))} left")
    return ", ".join(parts)
