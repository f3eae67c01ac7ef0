"""Whether memory grows: over many iterations, and over many trainers in one process."""

import gc
import json
from pathlib import Path

import numpy as np

from benchmarks.faults.injections import config
from benchmarks.faults.trial import Verdict, attempt
from benchmarks.stability import _memory as resident
from deimos.run import training
from deimos.run.trainer import Trainer

ITERATIONS, TRAINERS, REPORTS = 2000, 50, 20
MOST = 8.0  # MiB that the second half may add to the first
SECONDS = 36_000.0
JOBS = [("iterations", "particle"), ("iterations", "quad"), ("trainers", "particle"), ("trainers", "quad")]
COUNT = len(JOBS)


def iterations(env: str, count: int) -> list[float]:
    """Memory [MiB] while a trainer works."""
    trainer, found = Trainer(config(env, "p75"), training.resolve_device("cpu")), []
    for i in range(count):
        trainer.iterate()
        if (i + 1) % max(1, count // REPORTS) == 0:
            found.append(resident())
    return found


def trainers(env: str, count: int) -> list[float]:
    """Memory [MiB] after each of many trainers that are built, used and dropped."""
    found = []
    for _ in range(count):
        Trainer(config(env, "p75"), training.resolve_device("cpu")).iterate()
        gc.collect()
        found.append(resident())
    return found


def attack(number: int, rng: np.random.Generator, place: Path) -> Verdict:
    """Run one measurement in a separate process."""
    kind, env = JOBS[number % COUNT]

    def work() -> None:
        found = iterations(env, ITERATIONS) if kind == "iterations" else trainers(env, TRAINERS)
        (place / "memory.json").write_text(json.dumps(found))

    ended = attempt(work, place, SECONDS)
    if ended.code != 0:
        return Verdict("fault", f"{kind}, {env}", ended.said[-2000:], f"exit code {ended.code}")
    found = json.loads((place / "memory.json").read_text())
    half = len(found) // 2
    grown = found[-1] - found[half]
    fault = f"the second half added {grown:.1f} MiB" if grown > MOST else ""
    count = ITERATIONS if kind == "iterations" else TRAINERS
    return Verdict("fault" if fault else "flat", f"{count} {kind}, {env}", fault=fault, figures={"MiB": found})
