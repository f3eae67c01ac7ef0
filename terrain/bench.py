"""How fast terrains are made and looked up.

The machine may be shared and noisy. What is compared is therefore measured in turn, round after round, and a ratio
is the median of the rounds' ratios.
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

import numpy as np
import warp as wp

from kernels.height_scan import scan_heights, scan_points
from terrain import presets
from terrain.checks import check_at_least
from terrain.files import write_whole
from terrain.grid import Terrain
from terrain.heightfield import rasterise
from terrain.world import build, build_mesh


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """Measure the making of both presets, and the height scan beside NumPy."""

    robots: int = 4096
    """Robots that scan, at least 1; each looks at 187 points."""
    rounds: int = 7
    """Rounds that a ratio is the median of, at least 1."""
    device: str = "cpu"
    """Warp device of the ray casts and of the scan; NumPy stays on the CPU."""
    json: Path | None = None
    """Write all numbers to this file too."""

    def __post_init__(self) -> None:
        check_at_least("robots", self.robots, 1)
        check_at_least("rounds", self.rounds, 1)


def run(options: BenchOptions) -> dict[str, Any]:
    """Measure, print a table for each subject, and write the JSON file if asked for.

    Raises:
        ValueError: If the JSON file's folder does not exist.
    """
    if options.json is not None and not options.json.parent.is_dir():
        raise ValueError(f"json must be in a folder that exists, got {options.json}.")
    results: dict[str, Any] = {"device": options.device, "making": measure_making(options.rounds, options.device)}
    results["scan"] = measure_scan(options.robots, options.rounds, options.device)
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


def measure_scan(robots: int, rounds: int, device: str) -> dict[str, Any]:
    """Lookups per second of both rules, and NumPy's bilinear rule in the same rounds."""
    terrain = build(presets.preset("go1"), device=device)
    rng = np.random.default_rng(0)
    half = np.array(terrain.size) / 2
    place = np.insert(rng.uniform(-half, half, (robots, 2)), 2, 0.5, axis=1).astype(np.float32)
    pose = rng.normal(size=(robots, 4))
    pose = (pose / np.linalg.norm(pose, axis=1, keepdims=True)).astype(np.float32)
    points = scan_points()
    heights = wp.array(terrain.heights, dtype=wp.float32, device=device)
    position = wp.array(place, dtype=wp.vec3, device=device)
    quaternion = wp.array(pose, dtype=wp.vec4, device=device)
    point = wp.array(points, dtype=wp.vec2, device=device)
    out = wp.zeros((robots, len(points)), dtype=wp.float32, device=device)
    arguments = (heights, terrain.cell, terrain.corner, position, quaternion, point, out)
    bilinear, minimum = (scan_heights(*arguments, rule=rule, record=True) for rule in ("bilinear", "minimum"))
    assert bilinear is not None
    assert minimum is not None
    work: dict[str, Callable[[], Any]] = {
        "bilinear": bilinear.launch,
        "minimum": minimum.launch,
        "NumPy, bilinear": lambda: scan_by_numpy(terrain, place, pose, points),
    }
    seconds = _in_turn(work, rounds, device)
    lookups = robots * len(points)
    ratios = [a / b for a, b in zip(seconds["NumPy, bilinear"], seconds["bilinear"], strict=True)]
    return {
        "robots": robots,
        "lookups [1/s]": {name: lookups / statistics.median(values) for name, values in seconds.items()},
        "bilinear / NumPy": statistics.median(ratios),
    }


def scan_by_numpy(terrain: Terrain, position: np.ndarray, quaternion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The bilinear height scan as one writes it in NumPy, in float32, shape (robots, points)."""
    w, x, y, z = quaternion.T
    yaw = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    u = (position[:, :1] + cos * points[:, 0] - sin * points[:, 1] - terrain.corner[0]) / terrain.cell
    v = (position[:, 1:2] + sin * points[:, 0] + cos * points[:, 1] - terrain.corner[1]) / terrain.cell
    nx, ny = terrain.heights.shape
    i = np.clip(u.astype(np.int32), 0, nx - 2)
    j = np.clip(v.astype(np.int32), 0, ny - 2)
    s, t = np.clip(u - i, 0, 1), np.clip(v - j, 0, 1)
    flat, first = terrain.heights.reshape(-1), i * ny + j
    near = flat[first] + t * (flat[first + 1] - flat[first])
    far = flat[first + ny] + t * (flat[first + ny + 1] - flat[first + ny])
    return near + s * (far - near)


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
    scan = results["scan"]
    screen.print(f"Height scan, {scan['robots']} robots x 187 points", style="italic")
    table = Table()
    table.add_column("")
    table.add_column("M lookups/s", justify="right")
    for name, rate in scan["lookups [1/s]"].items():
        table.add_row(name, f"{rate / 1e6:.1f}")
    screen.print(table)
    screen.print(f"The kernel is {scan['bilinear / NumPy']:.1f} times as fast as NumPy (median of the rounds).")
    if results["peak memory [MiB]"] is not None:
        screen.print(f"Peak memory of this process: {results['peak memory [MiB]']:.0f} MiB.")
