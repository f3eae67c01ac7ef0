"""Whether legged robots can be simulated for long: invalid worlds, numbers that are not finite, memory that grows."""

import resource
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from benchmarks.timing import wide_console
from deimos.goals.selectors import uniform
from deimos.learn.policy import load_policy
from deimos.run.loop import GoalLoop, spaces
from deimos.run.presets import preset
from deimos.sim.envs import quad
from deimos.sim.legged.config import LocomotionConfig
from deimos.sim.legged.task import Locomotion

WALKER = Path(__file__).parent.parent / "docs" / "results" / "quad_flat"
WORLDS, WORLD_STEPS = 1024, 10_000_000
EXPLORATION = 0.5  # deviation of the noise on actions, about that of a policy halfway through its training
REPORTS = 20  # of memory and levels
BUILDS, ROBOTS = 10, 8


@torch.no_grad()
def measure(device: torch.device, world_steps: int = WORLD_STEPS, num_envs: int = WORLDS) -> dict[str, Any]:
    """Let the committed policy explore rough ground, with pushes, noise, levels and resets as in training.

    Returns:
        World-steps, invalid ones and their share, crashes, seconds, and mean level and the process's memory [MiB] at
        ``REPORTS`` moments.

    Raises:
        SimulationError: If too many world-steps are invalid, or an action is not finite.
        ValueError: If an observation or a reward is not finite.
    """
    config = preset("quad").env
    assert isinstance(config, LocomotionConfig)
    env = replace(config, terrain="rough").resolved(device).build(num_envs, device, seed=0)
    assert isinstance(env, Locomotion)
    policy, loop = load_policy(WALKER, str(device)), GoalLoop(env, uniform.Config().build(spaces(env), 0))
    generator = torch.Generator(device).manual_seed(0)
    steps, counts = -(-world_steps // num_envs), torch.zeros(2, dtype=torch.int64, device=device)
    levels, memory, begin = [], [], time.perf_counter()
    for t in range(steps):
        noise = torch.randn(num_envs, env.action_dim, generator=generator, device=device)
        step = env.step(policy.scaled(env.obs) + EXPLORATION * noise)
        counts += torch.stack([step.invalid.sum(), step.terminated.sum()])
        if not bool(step.obs.isfinite().all() & step.reward.isfinite().all()):
            raise ValueError(f"An observation or a reward is not finite after {t + 1} control steps.")
        env.check()
        loop.advance(step)
        if t % max(1, steps // REPORTS) == 0:
            levels.append(env.report()["level"])
            memory.append(_memory())
    invalid, crashes = counts.tolist()
    return {
        "engine": env.config.engine, "num_envs": num_envs, "world_steps": steps * num_envs, "invalid": invalid,
        "invalid_share": invalid / (steps * num_envs), "crashes": crashes, "seconds": time.perf_counter() - begin,
        "mean_level": levels, "memory": memory,
    }  # fmt: skip


def measure_builds(count: int = BUILDS) -> tuple[list[float], list[float]]:
    """Build and drop environments on rough ground: memory of the process [MiB] after each, and its CPU time [s]."""
    config, memory, seconds = quad.Config(terrain="rough"), [], []
    for _ in range(count):
        begin = time.process_time()
        config.build(ROBOTS, torch.device("cpu"), seed=0)
        seconds.append(time.process_time() - begin)
        memory.append(_memory())
    return memory, seconds


def _memory() -> float:
    """Memory of this process [MiB]: its current use or, if the system does not report that, its peak use."""
    status = Path("/proc/self/statm")
    if status.exists():
        return int(status.read_text().split()[1]) * resource.getpagesize() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def show(result: dict[str, Any]) -> None:
    """Print the table of ``measure``."""
    table = Table("", "", title=f"{result['num_envs']} Go1s on rough ground, {result['engine']}", title_justify="left")
    table.add_row("world-steps", f"{result['world_steps']:,}")
    table.add_row("of them invalid", f"{result['invalid']:,} ({100 * result['invalid_share']:.2g} %)")
    table.add_row("crashes", f"{result['crashes']:,}")
    table.add_row("mean level, first and last", f"{result['mean_level'][0]:.2f}, {result['mean_level'][-1]:.2f}")
    table.add_row("memory over time [MiB]", ", ".join(f"{value:.0f}" for value in result["memory"]))
    table.add_row("seconds", f"{result['seconds']:.0f}")
    wide_console().print(table)
