"""Timing of things that are compared.

The machine may be shared and noisy. Therefore things to be compared are measured alternately, round after round, and a
ratio is the median of the rounds' ratios.
"""

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from rich.console import Console


def in_turn(work: dict[str, Callable[[], Any]], rounds: int, device: torch.device) -> dict[str, list[float]]:
    """Seconds of every piece of work in every round; one more round runs first and is not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(rounds + 1):
        for name, function in work.items():
            begin = time.perf_counter()
            function()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            seconds[name].append(time.perf_counter() - begin)
    return {name: values[1:] for name, values in seconds.items()}


def ratio(slow: list[float], fast: list[float]) -> float:
    """Median over rounds of how many times as long the first takes as the second."""
    return statistics.median(a / b for a, b in zip(slow, fast, strict=True))


def wide_console() -> Console:
    """A console for tables: output to a file or a pipe is not cut to the width of a terminal."""
    console = Console()
    return console if console.is_terminal else Console(width=120)


def short(value: float) -> str:
    """Three digits and a unit."""
    for unit, size in (("G", 1e9), ("M", 1e6)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value:.3g}"
