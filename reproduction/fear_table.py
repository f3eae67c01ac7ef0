"""How well does fear rank goals within a context, late in training, depending on its data? Prints a table.

    python -m reproduction.fear_table runs/fear_table.csv                                 # 60 training runs
    python -m reproduction.fear_table runs/try.csv --seeds 1000 --methods p75 p75-literal --variants directional

Every method is trained in every variant with every seed. At five points of the last quarter a copy of the run is
audited: the exact outcomes of 50 candidates in each of at most 200 contexts with both outcomes, from clones. A run that
is already in the file is not trained again.
"""

import argparse
import copy
import csv
import math
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from scipy import stats

from deimos.checks import RunError
from deimos.goals.methods import method
from deimos.run.audit import audit_fear
from deimos.run.trainer import TrainConfig, Trainer
from deimos.run.training import cores
from deimos.sim.envs import particle
from deimos.study.audits import points

METHODS = ("p25-literal", "p25-threshold", "p25", "p75-literal", "p75-threshold", "p75")
VARIANTS = {"directional": 2000, "absolute": 5000}  # and the steps of a training run, as in the thesis
CONTEXTS = 200  # with both outcomes, at most so many at every point
BAR, FLOOR = 0.8, 0.7  # aims: for the mean over seeds, and the value that hardly any point should be below


def measure(name: str, variant: str, seed: int) -> dict[str, object]:
    """Train once, and audit the fear network along the way.

    Returns:
        ``auroc`` and ``contexts`` at every point, the former NaN if no context had both outcomes; ``waited``, the
        rollouts from the first crash of an interaction to the first fit; ``fitted``, the share of the rollouts since
        then in which fear was fitted; and ``percentile``, the mean delivered dose.
    """
    config = TrainConfig(
        env=particle.Config(variant=variant), selector=method(name), seed=seed, env_steps=VARIANTS[variant],
        evaluation=False,
    )  # fmt: skip
    trainer = Trainer(config, torch.device("cpu"))
    count = config.iterations
    rows, auroc, contexts = [], [], []
    while trainer.iteration < count:
        rows.append(trainer.iterate())
        if trainer.iteration in points(count):
            other = Trainer(config, torch.device("cpu"))
            other.load_state_dict(copy.deepcopy(trainer.state_dict()))
            try:
                found = audit_fear(other, CONTEXTS)
            except RunError:
                found = {"auroc": math.nan, "contexts": 0}
            auroc.append(round(found["auroc"], 4))
            contexts.append(min(found["contexts"], CONTEXTS))
    crashed = [row["fear/crash_rate"] > 0 for row in rows]
    fitted = [math.isfinite(row["fear/loss"]) for row in rows]
    first, crash = (column.index(True) if True in column else count for column in (fitted, crashed))
    return {
        "method": name, "variant": variant, "seed": seed,
        "auroc": " ".join(map(str, auroc)), "contexts": " ".join(map(str, contexts)),
        "waited": first - crash, "fitted": round(sum(fitted) / max(1, count - first), 4),
        "percentile": round(sum(row["goal_percentile"] for row in rows) / len(rows), 2),
    }  # fmt: skip


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="where the rows are kept")
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--seeds", type=int, nargs="+", default=range(5))
    parser.add_argument("--threads", type=int, default=cores())
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    known = read(args.file)
    for seed in args.seeds:
        for variant in args.variants:
            for name in args.methods:
                if (name, variant, str(seed)) not in {(row["method"], row["variant"], row["seed"]) for row in known}:
                    write(args.file, measure(name, variant, seed))
    show(read(args.file))


def read(path: Path) -> list[dict[str, str]]:
    """The rows in the file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, row: dict[str, object]) -> None:
    """Add a row."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, row)
        if new:
            writer.writeheader()
        writer.writerow(row)


def show(rows: list[dict[str, str]]) -> None:
    """Print a line for every method in every variant; the interval is Student's over seeds, at 95 %."""
    table = Table(title="AUROC of fear within contexts in the last quarter", title_justify="left")
    for name in (
        "variant",
        "method",
        "seeds",
        "mean",
        "95 %",
        "lowest",
        f"below {FLOOR}",
        "contexts",
        "waited",
        "fitted",
        "dose",
    ):
        table.add_column(name, justify="left" if name in ("variant", "method") else "right")
    for variant, name in sorted({(row["variant"], row["method"]) for row in rows}):
        own = [row for row in rows if (row["variant"], row["method"]) == (variant, name)]
        aurocs = [[float(x) for x in row["auroc"].split() if x != "nan"] for row in own]
        means = [math.fsum(values) / len(values) for values in aurocs if values]
        every = [value for values in aurocs for value in values]
        if not every:
            continue
        center, half = math.fsum(means) / len(means), math.nan
        if len(means) > 1:
            half = stats.t.ppf(0.975, len(means) - 1) * stats.sem(means)
        contexts = sum(int(x) for row in own for x in row["contexts"].split())
        dose, fitted = (sum(float(row[column]) for row in own) / len(own) for column in ("percentile", "fitted"))
        waited = max(int(row["waited"]) for row in own)
        table.add_row(
            variant, name, str(len(own)), f"{center:.3f}" + (" *" if center < BAR else ""),
            f"{center - half:.3f}-{center + half:.3f}", f"{min(every):.3f}",
            f"{sum(value < FLOOR for value in every)} of {len(every)}", str(contexts), str(waited), f"{fitted:.1%}",
            f"{dose:.1f}",
        )  # fmt: skip
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
