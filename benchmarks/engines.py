"""How fast the two engines of legged robots step on a CPU, compared with each other and with the bare native engine."""

import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from benchmarks.timing import ratio, wide_console
from deimos.goals.selectors import uniform
from deimos.learn.policy import load_policy
from deimos.run.loop import GoalLoop, spaces
from deimos.run.presets import preset
from deimos.sim.legged.config import LocomotionConfig
from deimos.sim.legged.task import Locomotion

WALKER = Path(__file__).parent.parent / "docs" / "results" / "quad_flat"
WORLDS, PERIOD = 512, 100
STEPS = 4  # control steps of a round
SETTLE = 50  # control steps before anything is timed: robots walk once they have landed
Seconds = dict[str, list[tuple[float, float]]]
"""Seconds of every piece of work in every round: wall-clock, and CPU time of all cores."""


class Walkers:
    """Robots under the committed walking policy, on one engine.

    Args:
        engine: Name of the engine.
        ground: The ground that they walk on.
        num_envs: How many.
        device: Where.
    """

    def __init__(self, engine: str, ground: str, num_envs: int, device: torch.device) -> None:
        config = preset("quad").env
        assert isinstance(config, LocomotionConfig)
        env = replace(config, engine=engine, terrain=ground, goal_period=PERIOD).build(num_envs, device, seed=0)
        assert isinstance(env, Locomotion)
        self.env, self._policy = env, load_policy(WALKER, str(device))
        self._loop = GoalLoop(env, uniform.Config().build(spaces(env), 0))
        for _ in range(SETTLE):
            self.step()

    @torch.no_grad()
    def step(self) -> tuple[float, float]:
        """Run one control step of all; returns the seconds of ``env.step``, without policy and goals."""
        action = self._policy.scaled(self.env.obs)
        begin = time.perf_counter(), time.process_time()
        step = self.env.step(action)
        end = time.perf_counter(), time.process_time()
        self._loop.advance(step)
        return end[0] - begin[0], end[1] - begin[1]

    def bare(self) -> tuple[float, float]:
        """Run one control step of only the engine, under the last targets."""
        begin = time.perf_counter(), time.process_time()
        self.env.physics.bare_step()
        return time.perf_counter() - begin[0], time.process_time() - begin[1]


def measure(device: torch.device, rounds: int, num_envs: int = WORLDS) -> dict[str, Any]:
    """Microseconds per control step of a robot, wall-clock and of all cores, on flat and on rough ground.

    Raises:
        ValueError: If the device is not the CPU, which the native engine is for.
    """
    if device.type != "cpu":
        raise ValueError(f"device must be cpu for the native engine, got {device}.")
    work: dict[str, Callable[[], tuple[float, float]]] = {}
    for ground in ("flat", "rough"):
        native, warp = (Walkers(engine, ground, num_envs, device) for engine in ("native", "warp"))
        work |= {f"native, {ground}": native.step, f"bare native, {ground}": native.bare}
        work |= {f"mujoco-warp, {ground}": warp.step}
    threads = torch.get_num_threads()  # the native engine's; torch has one during steps, as in training
    torch.set_num_threads(1)
    seconds = _in_turn(work, rounds)
    torch.set_num_threads(threads)
    each = 1e6 / (STEPS * num_envs)
    result: dict[str, Any] = {
        "num_envs": num_envs, "threads": threads,
        "us on the clock": {name: each * statistics.median(wall for wall, _ in t) for name, t in seconds.items()},
        "us of all cores": {name: each * statistics.median(cpu for _, cpu in t) for name, t in seconds.items()},
    }  # fmt: skip
    for ground in ("flat", "rough"):
        for label, slow, fast, clock in (
            ("mujoco-warp / native, clock", "mujoco-warp", "native", 0),
            ("mujoco-warp / native, all cores", "mujoco-warp", "native", 1),
            ("native / bare native, clock", "native", "bare native", 0),
        ):
            pair = [[turn[clock] for turn in seconds[f"{name}, {ground}"]] for name in (slow, fast)]
            result[f"{label}, {ground}"] = ratio(*pair)
    return result


def _in_turn(work: dict[str, Callable[[], tuple[float, float]]], rounds: int) -> Seconds:
    """``STEPS`` steps of everything in every round; one more round runs first and is not counted."""
    seconds: Seconds = {name: [] for name in work}
    for _ in range(rounds + 1):
        for name, step in work.items():
            turns = [step() for _ in range(STEPS)]
            seconds[name].append((sum(wall for wall, _ in turns), sum(cpu for _, cpu in turns)))
    return {name: turns[1:] for name, turns in seconds.items()}


def show(result: dict[str, Any]) -> None:
    """Print the table of ``measure``."""
    title = f"A robot's control step, {result['num_envs']} robots that walk, {result['threads']} threads"
    table = Table("", "us on the clock", "us of all cores", title=title, title_justify="left")
    for name, value in result["us on the clock"].items():
        table.add_row(name, f"{value:.1f}", f"{result['us of all cores'][name]:.1f}")
    for name, value in result.items():
        if isinstance(value, float):
            table.add_row(name, f"{value:.2f}")
    wide_console().print(table)
