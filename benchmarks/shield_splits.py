"""``python -m benchmarks.shield_splits RUN``: does a shield's guarantee hold, over many calibrations?

Crashes of a policy under uniform goals, one from each world, are split at random many times: a shield is calibrated on
one part and tested on the rest.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from deimos.checks import RunError, check_at_least, check_range
from deimos.goals.shield import GUARANTEES, Guarantee, threshold
from deimos.learn.policy import load_policy
from deimos.nn.threads import torch_on_one
from deimos.run.evaluation import make_target
from deimos.run.fear import load_fear
from deimos.run.folder import RunFolder
from deimos.run.shield import collect
from deimos.run.training import read_config

TESTED = 1000  # least number of crashes that a split is tested on


@dataclass(frozen=True, kw_only=True)
class SplitOptions:
    """Calibrate a run's shield many times, and count how often it lets through more than it should."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    alpha: float = 0.1
    """Largest miss rate, in (0, 1)."""
    calibration: int = 200
    """Crashes that each split is calibrated on, at least 1."""
    splits: int = 200
    """Random splits, at least 1."""
    worlds: int = 20_000
    """Worlds of a batch, at least 1; batches are run until there are enough crashes."""
    most: int = 20
    """Largest number of batches, at least 1."""
    steps: int = 1000
    """Steps of every world, at least 2 T."""
    json: Path | None = None
    """Write the results to this file too."""

    def __post_init__(self) -> None:
        check_range("alpha", self.alpha, 1e-6, 1 - 1e-6)
        for name in ("calibration", "splits", "worlds", "most", "steps"):
            check_at_least(name, getattr(self, name), 1)


def split(score: Tensor, alpha: float, calibration: int, splits: int, guarantee: Guarantee) -> Tensor:
    """Miss rates of shields on the crashes that they were not calibrated on, shape (splits,).

    Args:
        score: Scores of crashes, shape (n,).
        alpha: Largest miss rate.
        calibration: Crashes of the n that each shield is calibrated on.
        splits: Random splits.
        guarantee: The guarantee.
    """
    random = torch.Generator().manual_seed(0)
    rates = []
    for _ in range(splits):
        mixed = score[torch.randperm(len(score), generator=random)]
        limit = threshold(mixed[:calibration], alpha, guarantee)
        rates.append((mixed[calibration:] < limit).double().mean())
    return torch.stack(rates)


def measure(options: SplitOptions) -> dict[str, Any]:
    """Collect the crashes, and split them; see ``split``.

    Raises:
        RunError: If the run has no fear network, or its policy crashes too rarely.
    """
    folder, device = RunFolder.open(options.run), torch.device("cpu")
    config = read_config(folder)
    afraid = load_fear(folder, config, config.env.build(1, device, config.seed))
    if afraid is None:
        raise RunError(f"{folder.path} has no fear network that has learnt; train with a method that has one.")
    target = make_target(load_policy(folder.path).scaled, config.env, config.eval, device)
    need, found, goals = options.calibration + TESTED, [], 0
    for batch in range(options.most):
        outcomes = collect(target, afraid, options.worlds, options.steps, config.eval.seed + 2 + batch)
        found.append(outcomes.score[outcomes.crashed])
        goals += len(outcomes.score)
        print(f"{goals:,} goals, {sum(map(len, found)):,} of {need:,} crashes", flush=True)
        if sum(map(len, found)) >= need:
            break
    score = torch.cat(found)
    if len(score) < need:
        raise RunError(f"{need:,} crashes are needed, got {len(score):,} in {goals:,} goals; raise --most or --worlds.")
    rows = {}
    for guarantee in GUARANTEES:
        rates = split(score, options.alpha, options.calibration, options.splits, guarantee)
        error = rates.std().item() / math.sqrt(options.splits)
        rows[guarantee] = {
            "mean": rates.mean().item(), "standard_error": error, "above_alpha": int((rates > options.alpha).sum()),
        }  # fmt: skip
    return {
        "alpha": options.alpha, "goals": goals, "crashes": len(score), "calibrated_on": options.calibration,
        "tested_on": len(score) - options.calibration, "splits": options.splits, **rows,
    }  # fmt: skip


if __name__ == "__main__":
    asked = tyro.cli(SplitOptions)
    with torch_on_one():
        result = measure(asked)
    text = json.dumps(result, indent=2)
    print(text)
    if asked.json is not None:
        asked.json.write_text(text + "\n", encoding="utf-8")
