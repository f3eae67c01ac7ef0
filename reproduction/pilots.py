"""The pilots of docs/lab/pilots.md: a small, equal budget for every new selector, on settings that no study uses.

    python -m reproduction.pilots runs/pilots           # trains what is missing, then prints
    python -m reproduction.pilots runs/pilots --show    # prints the existing results

After an interruption the same command continues.
"""

import argparse
import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deimos.goals.selector import SelectorConfig
from deimos.goals.selectors import novelty, penalty, q_fear, uniform, weighted
from deimos.run.evaluation import EvalConfig, worst
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle
from reproduction.runs import finished

SETTINGS = {
    "A": particle.Config(variant="directional", max_force=0.5, max_speed=8.0, goal_period=125, goal_range=11.0),
    "B": particle.Config(variant="relative", max_force=2.0, max_speed=7.0, goal_period=140, goal_range=1600.0),
}
INSTEAD = particle.Config(variant="absolute", max_force=2.0, max_speed=7.0, goal_period=140, goal_range=1600.0)
HEADROOM = 0.01  # Uniform's crashes per interaction under the worst attacker
SEEDS = (9101, 9102)
WORLDS = 1000  # of a training run
EVALUATION = EvalConfig(worlds=500, attackers=("argmax", "argmax-long", "scripted"))
UNIFORM = "uniform"
SELECTORS: dict[str, dict[str, SelectorConfig]] = {
    "weighted": {
        f"mix {mix:g}, alpha {alpha:g}": weighted.Config(mix=mix, alpha=alpha)
        for mix in (0.5, 0.25) for alpha in (1.0, 0.5)
    },
    "fear-novelty": {f"eta {eta:g}": novelty.Config(eta=eta) for eta in (0.5, 1.0, 2.0, 4.0)},
    "q-fear": {f"beta {beta:g}": q_fear.Config(beta=beta) for beta in (0.5, 0.8, 0.9, 0.95)},
    "penalty": {f"size {size:g}": penalty.Config(size=size) for size in (3.0, 10.0, 30.0, 100.0)},
}  # fmt: skip
DEFAULTS = {"weighted": "mix 0.5, alpha 1", "fear-novelty": "eta 1", "q-fear": "beta 0.9"}  # before the pilots
KEEPS, COSTS_NOTHING = 0.95, 0.97  # shares of Uniform's score; see the rules in docs/lab/pilots.md


@dataclass(frozen=True, kw_only=True)
class Pilot:
    """A policy and its outcomes."""

    setting: str
    """Name of the setting."""
    selector: str
    """The selector that chose its goals."""
    configuration: str
    """The fields that the pilots vary; empty for Uniform."""
    seed: int
    """Training seed."""
    worst: float
    """Crashes per interaction under the worst attacker."""
    attacker: str
    """The attacker that was worst."""
    rates: dict[str, float]
    """Crashes per interaction under uniform goals and under every attacker."""
    score: float
    """Score under uniform goals."""


def configurations() -> Iterator[tuple[str, str, SelectorConfig]]:
    """Selector, configuration and the object built from it; Uniform first."""
    yield UNIFORM, "", uniform.Config()
    for selector, own in SELECTORS.items():
        for configuration, config in own.items():
            yield selector, configuration, config


def run(root: Path, setting: str, env: particle.Config, seeds: tuple[int, ...], chosen: list) -> None:
    """Train and evaluate some configurations in a setting."""
    for seed in seeds:
        for selector, configuration, config in chosen:
            train = TrainConfig(
                env=env, selector=config, seed=seed, num_envs=WORLDS, eval=EVALUATION, device="cpu", threads=1
            )  # fmt: skip
            finished(train, _path(root, setting, selector, configuration, seed))


def _path(root: Path, setting: str, selector: str, configuration: str, seed: int) -> Path:
    name = "-".join([setting, selector, *configuration.replace(",", "").split(), f"s{seed}"])
    return root / name


def read(root: Path) -> list[Pilot]:
    """All pilots that are finished, setting by setting in the order of ``configurations``."""
    found = []
    for setting in (*SETTINGS, "B-absolute"):
        for selector, configuration, _ in configurations():
            for seed in SEEDS:
                folder = RunFolder(_path(root, setting, selector, configuration, seed))
                if (folder.path / "evaluation.json").exists():
                    found.append(pilot(setting, selector, configuration, seed, folder.read_json("evaluation.json")))
    return found


def pilot(setting: str, selector: str, configuration: str, seed: int, rows: list[dict]) -> Pilot:
    """A policy from the rows of its evaluation."""
    (found,) = worst([rows])
    return Pilot(
        setting=setting, selector=selector, configuration=configuration, seed=seed, worst=found["crash_rate"],
        attacker=found["attacker"], rates={row["goals"]: row["crash_rate"] for row in rows}, score=rows[0]["score"],
    )  # fmt: skip


Table = dict[tuple[str, str], tuple[np.ndarray, float]]
"""By selector and configuration: the mean worst rate in every setting, and the score as a share of Uniform's."""


def means(pilots: list[Pilot], settings: list[str]) -> Table:
    """Means over the seeds that every configuration has in every setting; empty if there is no such seed."""
    every = [(selector, configuration) for selector, configuration, _ in configurations()]
    known = {(p.setting, p.selector, p.configuration, p.seed): p for p in pilots}
    seeds = [seed for seed in SEEDS if all((s, *name, seed) in known for s in settings for name in every)]
    if not seeds:
        return {}
    own = {name: [[known[s, *name, seed] for seed in seeds] for s in settings] for name in every}
    base = [np.mean([p.score for p in part]) for part in own[UNIFORM, ""]]
    return {
        name: (
            np.array([np.mean([p.worst for p in part]) for part in parts]),
            float(np.mean([np.mean([p.score for p in part]) / usual for part, usual in zip(parts, base, strict=True)])),
        )
        for name, parts in own.items()
    }


def choose(table: Table, selector: str, default: str) -> str:
    """The configuration of a selector that the rule for defaults chooses."""
    rates, score = table[selector, default]
    better = [
        (name, own) for (who, name), (own, share) in table.items()
        if who == selector and (own < rates).all() and share >= min(KEEPS, score)
    ]  # fmt: skip
    return min(better, key=lambda pair: pair[1].mean(), default=(default, rates))[0]


def sizes(table: Table) -> tuple[str, str]:
    """The small and the large penalty that their rules choose; both are configurations."""
    own = {name: found for (who, name), found in table.items() if who == "penalty"}
    ordered = list(own)  # ascending

    def safest(names: list[str]) -> str:
        return min(names, key=lambda name: own[name][0].mean())

    free = [name for name in ordered if own[name][1] >= COSTS_NOTHING]
    small = safest(free) if free else ordered[0]
    if small == ordered[-1]:
        return ordered[-2], small
    return small, safest(ordered[ordered.index(small) + 1 :])


def show(pilots: list[Pilot], file: Path | None) -> None:
    """Print a line per configuration and setting, with both policies, and the choices of the rules."""
    settings = ["A", "B-absolute" if any(p.setting == "B-absolute" for p in pilots) else "B"]
    table = means(pilots, settings)
    names = list(dict.fromkeys((p.setting, p.selector, p.configuration) for p in pilots))
    columns = ("naive", *EVALUATION.attackers)
    print(f"| setting | selector | configuration | {' | '.join(columns)} | worst | score |")
    print("|---|" + "---|" * (len(columns) + 4))
    for name in names:
        own = [p for p in pilots if (p.setting, p.selector, p.configuration) == name]
        cells = [", ".join(f"{100 * p.rates[goals]:.2f}" for p in own) for goals in columns]
        cells += [", ".join(f"{100 * p.worst:.2f}" for p in own), ", ".join(f"{p.score:.3f}" for p in own)]
        print(f"| {' | '.join([*name, *cells])} |")
    print(
        "\n| selector | configuration | mean worst rate [%], " + ", ".join(settings) + " | both | score / Uniform's |"
    )
    print("|---|---|---|---|---|")
    for (selector, configuration), (rates, score) in table.items():
        each = ", ".join(f"{100 * rate:.2f}" for rate in rates)
        print(f"| {selector} | {configuration} | {each} | {100 * rates.mean():.2f} | {score:.3f} |")
    if table:
        for selector, default in DEFAULTS.items():
            print(f"\n{selector}: {choose(table, selector, default)} (the default was {default})", end="")
        print("\npenalties: {} and {}".format(*sizes(table)))
    if file is not None:
        write(file, pilots)


def write(file: Path, pilots: list[Pilot]) -> None:
    """Write all pilots to a table."""
    with file.open("w", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        goals = ("naive", *EVALUATION.attackers)
        writer.writerow(["setting", "selector", "configuration", "seed", *goals, "worst", "attacker", "score"])
        for p in pilots:
            rates = [f"{p.rates[name]:.6g}" for name in goals]
            row = [p.setting, p.selector, p.configuration, p.seed, *rates, f"{p.worst:.6g}", p.attacker]
            writer.writerow([*row, f"{p.score:.6g}"])


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, help="where the runs are kept")
    parser.add_argument("--show", action="store_true", help="train nothing")
    parser.add_argument("--table", type=Path, help="CSV file to write with a row per policy")
    options = parser.parse_args()
    if not options.show:
        settings = dict(SETTINGS)
        every = list(configurations())
        for setting, env in SETTINGS.items():
            run(options.root, setting, env, SEEDS, every[:1])
        if np.mean([p.worst for p in read(options.root) if p.setting == "B" and p.selector == UNIFORM]) <= HEADROOM:
            del settings["B"]
            settings["B-absolute"] = INSTEAD
        for seed in SEEDS:
            for setting, env in settings.items():
                run(options.root, setting, env, (seed,), every)
    show(read(options.root), options.table)


if __name__ == "__main__":
    main()
