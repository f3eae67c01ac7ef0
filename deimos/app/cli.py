"""The command line: ``deimos train``, ``evaluate``, ``study``, ``play``, ``terrain`` and ``bench``.

Whatever the user can mend (a flag, a folder, a disk) ends in one line on stderr and exit code 2.
"""

import argparse
import contextlib
import dataclasses
import io
import os
import re
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import tyro

from deimos import __version__, plugins
from deimos.checks import SimulationError, check_at_least
from deimos.goals import selectors
from deimos.run.folder import RunError
from deimos.sim import envs

USAGE = f"""Deimos {__version__}: robot policies trained under a Director that chooses their goals by fear.

usage: deimos COMMAND [OPTIONS]

commands:
  train      train a policy and evaluate it (also: python train.py)
  evaluate   evaluate the policy of a run folder
  study      train and compare populations of policies
  play       render a trained robot as a film
  terrain    make ground for legged robots (also: python -m terrain)
  bench      measure the speed of everything

Every command explains its options with --help."""


def main(arguments: list[str] | None = None) -> int:
    """Run ``deimos``; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    commands: dict[str, Callable[[list[str]], int]] = {
        "train": train, "evaluate": evaluate, "study": study, "play": play, "terrain": terrain, "bench": bench,
    }  # fmt: skip
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0
    if arguments[0] == "--version":
        print(__version__)
        return 0
    if arguments[0] not in commands:
        return _fail(f"There is no command '{arguments[0]}'; there are: {', '.join(commands)}.")
    return commands[arguments[0]](arguments[1:])


def train(arguments: list[str] | None = None) -> int:
    """Run ``deimos train``; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with _one_line_errors() as outcome:
        if any(argument.split("=")[0] == "--resume" for argument in arguments):
            _resume(_parse(ResumeOptions, arguments, "deimos train"))
        else:
            _check_names(arguments)
            arguments, config = _take_preset(arguments)
            options = _train_options()
            fields = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
            _train(_parse(options, arguments, "deimos train", default=options(**fields)))
    return outcome.code


def _take_preset(arguments: list[str]) -> tuple[list[str], Any]:
    """The arguments without ``--preset NAME``, and what they start from: that preset, or the environment's own."""
    from deimos.run import presets

    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--preset")
    try:
        found, rest = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise RunError(f"--preset needs a name; there are: {', '.join(presets.names())}.") from error
    env = next((argument.removeprefix("env:") for argument in rest if argument.startswith("env:")), None)
    env = env and env.replace("-", "_")  # the name of its module
    name = found.preset or env or "particle"
    try:
        if env is not None and presets.environment(name) != env:
            raise RunError(f"The preset '{name}' is for env:{presets.environment(name)}, not for env:{env}.")
        return rest, presets.preset(name)
    except ValueError as error:
        raise RunError(str(error)) from error


def _check_names(arguments: list[str]) -> None:
    """Refuse an unknown ``env:NAME`` or ``selector:NAME``; tyro would list the choices of the other.

    Names are spelled with hyphens; tyro takes underscores too.
    """
    for kind, names in (("env", plugins.names(envs)), ("selector", ["none", *plugins.names(selectors)])):
        known = [f"{kind}:{name.replace('_', '-')}" for name in names]
        for argument in arguments:
            if argument.startswith(f"{kind}:") and argument.replace("_", "-") not in known:
                raise RunError(f"There is no '{argument}'; there are: {', '.join(known)}.")


def evaluate(arguments: list[str]) -> int:
    """Run ``deimos evaluate``; returns the exit code."""
    with _one_line_errors() as outcome:
        _evaluate(_parse(EvaluateOptions, arguments, "deimos evaluate"))
    return outcome.code


def play(arguments: list[str]) -> int:
    """Run ``deimos play``; returns the exit code."""
    with _one_line_errors() as outcome:
        from deimos.app import playback

        options = _parse(playback.PlayOptions, arguments, "deimos play")
        _quiet_warp()
        print(playback.play(options))
    return outcome.code


def terrain(arguments: list[str]) -> int:
    """Run ``deimos terrain``; returns the exit code."""
    from deimos.terrain import cli as generator

    return generator.main(arguments, "deimos terrain")


def study(arguments: list[str]) -> int:
    """Run ``deimos study``; returns the exit code."""
    with _one_line_errors() as outcome:
        from deimos.study import cli as studies

        if not arguments or arguments[0] in ("-h", "--help"):
            print(studies.USAGE)
            return 0
        name = arguments[0]
        if name not in studies.COMMANDS:
            raise RunError(f"There is no command 'study {name}'; there are: {', '.join(studies.COMMANDS)}.")
        options, command = studies.COMMANDS[name]
        parsed = _parse(options, arguments[1:], f"deimos study {name}")
        if name == "run":
            with _stop_on_interrupt() as stopped:
                command(parsed, stopped)
        else:
            command(parsed)
    return outcome.code


def bench(arguments: list[str]) -> int:
    """Run ``deimos bench``; returns the exit code."""
    with _one_line_errors() as outcome:
        import benchmarks

        options = _parse(benchmarks.BenchOptions, arguments, "deimos bench")
        _quiet_warp()
        benchmarks.run(options)
    return outcome.code


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResumeOptions:
    """Go on with an earlier run, from its last checkpoint."""

    resume: Path
    """Folder of the run."""
    env_steps: int | None = None
    """A larger budget: steps of every world in all. By default the one that the run had."""
    device: Literal["auto", "cpu", "cuda"] | None = None
    """Where to go on. By default where it was."""


@dataclasses.dataclass(frozen=True, kw_only=True)
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
    """T: steps that a goal is in force. By default as in training."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to simulate; auto takes the GPU where there is one."""
    oracle_worlds: int | None = None
    """Worlds that meet the oracle Adversary too; 200 is plenty. By default as the run was set up."""
    calibration: int = 0
    """Instead of the evaluation, judge the fear network's probabilities on this many interactions, and draw
    calibration.png. 0 for no such thing."""
    contexts: int = 0
    """Instead of the evaluation, audit the fear network on this many contexts: its AUROC within each,
    against the exact outcomes of cloned worlds. 0 for no audit."""

    def __post_init__(self) -> None:
        asked = [name for name in ("contexts", "calibration") if getattr(self, name)]
        for name in ("contexts", "calibration"):
            check_at_least(name, getattr(self, name), 0)
        names = ("worlds", "steps", "seed", "goal_period", "oracle_worlds")
        given = [name for name in names if getattr(self, name) is not None]
        if asked and given + asked[1:]:
            others = ", ".join(given + asked[1:])
            raise ValueError(f"{asked[0]} judges the fear network of the run as it was trained and excludes {others}.")


def _train_options() -> type:
    """``TrainConfig`` with every environment and selector that there is, and what belongs to the folder."""
    from deimos.run import presets
    from deimos.run.training import TrainConfig

    field = dataclasses.field
    env_default = next(f.default_factory for f in dataclasses.fields(TrainConfig) if f.name == "env")
    return dataclasses.make_dataclass(
        "TrainOptions",
        [
            ("env", _subcommands(envs), field(default_factory=env_default)),
            ("selector", _subcommands(selectors, Annotated[None, tyro.conf.subcommand("none")]), field(default=None)),
            ("out", Annotated[Path | None, tyro.conf.arg(
                help="Folder of the run, which must not exist. By default runs/ENV-METHOD-sSEED-TIME."
            )], field(default=None)),
            ("resume", Annotated[Path | None, tyro.conf.arg(
                help="Go on with the run in this folder from its last checkpoint; takes only --env-steps and --device."
            )], field(default=None)),
            ("init_from", Annotated[Path | None, tyro.conf.arg(
                help="Start with the networks of the run in this folder."
            )], field(default=None)),
        ],
        bases=(TrainConfig,), frozen=True, kw_only=True,
        namespace={"__doc__": (
            "Train a policy under a goal selector, then evaluate it against Naive and Adversary. "
            f"--preset NAME starts from a ready configuration: {', '.join(presets.names())}."
        )},
    )  # fmt: skip


def _subcommands(package: Any, *more: Any) -> Any:
    options = [
        Annotated[plugins.load(package, name).Config, tyro.conf.subcommand(name)] for name in plugins.names(package)
    ]
    return Union[tuple([*more, *options])]  # noqa: UP007 (a union of a computed list)


def _train(options: Any) -> None:
    from deimos.run import training
    from deimos.sim.shared import one_stream

    names = {field.name for field in dataclasses.fields(training.TrainConfig)}
    config = training.TrainConfig(**{name: getattr(options, name) for name in names})
    _quiet_warp()
    with one_stream(training.resolve_device(config.device)):
        trainer, folder = training.start(config, options.out, options.init_from)
        _run(trainer, folder)


def _resume(options: ResumeOptions) -> None:
    from deimos.run import training
    from deimos.sim.shared import one_stream

    _quiet_warp()
    config = training.read_config(training.RunFolder.open(options.resume))
    with one_stream(training.resolve_device(options.device or config.device)):
        trainer, folder = training.resume(options.resume, options.env_steps, options.device)
        _run(trainer, folder)


def _run(trainer: Any, folder: Any) -> None:
    """Train, evaluate, draw and say where everything is."""
    from deimos.app import console, figures
    from deimos.run import training

    config = trainer.config
    with _stop_on_interrupt() as stopped:
        with console.TrainingBar(trainer) as bar:
            finished = training.train(trainer, folder, bar.report, stopped)
        if not finished or stopped():
            print(f"Stopped after iteration {trainer.iteration}; go on with --resume {folder.path}", file=sys.stderr)
            raise SystemExit(130)
    rows = _evaluate_policy(folder, config.env, config.eval, trainer.env.device) if config.evaluation else []
    figures.draw_summary(folder, _title(config), rows)
    if trainer.env.device.type == "cpu":  # a GPU works on while the host counts
        console.print_timing(trainer)
    print(folder.path)


def _evaluate(options: EvaluateOptions) -> None:
    import torch

    from deimos.app import figures
    from deimos.run import training
    from deimos.sim.shared import one_stream

    folder = training.RunFolder.open(options.run)
    config = training.read_config(folder)
    torch.set_num_threads(config.threads or training.cores())  # the same numbers as at the end of the run
    _quiet_warp()
    device = training.resolve_device(options.device)
    if options.contexts or options.calibration:
        with one_stream(device):
            trainer = training.load(folder, dataclasses.replace(config, device=options.device))
            _judge_fear(trainer, folder, options)
        return
    changes = {name: getattr(options, name) for name in ("worlds", "steps", "seed", "oracle_worlds")}
    try:
        eval_config = dataclasses.replace(config.eval, **{k: v for k, v in changes.items() if v is not None})
        period = config.env.goal_period if options.goal_period is None else options.goal_period
        env_config = config.env.with_goal_period(period)
        if eval_config.steps < 2 * period:
            raise ValueError(f"steps must be at least 2 T = {2 * period}, got {eval_config.steps}.")
    except ValueError as error:
        raise RunError(str(error)) from error
    with one_stream(device):
        rows = _evaluate_policy(folder, env_config, eval_config, device)
    figures.draw_summary(folder, _title(config), rows)
    print(folder.path)


def _judge_fear(trainer: Any, folder: Any, options: EvaluateOptions) -> None:
    """Audit the fear network within contexts, or its probabilities."""
    from deimos.app import console, figures
    from deimos.run import audit

    if options.contexts:
        found = audit.audit_fear(trainer, options.contexts)
        folder.write_json("audit.json", found)
        console.print_audit(found)
        return
    judged = audit.audit_calibration(trainer, options.calibration)
    folder.write_json("calibration.json", {name: quality for name, (_, _, quality) in judged.items()})
    console.print_calibration({name: quality for name, (_, _, quality) in judged.items()})
    print(figures.draw_calibration(folder, {name: (p, crashed) for name, (p, crashed, _) in judged.items()}))


def _title(config: Any) -> str:
    from deimos.run.config import kind

    return f"{kind(config.env)} {getattr(config.env, 'variant', '')}, {config.label}, seed {config.seed}"


def _evaluate_policy(folder: Any, env_config: Any, eval_config: Any, device: Any) -> list[dict]:
    """Evaluate the folder's policy; replaces rows with the same key and adds the others. Returns the rows."""
    from deimos.app import console
    from deimos.learn.policy import load_policy
    from deimos.run.evaluation import evaluate, weights_hash

    policy = load_policy(folder.path, str(device))
    old = folder.read_json("evaluation.json") if (folder.path / "evaluation.json").exists() else []
    with console.stage_bar("evaluating") as progress:
        rows = evaluate(policy.scaled, env_config, eval_config, device, progress)
    rows = [row | {"weights": weights_hash(policy.actor)} for row in rows]
    key = ("goals", "goal_period", "seed", "worlds", "steps", "weights")
    fresh = {tuple(row[name] for name in key) for row in rows}
    kept = [row for row in old if tuple(row.get(name) for name in key) not in fresh]
    console.print_evaluation(rows)
    folder.write_json("evaluation.json", kept + rows)
    return rows


def _parse(options: Any, arguments: list[str], program: str, **more: Any) -> Any:
    """Parse by tyro, whose framed complaints become one line."""
    stderr = io.StringIO()
    try:
        with contextlib.redirect_stderr(stderr):
            return tyro.cli(options, args=arguments, prog=program, config=(tyro.conf.CascadeSubcommandArgs,), **more)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise RunError(_unframed(stderr.getvalue())) from None


def _unframed(text: str) -> str:
    """The message inside tyro's frame, without the hints below its first rules, on one line."""
    lines = [line.strip("│ ") for line in text.splitlines()[1:]]
    rule = r"(?m)^[╰─╯-]+$"  # drawn with dashes where stdout is not UTF-8
    parts = [part for part in re.split(rule, "\n".join(lines)) if part.strip()] or [text]
    message = parts[0] + "".join(part for part in parts[1:] if part.lstrip().startswith("Available"))
    return re.sub(r"^\s*Error parsing \w+Options:", "", message)


class _Outcome:
    code = 0


@contextlib.contextmanager
def _one_line_errors() -> Iterator[_Outcome]:
    outcome = _Outcome()
    hook, threading.excepthook = threading.excepthook, _skip_file_errors
    try:
        yield outcome
    except (RunError, SimulationError) as error:
        outcome.code = _fail(str(error))
    except OSError as error:
        what = error.filename or "A file of the run"
        outcome.code = _fail(f"{what} could not be read or written ({error.strerror or error}).")
    except KeyboardInterrupt:
        _fail("Interrupted; what was written before is whole.")
        outcome.code = 130
    except SystemExit as stop:
        outcome.code = stop.code if isinstance(stop.code, int) else 0
    finally:
        threading.excepthook = hook


def _skip_file_errors(thread: threading.ExceptHookArgs) -> None:
    """Say nothing of a full disk that TensorBoard's thread has met: it reports it to the main thread."""
    if not issubclass(thread.exc_type, OSError):
        threading.__excepthook__(thread)


def _fail(message: str) -> int:
    print(f"deimos: {' '.join(message.split())}", file=sys.stderr)
    return 2


@contextlib.contextmanager
def _stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C end the iteration instead of cutting it; a second one cuts."""
    asked: list[int] = []

    def ask(number: int, frame: Any) -> None:
        asked.append(number)
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: bool(asked)
    finally:
        signal.signal(signal.SIGINT, before)


def _quiet_warp() -> None:
    """Keep Warp's start-up report off the terminal, with its warning that there is no GPU; all else shows."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)  # the warning is printed from C
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            said = [line for line in file.read().decode().splitlines() if "find or load the NVIDIA" not in line]
            if said:
                print(*said, sep="\n", file=sys.stderr)
