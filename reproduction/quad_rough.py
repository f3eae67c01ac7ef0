"""Train a policy that walks on rough ground, and print the tables of docs/lab/quad.md.

    python train.py --preset quad-walk --seed 1 --out runs/walk    # five minutes of one core
    python -m reproduction.quad_rough runs/rough --init-from runs/walk --seed 1    # an hour; repeat it to continue
    python -m reproduction.quad_rough runs/rough --minutes 0 --figure rough.png    # tables and curves of that run
    python -m reproduction.quad_rough runs/pilot --init-from runs/walk --minutes 8 --change '{"num_envs": 1024}'

The run is that of ``python train.py --preset quad-rough --init-from RUN``, on one thread and without the evaluation at
its end, stopped after ``--minutes`` of processor time. Per-world rewards and levels of every iteration go to worlds.npz
in the run's folder, for intervals over worlds.
"""

import argparse
import json
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from deimos.checks import RunError
from deimos.run import training
from deimos.run.config import from_dict, to_dict
from deimos.run.evaluation import EvalConfig, evaluate_run
from deimos.run.folder import RunFolder
from deimos.run.presets import preset
from deimos.run.trainer import TrainConfig
from deimos.study import stats
from deimos.study.factors import merged

RECORDS = ("reward", "level", "invalid", "memory", "seconds")
EVALUATION = EvalConfig(worlds=1000, steps=1000, attackers=())  # five robots on every tile of the grid


class Recorder:
    """Data that progress.csv lacks: rewards and levels of every world, the process's memory and time."""

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
        level = self.rows["level"][-1].mean()
        print(
            f"iteration {done}/{total}, level {level:.2f}, {self.seconds / 60:.1f} min, {fps:.0f} FPS",
            file=sys.stderr, flush=True,
        )  # fmt: skip

    @property
    def seconds(self) -> float:
        """Processor time so far [s]; on an otherwise idle machine it equals wall-clock time."""
        return self.before + time.process_time()


def interval(values: np.ndarray) -> str:
    """Mean over worlds with its bootstrap interval."""
    return f"{stats.bootstrap([values], lambda x: x.mean(axis=-1)):+.5f}"


def table(path: Path) -> str:
    """Quarters of the run, as Markdown."""
    with np.load(path) as saved:
        data = {name: saved[name] for name in RECORDS}
    reward, level = data["reward"], data["level"]
    quarters = [quarter for quarter in np.array_split(np.arange(len(reward)), 4) if len(quarter)]
    lines = ["| quarter | reward per step | mean level | peak memory [MiB] |", "|---|---|---|---|"]
    lines += [
        f"| {i + 1} | {interval(reward[q].mean(0))} | {level[q].mean():.2f} | {data['memory'][q].max():.0f} |"
        for i, q in enumerate(quarters)
    ]
    change = reward[quarters[-1]].mean(0) - reward[quarters[0]].mean(0)
    lines += [
        "",
        f"Last quarter less first, over {reward.shape[1]} worlds: {interval(change)}.",
        f"Level {level[0].mean():.2f} after the first iteration, {level[-1].mean():.2f} after the last.",
        f"{int(data['invalid'].sum())} of {reward.size * 24} world-steps invalid.",
        f"{len(reward)} iterations, {data['seconds'][-1] / 60:.1f} minutes.",
    ]
    return "\n".join(lines)


def evaluate(path: Path) -> dict:
    """The row of uniform goals on the terrain, each goal lasting as long as in training; it is stored in the folder."""
    folder = RunFolder.open(path)
    return evaluate_run(folder, training.read_config(folder).env, EVALUATION, torch.device("cpu"), again=False)[0]


def tiles(row: dict) -> str:
    """Results of an evaluation on every level of every kind of ground, as Markdown.

    Shares of the goals that robots survived, with linear tracking in parentheses; the means weight tiles by their
    worlds.
    """
    found = {tuple(name.rsplit(" ", 1)): stratum for name, stratum in row["strata"].items()}
    kinds = [*sorted({kind for kind, _ in found}), "all"]
    levels = [*sorted({level for _, level in found}, key=int), "all"]

    def cell(kind: str, level: str) -> str:
        rows = [stratum for (k, n), stratum in found.items() if kind in (k, "all") and level in (n, "all")]
        worlds = [stratum["worlds"] for stratum in rows]
        success = np.average([stratum["success"] for stratum in rows], weights=worlds)
        return f"{success:.2f} ({np.average([stratum['tracking'][0] for stratum in rows], weights=worlds):.2f})"

    lines = [f"| ground | {' | '.join(levels)} |", "|---" * (len(levels) + 1) + "|"]
    return "\n".join(lines + [f"| {kind} | {' | '.join(cell(kind, level) for level in levels)} |" for kind in kinds])


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
    parser.add_argument("--preset", default="quad-rough")
    parser.add_argument("--init-from", type=Path, help="folder of a run whose networks a new run starts with")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60.0, help="most processor time of the run")
    parser.add_argument("--change", type=json.loads, default={}, help="fields that differ from the preset's, as JSON")
    parser.add_argument("--figure", type=Path, help="also draw the curves to this file")
    args = parser.parse_args()
    if (args.folder / "config.json").exists():
        trainer, folder = training.resume(args.folder)
    else:
        base = from_dict(TrainConfig, merged(to_dict(preset(args.preset)), args.change))
        config = replace(base, seed=args.seed, threads=1, evaluation=False, device="cpu")
        trainer, folder = training.start(config, args.folder, args.init_from)
    recorder = Recorder(trainer, folder.path / "worlds.npz")
    if recorder.before <= 60 * args.minutes:
        training.train(trainer, folder, recorder, lambda: recorder.seconds > 60 * args.minutes)
    print(f"{table(recorder.path)}\n\n{tiles(evaluate(folder.path))}")
    if args.figure is not None:
        draw(recorder.path, args.figure)


if __name__ == "__main__":
    try:
        main()
    except RunError as error:
        sys.exit(f"error: {error}")
