"""Training and evaluation as two functions."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from deimos.checks import RunError
from deimos.nn import ranks
from deimos.nn.threads import on_threads
from deimos.run import training
from deimos.run.branch import branch_config
from deimos.run.config import from_dict, require_readable, to_dict, with_plain_numbers
from deimos.run.evaluation import EvalConfig, evaluate_run
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.env import EnvConfig
from deimos.sim.shared import one_stream


def train(
    config: TrainConfig | None = None, out: Path | str | None = None, *, branch_from: Path | str | None = None
) -> Path:  # fmt: skip
    """Train a policy and evaluate it.

    The environment variables of the process are left alone. Where other programs use the cores too, set
    OMP_WAIT_POLICY=passive before torch is loaded, as the ``deimos`` command does: spinning threads are slow there.

    Processes that ``torchrun`` starts train one policy, each in its share of the worlds; all must call this, once, and
    the first one evaluates.

    Args:
        config: What to train; ``None`` for the main job, Particle Gym under the Director.
        out: Folder of the run, which must not exist; ``None`` for ``runs/ENV-METHOD-sSEED-TIME``.
        branch_from: Folder of a run whose networks, optimiser, worlds and levels it starts with; ``config`` then
            defaults to ``deimos.run.branch.branch_config`` of that run's.

    Returns:
        The run's folder, for ``evaluate`` and ``load_policy``.

    Raises:
        RunError: If the folder exists, a value in ``config`` is not of its field's type, the worlds do not fit into
            memory, a file cannot be written, or the other processes of torchrun cannot be reached.
        SimulationError: If a number is not finite; the last checkpoint is intact.
    """
    if config is None and branch_from is not None:
        config = branch_config(training.read_config(RunFolder.open(Path(branch_from))))
    config = with_plain_numbers(config or TrainConfig())
    with on_threads(torch.get_num_threads()), ExitStack() as stack:  # a run changes it; the host gets its own back
        with ranks.joined():
            with ranks.together():
                device = training.resolve_device(config.device)
                stack.enter_context(one_stream(device))
            trainer, folder = training.start(config, _path(out), branch_from=_path(branch_from))
            training.train(trainer, folder)
            first = ranks.place().first
        if first and config.evaluation:
            evaluate_run(folder, config.env, config.eval, device)
    return folder.path


def _path(name: Path | str | None) -> Path | None:
    return None if name is None else Path(name)


def evaluate(
    run: Path | str, *, goal_period: int | None = None, device: str = "auto", engine: str | None = None, **changes: Any
) -> list[dict]:  # fmt: skip
    """Evaluate the policy of a run against uniform goals (Naive) and against attackers.

    Args:
        run: The run's folder; its ``evaluation.json`` gains the rows.
        goal_period: T: steps that a goal is active; ``None`` for that of training.
        device: ``auto``, ``cpu`` or ``cuda``.
        engine: What simulates legged robots, ``warp`` or ``native``; ``None`` for the one of training.
        changes: Fields of ``EvalConfig`` that differ from the run's, such as ``worlds``, ``steps`` or ``seed``.

    Returns:
        A row for uniform goals and one for each attacker; see ``evaluation.evaluate``.

    Raises:
        RunError: If it is not a run folder, or a value is not allowed.
    """
    folder = RunFolder.open(Path(run))
    config = training.read_config(folder)
    env_config, eval_config = configure_evaluation(config, goal_period, changes, engine)
    found = training.resolve_device(device)
    with one_stream(found):
        return evaluate_run(folder, env_config, eval_config, found)


def configure_evaluation(
    config: TrainConfig, goal_period: int | None, changes: dict[str, Any], engine: str | None = None
) -> tuple[EnvConfig, EvalConfig]:
    """Environment and settings of an evaluation that may differ from those of the run.

    Raises:
        RunError: If a value is not allowed.
    """
    try:
        period = config.env.goal_period if goal_period is None else goal_period
        env_config = with_plain_numbers(config.env.for_evaluation().with_goal_period(period))  # no episode limits T
        eval_config = with_plain_numbers(replace(config.eval, **changes))
        require_readable(eval_config)
        if engine is not None:
            env_config = from_dict(EnvConfig, to_dict(env_config) | {"engine": engine})
        if eval_config.steps < 2 * period:
            raise ValueError(f"steps must be at least 2 T = {2 * period}, got {eval_config.steps}.")
    except (TypeError, ValueError) as error:
        raise RunError(str(error)) from error
    return env_config, eval_config
