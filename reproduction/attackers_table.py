"""Every attacker on Uniform policies of each variant of Particle, and on two planted policies: docs/lab/attackers.md.

    python -m reproduction.attackers_table runs/attackers                                  # after particle_pool
    python -m reproduction.attackers_table runs/attackers --variants directional --show    # prints the existing results

After an interruption the same command continues.
"""

import argparse
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import torch
from scipy import stats

from deimos.run.attack import Policy, names
from deimos.run.evaluation import EvalConfig, evaluate, worst
from deimos.run.folder import RunFolder
from deimos.sim.envs import particle
from reproduction.particle_pool import POOL, VARIANTS
from reproduction.runs import finished

SEEDS = (0, 1, 2)
PLANTED_WORLDS = 200
CPU = torch.device("cpu")


def attacks(variant: str) -> EvalConfig:
    """The evaluation by all attackers."""
    return EvalConfig(attackers=tuple(names()), pool=POOL / f"{variant}.pt")


def planted(variant: str) -> dict[str, Policy]:
    """A policy that never moves and one that follows its goals and never brakes."""
    env = VARIANTS[variant].env
    assert isinstance(env, particle.Config)
    blind = env.build(1, CPU, 0).reference_policy(brake=False)
    return {"stays at the origin": lambda obs: torch.zeros(len(obs), 3), "never brakes": blind}


def measure(root: Path, variant: str) -> None:
    """Train and evaluate the missing policies of a variant."""
    for seed in SEEDS:
        config = replace(VARIANTS[variant], method="uniform", seed=seed, eval=attacks(variant))
        finished(config, root / f"{variant}-s{seed}")
    sizes = replace(attacks(variant), worlds=PLANTED_WORLDS)
    for name, policy in planted(variant).items():
        if not (root / _file(variant, name)).exists():
            rows = evaluate(policy, VARIANTS[variant].env, sizes, CPU)
            RunFolder(root).write_json(_file(variant, name), rows)


def _file(variant: str, name: str) -> str:
    return f"{variant} {name}.json".replace(" ", "-")


def read(root: Path, variant: str) -> tuple[list[list[dict]], dict[str, list[dict]]]:
    """Rows of the Uniform policies, and of the planted ones by name, as far as they exist."""
    folders = [RunFolder(root / f"{variant}-s{seed}") for seed in SEEDS]
    policies = [
        _newest(each.read_json("evaluation.json")) for each in folders if (each.path / "evaluation.json").exists()
    ]
    own = {name: _file(variant, name) for name in planted(variant)}
    return policies, {name: RunFolder(root).read_json(file) for name, file in own.items() if (root / file).exists()}


def _newest(rows: list[dict]) -> list[dict]:
    """The last row of every attacker, Naive first: a folder keeps those of an earlier pool as well."""
    ordered = sorted(rows, key=lambda row: (row["goals"] != "naive", row["goals"]))
    return list({row["goals"]: row for row in ordered}.values())


def show(variant: str, policies: list[list[dict]], known: dict[str, list[dict]]) -> None:
    """Print a line per attacker: its effect on every policy, and for how many of them it was the worst."""
    if not policies:
        return
    chosen = Counter(found["attacker"] for found in worst(policies))
    header = [
        variant, "crashes per interaction [%], by policy (95 %)", "mean", "ratio to Naive", "worst of", "AUROC",
        "crashes seen", *known,
    ]  # fmt: skip
    print(f"\n| {' | '.join(header)} |")
    print("|" + "---|" * len(header))
    naive = [rows[0]["crash_rate"] for rows in policies]
    for goals in [row["goals"] for row in policies[0]]:
        own = [next(row for row in rows if row["goals"] == goals) for rows in policies]
        mean = math.fsum(row["crash_rate"] for row in own) / len(own)
        ratio = mean * len(own) / math.fsum(naive) if any(naive) else math.nan
        others = [next(row["crash_rate"] for row in rows if row["goals"] == goals) for rows in known.values()]
        columns = [
            goals, "; ".join(interval(row) for row in own), percent(mean), f"{ratio:.1f}",
            f"{chosen[goals]} of {len(own)}" if goals != "naive" else "",
            ", ".join(known_or_dash(row["adversary_auroc"]) for row in own if "adversary_auroc" in row),
            ", ".join(str(row["adversary_crashes"]) for row in own if "adversary_crashes" in row),
            *[percent(rate) for rate in others],
        ]  # fmt: skip
        print(f"| {' | '.join(columns)} |")


def interval(row: dict) -> str:
    """Rate of a row with Wilson's interval, as if interactions of the same world were independent."""
    found = stats.binomtest(row["interaction_crashes"], row["interactions"]).proportion_ci(method="wilson")
    return f"{percent(row['crash_rate'])} ({percent(found.low)}-{percent(found.high)})"


def known_or_dash(value: float | None) -> str:
    """Three digits, or a dash for an unknown value; files have no NaN."""
    return "-" if value is None or math.isnan(value) else f"{value:.3f}"


def percent(rate: float) -> str:
    """Three significant digits of a share, in percent."""
    return f"{100 * rate:.3g}"


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, help="where the runs are kept")
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--show", action="store_true", help="train and evaluate nothing")
    options = parser.parse_args()
    for variant in options.variants:
        if not options.show:
            options.root.mkdir(parents=True, exist_ok=True)
            measure(options.root, variant)
        show(variant, *read(options.root, variant))


if __name__ == "__main__":
    main()
