"""How fast the legged environments step, against the bare simulator, and how fast they train under every selector."""

import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from rich.table import Table

from benchmarks import training
from benchmarks.timing import in_turn, ratio, short, wide_console
from deimos.goals.methods import method
from deimos.goals.selector import SelectorConfig
from deimos.goals.selectors import vds
from deimos.run.presets import preset
from deimos.sim.legged.config import LocomotionConfig
from deimos.sim.legged.engines.captured import Captured
from deimos.sim.legged.task import Locomotion
from reproduction.thesis import TABLE_4_1

WORLDS = 512
PERIOD = 100  # T of the timed training: a fifth of the presets', so that selectors choose five times as often
METHODS_TIMED: dict[str, SelectorConfig] = {name: method(name) for name in ("uniform", "p25", "rnd", "vds", "cl")} | {
    "vds, own shares": vds.Config(data="share", epochs=3)
}
STEPS = 4  # control steps of a round
SETTLE = 50  # control steps before anything is timed: robots that have landed touch the ground with all feet


def measure_env(name: str, device: torch.device, rounds: int, num_envs: int = WORLDS) -> dict[str, Any]:
    """Control steps per second of ``env.step`` and of only mujoco-warp's captured substeps, on flat and rough ground.

    Both alternate in the same environment, so that robots are in the same poses for both.
    """
    config = preset(name).env
    assert isinstance(config, LocomotionConfig)
    work: dict[str, Callable[[], Any]] = {}
    for ground in ("flat", "rough"):
        env = replace(config, terrain=ground, engine="warp").build(num_envs, device, seed=0)
        assert isinstance(env, Locomotion)
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
    seconds = in_turn(work, training.OFTEN * rounds, device)  # the ratios are close to 1
    speeds = {name: num_envs * STEPS / statistics.median(values) for name, values in seconds.items()}
    return {
        "num_envs": num_envs,
        "control steps/s": speeds,
        "env.step / bare, flat": ratio(seconds["env.step, flat"], seconds["bare, flat"]),
        "env.step / bare, rough": ratio(seconds["env.step, rough"], seconds["bare, rough"]),
        "rough / flat, speed of the physics": ratio(seconds["bare, flat"], seconds["bare, rough"]),
    }


def measure_training(name: str, device: torch.device, rounds: int, num_envs: int = WORLDS // 2) -> dict[str, Any]:
    """A legged column of Table 4.1: an environment's preset with fewer worlds and a shorter T.

    The clocks of the goals are staggered, so that selectors have the same work in every iteration. A fear network
    learns and chooses once it has seen robots that fall and robots that do not; with this T, that is before anything is
    timed.
    """
    base = preset(name)
    env = base.env.with_goal_period(PERIOD)
    config = replace(base, env=env, num_envs=num_envs, evaluation=False, device="auto", threads=0)
    return training.measure_training(config, METHODS_TIMED, TABLE_4_1[name], device, rounds, length=1, warm_up=2)


def print_env(title: str, result: dict[str, Any]) -> None:
    """Print the table of ``measure_env``."""
    table = Table(title=f"{title}, {result['num_envs']} worlds", show_header=False, title_justify="left")
    for name, value in result["control steps/s"].items():
        table.add_row(f"{name}, control steps/s", short(value))
    for name, value in result.items():
        if isinstance(value, float):
            table.add_row(name, f"{value:.3f}")
    wide_console().print(table)
