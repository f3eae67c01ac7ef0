"""Train and evaluate the populations of docs/lab/particle.md, and print its tables.

    python -m reproduction.particle_population runs/population            # trains what is missing, then prints
    python -m reproduction.particle_population runs/population --audit    # adds the audit of the fear network
    python -m reproduction.particle_population runs/population --pilots   # the pilots instead: a seed of many settings

A run that was killed continues from its checkpoint when the command is given again.
"""

import argparse
import csv
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

SEEDS = range(5)
STEPS = {"directional": 2000, "relative": 2000, "absolute": 5000}  # thesis, 4.5.1
CELLS = [(variant, "uniform") for variant in STEPS] + [
    ("directional", method) for method in ("p25", "coop", "antagonist")
]
AUDITED = [1500, 1625, 1750, 1875, 2000]  # parallel steps: the last quarter of training
RESAMPLES = 10_000
PILOTS = [  # each under Uniform goals, seed 0: variant and what differs from the defaults
    ("directional", ""),
    ("directional", "--env.reward reciprocal"),
    ("directional", "--env.reward exponential --env.reward-length 5"),
    ("directional", "--env.max-force inf"),
    ("directional", "--env.max-speed 5"),
    ("directional", "--env.max-speed 20"),
    ("directional", "--env.goal-period 50"),
    ("directional", "--env.stagger-goals"),
    ("directional", "--env.obs-scale raw"),
    ("directional", "--ppo.activation elu"),
    ("directional", "--ppo.hidden 128 128"),
    ("directional", "--ppo.reward-scale 1"),
    ("directional", "--ppo.num-steps 16"),
    ("directional", "--ppo.num-steps 48"),
    ("directional", "--ppo.entropy-coef 0"),
    ("relative", "--env.reward reciprocal"),
    ("absolute", "--env.reward reciprocal"),
]


def run(folder: Path, options: list[str]) -> None:
    """Train and evaluate one policy, or continue with it, unless its evaluation is there."""
    if (folder / "evaluation.json").exists():
        return
    begun = (folder / "checkpoint.pt").exists()
    choice = ["--resume", str(folder)] if begun else ["--out", str(folder), "--threads", "1", *options]
    subprocess.run([sys.executable, "train.py", *choice], check=True, stdout=subprocess.DEVNULL)
    print("finished", folder, file=sys.stderr, flush=True)


def cell(root: Path, variant: str, method: str, seed: int) -> None:
    """One policy of the populations."""
    options = ["--method", method, "--seed", str(seed), "--env-steps", str(STEPS[variant]), "--env.variant", variant]
    run(root / f"{variant}-{method}-s{seed}", options)


def pilot(root: Path, number: int) -> str:
    """Train and evaluate one pilot; returns its row of the table."""
    variant, changes = PILOTS[number]
    folder = root / f"pilot-{number:02d}"
    options = ["--method", "uniform", "--env-steps", str(STEPS[variant]), "--env.variant", variant]
    run(folder, [*options, *changes.split()])
    naive = json.loads((folder / "evaluation.json").read_text())[0]
    with (folder / "progress.csv").open() as file:
        crashes = [float(row["crashes_per_1000"]) for row in csv.DictReader(file)]
    eighths = [np.mean(part) for part in np.array_split(crashes, 8)]
    return (f"| {variant} | {f'`{changes}`' if changes else 'defaults'} | {', '.join(f'{x:.2g}' for x in eighths)} "
            f"| {naive['crashes_per_1000']:.3f} | {naive['score']:.3f} |")  # fmt: skip


def audit(root: Path, seed: int) -> list[dict]:
    """Train p25 in stages and audit its fear network after each."""
    folder, found = root / f"audit-s{seed}", []
    for steps in AUDITED:
        kept = root / f"audit-s{seed}-{steps}.json"
        if not kept.exists():
            start = ["--method", "p25", "--seed", str(seed), "--threads", "1", "--no-evaluation", "--out", str(folder)]
            begin = ["--resume", str(folder)] if (folder / "config.json").exists() else start
            subprocess.run(
                [sys.executable, "train.py", *begin, "--env-steps", str(steps)], check=True, capture_output=True
            )
            command = [sys.executable, "-m", "deimos", "evaluate", str(folder), "--contexts", "200"]
            subprocess.run(command, check=True, capture_output=True)
            kept.write_text((folder / "audit.json").read_text())
        found.append(json.loads(kept.read_text()) | {"seed": seed, "steps": steps})
    return found


def interval(values: np.ndarray) -> str:
    """Percentile bootstrap interval of the median; five seeds cover at most 94 %, and it is all but their range."""
    picks = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.quantile(np.median(values[picks], axis=1), [0.025, 0.975])
    return f"[{low:.3g}, {high:.3g}]"


def print_tables(root: Path) -> None:
    """One row per cell: medians over seeds, with the range."""
    print("| variant | method | goals | crashes / 1000 (min-max) | crashes per interaction | score (min-max) "
          "| reward | Adversary's AUROC |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for variant, method in CELLS:
        runs = [json.loads((root / f"{variant}-{method}-s{s}" / "evaluation.json").read_text()) for s in SEEDS]
        for i, goals in enumerate(("naive", "adversary")):
            column = {
                name: np.array([r[i][name] for r in runs])
                for name in ("crashes_per_1000", "crash_rate", "score", "reward")
            }
            rate, score = column["crashes_per_1000"], column["score"]
            score_cell = f"{np.median(score):.3f} ({score.min():.3f}-{score.max():.3f})"
            aurocs = [np.nan if r[1]["adversary_auroc"] is None else r[1]["adversary_auroc"] for r in runs]
            weak = sum(r[1]["weak_adversary"] for r in runs)
            auroc = f"{np.nanmedian(aurocs):.3f}{f' ({weak} of {len(runs)} weak)' if weak else ''}" if i else ""
            print(f"| {variant} | {method} | {goals} | {np.median(rate):.3f} ({rate.min():.3f}-{rate.max():.3f}) "
                  f"| {np.median(column['crash_rate']):.4f} | {score_cell} "
                  f"| {np.median(column['reward']):.4f} | {auroc} |")  # fmt: skip
    runs = [json.loads((root / f"directional-uniform-s{s}" / "evaluation.json").read_text()) for s in SEEDS]
    naive, attacked = (
        np.array([(r[i]["interaction_crashes"] + 0.5) / r[i]["interactions"] for r in runs]) for i in (0, 1)
    )
    ratio = attacked / naive
    gap = np.array([r[1]["crash_rate"] - r[0]["crash_rate"] for r in runs])
    print(f"\nAdversary / Naive on the Uniform policies of Directional, crashes + 0.5 per non-first interaction: "
          f"median {np.median(ratio):.3g} {interval(ratio)}, each {', '.join(f'{x:.3g}' for x in ratio)}. "
          f"Difference in crashes per interaction: median {np.median(gap):.4f} {interval(gap)}.")  # fmt: skip


def write_rows(root: Path, audits: list[list[dict]]) -> None:
    """Keep what the tables are made of in ``population.json``."""
    names = [f"{variant}-{method}-s{seed}" for variant, method in CELLS for seed in SEEDS]
    evaluations = [
        {"run": name} | row for name in names for row in json.loads((root / name / "evaluation.json").read_text())
    ]
    rows = {"evaluations": evaluations, "audits": [row for found in audits for row in found]}
    (root / "population.json").write_text(json.dumps(rows, indent=1) + "\n")


def print_audits(rows: list[dict]) -> None:
    """The table of the audits of fear; nothing where there are none."""
    if not rows:
        return
    print("\n| seed | parallel steps | contexts | crash rate | AUROC within contexts | 95 % interval |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        print(f"| {row['seed']} | {row['steps']} | {row['contexts']} of {row['tried']} | {row['crash_rate']:.3f} "
              f"| {row['auroc']:.3f} | [{row['low']:.3f}, {row['high']:.3f}] |")  # fmt: skip


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--workers", type=int, default=2, help="runs at a time, one thread each")
    parser.add_argument("--audit", action="store_true")
    parser.add_argument("--pilots", action="store_true")
    options = parser.parse_args()
    if options.pilots:
        with ThreadPoolExecutor(options.workers) as pool:
            rows = list(pool.map(lambda number: pilot(options.root, number), range(len(PILOTS))))
        print("| variant | differs by | crashes / 1000 in training, by eighths | against Naive | score |")
        print("|---|---|---|---|---|")
        print("\n".join(rows))
        return
    jobs = [(options.root, variant, method, seed) for seed in SEEDS for variant, method in CELLS]
    with ThreadPoolExecutor(options.workers) as pool:
        list(pool.map(lambda job: cell(*job), jobs))
        audits = list(pool.map(lambda seed: audit(options.root, seed), SEEDS)) if options.audit else []
    print_tables(options.root)
    write_rows(options.root, audits)
    print_audits([row for rows in audits for row in rows])


if __name__ == "__main__":
    main()
