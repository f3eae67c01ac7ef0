"""Train the policies that the legged studies branch off, and the networks of the attacker ``pooled`` used on them.

    python -m reproduction.legged_bases runs/legged_bases    # eight; repeat it to continue after a kill
    python -m reproduction.legged_bases runs/legged_bases --robots quad

A base is trained under Uniform, in two stages, the second starting from the first one's networks; studies branch off
the second. Its policy is evaluated under uniform goals before anything branches off. The pool of a base is made from
the other bases of its robot, so no policy has trained its own attacker. A file that exists is not written again.
"""

import argparse
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from deimos.learn.policy import load_policy
from deimos.nn.threads import torch_on_one
from deimos.run import training
from deimos.run.attackers.pooled import make_pool
from deimos.run.evaluation import EvalConfig, evaluate_run, make_target
from deimos.run.folder import RunFolder
from deimos.run.presets import preset
from deimos.run.trainer import TrainConfig
from deimos.sim.shared import one_stream
from reproduction.particle_pool import POOL, note_checksums
from reproduction.runs import finished

KEPT_IN = Path(__file__).parent.parent / "docs/results/legged"
KEPT = ("config.json", "checkpoint.pt", "policy.pt", "progress.csv")
LONG, SHORT = 500, 100  # T10 and T2 [steps]
ATTACKS = EvalConfig(worlds=400, steps=2000, adversary_steps=2000)  # two robots on every tile of the ground


@dataclass(frozen=True)
class Bases:
    """The bases of a robot."""

    seeds: tuple[int, ...]
    """Seeds that no other run uses; the first base has the first."""
    stages: tuple[tuple[str, int], ...]
    """Presets and transitions, one after the other."""
    period: int
    """T in their training [steps]."""
    judged: tuple[int, ...]
    """The T of their evaluations [steps]."""


ROBOTS: Mapping[str, Bases] = {
    # As the thesis trains them: T10, and episodes of two goals.
    "quad": Bases(
        (7001, 7002, 7003, 7004, 7005), (("quad-walk", 4_000_000), ("quad-rough", 6_000_000)), LONG, (SHORT, LONG)
    ),
    # As in the presets (docs/lab/quad_arm.md), whose goals of two seconds make it walk and reach.
    "quad_arm": Bases(
        (7101, 7102, 7103), (("quad-arm-walk", 4_030_464), ("quad-arm-reach", 6_144_000)), SHORT, (SHORT,)
    ),
}  # fmt: skip


def base_name(robot: str, index: int) -> str:
    """Name of a base's folder and of the file of its pool; studies call the first one 1."""
    return f"{robot}_base_{index + 1}"


def base_config(bases: Bases, stage: int, index: int) -> TrainConfig:
    """A stage of a base: its preset under Uniform, with goals of the bases' T and episodes of at least two goals."""
    name, transitions = bases.stages[stage]
    config = preset(name)
    env = replace(
        config.env, goal_period=bases.period, episode_steps=max(config.env.episode_steps, 2 * bases.period)
    )  # fmt: skip
    return replace(
        config, env=env, method="uniform", env_steps=transitions // config.num_envs, seed=bases.seeds[index],
        evaluation=False, device="cpu", threads=1,
    )  # fmt: skip


def base(robot: str, index: int, root: Path) -> Path:
    """Train a base, or continue it, and evaluate it; returns the folder that is kept."""
    bases = ROBOTS[robot]
    kept = KEPT_IN / base_name(robot, index)
    if not kept.exists():
        home, last = root / kept.name, None
        for stage, (name, _) in enumerate(bases.stages):
            folder, _ = finished(base_config(bases, stage, index), home / name, last)
            last = folder.path
        shutil.rmtree(home / "kept", ignore_errors=True)
        for name in KEPT:
            (home / "kept").mkdir(exist_ok=True)
            shutil.copy2(folder.path / name, home / "kept" / name)
        kept.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(home / "kept", kept)
    judge(kept, bases.judged)
    return kept


def judge(folder: Path, periods: tuple[int, ...]) -> list[dict]:
    """The rows of a base under uniform goals, for each T; they are stored in its folder."""
    run, device = RunFolder.open(folder), torch.device("cpu")
    env = training.read_config(run).env
    naive = replace(ATTACKS, attackers=())
    with one_stream(device):
        return [
            row for period in periods
            for row in evaluate_run(run, env.with_goal_period(period), naive, device, again=False)
        ]  # fmt: skip


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
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=list(ROBOTS))
    options = parser.parse_args()
    for robot in options.robots:
        folders = [base(robot, index, options.root) for index in range(len(ROBOTS[robot].seeds))]
        for own in folders:
            path = POOL / f"{own.name}.pt"
            if not path.exists():
                pool([other for other in folders if other != own], path)
    note_checksums()


if __name__ == "__main__":
    main()
