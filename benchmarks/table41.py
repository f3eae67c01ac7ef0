"""The thesis's Table 4.1: how fast each method trains in its five environments, all of them in one run.

In a round every method of every environment trains for as long as each of its worlds needs to get a goal, one after
another, so that other load on the machine affects all alike. Speeds are medians over rounds; comparable with the thesis
are their ratios to Uniform's, each within a round.
"""

import json
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.table import Table

from benchmarks.timing import wide_console
from deimos.checks import RunError
from deimos.files import write_whole
from deimos.goals.fear_selector import fear_selector
from deimos.run.presets import preset
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.legged.engines import Name as EngineName
from deimos.sim.legged.engines import resolve
from reproduction.thesis import LEGGED, PARTICLE, RATIOS_4_1, TABLE_4_1

TITLES = {"p25": "DEIMOS (p25)", "rnd": "RND", "uniform": "Uniform", "vds": "VDS", "cl": "CL"}
"""The table's methods, in the thesis's order."""
ROBOTS = 256
PERIOD = 100  # T of the robots: a fifth of the presets', so that selectors choose five times as often
WARM_UP = 2  # iterations before anything is timed, and as many more as a fear network needs until its first fit
MOST = 20  # goals of every world that this may take

Round = dict[str, Any]
"""``seconds`` of every environment and method, the ``load`` of the host before it, and the ``cores`` that it had."""


@dataclass(frozen=True)
class Column:
    """An environment of the table."""

    config: TrainConfig
    """What is trained; its method is ignored."""
    methods: tuple[str, ...]
    """Names of the methods, ``uniform`` among them."""

    @property
    def iterations(self) -> int:
        """Iterations of a turn: if goals fall due in all worlds at once, as many as it takes until they do."""
        due_at_once = not getattr(self.config.env, "stagger_goals", True)
        return math.ceil(self.config.env.goal_period / self.config.ppo.num_steps) if due_at_once else 1

    @property
    def transitions(self) -> int:
        """World-steps of a turn."""
        return self.iterations * self.config.num_envs * self.config.ppo.num_steps


def columns(engine: EngineName, device: torch.device) -> dict[str, Column]:
    """The thesis's environments, in its order.

    Args:
        engine: Physics of the robots.
        device: Where.
    """
    found = {}
    for name in (*PARTICLE, *LEGGED):
        if name in PARTICLE:
            base = preset("particle")
            env = replace(base.env, variant=name)
        else:
            base = replace(preset(name), num_envs=ROBOTS)
            env = replace(base.env.with_goal_period(PERIOD), engine=resolve(engine, device))
        config = replace(base, env=env, method=None, evaluation=False, device=device.type, threads=0)
        found[name] = Column(config, tuple(TABLE_4_1[name]))
    return found


def measure(
    table: Mapping[str, Column], rounds: int, device: torch.device, *, seconds: float = math.inf,
    keep: Callable[[list[Round]], None] = lambda rounds: None, known: list[Round] | None = None,
) -> list[Round]:  # fmt: skip
    """Time rounds until there are enough of them or time is up.

    Args:
        table: The environments and methods.
        rounds: How many rounds are wanted, including the known ones.
        device: Where.
        seconds: No round except the first starts later than this after the call [s].
        keep: Called with all rounds after each.
        known: Rounds of earlier calls.

    Returns:
        All rounds, the known ones first.
    """
    begin, found = time.monotonic(), list(known or [])
    if len(found) >= rounds:
        return found
    trainers = {
        name: {each: Trainer(replace(column.config, method=each), device) for each in column.methods}
        for name, column in table.items()
    }
    for own in trainers.values():
        for trainer in own.values():
            _warm_up(trainer)
    first = len(found)
    while len(found) < rounds and (len(found) == first or time.monotonic() - begin < seconds):
        load, started = os.getloadavg()[0], (time.perf_counter(), time.process_time())
        spent = {
            name: {each: _turn(trainer, table[name], device) for each, trainer in own.items()}
            for name, own in trainers.items()
        }
        cores = (time.process_time() - started[1]) / (time.perf_counter() - started[0])
        found.append({"seconds": spent, "load": load, "cores": cores})
        keep(found)
    return found


def _warm_up(trainer: Trainer) -> None:
    """Train until memory has been allocated and fear, if any, has learnt."""
    afraid = fear_selector(trainer.loop.selector)
    while trainer.iteration < WARM_UP or (afraid and not afraid.fear.fitted):
        if trainer.iteration * trainer.config.ppo.num_steps > MOST * trainer.config.env.goal_period:
            raise RunError(f"After {MOST} goals the fear network of {trainer.config.label} has learnt nothing.")
        trainer.iterate()


def _turn(trainer: Trainer, column: Column, device: torch.device) -> float:
    begin = time.perf_counter()
    for _ in range(column.iterations):
        trainer.iterate()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - begin


def continued(path: Path | None, results: dict[str, Any]) -> list[Round]:
    """The rounds in a file; none if it does not exist.

    Raises:
        RunError: If they belong to another commit, device, engine or number of threads.
    """
    if path is None or not path.exists():
        return []
    stored = json.loads(path.read_text())
    if differs := [name for name, value in results.items() if stored.get(name) != value]:
        raise RunError(
            f"{path} holds rounds of other {', '.join(differs)}: one table is one commit on one machine; "
            "give --json another file."
        )
    return stored["table41"]


def run(results: dict[str, Any], rounds: int, device: torch.device, path: Path | None, seconds: float) -> None:
    """Measure the table, print it, and keep every round in a file, so that the same command continues it.

    Args:
        results: The entries that the rounds of one table have in common; ``table41`` is added.
        rounds: See ``measure``.
        device: Where.
        path: The file; ``None`` for none.
        seconds: See ``measure``.

    Raises:
        RunError: See ``continued``.
    """
    table = columns(results["engine"], device)

    def keep(found: list[Round]) -> None:
        results["table41"] = found
        if path is not None:
            write_whole(path, lambda file: file.write(json.dumps(results).encode() + b"\n"))

    known = continued(path, results)
    keep(measure(table, rounds, device, seconds=seconds, keep=keep, known=known))
    show(table, results["table41"])
    if len(results["table41"]) < rounds:
        wide_console().print(f"{rounds - len(results['table41'])} rounds are left; the same command continues.")


def speeds(table: Mapping[str, Column], rounds: list[Round]) -> list[dict[str, Any]]:
    """Frames per second of every environment and method, and their ratio to Uniform's, both over rounds.

    Returns:
        ``environment``, ``method``, ``fps`` (median), and the quartiles ``low``, ``ratio`` and ``high`` of the ratio.
    """
    rows = []
    for name, column in table.items():
        seconds = {each: np.array([turn["seconds"][name][each] for turn in rounds]) for each in column.methods}
        for each, own in seconds.items():
            low, ratio, high = np.quantile(seconds["uniform"] / own, [0.25, 0.5, 0.75]).tolist()
            fps = column.transitions / float(np.median(own))
            rows.append({"environment": name, "method": each, "fps": fps, "low": low, "ratio": ratio, "high": high})
    return rows


def show(table: Mapping[str, Column], rounds: list[Round]) -> None:
    """Print the table in frames per second and as ratios next to the thesis's, and how busy the host was."""
    found = {(row["environment"], row["method"]): row for row in speeds(table, rounds)}
    fps = Table("method", *table, title="Frames per second in training, all worlds together", title_justify="left")
    ratios = Table(
        "method", *table, title="Beside Uniform: median over rounds [quartiles]; thesis", title_justify="left"
    )
    for each, title in TITLES.items():
        rows = [found.get((name, each)) for name in table]
        fps.add_row(title, *["" if row is None else f"{row['fps']:,.0f}" for row in rows])
        ratios.add_row(title, *["" if row is None else _beside_thesis(row) for row in rows])
    console = wide_console()
    console.print(fps, ratios)
    loads, cores = ([turn[name] for turn in rounds] for name in ("load", "cores"))
    console.print(
        f"{len(rounds)} rounds; {os.cpu_count()} cores, of which this process had {np.median(cores):.2f} "
        f"({min(cores):.2f} to {max(cores):.2f}); load of the host {np.median(loads):.1f} "
        f"({min(loads):.1f} to {max(loads):.1f}).",
        highlight=False,
    )


def _beside_thesis(row: dict[str, Any]) -> str:
    text = f"{row['ratio']:.2f} [{row['low']:.2f}, {row['high']:.2f}]"
    return "1" if row["method"] == "uniform" else f"{text}; {RATIOS_4_1[row['environment']][row['method']]:.2f}"
