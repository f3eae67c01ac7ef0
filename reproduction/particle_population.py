"""Train and evaluate the populations of docs/lab/particle.md, and print its tables.

    python -m reproduction.particle_population runs/population            # trains what is missing, then prints
    python -m reproduction.particle_population runs/population --audit    # adds the audit of the fear network
    python -m reproduction.particle_population runs/pilots --pilots       # the pilots instead: a seed of many settings

Both are studies (``deimos study``): after an interruption the same command continues.
"""

import argparse
import multiprocessing
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from deimos.run import training
from deimos.run.audit import audit_fear
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.study import plan
from deimos.study.cli import RunOptions
from deimos.study.results import Results, Row
from deimos.study.stats import Interval, bootstrap

STUDIES = Path(__file__).parent / "studies"
AUDITED = (1500, 1625, 1750, 1875, 2000)  # parallel steps: the last quarter of training
CONTEXTS = 200


def audit(root: Path, seed: int) -> list[dict]:
    """Train p25 in stages and audit its fear network after each."""
    home, found = RunFolder(root), []
    for steps in AUDITED:
        name = f"audit-s{seed}-{steps}.json"
        if not (root / name).exists():
            path = root / f"audit-s{seed}"
            if (path / "config.json").exists():
                trainer, folder = training.resume(path, steps)
            else:
                config = TrainConfig(method="p25", seed=seed, env_steps=steps, threads=1, evaluation=False)
                trainer, folder = training.start(config, path, None)
            training.train(trainer, folder)
            home.write_json(name, audit_fear(training.load(folder, trainer.config), CONTEXTS))
        found.append(home.read_json(name) | {"seed": seed, "steps": steps})
    return found


def interval(values: np.ndarray) -> Interval:
    """Median with its percentile bootstrap interval; for five seeds it covers at most 94 %, almost their range."""
    return bootstrap([values], lambda x: np.median(x, axis=-1))


def print_populations(rows: list[Row]) -> None:
    """One row per cell: medians over seeds, with the range."""
    groups: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for row in sorted(rows, key=lambda row: row["seed"]):
        goals = "adversary" if row["goals"] == "argmax" else row["goals"]  # its name in version 0.1.0
        groups[row["environment"], row["method"], goals].append(row)
    print("| variant | method | goals | crashes / 1000 (min-max) | crashes per interaction | score (min-max) "
          "| reward | Adversary's AUROC |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for (variant, method, goals), own in groups.items():
        names = ("crashes_per_1000", "crash_rate", "score", "reward", "adversary_auroc")
        rate, crashed, score, reward, aurocs = (np.array([row[name] for row in own]) for name in names)
        weak = sum(bool(row["weak_adversary"] or row.get("uninformed")) for row in own)
        known = aurocs[~np.isnan(aurocs)]
        auroc = f"{np.median(known):.3f}" if len(known) else ""
        auroc += f" ({weak} of {len(own)} uninformed)" if weak else ""
        print(f"| {variant} | {method} | {goals} | {np.median(rate):.3f} ({rate.min():.3f}-{rate.max():.3f}) "
              f"| {np.median(crashed):.4f} | {np.median(score):.3f} ({score.min():.3f}-{score.max():.3f}) "
              f"| {np.median(reward):.4f} | {auroc} |")  # fmt: skip
    both = [groups["directional", "uniform", goals] for goals in ("naive", "adversary")]
    naive, attacked = (np.array([(r["interaction_crashes"] + 0.5) / r["interactions"] for r in part]) for part in both)
    ratio = attacked / naive
    gap = np.array([theirs["crash_rate"] - own["crash_rate"] for own, theirs in zip(*both, strict=True)])
    print(f"\nAdversary / Naive on the Uniform policies of Directional, crashes + 0.5 per non-first interaction: "
          f"median {interval(ratio):.3g}, each {', '.join(f'{x:.3g}' for x in ratio)}. "
          f"Difference in crashes per interaction: median {interval(gap):.3g}.")  # fmt: skip


def print_audits(rows: list[dict]) -> None:
    """The table of the audits of fear; nothing if there are none."""
    if not rows:
        return
    print("\n| seed | parallel steps | contexts | crash rate | AUROC within contexts | 95 % interval |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        print(f"| {row['seed']} | {row['steps']} | {row['contexts']} of {row['tried']} | {row['crash_rate']:.3f} "
              f"| {row['auroc']:.3f} | [{row['low']:.3f}, {row['high']:.3f}] |")  # fmt: skip


def print_pilots(results: Results, environments: list[dict]) -> None:
    """One row per pilot, named by its settings in the study's file other than the variant, as command-line options."""
    print("| variant | differs by | crashes / 1000 in training, by eighths | against Naive | score |")
    print("|---|---|---|---|---|")
    naive = {row["environment"]: row for row in results.rows if row["goals"] == "naive"}
    curves = {row["environment"]: row["crashes_per_1000"] for row in results.curves}
    for each in environments:
        own = {"env": each["env"], "ppo": each["train"].get("ppo", {})}
        flags = " ".join(
            _flag(part, name, value) for part, fields in own.items() for name, value in fields.items()
            if name not in ("kind", "variant")
        )  # fmt: skip
        eighths = ", ".join(f"{part.mean():.2g}" for part in np.array_split(curves[each["name"]], 8))
        row = naive[each["name"]]
        print(f"| {each['env']['variant']} | {f'`{flags}`' if flags else 'defaults'} | {eighths} "
              f"| {row['crashes_per_1000']:.3f} | {row['score']:.3f} |")  # fmt: skip


def _flag(part: str, name: str, value: Any) -> str:
    values = [] if value is True else [f"{x:g}" if isinstance(x, float) else str(x) for x in np.ravel(value).tolist()]
    return " ".join([f"--{part}.{name.replace('_', '-')}", *values])


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--workers", type=int, default=2, help="runs at a time, one thread each")
    parser.add_argument("--audit", action="store_true")
    parser.add_argument("--pilots", action="store_true")
    options = parser.parse_args()
    file = STUDIES / ("pilots.toml" if options.pilots else "population.toml")
    study = plan.read(file)
    RunOptions(folder=options.root, file=file, workers=options.workers).run()
    results = Results.read(options.root)
    if options.pilots:
        print_pilots(results, study["environment"])
        return
    audits: list[dict] = []
    if options.audit:
        with ProcessPoolExecutor(options.workers, multiprocessing.get_context("spawn")) as pool:
            audits = list(chain.from_iterable(pool.map(partial(audit, options.root), range(study["seeds"]))))
    print_populations(results.rows)
    print_audits(audits)
    RunFolder(options.root).write_json("population.json", {"evaluations": results.rows, "audits": audits})


if __name__ == "__main__":
    main()
