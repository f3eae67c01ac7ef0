"""What a person sees on the terminal: progress bars and small tables."""

import contextlib
import math
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

if TYPE_CHECKING:
    from deimos.run.training import Trainer


class TrainingBar:
    """Iteration, frames per second, reward, crashes per 1000 transitions, time left."""

    def __init__(self, trainer: "Trainer") -> None:
        self._trainer = trainer
        self._progress = Progress(
            TextColumn("iteration {task.completed}/{task.total}"),
            BarColumn(),
            TextColumn("{task.fields[fps]:.0f} FPS  reward {task.fields[reward]:.3f}  "
                       "crashes/1000 {task.fields[crashes]:.2f}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )  # fmt: skip
        self._task = self._progress.add_task(
            "train", total=trainer.config.iterations, completed=trainer.iteration, fps=0.0, reward=0.0, crashes=0.0
        )

    def report(self, row: dict[str, float], fps: float) -> None:
        """Show an iteration."""
        self._progress.update(
            self._task, completed=row["iteration"], fps=fps, reward=row["reward"], crashes=row["crashes_per_1000"]
        )

    def __enter__(self) -> "TrainingBar":
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()


@contextlib.contextmanager
def stage_bar(title: str) -> Iterator[Callable[[str, float], None]]:
    """A bar over named stages; gives the function that reports (stage, share done)."""
    columns = (TextColumn(title + ": {task.description}"), BarColumn(), TaskProgressColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=1.0)
        yield lambda stage, share: progress.update(task, description=stage, completed=share)


def print_evaluation(rows: list[dict]) -> None:
    """Print Naive beside Adversary."""
    table = Table(title="Evaluation", title_justify="left")
    table.add_column("")
    for row in rows:
        table.add_column(row["goals"].capitalize(), justify="right")
    for label, name, form in (
        ("score (0 does nothing, 1 reference)", "score", ".3f"),
        ("reward per transition", "reward", ".4f"),
        ("crashes", "crashes", "d"),
        ("crashes per 1000 transitions", "crashes_per_1000", ".3f"),
        ("crashes per robot-minute", "crashes_per_minute", ".3f"),
        ("crashes per interaction", "crash_rate", ".4f"),
        ("interactions", "interactions", "d"),
        ("crashes under first goals", "first_goal_crashes", "d"),
        ("Adversary's AUROC", "adversary_auroc", ".3f"),
        ("Adversary's interactions", "adversary_interactions", "d"),
        ("crashes among them", "adversary_crashes", "d"),
    ):
        cells = [_cell(row.get(name), form) for row in rows]
        if set(cells) != {"-"}:
            table.add_row(label, *cells)
    for name in rows[0].get("errors", {}):
        table.add_row(f"median error, {name}", *[_cell(row["errors"][name], ".3f") for row in rows])
    groups = len(rows[0]["tracking"])
    for i in range(groups if groups > 1 else 0):  # a single one is the reward
        table.add_row(f"tracking of goal group {i}", *[_cell(row["tracking"][i], ".3f") for row in rows])
    Console().print(table)
    if any(row.get("weak_adversary") for row in rows):
        Console().print("weak adversary: it has seen too few crashes, or ranks goals too badly, to prove much")


def print_audit(audit: dict) -> None:
    """Print the audit of a fear network."""
    table = Table(title="Fear network against exact outcomes", title_justify="left", show_header=False)
    for label, name, form in (
        ("AUROC within contexts", "auroc", ".3f"),
        ("95 % interval, low", "low", ".3f"),
        ("95 % interval, high", "high", ".3f"),
        ("contexts with both outcomes", "contexts", "d"),
        ("contexts tried", "tried", "d"),
        ("crash share", "crash_share", ".3f"),
        ("after iteration", "iteration", "d"),
    ):
        table.add_row(label, _cell(audit[name], form))
    Console().print(table)


def print_calibration(judged: dict[str, dict[str, float]]) -> None:
    """Print how good the fear network's probabilities are, under each kind of goals."""
    table = Table(title="Fear network's probabilities", title_justify="left")
    table.add_column("goals")
    for name in judged:
        table.add_column(name, justify="right")
    for name in next(iter(judged.values())):
        form = ".0f" if name == "interactions" else ".4f"
        table.add_row(name.replace("_", " "), *[_cell(quality[name], form) for quality in judged.values()])
    Console().print(table)


def print_timing(trainer: "Trainer") -> None:
    """Print where the time of the iterations went."""
    total = sum(trainer.seconds.values())
    if total > 0:
        shares = "  ".join(f"{name} {100 * seconds / total:.1f} %" for name, seconds in trainer.seconds.items())
        Console().print(f"time: {shares}", highlight=False)


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None or (isinstance(value, float) and math.isnan(value)) else format(value, form)
