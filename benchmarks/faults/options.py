"""Commands with hostile options: each runs, is stopped, or is refused in one line."""

import functools
import json
import math
import re
import shutil
import tempfile
from pathlib import Path

import numpy as np
import torch

from benchmarks.faults.trial import Ended, Verdict, attempt, judged
from deimos.app import cli
from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.evaluation import EvalConfig
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle

COUNT = 500
SECONDS = 40.0
STUDY = Path(__file__).parent / "study.toml"
TRAIN = (
    "train --num-envs 8 --env-steps 32 --ppo.num-steps 8 --ppo.minibatches 2 --ppo.hidden 8 --device cpu --threads 1 "
    "--no-evaluation --out run"
)
COMMANDS = {
    **{f"train {selector}": f"{TRAIN} env:particle selector:{selector}" for selector in (
        "director", "uniform", "plr", "rnd", "vds", "cl", "grid", "q-fear", "learnability", "weighted")},
    "train quad": f"{TRAIN} env:quad selector:none",
    "evaluate": "evaluate known --device cpu --worlds 8 --steps 32",
    "study run": f"study run study --file {STUDY} --allow-uncommitted --estimate",
    "pool": "pool known --out pool.pt --worlds 8 --adversary-steps 32 --device cpu",
    "play": "play known --out pictures",
    "terrain shape": "terrain shape stairs-up --out ground.npz",
    "terrain grid": "terrain grid --out ground.npz",
}  # fmt: skip
"""Valid commands, by the words with which their help is requested."""
NUMBERS = [
    "0", "1", "2", "3", "-1", "0.5", "-0.5", "1.5", "-0.0", "2147483647", "2147483648", "4294967296", "1000000000",
    "1" + "0" * 30, "1e9", "1e-300", "1e308", "nan", "inf", "-inf",
]  # fmt: skip
TEXTS = [
    "", " ", "x", "None", "True", "[]", "{}", "a,b", "0x10", "1_0", "é", "\u202e", "..", "../..", "/dev/zero",
    "/dev/full", "$(x)", "%s", "[/red]", "<script>", "9" * 400, "uniform", "p75", "argmax", "auto", "cpu",
]  # fmt: skip


def known_run(path: Path) -> None:
    """Train the run that commands work on."""
    config = TrainConfig(
        env=particle.Config(goal_period=8), method="p75", ppo=PPOConfig(hidden=(8,), num_steps=8, minibatches=2),
        eval=EvalConfig(worlds=8, steps=32, adversary_steps=32), evaluation=False, num_envs=16, env_steps=64,
        device="cpu", threads=1,
    )  # fmt: skip
    trainer, folder = training.start(config, path)
    training.train(trainer, folder)
    torch.set_num_threads(1)


def run(arguments: list[str], place: Path) -> Ended:
    """A command of ``deimos`` in a folder."""
    return attempt(lambda: cli.main(arguments), place, SECONDS)


@functools.cache
def flags(words: str) -> list[str]:
    """All options that a command's help lists."""
    with tempfile.TemporaryDirectory() as place:
        run([*COMMANDS[words].split(), "--help"], Path(place))
        text = (Path(place) / "stdout.txt").read_text()
    return sorted({flag for flag in re.findall(r"(?<!\S)(--[a-z][\w.-]*\w)", text)} - {"--help", "--resume"})


@functools.cache
def known() -> Path:
    """A folder with the run that commands work on."""
    place = Path(tempfile.mkdtemp(prefix="deimos-faults-"))
    known_run(place / "known")
    return place / "known"


def attack(number: int, rng: np.random.Generator, place: Path) -> Verdict:
    """Give a command one to three unusual options."""
    words = list(COMMANDS)[number % len(COMMANDS)]
    if "known" in COMMANDS[words]:
        shutil.copytree(known(), place / "known")
    arguments = COMMANDS[words].split()
    for _ in range(rng.integers(1, 4)):
        values = NUMBERS if rng.random() < 0.7 else TEXTS
        arguments.append(str(rng.choice(flags(words))))
        arguments += [str(value) for value in rng.choice(values, rng.choice([0, 1, 1, 1, 1, 2]))]
    ended = run(arguments, place)
    verdict = judged(" ".join(map(repr, ["deimos", *arguments])), ended)
    if ended.code == 0 and (nonsense := _nonsense(place)):
        return Verdict("fault", verdict.what, verdict.said, nonsense)
    return verdict


def _nonsense(place: Path) -> str:
    """What is wrong with the files that a command has written."""
    for path in place.glob("run/config.json"):
        if text := re.search(r"NaN|Infinity", path.read_text()):
            return f"{path.name} holds {text[0]}"
        stack = [json.loads(path.read_text())["config"]]
        while stack:
            value = stack.pop()
            if isinstance(value, float) and not math.isfinite(value):
                return f"{path.name} holds {value}"
            stack += value.values() if isinstance(value, dict) else value if isinstance(value, list) else []
    left = [path.name for path in place.rglob("*.partial")]
    return f"left {left[0]} behind" if left else ""
