"""From scratch to a walking robot: train a preset over seeds, and print the tables of docs/lab/quad.md.

    python -m reproduction.quad_walk runs/walk --seeds 1 2 3 4 5 --engines native warp    # repeat to continue
    python -m reproduction.quad_walk runs/walk --engines native warp --worlds 512    # the policies in both simulators
    python -m reproduction.quad_walk runs/both --preset quad-arm-walk    # walks and reaches: docs/lab/quad_arm.md
    python -m reproduction.quad_walk runs/pilot --seeds 1 --minutes 3 --change '{"ppo": {"desired_kl": 0.02}}'

Every run is that of ``python train.py --preset NAME --seed SEED``, on one thread and without the evaluation at its
end. The processor time so far goes to processor.csv in the run's folder, with the tracking of every iteration.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from scipy import stats

from deimos.checks import RunError
from deimos.run import presets, training
from deimos.run.config import from_dict, to_dict
from deimos.run.evaluation import EvalConfig, evaluate_run
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.legged.config import LocomotionConfig
from deimos.sim.legged.engines import PhysicsConfig
from deimos.study.factors import merged

METER = "processor.csv"
GOAL_PERIOD = 100  # steps; two seconds, T2
EVALUATION = EvalConfig(worlds=256, steps=1000, attackers=())


class Meter:
    """The processor time of a run, user and system, over all its continuations."""

    def __init__(self, trainer: training.Trainer, folder: RunFolder, start: float) -> None:
        self.folder, self.start = folder, start
        folder.cut_csv(METER, trainer.iteration)
        rows = folder.read_csv(METER)
        self.before = float(rows[-1]["seconds"]) if rows else 0.0
        config = cast(LocomotionConfig, trainer.config.env)
        weights, period = config.rewards, config.physics.control_period
        self.most = {name: getattr(weights, name) * period for name in ("linear_tracking", "yaw_tracking")}

    def __call__(self, row: dict[str, float], fps: float) -> None:
        """Record an iteration, with its tracking as a share of perfect tracking."""
        tracking = {name: row[f"reward/{name}"] / most for name, most in self.most.items()}
        kept = {name: row[name] for name in ("iteration", "transitions")}
        self.folder.append_csv(METER, kept | {"seconds": self.seconds} | tracking)

    @property
    def seconds(self) -> float:
        """Time so far [s], including building the worlds."""
        return self.before + time.process_time() - self.start


def train(config: TrainConfig, path: Path, minutes: float) -> float:
    """Train, or continue, until the transitions or ``minutes`` are used up; returns the processor time [s]."""
    start, known = time.process_time(), (path / "config.json").exists()
    trainer, folder = training.resume(path) if known else training.start(config, path, None)
    meter = Meter(trainer, folder, start)
    training.train(trainer, folder, meter, lambda: meter.seconds > 60 * minutes)
    return meter.seconds


def evaluate(path: Path, engine: str, worlds: int) -> dict:
    """The row of uniform goals at T2 on an engine; it is stored in the run's folder."""
    folder = RunFolder.open(path)
    env = cast(LocomotionConfig, training.read_config(folder).env.with_goal_period(GOAL_PERIOD))
    env = replace(env, engine=cast(Any, engine))
    setting = replace(EVALUATION, worlds=worlds)
    return evaluate_run(folder, env, setting, torch.device("cpu"), again=False)[0]


def cells(row: dict) -> str:
    """Linear and yaw tracking, crashes per robot-minute with their exact 95 % interval, median errors if there are."""
    minutes = row["worlds"] * row["steps"] * PhysicsConfig().control_period / 60
    low = stats.chi2.ppf(0.025, 2 * row["crashes"]) / 2 / minutes if row["crashes"] else 0.0
    high = stats.chi2.ppf(0.975, 2 * row["crashes"] + 2) / 2 / minutes
    linear, yaw = row["tracking"][:2]
    errors = "".join(f" | {error:.3f}" for error in row["errors"].values())
    return f"{linear:.3f} | {yaw:.3f} | {row['crashes'] / minutes:.2f} [{low:.2f}, {high:.2f}]{errors}"


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--preset", default="quad-walk")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--minutes", type=float, default=60.0, help="most processor time of a run")
    parser.add_argument("--change", type=json.loads, default={}, help="fields that differ from the preset's, as JSON")
    parser.add_argument("--engines", nargs="*", choices=["native", "warp"], default=["native"])
    parser.add_argument("--worlds", type=int, default=EVALUATION.worlds, help="robots that a policy is evaluated with")
    args = parser.parse_args()
    base = from_dict(TrainConfig, merged(to_dict(presets.preset(args.preset)), args.change))
    for seed in args.seeds:
        path = args.folder / f"seed_{seed}"
        seconds = train(replace(base, seed=seed, threads=1, evaluation=False, device="cpu"), path, args.minutes)
        rows = [cells(evaluate(path, engine, args.worlds)) for engine in args.engines]
        print(f"| {seed} | {seconds / 60:.1f} | " + " | ".join(rows) + " |", flush=True)


if __name__ == "__main__":
    try:
        main()
    except RunError as error:
        sys.exit(f"error: {error}")
