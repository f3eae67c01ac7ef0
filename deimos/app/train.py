"""``deimos train``: train a policy and evaluate it, or resume an earlier run."""

import contextlib
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, Union

import tyro

from deimos import plugins
from deimos.app import console, figures
from deimos.app.evaluate import show_evaluation, title
from deimos.checks import RunError
from deimos.goals import selectors
from deimos.learn.policy import load_policy
from deimos.nn import ranks
from deimos.run import presets, training
from deimos.run.branch import branch_config
from deimos.run.evaluation import weights_hash
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim import envs
from deimos.sim.graphs import Mode
from deimos.sim.shared import one_stream


@dataclass(frozen=True, kw_only=True)
class ResumeOptions:
    """Resume an earlier run from its last checkpoint."""

    resume: Path
    """Folder of the run."""
    env_steps: int | None = None
    """A larger budget: steps of every world in all. By default that of the run."""
    device: str | None = None
    """Where to continue. By default on the device that the run had."""
    graph: Mode | None = None
    """Whether a GPU replays CUDA graphs. By default as before."""


@dataclass(frozen=True, kw_only=True)
class FirstOptions:
    """The options that decide which others there are."""

    preset: str | None = None
    """Name of a ready-made configuration to start from; the other options change it."""
    resume: Path | None = None
    """Resume the run in this folder from its last checkpoint; takes only --env-steps, --device and --graph."""
    branch_from: Path | None = None
    """Start with networks, optimiser, worlds and levels of the run in this folder, and with its settings: method,
    env.crash-penalty, env.goal-period, env.engine, seed and budget may differ."""
    out: Path | None = None
    """Folder of the run, which must not exist. By default runs/ENV-METHOD-sSEED-TIME."""


@dataclass(frozen=True, kw_only=True)
class FolderOptions(TrainConfig, FirstOptions):
    """The options of ``FirstOptions`` and ``TrainConfig``, and what belongs to the folder."""

    init_from: Path | None = None
    """Start with the networks of the run in this folder."""


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos train``."""
    first, _ = console.parse(FirstOptions, arguments, program, add_help=False, return_unknown_args=True)
    if first.resume is not None:
        _resume(console.parse(ResumeOptions, arguments, program))
        return
    _check_names(arguments)
    options, config = _train_options(), _start_from(first, arguments)
    default = options(**vars(config))
    _train(console.parse(options, arguments, program, default=default))


def _train(options: Any) -> None:
    config = TrainConfig(**{field.name: getattr(options, field.name) for field in fields(TrainConfig)})
    _run(config.device, lambda: training.start(config, options.out, options.init_from, options.branch_from))


def _resume(options: ResumeOptions) -> None:
    device = options.device or training.read_config(RunFolder.open(options.resume)).device
    _run(device, lambda: training.resume(options.resume, options.env_steps, options.device, options.graph))


def _run(device: str, begin: Callable[[], tuple[Trainer, RunFolder]]) -> None:
    """Begin a run and train, alone or with the other processes of torchrun; the first one then evaluates and draws."""
    console.quiet_warp()
    with contextlib.ExitStack() as stack:
        with ranks.joined():
            with ranks.together():
                stack.enter_context(one_stream(training.resolve_device(device)))
            trainer, folder = begin()
            _fit(trainer, folder)
            first = ranks.place().first
        if first:
            _finish(trainer, folder)


def _fit(trainer: Trainer, folder: RunFolder) -> None:
    """Train; a signal to one of the processes stops all of them after the same iteration."""
    first = ranks.place().first
    progress = _training_progress(trainer) if first else contextlib.nullcontext(lambda row, fps: None)
    with console.stop_on_interrupt() as stopped:
        with progress as report:
            finished = training.train(trainer, folder, report, lambda: bool(stopped()))
        (number,) = ranks.largest(stopped())
        if not finished or number:
            if first:
                where = f"Stopped after iteration {trainer.iteration}; resume with --resume {folder.path}"
                print(where, file=sys.stderr)
            raise SystemExit(128 + (number or signal.SIGINT))


def _finish(trainer: Trainer, folder: RunFolder) -> None:
    """Evaluate, draw and print where everything is."""
    config = trainer.config
    total = sum(trainer.seconds.values())
    if trainer.env.device.type == "cpu" and total > 0:  # a GPU works on while the host counts
        parts = [f"{name} {seconds / total:.0%}" for name, seconds in trainer.seconds.items()]
        print(f"Training took {total:.1f} s: {', '.join(parts)}.", flush=True)
    if config.evaluation:
        show_evaluation(folder, config, config.env, config.eval, trainer.env.device)
    else:
        figures.draw_summary(folder, title(config), weights_hash(load_policy(folder.path).actor))
    print(folder.path)


@contextlib.contextmanager
def _training_progress(trainer: Trainer) -> Iterator[Callable[[dict[str, float], float], None]]:
    """Frames per second, reward and crashes per 1000 transitions, short enough for 80 columns."""
    total = trainer.config.iterations
    with console.progress("training") as report, console.log_shown():
        yield lambda row, fps: report(
            f"{fps:,.0f} FPS, reward {console.number(row['reward'])}, "
            f"crashes/1000 {console.number(row['crashes_per_1000'])}",
            row["iteration"] / total,
        )


def _train_options() -> type:
    """``FolderOptions`` with every environment and selector that there is."""
    about = (
        "Train a policy under a goal selector, then evaluate it against uniform goals and attackers. "
        f"--preset NAME starts from a ready-made configuration: {', '.join(presets.names())}."
    )
    selector = _subcommands(selectors, Annotated[None, tyro.conf.subcommand("none")])
    return make_dataclass(
        "TrainOptions", [("env", _subcommands(envs)), ("selector", selector)],
        bases=(FolderOptions,), frozen=True, kw_only=True, namespace={"__doc__": about},
    )  # fmt: skip


def _subcommands(package: Any, *more: Any) -> Any:
    options = [
        Annotated[module.Config, tyro.conf.subcommand(name)] for name, module in plugins.load_all(package).items()
    ]
    return Union[tuple([*more, *options])]  # noqa: UP007 (a union of a computed list)


def _start_from(first: FirstOptions, arguments: list[str]) -> TrainConfig:
    """What the options start from: a run that is branched off, or a preset."""
    if first.branch_from is None:
        return _preset(first.preset, arguments)
    if first.preset is not None:
        raise RunError("--preset and --branch-from cannot be combined; the run has its own settings.")
    return branch_config(training.read_config(RunFolder.open(first.branch_from)))


def _preset(name: str | None, arguments: list[str]) -> TrainConfig:
    """What the options start from: the preset of this name, or that of the environment."""
    env = next((argument.removeprefix("env:") for argument in arguments if argument.startswith("env:")), None)
    name = name or env or "particle"
    try:
        if env is not None and presets.spelled(presets.environment(name)) != presets.spelled(env):
            raise RunError(f"The preset '{name}' is for env:{presets.environment(name)}, not for env:{env}.")
        return presets.preset(name)
    except ValueError as error:
        raise RunError(str(error)) from error


def _check_names(arguments: list[str]) -> None:
    """Refuse an unknown or broken ``env:NAME`` or ``selector:NAME``; tyro would list the choices of the other.

    Names are spelled with hyphens; tyro takes underscores too.
    """
    for kind, package, none in (("env", envs, []), ("selector", selectors, ["none"])):
        known = {f"{kind}:{name.replace('_', '-')}": name for name in [*none, *plugins.names(package)]}
        for argument in arguments:
            if argument.startswith(f"{kind}:") and argument.replace("_", "-") not in known:
                raise RunError(f"Unknown argument '{argument}'; choose from: {', '.join(known)}.")
            if (name := known.get(argument.replace("_", "-"), "none")) != "none":
                plugins.load(package, name)  # reports what is wrong with a broken one
