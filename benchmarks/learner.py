"""A minibatch of the learner against one large matrix product: which share of a CPU's speed the networks reach."""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from rich.table import Table

from benchmarks.timing import wide_console
from deimos.nn.losses import Surrogate, ValueLoss
from deimos.nn.mlps import MLPs, gradients
from deimos.nn.networks import Activation, Actor, mlp
from deimos.nn.threads import on_threads

LARGE = 1536  # rows and columns of the large product


@dataclass(frozen=True)
class Case:
    """Networks that learn from one minibatch."""

    name: str
    inputs: int
    hidden: tuple[int, ...]
    actions: int
    """Outputs of the actor; 0 for critics alone."""
    critics: int
    activation: Activation
    rows: int


CASES = (
    Case("Particle, [64, 64]", 12, (64, 64), 3, 1, "relu", 12_000),
    Case("robot, [256, 128, 64]", 48, (256, 128, 64), 12, 1, "elu", 6144),
    Case("robot, [512, 256, 128]", 48, (512, 256, 128), 12, 1, "elu", 6144),
    Case("ten critics, [64, 64]", 12, (64, 64), 0, 10, "relu", 12_000),
)
Work = dict[str, tuple[Callable[[], Any], float]]
"""By name, the work to do and its number of operations."""


def operations(case: Case) -> float:
    """Floating-point operations of a minibatch, forward and backward, without losses and activations."""
    total = 0
    for outputs, count in ((case.actions, int(case.actions > 0)), (1, case.critics)):
        products = [a * b for a, b in pairwise((case.inputs, *case.hidden, outputs))]
        total += count * (3 * sum(products) - products[0])  # the inputs need no gradient
    return 2.0 * total * case.rows


def update(case: Case, kernel: bool) -> Callable[[], object]:
    """The gradients of PPO's surrogate and value loss on a minibatch."""
    generator = torch.Generator().manual_seed(0)
    sizes = case.hidden, case.activation
    x = torch.randn(case.inputs, case.rows, generator=generator).t()
    work = []
    if case.actions:
        actor = MLPs([Actor(case.inputs, case.hidden, case.actions, case.activation, 1.0, generator)])
        data = torch.randn(1, 2 * case.actions + 3, case.rows, generator=generator)
        data[:, -3] = -0.5 * data[:, : case.actions].square().sum(1) - 0.92 * case.actions  # their log-probability
        work.append((actor, x, Surrogate(data, 0.2)))
    critics = MLPs([mlp(case.inputs, sizes[0], 1, sizes[1], generator) for _ in range(case.critics)])
    work.append((critics, x, ValueLoss(torch.randn(case.critics, 3, case.rows, generator=generator), 0.2)))
    for nets, _, _ in work:
        nets._kernel = nets._kernel if kernel else None
    threads = 1 if kernel else torch.get_num_threads()  # the kernel's own threads should have no others to compete with

    def learn() -> None:
        with on_threads(threads):
            gradients(*work)

    return learn


def large_products() -> Work:
    """The large product, by each of torch's libraries for it."""
    a = torch.randn(LARGE, LARGE)
    found: Work = {"large product, torch.mm": (lambda: torch.mm(a, a), 2.0 * LARGE**3)}
    linear = getattr(torch.ops.mkldnn, "_linear_pointwise", None)  # private to torch: only used for comparison
    if linear is not None and torch.backends.mkldnn.is_available():
        found["large product, oneDNN"] = (lambda: linear(a, a, None, "none", [], ""), 2.0 * LARGE**3)
    return found


@contextmanager
def busy_core(busy: bool) -> Iterator[None]:
    """Another program that never waits, on one of this process's cores."""
    if not busy:
        yield
        return
    code = f"import os\nos.sched_setaffinity(0, {{{max(os.sched_getaffinity(0))}}})\nwhile True: pass"
    other = subprocess.Popen([sys.executable, "-c", code])
    try:
        time.sleep(0.5)
        yield
    finally:
        other.terminate()
        other.wait()


def measure(rounds: int, cases: Sequence[Case] = CASES) -> list[dict[str, Any]]:
    """Milliseconds, GFLOP/s and share of the best large product of the same round, for every case, kernel and torch.

    The number of threads is torch's. Every case is also timed next to a busy core.

    Args:
        rounds: Rounds, alternating everything, over which figures are medians.
        cases: What to measure.
    """
    rows = []
    for case in cases:
        for busy in (False, True):
            work = large_products()
            for name, kernel in (("kernel", True), ("torch", False)):
                work[name] = (update(case, kernel), operations(case))
            with busy_core(busy):
                rates = _rates(work, rounds)
            best = [max(pair) for pair in zip(*(v for k, v in rates.items() if k.startswith("large")), strict=True)]
            for name in ("kernel", "torch"):
                rate = statistics.median(rates[name])
                rows.append({
                    "case": case.name, "by": name, "busy core": busy, "ms": work[name][1] / rate / 1e6, "GFLOP/s": rate,
                    "large product [GFLOP/s]": statistics.median(best),
                    "share": statistics.median(a / b for a, b in zip(rates[name], best, strict=True)),
                })  # fmt: skip
    return rows


def _rates(work: Work, rounds: int) -> dict[str, list[float]]:
    """GFLOP/s of everything in every round; one more round runs first and is not counted."""
    rates: dict[str, list[float]] = {name: [] for name in work}
    for i in range(rounds + 1):
        for name, (function, count) in work.items():
            time.sleep(0.02)  # until OpenMP's threads, which wait in a loop, are asleep
            function()  # in training one minibatch follows another: caches are warm
            begin = time.perf_counter()
            function()
            if i:
                rates[name].append(count / (time.perf_counter() - begin) / 1e9)
    return rates


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table of ``measure``."""
    title = f"Gradients of a minibatch, {torch.get_num_threads()} threads, {torch.backends.cpu.get_cpu_capability()}"
    table = Table(title=title, title_justify="left")
    for name in ("case", "by", "ms", "GFLOP/s", "large product", "share"):
        table.add_column(name, justify="left" if name in ("case", "by") else "right")
    for row in rows:
        table.add_row(
            row["case"] + (", a core busy" if row["busy core"] else ""), row["by"], f"{row['ms']:.2f}",
            f"{row['GFLOP/s']:.1f}", f"{row['large product [GFLOP/s]']:.1f}", f"{row['share']:.2f}",
        )  # fmt: skip
    wide_console().print(table)
