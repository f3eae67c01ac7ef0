"""How fast Particle Gym steps, compared with the same step in eager torch and in NumPy."""

import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from rich.table import Table
from torch import Tensor

from benchmarks.timing import in_turn, ratio, short, wide_console
from deimos.sim.envs import particle
from deimos.sim.envs.particle import HALF_SIDE

SIZES = (2_000, 65_536, 1_048_576)
# What one particle's step moves through memory, in float32 words: read action, velocity, position, target
# (12); write force, velocity, position (9) and observation (12), reward (1); two clocks read and written (4);
# four flags of a byte (1).
WORDS_PER_STEP = 39
# Counted in the kernel: clip, halve, add (21), crash (6), distance and reward (9), scaling (12), clocks (4).
OPERATIONS_PER_STEP = 52


def measure_env(num_envs: int, device: torch.device, rounds: int) -> dict[str, float]:
    """Throughput of the bare kernel, of ``env.step``, and of the same step in eager torch and in NumPy."""
    config = particle.Config(goal_period=10**9)  # no events: nothing but the step is timed
    env = config.build(num_envs, device, seed=0)
    action = torch.zeros(num_envs, 3, device=device)
    steps = max(2, 1_000_000 // num_envs)  # few enough that no particle, starting at rest, leaves the cube

    def repeat(function: Callable[[], Any]) -> Callable[[], None]:
        def work() -> None:
            for _ in range(steps):
                function()

        return work

    work = {
        "kernel": repeat(env.launch_step),
        "env.step": repeat(lambda: env.step(action)),
        "eager torch": repeat(_torch_step(config, num_envs, device, action)),
    }
    if device.type == "cpu":
        work["numpy"] = repeat(_numpy_step(config, num_envs))
    seconds = in_turn(work, rounds, device)
    result: dict[str, float] = {"num_envs": num_envs}
    for name, values in seconds.items():
        result[f"{name} [steps/s]"] = num_envs * steps / statistics.median(values)
    result["torch / env.step"] = ratio(seconds["eager torch"], seconds["env.step"])
    result["bytes/s"] = 4 * WORDS_PER_STEP * result["kernel [steps/s]"]
    result["operations/s"] = OPERATIONS_PER_STEP * result["kernel [steps/s]"]
    return result


def _torch_step(
    config: particle.Config, num_envs: int, device: torch.device, action: Tensor
) -> Callable[[], tuple[Tensor, ...]]:
    """The directional step as one would write it in torch, with the same outputs."""
    params = config.params()
    position, velocity, target = (torch.zeros(num_envs, 3, device=device) for _ in range(3))
    clock = torch.zeros(num_envs, dtype=torch.int32, device=device)
    episode = torch.zeros(num_envs, dtype=torch.int32, device=device)

    def step() -> tuple[Tensor, ...]:
        nonlocal position, velocity, clock, episode
        force = action.clamp(-params.max_force, params.max_force)
        velocity = (velocity + 0.5 * force).clamp(-params.max_speed, params.max_speed)
        position = position + velocity
        terminated = (position.abs() > HALF_SIDE).any(dim=1)
        reward = 1.0 - (velocity - target).norm(dim=1) / (1.01 * params.largest_distance)
        clock, episode = clock + 1, episode + 1
        goal_due = clock >= config.goal_period
        truncated = torch.zeros_like(terminated)
        invalid = ~(action.isfinite().all(dim=1) & position.isfinite().all(dim=1))
        obs = torch.cat([
            velocity * params.velocity_scale, position * params.position_scale,
            force * params.force_scale, target * params.velocity_scale,
        ], dim=1)  # fmt: skip
        return obs, reward, terminated, truncated, goal_due, invalid

    return step


def _numpy_step(config: particle.Config, num_envs: int) -> Callable[[], tuple]:
    """The directional step as one would write it in NumPy, with the same outputs."""
    params = config.params()
    action, position, velocity, target = (np.zeros((num_envs, 3), np.float32) for _ in range(4))
    clock, episode = (np.zeros(num_envs, np.int32) for _ in range(2))

    def step() -> tuple:
        nonlocal position, velocity, clock, episode
        force = np.clip(action, -params.max_force, params.max_force)
        velocity = np.clip(velocity + np.float32(0.5) * force, -params.max_speed, params.max_speed)
        position = position + velocity
        terminated = (np.abs(position) > HALF_SIDE).any(axis=1)
        reward = 1.0 - np.linalg.norm(velocity - target, axis=1) / (1.01 * params.largest_distance)
        clock, episode = clock + 1, episode + 1
        goal_due = clock >= config.goal_period
        truncated = np.zeros_like(terminated)
        invalid = ~(np.isfinite(action).all(axis=1) & np.isfinite(position).all(axis=1))
        obs = np.concatenate([
            velocity * params.velocity_scale, position * params.position_scale,
            force * params.force_scale, target * params.velocity_scale,
        ], axis=1)  # fmt: skip
        return obs, reward, terminated, truncated, goal_due, invalid

    return step


def print_env(rows: list[dict[str, float]], threads: int, device: str) -> None:
    """Print the table of ``measure_env``."""
    table = Table(title=f"Steps of one particle per second, {threads} threads, {device}")
    names = [name for name in rows[0] if name != "num_envs"]
    table.add_column("worlds", justify="right")
    for name in names:
        table.add_column(name.replace(" [steps/s]", ""), justify="right")
    for row in rows:
        table.add_row(f"{row['num_envs']:,}", *[short(row[name]) for name in names])
    wide_console().print(table)
