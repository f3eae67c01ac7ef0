"""``deimos shield``: a threshold of fear with a guarantee, and what it is worth under attack."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import tyro

from deimos.app import console, figures
from deimos.app.console import table
from deimos.app.findings import known, percent
from deimos.checks import RunError
from deimos.run import training
from deimos.run.attack import require_heard
from deimos.run.evaluation import require_pool
from deimos.run.folder import RunFolder
from deimos.run.shield import ShieldConfig, shield_run, without_pool
from deimos.sim.shared import one_stream

_CHANGES = ("worlds", "steps", "seed", "adversary_steps", "pool", "oracle_worlds")


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """How shields are tried. By default as the run was set up."""

    worlds: int | None = None
    """Parallel worlds."""
    steps: int | None = None
    """Steps of every world."""
    seed: int | None = None
    """Seed of the worlds and their goals."""
    adversary_steps: int | None = None
    """Unit of the attackers' budgets: steps that ``argmax`` learns from."""
    pool: Path | None = None
    """File of the attacker pooled, made by ``deimos pool``."""
    oracle_worlds: int | None = None
    """Worlds that meet the attacker ``oracle``."""


@dataclass(frozen=True, kw_only=True)
class ShieldOptions:
    """Make a shield from a run's fear network: it refuses goals that would crash the policy, at a promised rate.

    It is calibrated on uniform goals in fresh worlds, one per world, then tried under uniform goals (Naive) and under
    attackers that learn with it in their worlds, and compared with refusing as many goals at random or by a plain rule.
    The run's folder gets shield.json and shield.png; an export made afterwards has the shield too.
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run; it must have been trained under a method with a fear network."""
    shield: tyro.conf.OmitArgPrefixes[ShieldConfig] = field(default_factory=ShieldConfig)
    """How the shield is made."""
    attackers: tuple[str, ...] | None = None
    """Who attacks, by name. By default every attacker that needs no file."""
    eval: Evaluation = field(default_factory=Evaluation)
    """How it is tried."""
    device: str = "auto"
    """Where to simulate: cpu, cuda or cuda:N; auto takes the GPU where there is one."""


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos shield``."""
    options: ShieldOptions = console.parse(ShieldOptions, arguments, program)
    folder = RunFolder.open(options.run)
    config = training.read_config(folder)
    console.quiet_warp()
    device = training.resolve_device(options.device)
    changes = {name: getattr(options.eval, name) for name in _CHANGES if getattr(options.eval, name) is not None}
    attackers = without_pool() if options.attackers is None else options.attackers
    try:
        require_heard(attackers, options.eval.pool, options.eval.oracle_worlds)
        eval_config = replace(config.eval, attackers=attackers, **changes)
        if eval_config.steps < 2 * config.env.goal_period:
            least = 2 * config.env.goal_period
            raise ValueError(f"eval.steps must be at least 2 T = {least}, got {eval_config.steps}.")
    except ValueError as error:
        raise RunError(str(error)) from error
    require_pool(eval_config)
    with one_stream(device), console.progress("shield") as report:
        found = shield_run(folder, config, options.shield, eval_config, device, report)
    figures.draw_tradeoff(folder, found)
    print(describe(found), folder.path / "shield.png", sep="\n\n")


def describe(found: dict) -> str:
    """What ``shield_run`` has found, in words."""
    deploy, test = found["deploy"], found["test"]
    name = deploy["guarantee"]
    promise = {
        "marginal": "on average over calibrations",
        "conditional": "with a confidence of 95 %",
    }[name]
    head = (
        f"Of the goals that would crash the policy, at most {percent(deploy['alpha'])} get through, {promise}: "
        f"calibrated on {deploy['crashes']:,} crashes. Of {test['crashes']:,} others "
        f"{percent(test['miss_rate']) if test['crashes'] else 'none'} got through, and "
        f"{percent(test['refused'])} of {test['goals']:,} uniform goals were refused."
    )
    rows = [
        [row["shield"], row["goals"], percent(row["refused"]), percent(row["crash_rate"]), known(row["tracking"])]
        for row in found["trials"]
    ]
    header = ("shield", "goals by", "refused", "crashed", "tracking of what was given")
    tail = (
        "The promise is for uniform goals in states that the policy gets to under them. Under an attacker, or a shield "
        "in the loop, it is not one: the table says what happened."
    )
    return f"{head}\n\n{table(header, rows)}\n\n{tail}"
