"""How far something is, on stderr: a bar on a terminal, elsewhere a plain line now and then.

Importing it needs Python alone.
"""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from decimal import Decimal

# From line to line where progress cannot be shown in place: seconds at least, and a share of the time so far.
PLAIN_SECONDS, PLAIN_SHARE = 20.0, 0.05


@contextlib.contextmanager
def progress(title: str, wanted: bool | None = True) -> Iterator[Callable[[str, float], None]]:
    """Show how far something is: gives the function that reports (what is done, fraction of the whole that is done).

    On a terminal a bar; elsewhere, such as in the log of a job, a plain line now and then, less often in a long job.

    Args:
        title: What is being done.
        wanted: Whether to show it; ``None`` shows it only on a terminal and in a notebook.
    """
    if wanted is False:
        yield lambda stage, fraction: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    screen = Console(stderr=True)
    if not screen.is_terminal:
        yield _plain_progress(title) if wanted or screen.is_jupyter else lambda stage, fraction: None
        return
    text = TextColumn(title + ": {task.description}", markup=False)
    with Progress(
        text, BarColumn(bar_width=12), TaskProgressColumn(), TimeRemainingColumn(), console=screen, transient=True
    ) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda stage, fraction: bar.update(task, description=stage, completed=fraction)


@contextlib.contextmanager
def training_progress(
    iterations: int, wanted: bool | None = True
) -> Iterator[Callable[[dict[str, float], float], None]]:
    """``progress`` of a training: gives the function that takes the row of an iteration and the frames per second.

    It shows the latter, reward and crashes per 1000 transitions, short enough for 80 columns.
    """
    with progress("training", wanted) as report:
        yield lambda row, fps: report(
            f"{fps:,.0f} FPS, reward {number(row['reward'])}, crashes/1000 {number(row['crashes_per_1000'])}",
            row["iteration"] / iterations,
        )


def _plain_progress(title: str) -> Callable[[str, float], None]:
    begin = last = time.monotonic()

    def report(stage: str, fraction: float) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= max(PLAIN_SECONDS, PLAIN_SHARE * (last - begin)):
            last = now
            print(f"{title}: {stage}, {fraction:.0%}", file=sys.stderr, flush=True)

    return report


def number(value: float, digits: int = 3) -> str:
    """A number with ``digits`` significant digits, in full: never in powers of ten, and 0 only for zero."""
    value += 0.0  # no -0
    if 0 < abs(value) < 1e-6:
        return "< 0.000001" if value > 0 else "> -0.000001"
    if abs(value) >= 10.0**digits:
        return f"{value:,.0f}"
    return f"{Decimal(f'{value:.{digits}g}'):f}"
