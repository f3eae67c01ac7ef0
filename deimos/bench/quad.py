"""How fast Quad steps, beside the bare simulator on the same model, flat and rough."""

import statistics
from collections.abc import Callable
from typing import Any

import torch
from rich.table import Table

from deimos.bench.timing import in_turn, ratio, short, wide_console
from deimos.envs import quad
from deimos.physics import Captured

WORLDS = 512
STEPS = 8  # control steps of a turn
SETTLE = 50  # control steps before anything is timed: robots that have landed touch the ground with all feet


def measure_env(device: torch.device, rounds: int, num_envs: int = WORLDS) -> dict[str, Any]:
    """Control steps per second of ``env.step`` and of the captured substeps alone, on flat and on rough ground.

    Both run in the same environment in turn, so that the robots of both are in the same poses.
    """
    work: dict[str, Callable[[], Any]] = {}
    for ground in ("flat", "rough"):
        env = quad.Config(terrain=ground).build(num_envs, device, seed=0)
        action = torch.zeros(num_envs, env.action_dim, device=device)
        for _ in range(SETTLE):
            env.step(action)
        bare = Captured(env.physics.bare_step, device)

        def stepped(env: Any = env, action: torch.Tensor = action) -> None:
            for _ in range(STEPS):
                env.step(action)

        def simulated(bare: Captured = bare) -> None:
            for _ in range(STEPS):
                bare()

        work |= {f"env.step, {ground}": stepped, f"bare, {ground}": simulated}
    seconds = in_turn(work, rounds, device)
    speeds = {name: num_envs * STEPS / statistics.median(values) for name, values in seconds.items()}
    return {
        "num_envs": num_envs,
        "control steps/s": speeds,
        "env.step / bare, flat": ratio(seconds["env.step, flat"], seconds["bare, flat"]),
        "env.step / bare, rough": ratio(seconds["env.step, rough"], seconds["bare, rough"]),
        "rough / flat, speed of the physics": ratio(seconds["bare, flat"], seconds["bare, rough"]),
    }


def print_env(result: dict[str, Any]) -> None:
    """Print the table of ``measure_env``."""
    table = Table(title=f"Quad, {result['num_envs']} worlds", show_header=False, title_justify="left")
    for name, value in result["control steps/s"].items():
        table.add_row(f"{name}, control steps/s", short(value))
    for name, value in result.items():
        if isinstance(value, float):
            table.add_row(name, f"{value:.3f}")
    wide_console().print(table)
