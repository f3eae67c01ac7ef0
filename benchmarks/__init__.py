"""``deimos bench``: how fast everything is, beside what else there is."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from rich.console import Console

from deimos.checks import check_at_least
from deimos.run.folder import RunError


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """Measure speed; everything that is compared is measured in the same run."""

    what: tyro.conf.Positional[Literal["particle", "quad", "quad-arm", "terrain"]]
    """What to measure."""
    json: Path | None = None
    """Write all numbers to this file too."""
    rounds: int = 7
    """Rounds that a ratio is the median of, at least 1."""
    threads: int = 0
    """CPU threads, at least 0; 0 takes one per core."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to measure; auto takes the GPU where there is one."""

    def __post_init__(self) -> None:
        check_at_least("rounds", self.rounds, 1)
        check_at_least("threads", self.threads, 0)


def run(options: BenchOptions) -> dict[str, Any]:
    """Measure, print one table per subject, and write the JSON file if asked for."""
    from deimos.run.training import cores, provenance, resolve_device
    from deimos.sim.shared import one_stream

    if options.json is not None and not options.json.parent.is_dir():
        raise RunError(f"The folder of {options.json} does not exist.")
    device = resolve_device(options.device)
    torch.set_num_threads(options.threads or cores())
    if options.what == "terrain":
        from deimos.terrain import bench as terrain_bench

        return terrain_bench.run(
            terrain_bench.BenchOptions(rounds=options.rounds, device=str(device), json=options.json)
        )
    results: dict[str, Any] = {
        "versions": provenance(), "threads": torch.get_num_threads(), "device": str(device),
    }  # fmt: skip
    particle = options.what == "particle"
    with one_stream(device):
        results |= (
            _particle(options.rounds, device)
            if particle
            else _legged(options.what.replace("-", "_"), options.rounds, device)
        )
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=2) + "\n")
    return results


def _particle(rounds: int, device: torch.device) -> dict[str, Any]:
    """The step of Particle Gym, and Table 4.1 of the thesis for its three variants."""
    from benchmarks import particle, training
    from deimos.run.training import TrainConfig
    from deimos.sim.envs.particle import Config
    from reproduction.thesis import TABLE_4_1

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
        Console().print(f"{name}: {value:.3g}", highlight=False)
    return results


def _legged(name: str, rounds: int, device: torch.device) -> dict[str, Any]:
    """The step of a legged environment beside the bare simulator, and its column of the thesis's Table 4.1."""
    from benchmarks import quad, training

    results: dict[str, Any] = {"env": quad.measure_env(name, device, rounds)}
    quad.print_env(name, results["env"])
    results["training"] = quad.measure_training(name, device, 3 * rounds)
    training.print_training(f"{name}, flat, T = {quad.PERIOD}", results["training"])
    return results
