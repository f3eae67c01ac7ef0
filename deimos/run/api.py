"""Training and evaluation as two functions."""

import warnings
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from deimos.checks import RunError
from deimos.nn import ranks
from deimos.nn.threads import on_threads
from deimos.run import presets, training
from deimos.run.attack import require_heard
from deimos.run.branch import branch_config
from deimos.run.config import from_dict, require_readable, to_dict, with_plain_numbers
from deimos.run.evaluation import EvalConfig, evaluate_run
from deimos.run.folder import RunFolder
from deimos.run.progress import progress as shown
from deimos.run.progress import training_progress
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.env import EnvConfig
from deimos.sim.graphs import Mode
from deimos.sim.shared import one_stream

Callback = Callable[[dict[str, float]], Any]
"""Takes the row of an iteration; returning ``False`` stops the run."""


def train(
    config: TrainConfig | None = None, out: Path | str | None = None, *, resume: Path | str | None = None,
    env_steps: int | None = None, device: str | None = None, graph: Mode | None = None,
    init_from: Path | str | None = None, branch_from: Path | str | None = None, callback: Callback | None = None,
    progress: bool | None = None,
) -> Path:  # fmt: skip
    """Train a policy and evaluate it, or resume an earlier run.

    The environment variables of the process are left alone. Where other programs use the cores too, set
    OMP_WAIT_POLICY=passive before torch is loaded, as the ``deimos`` command does: spinning threads are slow there.

    Processes that ``torchrun`` starts train one policy, each in its share of the worlds; all must call this, once, and
    the first one evaluates.

    Args:
        config: What to train; ``None`` for the main job, Particle Gym under the Director. For robots, start from
            ``deimos.preset``: the default learner is Particle Gym's, and a warning says so.
        out: Folder of the run, which must not exist; ``None`` for ``runs/ENV-METHOD-sSEED-TIME``.
        resume: Folder of a run to resume from its last checkpoint; takes only ``env_steps``, ``device`` and ``graph``.
        env_steps: A larger budget of a resumed run: steps of every world in all.
        device: Where to resume; ``None`` for the device that the run had.
        graph: Whether a GPU replays CUDA graphs in a resumed run; ``None`` for as before.
        init_from: Folder of a run whose networks it starts with.
        branch_from: Folder of a run whose networks, optimiser, worlds and levels it starts with; ``config`` then
            defaults to ``deimos.run.branch.branch_config`` of that run's.
        callback: Called after every iteration with its row of ``progress.csv``, in the first process. If it returns
            False, the run stops with a checkpoint and is not evaluated. If it raises, the last checkpoint stays.
        progress: Whether to show progress on stderr; ``None`` shows it on a terminal and in a notebook.

    Returns:
        The run's folder, for ``evaluate`` and ``load_policy``.

    Raises:
        RunError: If arguments exclude each other, the folder exists, a value in ``config`` is not of its field's type,
            the other run does not fit, the worlds do not fit into memory, a file cannot be written, or the other
            processes of torchrun cannot be reached.
        SimulationError: If a number is not finite; the last checkpoint is intact.
    """
    if resume is None:
        _refuse("is for resume; a new run has it in config", env_steps=env_steps, device=device, graph=graph)
        if config is None:
            config = TrainConfig() if branch_from is None else branch_config(_config(branch_from))
        device = config.device
        begin = partial(training.start, config, _path(out), _path(init_from), _path(branch_from))
    else:
        why = "is not for resume, which takes only env_steps, device and graph"
        _refuse(why, config=config, out=out, init_from=init_from, branch_from=branch_from)
        begin = partial(training.resume, Path(resume), env_steps, device, graph)
        device = device or _config(resume).device
    is_new = resume is None and branch_from is None
    return _train(device, begin, callback, progress, is_new)


def _train(
    device: str, begin: Callable[[], tuple[Trainer, RunFolder]], callback: Callback | None, wanted: bool | None,
    is_new: bool,
) -> Path:  # fmt: skip
    """Begin a run, train and evaluate it; see ``train``."""
    with on_threads(torch.get_num_threads()), ExitStack() as stack:  # a run changes it; the host gets its own back
        with ranks.joined():
            with ranks.together():
                stack.enter_context(one_stream(training.resolve_device(device)))
            trainer, folder = begin()
            first = ranks.place().first
            if first and is_new and (advice := presets.advice(trainer.config)):
                warnings.warn(advice, stacklevel=3)
            finished = _fit(trainer, folder, callback, wanted if first else False)
        config = trainer.config
        if first and finished and config.evaluation:
            with shown("evaluating", wanted) as report:
                evaluate_run(folder, config.env, config.eval, trainer.env.device, report)
    return folder.path


def _fit(trainer: Trainer, folder: RunFolder, callback: Callback | None, wanted: bool | None) -> bool:
    """Train until the budget is used up or the callback stops it; returns whether the run is complete."""
    stop = False

    def report(row: dict[str, float], fps: float) -> None:
        nonlocal stop
        show(row, fps)
        stop = callback is not None and callback(dict(row)) is False

    with training_progress(trainer.config.iterations, wanted) as show:
        return training.train(trainer, folder, report, lambda: stop) and not stop


def _refuse(why: str, **arguments: Any) -> None:
    """Raise ``RunError`` for an argument that is given."""
    for name, value in arguments.items():
        if value is not None:
            raise RunError(f"{name} {why}.")


def _config(path: Path | str) -> TrainConfig:
    return training.read_config(RunFolder.open(Path(path)))


def _path(name: Path | str | None) -> Path | None:
    return None if name is None else Path(name)


def evaluate(
    run: Path | str, *, worlds: int | None = None, steps: int | None = None, seed: int | None = None,
    attackers: tuple[str, ...] | None = None, goal_period: int | None = None, engine: str | None = None,
    terrain_seed: int | None = None, iteration: int | None = None, device: str = "auto", progress: bool | None = None,
    **changes: Any,
) -> list[dict]:  # fmt: skip
    """Evaluate the policy of a run against uniform goals (Naive) and against attackers, as ``deimos evaluate`` does.

    Args:
        run: The run's folder; its ``evaluation.json`` gains the rows.
        worlds: Parallel worlds; here and in the next three, ``None`` for as the run was set up.
        steps: Steps of every world.
        seed: Seed of the worlds and their goals.
        attackers: Attackers of the policy, by name; ``()`` for uniform goals alone.
        goal_period: T: steps that a goal is active; ``None`` for that of training.
        engine: What simulates legged robots, ``warp`` or ``native``; ``None`` for the one of training.
        terrain_seed: Seed of the ground of legged robots; ``None`` for that of training. Another one draws random tiles
            that they have not met.
        iteration: Use the policy that ``save_every`` kept after this iteration; ``None`` for the last one.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: Whether to show progress on stderr; ``None`` shows it on a terminal and in a notebook.
        changes: Other fields of ``EvalConfig`` that differ from the run's, such as ``pool`` or ``adversary_steps``.

    Returns:
        A row for uniform goals and one for each attacker; see ``evaluation.evaluate``.

    Raises:
        RunError: If it is not a run folder, it has not kept that policy, or a value is not allowed.
    """
    folder = RunFolder.open(Path(run))
    usual = {"worlds": worlds, "steps": steps, "seed": seed, "attackers": attackers}
    changes |= {name: value for name, value in usual.items() if value is not None}
    config = training.read_config(folder)
    env_config, eval_config = configure_evaluation(config, goal_period, changes, engine, terrain_seed)
    found = training.resolve_device(device)
    with one_stream(found), shown("evaluating", progress) as report:
        return evaluate_run(folder, env_config, eval_config, found, report, iteration=iteration)


def configure_evaluation(
    config: TrainConfig, goal_period: int | None, changes: dict[str, Any], engine: str | None = None,
    terrain_seed: int | None = None,
) -> tuple[EnvConfig, EvalConfig]:  # fmt: skip
    """Environment and settings of an evaluation that may differ from those of the run.

    Raises:
        RunError: If a value is not allowed, or is for an attacker that is not among them.
    """
    try:
        period = config.env.goal_period if goal_period is None else goal_period
        env_config = with_plain_numbers(config.env.for_evaluation().with_goal_period(period))  # no episode limits T
        eval_config = with_plain_numbers(replace(config.eval, **changes))
        require_readable(eval_config)
        settings = {"engine": engine, "terrain_seed": terrain_seed}
        if given := {name: value for name, value in settings.items() if value is not None}:
            env_config = from_dict(EnvConfig, to_dict(env_config) | given)
        if eval_config.steps < 2 * period:
            raise ValueError(f"steps must be at least 2 T = {2 * period}, got {eval_config.steps}.")
    except (TypeError, ValueError) as error:
        raise RunError(str(error)) from error
    require_heard(eval_config.attackers, changes.get("pool"), changes.get("oracle_worlds"))
    return env_config, eval_config
