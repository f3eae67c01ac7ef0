"""``deimos evaluate``: the policy of a run under Naive and attackers, or its fear network against what happened."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch
import tyro

from deimos.app import console, figures
from deimos.app.console import table
from deimos.app.findings import describe, known
from deimos.checks import check_at_least
from deimos.nn.threads import torch_on_one
from deimos.run import api, audit, training
from deimos.run.attack import require_heard
from deimos.run.config import kind
from deimos.run.evaluation import EvalConfig, elsewhere, evaluate_run
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.env import EnvConfig
from deimos.sim.shared import one_stream

_CHANGES = ("worlds", "steps", "seed", "attackers", "pool", "oracle_worlds")
_AUDITS = ("contexts", "calibration")
_AUDIT = (
    ("AUROC within contexts (0.5: chance, 1: perfect)", "auroc"),
    ("95 % interval, low", "low"),
    ("95 % interval, high", "high"),
    ("contexts with both outcomes", "contexts"),
    ("contexts tried", "tried"),
    ("crash rate", "crash_rate"),
    ("after iteration", "iteration"),
)
_QUALITIES = {"auroc": "AUROC (0.5: chance, 1: perfect)", "brier": "Brier score", "ece": "expected calibration error"}


@dataclass(frozen=True, kw_only=True)
class Elsewhere:
    """What the policy is evaluated in, if that is not what it was trained in."""

    engine: Literal["warp", "native"] | None = None
    """What simulates legged robots. By default as in training; the other one shows how the policy does in another
    simulator, compared with its own."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Evaluate the policy of a run against uniform goals (Naive) and against attackers."""

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
    device: str = "auto"
    """Where to simulate: cpu, cuda or cuda:N; auto takes the GPU where there is one."""
    attackers: tuple[str, ...] | None = None
    """Attackers in addition to those that the run was set up with, by name: argmax-long, oracle, ..."""
    pool: Path | None = None
    """File of the attacker pooled, made by ``deimos pool``. By default as the run was set up."""
    env: Elsewhere = field(default_factory=Elsewhere)
    """What the policy is evaluated in."""
    oracle_worlds: int | None = None
    """Worlds that meet the attacker oracle, which tries goals in clones. By default as the run was set up."""
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
        others += ["env.engine"] if self.env.engine else []
        if asked and others:
            raise ValueError(
                f"{asked[0]} evaluates the fear network of the run as it was trained and cannot be combined with "
                f"{', '.join(others)}."
            )


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos evaluate``."""
    options: EvaluateOptions = console.parse(EvaluateOptions, arguments, program)
    folder = RunFolder.open(options.run)
    folder.require_writable()
    config = training.read_config(folder)
    console.quiet_warp()
    device = training.resolve_device(options.device)
    if options.contexts or options.calibration:
        with one_stream(device):
            trainer = training.load(folder, replace(config, device=options.device))
            with torch_on_one():
                _evaluate_fear(trainer, folder, options)
        return
    changes = {name: getattr(options, name) for name in _CHANGES if getattr(options, name) is not None}
    changes["attackers"] = tuple(dict.fromkeys((*config.eval.attackers, *changes.get("attackers", ()))))
    env_config, eval_config = api.configure_evaluation(config, options.goal_period, changes, options.env.engine)
    require_heard(eval_config.attackers, options.pool, options.oracle_worlds)
    with one_stream(device):
        show_evaluation(folder, config, env_config, eval_config, device)
    print(folder.path)


def title(config: TrainConfig) -> str:
    """Title of the figures of a run."""
    env = " ".join([kind(config.env), *filter(None, [getattr(config.env, "variant", None)])])
    return f"{env}, goals chosen by {config.label}, seed {config.seed}"


def show_evaluation(
    folder: RunFolder, config: TrainConfig, env_config: EnvConfig, eval_config: EvalConfig, device: torch.device
) -> None:
    """Evaluate the policy of a run, whose configuration is ``config``; draw the summary and print what was found."""
    with console.progress("evaluating") as report:
        rows = evaluate_run(folder, env_config, eval_config, device, report)
    # Before anything is printed: its reader may be gone.
    figures.draw_summary(folder, title(config), rows[0]["weights"])
    print(describe(rows, elsewhere(folder, rows)))


def _evaluate_fear(trainer: Trainer, folder: RunFolder, options: EvaluateOptions) -> None:
    """Audit the fear network within contexts, or its probabilities."""
    if options.contexts:
        found = audit.audit_fear(trainer, options.contexts)
        folder.write_json("audit.json", found)
        audited_lines = [(label, known(found[key])) for label, key in _AUDIT]
        print("Fear network against exact outcomes", table(("", ""), audited_lines), sep="\n")
        return
    audited = audit.audit_calibration(trainer, options.calibration)
    qualities = {name: quality for name, (_, _, quality) in audited.items()}
    folder.write_json("calibration.json", qualities)
    path = figures.draw_calibration(folder, {name: (p, crashed) for name, (p, crashed, _) in audited.items()})
    names = next(iter(qualities.values()))
    lines = [
        [_QUALITIES.get(name, name.replace("_", " ")), *[known(quality[name]) for quality in qualities.values()]]
        for name in names
    ]
    print("Fear network's probabilities", table(("", *qualities), lines), path, sep="\n")
