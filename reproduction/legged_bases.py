"""Train the policies that the legged studies branch off, and the networks of the attacker ``pooled`` that they meet.

    python -m reproduction.legged_bases runs/legged_bases    # five of Quad; again to continue what was killed

A base is trained under Uniform at T10: 4 M transitions on flat ground, then, with these networks, 6 M on rough ground.
Its rough run is what studies branch off. The pool of a base is made from the other bases, so no policy has taught its
own attacker. A file that exists is not written again.
"""

import argparse
import shutil
from dataclasses import replace
from pathlib import Path

import torch

from deimos.learn.policy import load_policy
from deimos.nn.threads import torch_on_one
from deimos.run import training
from deimos.run.attackers.pooled import make_pool
from deimos.run.evaluation import EvalConfig, make_target
from deimos.run.folder import RunFolder
from deimos.run.presets import preset
from deimos.run.trainer import TrainConfig
from reproduction.particle_pool import POOL, note_checksums
from reproduction.runs import finished

BASES = Path(__file__).parent.parent / "docs/results/legged"
KEPT = ("config.json", "checkpoint.pt", "policy.pt", "progress.csv")
SEEDS = (7001, 7002, 7003, 7004, 7005)  # of no other run; base_1 has the first
LONG, SHORT = 500, 100  # T10 and T2 [steps]
FLAT, ROUGH = 4_000_000, 6_000_000  # transitions
ATTACKS = EvalConfig(worlds=512, steps=1500)


def base_config(name: str, transitions: int, seed: int) -> TrainConfig:
    """A preset at T10 under Uniform, with episodes of two goals."""
    config = preset(name)
    env = replace(config.env, goal_period=LONG, episode_steps=2 * LONG)
    return replace(
        config, env=env, method="uniform", env_steps=transitions // config.num_envs, seed=seed, evaluation=False,
        device="cpu", threads=1,
    )  # fmt: skip


def base(index: int, root: Path) -> Path:
    """Train a base, or go on with it; gives the folder that is kept of it."""
    kept = BASES / f"base_{index + 1}"
    if not kept.exists():
        home = root / kept.name
        flat, _ = finished(base_config("quad-walk", FLAT, SEEDS[index]), home / "flat")
        rough, _ = finished(base_config("quad-rough", ROUGH, SEEDS[index]), home / "rough", flat.path)
        shutil.rmtree(home / "kept", ignore_errors=True)
        for name in KEPT:
            (home / "kept").mkdir(exist_ok=True)
            shutil.copy2(rough.path / name, home / "kept" / name)
        kept.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(home / "kept", kept)
    return kept


def pool(folders: list[Path], path: Path) -> None:
    """Make a pool of the policies in ``folders``, at T2 on their own ground."""
    targets = []
    for folder in folders:
        env = training.read_config(RunFolder.open(folder)).env.with_goal_period(SHORT)
        targets.append(make_target(load_policy(folder, "cpu").scaled, env, ATTACKS, torch.device("cpu")))
    with torch_on_one():
        print(path.stem, make_pool(targets, path), flush=True)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, help="where the runs are kept")
    root = parser.parse_args().root
    bases = [base(index, root) for index in range(len(SEEDS))]
    for own in bases:
        path = POOL / f"quad_{own.name}.pt"
        if not path.exists():
            pool([other for other in bases if other != own], path)
    note_checksums()


if __name__ == "__main__":
    main()
