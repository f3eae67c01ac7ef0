"""``python -m benchmarks WHAT``: everything that is compared is measured in the same run."""

import json
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
import warp as wp

from benchmarks import (
    commits,
    director,
    engine_training,
    engines,
    learner,
    particle,
    quad,
    stability,
    table41,
    terrain,
    training,
    viewer,
)
from benchmarks.timing import wide_console
from deimos.app.console import parse
from deimos.checks import RunError, check_at_least, check_positive
from deimos.nn.threads import torch_on_one
from deimos.run.trainer import TrainConfig
from deimos.run.training import cores, provenance, resolve_device
from deimos.sim.envs.particle import Config
from deimos.sim.legged.engines import Name as EngineName
from deimos.sim.legged.engines import resolve
from deimos.sim.shared import one_stream
from reproduction.thesis import TABLE_4_1


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """Measure speed; everything that is compared is measured in the same run."""

    what: tyro.conf.Positional[
        Literal[
            "particle",
            "quad",
            "quad-arm",
            "engines",
            "engine-training",
            "stability",
            "builds",
            "terrain",
            "director",
            "learner",
            "commits",
            "table41",
            "viewer",
        ]
    ]
    """What to measure."""
    against: str = "HEAD"
    """The other commit for ``commits``: it is trained alternately with this checkout, in separate processes."""
    json: Path | None = None
    """Write all numbers to this file too."""
    rounds: int = 7
    """Rounds over which ratios are medians, at least 1."""
    threads: int = 0
    """CPU threads, at least 0; 0 takes one per core."""
    device: str = "auto"
    """Where to measure; auto takes the GPU if there is one."""
    engine: EngineName = "auto"
    """Physics of the robots of ``table41``; auto is warp (mujoco-warp) on a GPU and native on a CPU."""
    seconds: float = math.inf
    """``table41`` starts no round after this time [s], positive. With ``json`` the same command continues the table."""

    def __post_init__(self) -> None:
        check_positive("seconds", self.seconds)
        check_at_least("rounds", self.rounds, 1)
        check_at_least("threads", self.threads, 0)
        if self.json is not None and not self.json.parent.is_dir():
            raise ValueError(f"json must be in a folder that exists, got {self.json}.")


def run(options: BenchOptions) -> dict[str, Any]:
    """Measure, print a table per subject, and write the JSON file if one is given.

    Raises:
        RunError: If CUDA is requested but not available.
    """
    device = resolve_device(options.device)
    torch.set_num_threads(options.threads or cores())
    results: dict[str, Any] = {
        "versions": provenance(), "threads": torch.get_num_threads(), "device": str(device),
    }  # fmt: skip
    measure = {
        "particle": measure_particle, "engines": measure_engines, "terrain": measure_terrain,
        "director": measure_director, "stability": measure_stability,
        "engine-training": measure_engine_training,
    }  # fmt: skip
    if options.what == "commits":
        results["commits"] = commits.measure(options.against, options.rounds, options.threads or cores())
        commits.show(results["commits"], options.against)
        return _write(results, options.json)
    if options.what == "viewer":
        results["viewer"] = viewer.measure(options.rounds)
        viewer.show(results["viewer"])
        return _write(results, options.json)
    if options.what == "builds":
        results["memory"], results["seconds"] = stability.measure_builds()
        print("MiB after each build:", *map(round, results["memory"]))
        print("CPU time of each [s]:", *(f"{value:.2f}" for value in results["seconds"]))
        return _write(results, options.json)
    if options.what == "learner":
        results["learner"] = learner.measure(options.rounds)
        learner.show(results["learner"])
        return _write(results, options.json)
    with one_stream(device):
        if options.what == "table41":
            results["engine"] = resolve(options.engine, device)
            table41.run(results, options.rounds, device, options.json, options.seconds)
            return results
        if options.what in measure:
            results |= measure[options.what](options.rounds, device)
        else:
            results |= measure_legged(options.what.replace("-", "_"), options.rounds, device)
    return _write(results, options.json)


def _write(results: dict[str, Any], path: Path | None) -> dict[str, Any]:
    if path is not None:
        path.write_text(json.dumps(results, indent=2) + "\n")
    return results


def measure_particle(rounds: int, device: torch.device) -> dict[str, Any]:
    """The step of Particle Gym, and Table 4.1 of the thesis for its three variants."""
    results: dict[str, Any] = {"env": [particle.measure_env(n, device, rounds) for n in particle.SIZES]}
    particle.print_env(results["env"], torch.get_num_threads(), str(device))
    results["training"] = {}
    for variant in ("directional", "absolute", "relative"):
        config = replace(TrainConfig(), env=Config(variant=variant))
        results["training"][variant] = training.measure_in_groups(
            config, TABLE_4_1[variant], device, rounds, everything=variant == "directional"
        )
        training.print_training(f"{variant}, default sizes", results["training"][variant])
    results["machine"] = training.machine(device)
    for name, value in results["machine"].items():
        wide_console().print(f"{name}: {value:.3g}", highlight=False)
    return results


def measure_legged(name: str, rounds: int, device: torch.device) -> dict[str, Any]:
    """The step of a legged environment against the bare simulator, and its column of the thesis's Table 4.1."""
    results: dict[str, Any] = {"env": quad.measure_env(name, device, rounds)}
    quad.print_env(name, results["env"])
    results["training"] = quad.measure_training(name, device, 3 * rounds)
    training.print_training(f"{name}, flat, T = {quad.PERIOD}", results["training"])
    return results


def measure_engines(rounds: int, device: torch.device) -> dict[str, Any]:
    """The engines of the legged environments, compared."""
    results = engines.measure(device, rounds)
    engines.show(results)
    return results


def measure_engine_training(rounds: int, device: torch.device) -> dict[str, Any]:
    """Training on each engine."""
    result = engine_training.measure(device, rounds)
    engine_training.show(result)
    return {"training": result}


def measure_stability(rounds: int, device: torch.device) -> dict[str, Any]:
    """Legged robots over ten million world-steps, whatever the rounds."""
    with torch_on_one():
        result = stability.measure(device)
    stability.show(result)
    return {"stability": result}


def measure_terrain(rounds: int, device: torch.device) -> dict[str, Any]:
    """Building terrains."""
    results = terrain.measure(device, rounds)
    terrain.show(results)
    return results


def measure_director(rounds: int, device: torch.device) -> dict[str, Any]:
    """The Director in other training loops."""
    results = director.measure(device, rounds)
    director.show(results)
    return results


def main(arguments: list[str]) -> int:
    """Run the command line; returns the exit code."""
    wp.config.quiet = True
    try:
        run(parse(BenchOptions, arguments, "python -m benchmarks"))
    except (RunError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
