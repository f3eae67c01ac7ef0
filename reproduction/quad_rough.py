"""Train a committed flat policy on rough ground and print the table of docs/quad.md or docs/quad_arm.md.

    python -m reproduction.quad_rough runs/rough    # 20 minutes of one core; again to continue
    python -m reproduction.quad_rough runs/rough --figure curve.png
    python -m reproduction.quad_rough runs/rough_arm --preset quad-arm

Per-world rewards and levels of every iteration go to worlds.npz in the run's folder, for intervals over worlds.
"""

import argparse
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from deimos.checks import RunError
from deimos.run import training
from deimos.run.presets import preset
from deimos.sim.legged.config import LocomotionConfig
from deimos.study import stats

RESULTS = Path(__file__).parent.parent / "docs" / "results"
ORIGINS = {"quad": RESULTS / "quad_flat", "quad-arm": RESULTS / "quad_arm_stand"}
RECORDS = ("reward", "level", "invalid", "memory", "seconds")


class Recorder:
    """What progress.csv does not hold: rewards and levels of every world, the process's memory and time."""

    def __init__(self, trainer: training.Trainer, path: Path) -> None:
        self.trainer, self.path = trainer, path
        self.rows: dict[str, list] = {name: [] for name in RECORDS}
        if path.exists():
            with np.load(path) as saved:
                self.rows = {name: list(saved[name][: trainer.iteration]) for name in RECORDS}
        self.before = self.rows["seconds"][-1] if self.rows["seconds"] else 0.0

    def __call__(self, row: dict[str, float], fps: float) -> None:
        """Record the iteration that has just ended."""
        trainer = self.trainer
        self.rows["reward"].append(trainer.rollout.reward.mean(0).numpy().copy())
        self.rows["level"].append(trainer.env.tensors["level"].numpy().copy())
        self.rows["invalid"].append(row["invalid_steps"])
        self.rows["memory"].append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        self.rows["seconds"].append(self.seconds)
        np.savez(self.path.with_suffix(".part.npz"), allow_pickle=False, **self.rows)
        self.path.with_suffix(".part.npz").replace(self.path)
        done, total = trainer.iteration, trainer.config.iterations
        print(f"iteration {done}/{total}, {self.seconds / 60:.1f} min, {fps:.0f} FPS", file=sys.stderr, flush=True)

    @property
    def seconds(self) -> float:
        """Processor time so far [s]; on a machine that does nothing else the time on its clock."""
        return self.before + time.process_time()


def interval(values: np.ndarray) -> str:
    """Mean over worlds with its bootstrap interval."""
    return f"{stats.bootstrap([values], lambda x: x.mean(axis=-1)):+.5f}"


def table(path: Path) -> str:
    """Quarters of the run, as Markdown."""
    with np.load(path) as saved:
        data = {name: saved[name] for name in RECORDS}
    reward, level = data["reward"], data["level"]
    quarters = np.array_split(np.arange(len(reward)), 4)
    lines = ["| quarter | reward per step | mean level | peak memory [MiB] |", "|---|---|---|---|"]
    lines += [
        f"| {i + 1} | {interval(reward[q].mean(0))} | {level[q].mean():.2f} | {data['memory'][q].max():.0f} |"
        for i, q in enumerate(quarters)
    ]
    change = reward[quarters[3]].mean(0) - reward[quarters[0]].mean(0)
    lines += [
        "",
        f"Last quarter less first, over {reward.shape[1]} worlds: {interval(change)}.",
        f"Level {level[0].mean():.2f} after the first iteration, {level[-1].mean():.2f} after the last.",
        f"{int(data['invalid'].sum())} of {reward.size * 24} world-steps invalid.",
        f"{len(reward)} iterations, {data['seconds'][-1] / 60:.1f} minutes.",
    ]
    return "\n".join(lines)


def draw(path: Path, to: Path) -> None:
    """Reward and level over the run, with the deciles of the worlds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with np.load(path) as saved:
        reward, level, minutes = saved["reward"], saved["level"], saved["seconds"] / 60
    kernel = np.ones(10) / 10
    smooth = np.apply_along_axis(np.convolve, 0, reward, kernel, "valid")  # a rollout is half a second of a world
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    for axis, values, when, label in (
        (axes[0], smooth, minutes[9:], "reward per step, mean of 10 iterations"),
        (axes[1], level, minutes, "level"),
    ):
        low, high = np.percentile(values, [10, 90], axis=1)
        axis.fill_between(when, low, high, color="#0072B2", alpha=0.2, linewidth=0, label="deciles of worlds")
        axis.plot(when, values.mean(1), color="#0072B2", label="mean")
        axis.set_xlabel("processor minutes")
        axis.set_ylabel(label)
        axis.legend(frameon=False)
    figure.savefig(to, dpi=110)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--preset", choices=ORIGINS, default="quad")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--start-levels", type=int, default=1)
    parser.add_argument("--figure", type=Path, help="also draw the curves to this file")
    args = parser.parse_args()
    if (args.folder / "config.json").exists():
        trainer, folder = training.resume(args.folder)
    else:
        base = preset(args.preset)
        env = replace(cast(LocomotionConfig, base.env), terrain="rough", noise=False, start_levels=args.start_levels)
        config = replace(
            base, env=env, method="uniform", num_envs=512, env_steps=100_000, seed=args.seed, threads=1,
            evaluation=False, device="cpu",
        )  # fmt: skip
        trainer, folder = training.start(config, args.folder, ORIGINS[args.preset])
    recorder = Recorder(trainer, folder.path / "worlds.npz")
    training.train(trainer, folder, recorder, lambda: recorder.seconds > 60 * args.minutes)
    print(table(recorder.path))
    if args.figure is not None:
        draw(recorder.path, args.figure)


if __name__ == "__main__":
    try:
        main()
    except RunError as error:
        sys.exit(f"error: {error}")
