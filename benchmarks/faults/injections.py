"""Huge and non-finite numbers, put into a running trainer: caught with the last good checkpoint intact, or harmless."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.faults.trial import Verdict, attempt
from deimos.checks import SimulationError
from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.failure import REPORT, check_finite
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle, quad

COUNT = 200
SECONDS = 240.0
CAUGHT = 42  # exit code
METHODS = ["p75", "plr", "rnd", "vds", "q-fear", "cl", "uniform", "grid"]
NUMBERS = [float("nan"), float("inf"), -float("inf"), 3e38]
SMALL = PPOConfig(hidden=(8,), num_steps=8, minibatches=2)
ENVS = {"particle": particle.Config(goal_period=8), "quad": quad.Config(goal_period=8, engine="native")}


def config(env: str, method: str) -> TrainConfig:
    """A small run."""
    worlds = 64 if env == "particle" else 16
    return TrainConfig(
        env=ENVS[env], method=method, ppo=SMALL, evaluation=False, num_envs=worlds, env_steps=8 * 8, device="cpu",
        threads=1,
    )  # fmt: skip


def tensors(name: str, value: Any, seen: set[int]) -> Iterator[tuple[str, Tensor]]:
    """All floating-point tensors that an object holds, by name."""
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, Tensor):
        if value.is_floating_point() and value.numel():
            yield name, value
    elif isinstance(value, dict):
        for key, part in value.items():
            yield from tensors(f"{name}.{key}", part, seen)
    elif isinstance(value, list | tuple):
        for i, part in enumerate(value):
            yield from tensors(f"{name}.{i}", part, seen)
    elif isinstance(value, torch.nn.Module):
        yield from tensors(name, dict(value.named_parameters()) | dict(value.named_buffers()), seen)
    elif type(value).__module__.startswith("deimos") and hasattr(value, "__dict__"):
        yield from tensors(name, vars(value), seen)


def attack(number: int, rng: np.random.Generator, place: Path) -> Verdict:
    """Put a number into a tensor between two iterations, and continue."""
    env, method = ("particle", "quad")[number % 2], METHODS[int(rng.integers(len(METHODS)))]
    draws = rng.integers(2**31, size=3)
    bad, after = NUMBERS[int(rng.integers(len(NUMBERS)))], int(rng.integers(1, 5))

    def work() -> int:
        trainer, folder = training.start(config(env, method), place / "run")
        held = [*tensors("trainer", {"ppo": trainer.ppo, "env": trainer.env, "loop": trainer.loop}, set())]
        name, tensor = held[int(draws[0]) % len(held)]
        where = np.unravel_index(int(draws[1]) % tensor.numel(), tensor.shape)
        print(f"{env}, {method}: {name}{[*map(int, where)]} = {bad} after iteration {after}", flush=True)
        return _go_on(trainer, folder, after, lambda: tensor.data.__setitem__(where, bad))

    ended = attempt(work, place, SECONDS)
    what = (place / "stdout.txt").read_text().strip() or f"{env}, {method}"
    said = ended.said.strip().splitlines()
    if ended.code not in (0, CAUGHT) or ended.asked:
        return Verdict("fault", what, ended.said[-2000:], "it waited" if ended.asked else f"exit code {ended.code}")
    outcome = "caught" if ended.code == CAUGHT else "harmless"
    fault = _poisoned(place / "run") or ("no report" if ended.code == CAUGHT and not _reported(place / "run") else "")
    return Verdict("fault" if fault else outcome, what, said[-1][:300] if said else "", fault)


def _go_on(trainer: Trainer, folder: RunFolder, after: int, inject: Any) -> int:
    """Continue training, with the injection after an iteration."""
    iterate = trainer.iterate

    def spoiled() -> dict[str, float]:
        row = iterate()
        if trainer.iteration == after:
            inject()
        return row

    trainer.iterate = spoiled  # type: ignore[method-assign]
    training.CHECKPOINT_SECONDS = 0.0  # after every iteration
    try:
        training.train(trainer, folder)
    except SimulationError as error:
        os.write(2, str(error).encode())
        return CAUGHT
    return 0


def _reported(run: Path) -> bool:
    return bool(RunFolder(run).read_json(REPORT)["error"])


def _poisoned(run: Path) -> str:
    """What is wrong with the checkpoint, and with the rows, that such a run has left."""
    folder = RunFolder.open(run)
    trainer = training.load(folder, training.read_config(folder))
    try:
        check_finite(trainer)
        trainer.iterate()
    except SimulationError as error:
        return f"the checkpoint cannot be gone on with: {error}"
    for row in folder.read_csv("progress.csv"):
        if broken := [name for name, cell in row.items() if cell in ("inf", "-inf")]:
            return f"progress.csv holds infinite {', '.join(broken)}"
    return ""
