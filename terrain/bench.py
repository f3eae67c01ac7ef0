"""How fast terrains are made.

The machine may be shared and noisy. Mesh and rays are therefore measured in turn, round after round, and a figure is
the median of the rounds.
"""

import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import warp as wp

from . import presets
from .checks import check_at_least
from .files import write_whole
from .heightfield import rasterise
from .world import build, build_mesh


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """Measure the making of both presets."""

    rounds: int = 7
    """Rounds that a figure is the median of, at least 1."""
    device: str = "cpu"
    """Warp device of the ray casts."""
    json: Path | None = None
    """Write all numbers to this file too."""

    def __post_init__(self) -> None:
        check_at_least("rounds", self.rounds, 1)


def run(options: BenchOptions) -> dict[str, Any]:
    """Measure, print a table, and write the JSON file if asked for.

    Raises:
        ValueError: If the JSON file's folder does not exist.
    """
    if options.json is not None and not options.json.parent.is_dir():
        raise ValueError(f"json must be in a folder that exists, got {options.json}.")
    results: dict[str, Any] = {"device": options.device, "making": measure_making(options.rounds, options.device)}
    results["peak memory [MiB]"] = peak_memory()
    _show(results)
    if options.json is not None:
        text = json.dumps(results, indent=2) + "\n"
        write_whole(options.json, lambda file: file.write(text.encode()))
    return results


def measure_making(rounds: int, device: str) -> list[dict[str, Any]]:
    """Seconds that mesh and ray casts of each preset take, by the median of some rounds."""
    build(presets.preset("go1", levels=1, columns=1), device=device)  # compiles the kernel
    rows = []
    for name in presets.preset_names():
        grid = presets.preset(name)
        mesh = build_mesh(grid)
        cast = partial(rasterise, mesh, grid.corner, grid.cell, grid.num_samples, device=device)
        seconds = _in_turn({"mesh": partial(build_mesh, grid), "rays": cast}, rounds, device)
        nx, ny = grid.num_samples
        rows.append(
            {
                "preset": name,
                "samples": nx * ny,
                "faces": len(mesh.faces),
                "mesh [s]": statistics.median(seconds["mesh"]),
                "rays [s]": statistics.median(seconds["rays"]),
                "rays [1/s]": nx * ny / statistics.median(seconds["rays"]),
            }
        )
    return rows


def peak_memory() -> float | None:
    """Most memory that this process has held so far [MiB], where the system tells."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def _in_turn(work: dict[str, Callable[[], Any]], rounds: int, device: str) -> dict[str, list[float]]:
    """Seconds of every job in each round, after one round that does not count."""
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(rounds + 1):
        for name, job in work.items():
            wp.synchronize_device(device)
            start = time.perf_counter()
            job()
            wp.synchronize_device(device)
            seconds[name].append(time.perf_counter() - start)
    return {name: values[1:] for name, values in seconds.items()}


def _show(results: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    screen = Console(highlight=False)
    screen.print(f"Making a grid of 10 x 20 tiles, {results['device']}", style="italic")
    table = Table()
    for name in ("preset", "samples", "faces", "mesh \\[s]", "rays \\[s]", "M rays/s"):
        table.add_column(name, justify="left" if name == "preset" else "right")
    for row in results["making"]:
        table.add_row(
            row["preset"], f"{row['samples']:,}", f"{row['faces']:,}", f"{row['mesh [s]']:.2f}",
            f"{row['rays [s]']:.2f}", f"{row['rays [1/s]'] / 1e6:.1f}",
        )  # fmt: skip
    screen.print(table)
    if results["peak memory [MiB]"] is not None:
        screen.print(f"Peak memory of this process: {results['peak memory [MiB]']:.0f} MiB.")
