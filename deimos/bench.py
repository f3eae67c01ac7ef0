"""``deimos bench``: how fast everything is, beside what else there is.

The machine may be shared and noisy. What is compared is therefore measured in turn, round after round,
and a ratio is the median of the rounds' ratios.
"""

import json
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor

from deimos.checks import check_at_least
from deimos.envs import particle
from deimos.envs.particle import HALF_SIDE
from deimos.goal_loop import spaces
from deimos.methods import METHODS, method
from deimos.run_folder import RunError
from deimos.training import TrainConfig, Trainer, cores, provenance

SIZES = (2_000, 65_536, 1_048_576)
# What one particle's step moves through memory, in float32 words: read action, velocity, position, target
# (12); write force, velocity, position (9) and observation (12), reward (1); two clocks read and written (4);
# four flags of a byte (1).
WORDS_PER_STEP = 39
# Counted in the kernel: clip, halve, add (21), crash (6), distance and reward (9), scaling (12), clocks (4).
OPERATIONS_PER_STEP = 52


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """Measure speed; everything that is compared is measured in the same run."""

    what: tyro.conf.Positional[Literal["particle", "terrain"]]
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
    from deimos.training import one_stream, resolve_device

    if options.json is not None and not options.json.parent.is_dir():
        raise RunError(f"The folder of {options.json} does not exist.")
    device = resolve_device(options.device)
    torch.set_num_threads(options.threads or cores())
    if options.what == "terrain":
        from terrain import bench as terrain_bench

        return terrain_bench.run(
            terrain_bench.BenchOptions(rounds=options.rounds, device=str(device), json=options.json)
        )
    with one_stream(device):
        results = {
            "versions": provenance(),
            "threads": torch.get_num_threads(),
            "device": str(device),
            "env": [measure_env(n, device, options.rounds) for n in SIZES],
            **measure_training(device, options.rounds),
        }
    print_results(results)
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=2) + "\n")
    return results


def in_turn(work: dict[str, Callable[[], Any]], rounds: int, device: torch.device) -> dict[str, list[float]]:
    """Seconds of every piece of work in every round; one more round comes first and is not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(rounds + 1):
        for name, function in work.items():
            begin = time.perf_counter()
            function()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            seconds[name].append(time.perf_counter() - begin)
    return {name: values[1:] for name, values in seconds.items()}


def ratio(slow: list[float], fast: list[float]) -> float:
    """Median over rounds of how many times as long the first takes."""
    return statistics.median(a / b for a, b in zip(slow, fast, strict=True))


def measure_env(num_envs: int, device: torch.device, rounds: int) -> dict[str, float]:
    """Throughput of the bare kernel, of ``env.step``, and of the same step in eager torch and in NumPy."""
    config = particle.Config(goal_period=10**9)  # no events: a step is nothing but a step
    env = config.build(num_envs, device, seed=0)
    action = torch.zeros(num_envs, 3, device=device)
    steps = max(2, 1_000_000 // num_envs)  # few enough that no particle leaves the cube at rest

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
    params = config.params(0, 0)
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
        goal_due = clock >= params.goal_period
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
    params = config.params(0, 0)
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
        goal_due = clock >= params.goal_period
        truncated = np.zeros_like(terminated)
        invalid = ~(np.isfinite(action).all(axis=1) & np.isfinite(position).all(axis=1))
        obs = np.concatenate([
            velocity * params.velocity_scale, position * params.position_scale,
            force * params.force_scale, target * params.velocity_scale,
        ], axis=1)  # fmt: skip
        return obs, reward, terminated, truncated, goal_due, invalid

    return step


def measure_training(device: torch.device, rounds: int) -> dict[str, Any]:
    """Training speed of every method, and of rsl_rl on the same environment, in turns of a few iterations.

    A turn is as many iterations as it takes for every world to get at least one goal.
    """
    base = TrainConfig(device="cuda" if device.type == "cuda" else "cpu")
    turn = math.ceil(base.env.goal_period / base.ppo.num_steps)
    trainers = {name: Trainer(replace(base, method=name), device) for name in METHODS}

    def iterate(trainer: Trainer) -> None:
        for _ in range(turn):
            trainer.iterate()

    work: dict[str, Callable[[], Any]] = {name: partial(iterate, trainer) for name, trainer in trainers.items()}
    learn = _rsl_rl(base, device)
    if learn is not None:
        work["rsl_rl"] = lambda: learn(turn)
    for trainer in trainers.values():  # let every fear network see both classes before anything is timed
        for _ in range(4):
            iterate(trainer)
        trainer.synchronise = True
        trainer.seconds.update(dict.fromkeys(trainer.seconds, 0.0))
    seconds = in_turn(work, rounds, device)
    transitions = turn * base.num_envs * base.ppo.num_steps
    rows = []
    for name, values in seconds.items():
        row: dict[str, Any] = {
            "method": name,
            "fps": transitions / statistics.median(values),
            "ms per iteration": 1000 * statistics.median(values) / turn,
            "ratio to uniform": 1 / ratio(values, seconds["uniform"]),
        }
        if name in trainers:
            spent = trainers[name].seconds
            row["shares"] = {part: value / sum(spent.values()) for part, value in spent.items()}
        rows.append(row)
    result: dict[str, Any] = {"training": rows, "limits": _limits(base, trainers["p25"])}
    if "rsl_rl" in seconds:
        result["uniform / rsl_rl"] = ratio(seconds["rsl_rl"], seconds["uniform"])
    return result


def _limits(config: TrainConfig, trainer: Trainer) -> dict[str, float]:
    """Operations of the matrix products of an iteration: they bound it from below."""

    def products(sizes: list[int]) -> int:
        return sum(2 * a * b for a, b in pairwise(sizes))

    space, ppo = spaces(trainer.env), config.ppo
    nets = products([trainer.env.obs_dim, *ppo.hidden, 3]) + products([trainer.env.obs_dim, *ppo.hidden, 1])
    transitions = config.num_envs * ppo.num_steps
    update = 3 * nets * transitions * ppo.epochs  # forward, by the weights, by the inputs
    fear = method("p25").fear  # type: ignore[attr-defined]
    decisions = transitions / config.env.goal_period
    candidate = products([space.goal_dim, *fear.hidden, 1])
    interaction = products([space.state_dim + 2 * space.goal_dim, *fear.hidden, 1])
    scores = decisions * method("p25").candidates * candidate  # type: ignore[attr-defined]
    fit = 3 * fear.epochs * 2 * config.num_envs * interaction
    device = trainer.env.device
    a = torch.randn(2048, 2048, device=device)
    big, copy = (torch.zeros(2**24, device=device) for _ in range(2))
    threads = torch.get_num_threads()
    seconds = min(in_turn({"product": lambda: a @ a}, 5, device)["product"])
    torch.set_num_threads(1)  # Warp's CPU backend runs on one core
    moved = 2 * 4 * 2**24 / min(in_turn({"copy": lambda: copy.copy_(big)}, 5, device)["copy"])
    torch.set_num_threads(threads)
    return {
        "update [GFLOP]": update / 1e9,
        "scores [GFLOP]": scores / 1e9,
        "fit [GFLOP]": fit / 1e9,
        "peak product [GFLOP/s]": 2 * 2048**3 / seconds / 1e9,
        "copy, one core [GB/s]": moved / 1e9,
        "director's products / learner's": (scores + fit) / update,
    }


def _rsl_rl(config: TrainConfig, device: torch.device) -> Callable[[int], None] | None:
    """rsl_rl's own training loop on the same environment, sizes and hyper-parameters, if it is installed."""
    try:
        from rsl_rl.runners import OnPolicyRunner

        from deimos.adapters.rsl_rl import RslRlVecEnv, runner_config
    except ImportError:
        return None
    import contextlib
    import io

    env = RslRlVecEnv(config.env.build(config.num_envs, device, config.seed), reward_scale=config.ppo.reward_scale)
    with contextlib.redirect_stdout(io.StringIO()):
        runner = OnPolicyRunner(env, runner_config(config.ppo), log_dir=None, device=str(device))

    def learn(iterations: int) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            runner.learn(iterations)

    return learn


def print_results(results: dict[str, Any]) -> None:
    """Print the tables."""
    console = Console()
    table = Table(title=f"Steps of one particle per second, {results['threads']} threads, {results['device']}")
    names = [name for name in results["env"][0] if name != "num_envs"]
    table.add_column("worlds", justify="right")
    for name in names:
        table.add_column(name.replace(" [steps/s]", ""), justify="right")
    for row in results["env"]:
        table.add_row(f"{row['num_envs']:,}", *[_short(row[name]) for name in names])
    console.print(table)

    parts = list(results["training"][0]["shares"])
    table = Table(title="Training, default sizes")
    for name in ("method", "FPS", "ms / iteration", "/ uniform", *[f"{part} %" for part in parts]):
        table.add_column(name, justify="left" if name == "method" else "right")
    for row in results["training"]:
        shares = [f"{100 * row['shares'][part]:.1f}" for part in parts] if "shares" in row else ["-"] * len(parts)
        table.add_row(
            row["method"], f"{row['fps']:,.0f}", f"{row['ms per iteration']:.1f}",
            f"{row['ratio to uniform']:.3f}", *shares,
        )  # fmt: skip
    console.print(table)
    if "uniform / rsl_rl" in results:
        console.print(f"Uniform trains {results['uniform / rsl_rl']:.2f} times as fast as rsl_rl.", highlight=False)
    else:
        console.print("rsl_rl is not installed (pip install 'deimos-rl[test]'), so it is not compared.")
    for name, value in results["limits"].items():
        console.print(f"{name}: {value:.3g}", highlight=False)


def _short(value: float) -> str:
    for unit, size in (("G", 1e9), ("M", 1e6)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value:.3g}"
