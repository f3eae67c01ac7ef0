"""How fast a robot trains on each engine, and how fast it could if learning cost only its matrix products."""

import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from rich.table import Table

from benchmarks import flops
from benchmarks.timing import in_turn, ratio, wide_console
from benchmarks.training import machine
from deimos.run.presets import preset
from deimos.run.trainer import Trainer
from deimos.sim.legged.config import LocomotionConfig


def measure(device: torch.device, rounds: int, num_envs: int = 1024) -> dict[str, Any]:
    """Frames per second of the preset ``quad`` under Uniform, alternating iterations of each engine.

    ``limit`` is the ratio that would result if the update ran its floating-point operations at the speed of a large
    matrix product on as many threads, and everything else took as long as it does.

    Raises:
        ValueError: If the device is not the CPU, which the native engine is for.
    """
    if device.type != "cpu":
        raise ValueError(f"device must be cpu for the native engine, got {device}.")
    base, trainers = preset("quad"), {}
    config = replace(base, num_envs=num_envs, method="uniform", evaluation=False, device="cpu")
    assert isinstance(base.env, LocomotionConfig)
    for ground in ("flat", "rough"):
        for engine in ("native", "warp"):
            env = replace(base.env, terrain=ground, engine=engine)
            trainers[f"{engine}, {ground}"] = Trainer(replace(config, env=env), device)
    work: dict[str, Callable[[], Any]] = {name: trainer.iterate for name, trainer in trainers.items()}
    seconds = in_turn(work, rounds, device)
    transitions = num_envs * config.ppo.num_steps
    learner, peak = flops.of_learner(config.ppo, trainers["native, flat"].env), machine(device)
    ideal = learner / peak["peak product [GFLOP/s]"] / 1e9
    result: dict[str, Any] = {
        "num_envs": num_envs, "threads": torch.get_num_threads(), "learner [GFLOP]": learner / 1e9,
        "update at the peak [s]": ideal, **peak, "rows": {},
    }  # fmt: skip
    for name, trainer in trainers.items():
        spent = {part: value / (rounds + 1) for part, value in trainer.seconds.items()}
        result["rows"][name] = {"fps": transitions / statistics.median(seconds[name]), "seconds": spent}
    for ground in ("flat", "rough"):
        slow, fast = (f"{engine}, {ground}" for engine in ("warp", "native"))
        result[f"native / mujoco-warp, {ground}"] = ratio(seconds[slow], seconds[fast])
        rest = [
            statistics.median(seconds[name]) - result["rows"][name]["seconds"]["update"] + ideal
            for name in (slow, fast)
        ]
        result[f"limit, {ground}"] = rest[0] / rest[1]
    return result


def show(result: dict[str, Any]) -> None:
    """Print the table of ``measure``."""
    title = f"Training, {result['num_envs']} robots, {result['threads']} threads"
    parts = list(next(iter(result["rows"].values()))["seconds"])
    table = Table("", "FPS", *(f"{part} [s]" for part in parts), title=title, title_justify="left")
    for name, row in result["rows"].items():
        table.add_row(name, f"{row['fps']:.0f}", *(f"{row['seconds'][part]:.2f}" for part in parts))
    for name, value in result.items():
        if isinstance(value, float):
            table.add_row(name, f"{value:.2f}")
    wide_console().print(table)
