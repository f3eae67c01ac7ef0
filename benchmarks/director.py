"""What ``deimos.GoalDirector`` costs in somebody else's loop, per step of its worlds."""

import statistics
from collections.abc import Callable
from typing import Any

import torch
from rich.table import Table

from benchmarks.timing import in_turn, short, wide_console
from deimos.goals.director import GoalDirector

WORLDS, PERIOD, CANDIDATES = 2000, 100, 100
STATE, GOAL = 9, 3  # components, as in Particle Gym
CRASHES = 0.001  # per world and step
METHODS = ("uniform", "p25", "rnd")


def measure(
    device: torch.device, rounds: int, num_envs: int = WORLDS, period: int = PERIOD, methods: tuple[str, ...] = METHODS
) -> dict[str, Any]:
    """Milliseconds and world-steps per second of ``GoalDirector.step`` under some methods, learning included.

    Args:
        device: Where.
        rounds: Rounds of T steps that a figure is the median of.
        num_envs: Worlds.
        period: T, in steps.
        methods: Who chooses the goals.
    """
    generator = torch.Generator(device).manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(num_envs, *shape, generator=generator, device=device)

    states, candidates = [draw(STATE) for _ in range(8)], draw(CANDIDATES, GOAL)
    crashes = [draw() < CRASHES for _ in range(8)]
    never = torch.zeros(num_envs, dtype=torch.bool, device=device)

    def loop(method: str) -> Callable[[], None]:
        director, goal = GoalDirector(method, period), candidates[:, 0].clone()

        def work() -> None:
            for t in range(period):
                found = director.step(states[t % 8], goal, crashes[t % 8], never, candidates)
                goal.copy_(found.goal)

        return work

    work = {name: loop(name) for name in methods}
    for function in work.values():  # until fear networks have seen both classes
        for _ in range(3):
            function()
    seconds = in_turn(work, rounds, device)
    return {
        "num_envs": num_envs,
        "ms per step": {name: 1000 * statistics.median(values) / period for name, values in seconds.items()},
        "world-steps/s": {name: num_envs * period / statistics.median(values) for name, values in seconds.items()},
    }


def show(result: dict[str, Any]) -> None:
    """Print the table of ``measure``."""
    table = Table(title=f"GoalDirector.step, {result['num_envs']} worlds", title_justify="left")
    for name in ("method", "ms per step", "world-steps/s"):
        table.add_column(name, justify="left" if name == "method" else "right")
    for name, value in result["ms per step"].items():
        table.add_row(name, f"{value:.3f}", short(result["world-steps/s"][name]))
    wide_console().print(table)
