"""How fast terrains are built.

The machine may be shared and noisy. Therefore mesh and rays are measured alternately, round after round, and a figure
is the median of the rounds.
"""

import statistics
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
import warp as wp
from deimos.terrain import presets
from deimos.terrain.heightfield import rasterise
from deimos.terrain.world import Grid, build, build_mesh
from rich.table import Table

from benchmarks.timing import in_turn, wide_console


def measure(device: torch.device, rounds: int, grids: Sequence[Grid] | None = None) -> dict[str, Any]:
    """Seconds that mesh and ray casts of each preset take, as medians of some rounds, and the memory used.

    Args:
        device: Where rays are cast.
        rounds: Rounds over which figures are medians.
        grids: Grids to use in place of the presets, in their order.
    """
    build(presets.preset("go1", levels=1, columns=1), device=str(device))  # compiles the kernel
    rows = []
    names = presets.preset_names()
    for name, grid in zip(names, grids or map(presets.preset, names), strict=True):
        mesh = build_mesh(grid)

        def cast(grid: Grid = grid, mesh: Any = mesh) -> None:
            rasterise(mesh, grid.corner, grid.cell, grid.num_samples, device=str(device))
            wp.synchronize_device(str(device))

        work: dict[str, Callable[[], Any]] = {"mesh": partial(build_mesh, grid), "rays": cast}
        seconds = {part: statistics.median(values) for part, values in in_turn(work, rounds, device).items()}
        nx, ny = grid.num_samples
        rows.append({
            "preset": name, "samples": nx * ny, "faces": len(mesh.faces), "mesh [s]": seconds["mesh"],
            "rays [s]": seconds["rays"], "rays [1/s]": nx * ny / seconds["rays"],
        })  # fmt: skip
    return {"making": rows, "peak memory [MiB]": peak_memory()}


def peak_memory() -> float | None:
    """Peak memory of this process so far [MiB], if the system reports it."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def show(results: dict[str, Any]) -> None:
    """Print the table of ``measure``."""
    table = Table(title="Making a grid of 10 x 20 tiles", title_justify="left")
    for name in ("preset", "samples", "faces", "mesh \\[s]", "rays \\[s]", "M rays/s"):
        table.add_column(name, justify="left" if name == "preset" else "right")
    for row in results["making"]:
        table.add_row(
            row["preset"], f"{row['samples']:,}", f"{row['faces']:,}", f"{row['mesh [s]']:.2f}",
            f"{row['rays [s]']:.2f}", f"{row['rays [1/s]'] / 1e6:.1f}",
        )  # fmt: skip
    wide_console().print(table)
    if results["peak memory [MiB]"] is not None:
        wide_console().print(f"Peak memory of this process: {results['peak memory [MiB]']:.0f} MiB.")
