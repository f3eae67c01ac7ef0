"""``deimos evaluate``: the policy of a run under Naive and the Adversary, or its fear network against what happened."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from deimos.app import console, figures
from deimos.checks import check_at_least
from deimos.nn.threads import on_threads
from deimos.run import api, audit, training
from deimos.run.config import kind
from deimos.run.evaluation import EvalConfig
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.env import EnvConfig
from deimos.sim.shared import one_stream

_CHANGES = ("worlds", "steps", "seed", "oracle_worlds")
_AUDITS = ("contexts", "calibration")
_EVALUATION = (
    ("score (0 does nothing, 1 reference)", "score", ".3f"),
    ("reward per transition", "reward", ".4f"),
    ("crashes", "crashes", "d"),
    ("crashes per 1000 transitions", "crashes_per_1000", ".3f"),
    ("crashes per robot-minute", "crashes_per_minute", ".3f"),
    ("crashes per interaction", "crash_rate", ".4f"),
    ("interactions", "interactions", "d"),
    ("crashes under first goals", "first_goal_crashes", "d"),
    ("Adversary's AUROC", "adversary_auroc", ".3f"),
    ("Adversary's interactions", "adversary_interactions", "d"),
    ("crashes among them", "adversary_crashes", "d"),
)
_AUDIT = (
    ("AUROC within contexts", "auroc", ".3f"),
    ("95 % interval, low", "low", ".3f"),
    ("95 % interval, high", "high", ".3f"),
    ("contexts with both outcomes", "contexts", "d"),
    ("contexts tried", "tried", "d"),
    ("crash rate", "crash_rate", ".3f"),
    ("after iteration", "iteration", "d"),
)


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Evaluate the policy of a run against Naive and against a freshly trained Adversary."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    worlds: int | None = None
    """Parallel worlds. By default as the run was set up."""
    steps: int | None = None
    """Steps of every world. By default as the run was set up."""
    seed: int | None = None
    """Seed of the worlds and their goals. By default as the run was set up."""
    goal_period: int | None = None
    """T: steps that a goal is active. By default as in training."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to simulate; auto takes the GPU where there is one."""
    oracle_worlds: int | None = None
    """Worlds that meet the oracle Adversary too; 200 is plenty. By default as the run was set up."""
    calibration: int = 0
    """Instead of the policy, evaluate the fear network's probabilities on this many interactions, and draw
    calibration.png. 0 disables it."""
    contexts: int = 0
    """Instead of the policy, audit the fear network on this many contexts: its AUROC within each,
    against the exact outcomes of cloned worlds. 0 disables it."""

    def __post_init__(self) -> None:
        for name in _AUDITS:
            check_at_least(name, getattr(self, name), 0)
        asked = [name for name in _AUDITS if getattr(self, name)]
        others = [name for name in (*_CHANGES, "goal_period") if getattr(self, name) is not None] + asked[1:]
        if asked and others:
            raise ValueError(
                f"{asked[0]} evaluates the fear network of the run as it was trained and cannot be combined with "
                f"{', '.join(others)}."
            )


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos evaluate``."""
    options: EvaluateOptions = console.parse(EvaluateOptions, arguments, program)
    folder = RunFolder.open(options.run)
    config = training.read_config(folder)
    console.quiet_warp()
    device = training.resolve_device(options.device)
    if options.contexts or options.calibration:
        with one_stream(device):
            trainer = training.load(folder, replace(config, device=options.device))
            with on_threads(1):  # sums of torch's depend on its threads
                _evaluate_fear(trainer, folder, options)
        return
    changes = {name: getattr(options, name) for name in _CHANGES if getattr(options, name) is not None}
    env_config, eval_config = api.configure_evaluation(config, options.goal_period, changes)
    with one_stream(device):
        rows = evaluate_run(folder, env_config, eval_config, device)
    figures.draw_summary(folder, title(config), rows)
    print(folder.path)


def title(config: TrainConfig) -> str:
    """What stands above the figures of a run."""
    return f"{kind(config.env)} {getattr(config.env, 'variant', '')}, {config.label}, seed {config.seed}"


def evaluate_run(folder: RunFolder, env_config: EnvConfig, eval_config: EvalConfig, device: torch.device) -> list[dict]:
    """Evaluate the folder's policy under a progress bar, and print the table."""
    with console.stage_bar("evaluating: ") as progress:
        rows = api.evaluate_run(folder, env_config, eval_config, device, progress)
    _print_evaluation(rows)
    return rows


def _evaluate_fear(trainer: Trainer, folder: RunFolder, options: EvaluateOptions) -> None:
    """Audit the fear network within contexts, or its probabilities."""
    if options.contexts:
        found = audit.audit_fear(trainer, options.contexts)
        folder.write_json("audit.json", found)
        _print_table("Fear network against exact outcomes", {"": found}, _AUDIT)
        return
    audited = audit.audit_calibration(trainer, options.calibration)
    qualities = {name: quality for name, (_, _, quality) in audited.items()}
    folder.write_json("calibration.json", qualities)
    names = next(iter(qualities.values()))
    lines = [(name.replace("_", " "), name, ".0f" if name == "interactions" else ".4f") for name in names]
    _print_table("Fear network's probabilities", qualities, lines)
    print(figures.draw_calibration(folder, {name: (p, crashed) for name, (p, crashed, _) in audited.items()}))


def _print_evaluation(rows: list[dict]) -> None:
    """Print Naive beside Adversary, without what neither has."""
    columns, more = {}, {}
    for row in rows:
        more = {f"median error, {name}": error for name, error in row.get("errors", {}).items()}
        if len(row["tracking"]) > 1:  # a single one is the reward
            more |= {f"tracking of goal group {i}": value for i, value in enumerate(row["tracking"])}
        columns[row["goals"].capitalize()] = row | more
    lines = [*_EVALUATION, *[(name, name, ".3f") for name in more]]
    lines = [line for line in lines if any(_cell(row.get(line[1]), line[2]) != "-" for row in columns.values())]
    _print_table("Evaluation", columns, lines)
    if any(row.get("weak_adversary") for row in rows):
        print("weak Adversary: inconclusive; it has seen too few crashes, or its AUROC is too low")


def _print_table(title: str, columns: dict[str, dict], lines: Iterable[tuple[str, str, str]]) -> None:
    """Print values side by side; a line is its label, the key of its values and their format."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", show_header=any(columns))
    table.add_column("")
    for name in columns:
        table.add_column(name, justify="right")
    for label, key, form in lines:
        table.add_row(label, *[_cell(values.get(key), form) for values in columns.values()])
    Console().print(table)


def _cell(value: Any, form: str) -> str:
    return "-" if value is None or (isinstance(value, float) and math.isnan(value)) else format(value, form)
