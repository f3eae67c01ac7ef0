"""Kills at random moments, some within a save: a killed run resumes bit for bit."""

import os
import shutil
import signal
import tempfile
import time
from collections import Counter
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from benchmarks.faults.injections import config
from benchmarks.faults.trial import Verdict, attempt
from deimos import files
from deimos.goals.methods import METHODS
from deimos.run import training
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import quad

SECONDS = 240.0
PER_METHOD, PER_ENGINE, ENGINES = 6, 10, ("native", "warp")
SELECTORS = sorted({selector: name for name, (selector, _) in reversed(METHODS.items())}.values())
"""One method for every selector."""
SAVES = 4  # of so many runs one has its first kill within a save
RUNS = [*((method, None) for method in SELECTORS for _ in range(PER_METHOD)),
        *(("p75", engine) for engine in ENGINES for _ in range(PER_ENGINE))]  # fmt: skip
COUNT = len(RUNS)


def _config(method: str, engine: str | None) -> TrainConfig:
    if engine is None:
        return config("particle", method)
    return replace(config("quad", method), env=quad.Config(goal_period=8, engine=engine))


def train(path: Path, method: str, engine: str | None, kill_at: int = 0) -> None:
    """Start or resume a run, with a checkpoint after every iteration.

    Args:
        path: Its folder.
        method: The method that chooses its goals.
        engine: The engine that simulates Quad; ``None`` for particles.
        kill_at: The disk write, counted over all its saves, at which the process kills itself; 0 for none.
    """
    training.CHECKPOINT_SECONDS = 0.0
    flush, left = os.fsync, [kill_at]

    def fsync(descriptor: int) -> None:
        left[0] -= 1
        if left[0] == 0:
            os.ftruncate(descriptor, os.fstat(descriptor).st_size // 2)  # the part that has reached the disk by then
            os.kill(os.getpid(), signal.SIGKILL)
        flush(descriptor)

    files.os.fsync = fsync  # type: ignore[attr-defined]
    begun = (path / "checkpoint.pt").exists()
    if not begun:
        shutil.rmtree(path, ignore_errors=True)  # killed before its first checkpoint: it starts again
    trainer, folder = training.resume(path) if begun else training.start(_config(method, engine), path)
    training.train(trainer, folder)


@cache
def uninterrupted(method: str, engine: str | None) -> tuple[tuple[bytes, ...], float]:
    """The files of an uninterrupted run, and how long it takes [s]."""
    with tempfile.TemporaryDirectory() as place:
        begin = time.monotonic()
        ended = attempt(lambda: train(Path(place) / "run", method, engine), Path(place), SECONDS)
        assert ended.code == 0, ended.said
        return _left(Path(place) / "run"), time.monotonic() - begin


def _left(run: Path) -> tuple[bytes, ...]:
    return tuple((run / name).read_bytes() for name in ("progress.csv", "policy.pt", "checkpoint.pt"))


def attack(number: int, rng: np.random.Generator, place: Path) -> Verdict:
    """Kill a run one to three times, and compare its final files with those of an uninterrupted run."""
    method, engine = RUNS[number % COUNT]
    expected, seconds = uninterrupted(method, engine)
    kills = []
    for i in range(rng.integers(1, 4)):
        within = number % SAVES == 0 and i == 0
        work = partial(train, place / "run", method, engine, int(rng.integers(3, 18)) if within else 0)
        moment = SECONDS if within else float(rng.uniform(0.0, seconds))
        ended = attempt(work, place, moment, signal.SIGKILL)
        kills.append("too late" if ended.code == 0 else "in a save" if within else "at random")
        if ended.code not in (0, -signal.SIGKILL):
            return Verdict("fault", f"{method} {engine or ''}", ended.said[-2000:], f"exit code {ended.code}")
    ended = attempt(lambda: train(place / "run", method, engine), place, SECONDS)
    what = f"{method}{f', Quad, {engine}' if engine else ''}: killed {', '.join(kills)}"
    if ended.code != 0:
        return Verdict("fault", what, ended.said[-2000:], f"exit code {ended.code}")
    found = _left(place / "run")
    names = ("progress.csv", "policy.pt", "checkpoint.pt")
    differing = [name for name, a, b in zip(names, found, expected, strict=True) if a != b]
    left = [path.name for path in (place / "run").glob("*.partial")]
    fault = f"differs: {', '.join(differing)}" if differing else f"left {left}" if left else ""
    return Verdict("fault" if fault else "bit for bit", what, fault=fault, figures=dict(Counter(kills)))
