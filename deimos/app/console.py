"""What all commands share: their dispatch, the parsing of options, progress bars, and how they are stopped.

Importing it needs Python alone, so that ``deimos`` can say which packages are missing.
"""

import ast
import contextlib
import dataclasses
import functools
import inspect
import io
import itertools
import logging
import os
import re
import shutil
import signal
import sys
import tempfile
import textwrap
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from deimos.checks import RunError
from deimos.run.progress import number as number  # commands call them as they call the rest
from deimos.run.progress import progress as progress

Command = Callable[[list[str], str], None]
"""Runs on its arguments, under the name that a user calls it by, such as ``deimos study run``."""

LEAST_WIDTH = 60  # columns of a terminal that help is wrapped at


def dispatch(commands: Mapping[str, tuple[str, Command]], about: str, arguments: list[str], program: str) -> None:
    """Run the command that the first argument names; without one, list them all.

    Args:
        commands: By name, one line about the command and the command.
        about: What they do together.
        arguments: What follows ``program`` on the command line.
        program: How a user calls them.

    Raises:
        RunError: If there is no such command.
    """
    if not arguments or arguments[0] in ("-h", "--help"):
        width, screen = max(map(len, commands)), max(LEAST_WIDTH, shutil.get_terminal_size().columns)
        listed = [
            textwrap.fill(f"  {name:{width}}  {text}", screen, subsequent_indent=" " * (width + 4))
            for name, (text, _) in commands.items()
        ]
        parts = (about, f"usage: {program} COMMAND [OPTIONS]", "Every command explains its options with --help.")
        first, usage, last = (textwrap.fill(part, screen) for part in parts)
        print(first, usage, "\n".join(["commands:", *listed]), last, sep="\n\n")
        return
    name, rest = arguments[0], arguments[1:]
    if name not in commands:
        asked = " ".join([*program.split()[1:], name])
        raise RunError(f"Unknown command '{asked}'; choose from: {', '.join(commands)}.")
    commands[name][1](rest, f"{program} {name}")


def parse(options: Any, arguments: list[str], program: str, **more: Any) -> Any:
    """The options that the arguments ask for, by tyro.

    Raises:
        RunError: If the arguments are wrong.
        SystemExit: If only help was asked for.
    """
    import tyro

    arguments = [_at_home(argument) for argument in arguments]
    is_help = bool({"-h", "--help"} & set(arguments))
    rule, registry = _Fields(is_help), tyro.constructors.ConstructorRegistry()
    registry.struct_rule(rule)
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(ImportError):  # then tyro's own framed messages stay, with exit code 2
            from tyro._errors import on_parse_error  # since 1.0.16, and private

            stack.enter_context(on_parse_error(functools.partial(_refuse, arguments)))
        if is_help:
            stack.enter_context(_wrapped_help())
        found = tyro.cli(
            options, args=arguments, prog=program, config=(tyro.conf.CascadeSubcommandArgs,), registry=registry, **more
        )
    _refuse_repeated(arguments, rule.lists)
    return found


def _refuse_repeated(arguments: list[str], lists: set[str]) -> None:
    """Refuse an option of several values that is given twice: only the values of the last one would count."""
    flags = [argument.partition("=")[0] for argument in arguments if argument.startswith("--")]
    for flag in dict.fromkeys(flags):
        if flags.count(flag) > 1 and flag.rpartition(".")[2].lstrip("-").replace("-", "_") in lists:
            raise RunError(f"{flag} is given twice; give it once, with all its values: {flag} A B.")


class _Fields:
    """A rule of tyro's: how the fields of a dataclass are read and, for help, explained.

    None cannot be given as a value and is not shown: what it stands for is in the docstring. Docstrings below fields
    are shown without the line breaks that tyro would keep.

    Args:
        explained: Whether help is asked for.
    """

    def __init__(self, explained: bool) -> None:
        self._explained = explained
        self._is_asking = False  # whether tyro's answer without this rule is asked for
        self.lists: set[str] = set()
        """Names of the fields that take any number of values."""

    def __call__(self, struct: Any) -> Any:
        """What tyro is to show; ``None`` leaves that to the other rules."""
        import tyro

        if self._is_asking or not (isinstance(struct.type, type) and dataclasses.is_dataclass(struct.type)):
            return None
        if self._explained:
            _explain(struct.type)
        self._is_asking = True
        try:
            found = tyro.constructors.ConstructorRegistry.get_struct_spec(struct)
        finally:
            self._is_asking = False
        if not isinstance(found, tyro.constructors.StructConstructorSpec):
            return found
        self.lists |= {field.name for field in found.fields if _is_list(field.type)}
        return dataclasses.replace(found, fields=tuple(map(_without_none, found.fields)))


def _is_list(kind: Any) -> bool:
    """Whether a type is a list or a tuple of any length, or one of these or None."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Annotated, Union, UnionType):
        return any(map(_is_list, parts))
    return origin is list or (origin is tuple and Ellipsis in parts)


def _explain(kind: type) -> None:
    """Give the fields of a dataclass the docstrings below them as their help."""
    texts: dict[str, str] = {}
    for each in reversed(inspect.getmro(kind)):
        texts |= _docstrings(each.__module__).get(each.__name__, {})
    for known in dataclasses.fields(kind):
        if known.name in texts:
            known.metadata = MappingProxyType({"help": texts[known.name]} | known.metadata)


def _without_none(field: Any) -> Any:
    """A field of tyro's that is None by default, without None as a value that can be given; others as they are."""
    from tyro import conf, constructors

    if field.default is not None:
        return field
    info = constructors.PrimitiveTypeInfo.make(field.type, set())
    spec = constructors.ConstructorRegistry.get_primitive_spec(info)
    if not isinstance(spec, constructors.PrimitiveConstructorSpec):
        return field
    return dataclasses.replace(field, type=Annotated[field.type, conf.DisallowNone, conf.arg(help_behavior_hint="")])


@functools.cache
def _docstrings(module: str) -> dict[str, dict[str, str]]:
    """The docstrings below the fields of a module's classes, by class and field."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError):  # it has no source
        return {}
    found: dict[str, dict[str, str]] = {}
    for node in (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
        for field, below in itertools.pairwise(node.body):
            match field, below:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(value=ast.Constant(str(text))):
                    found.setdefault(node.name, {})[name] = " ".join(text.replace("``", "").split())
    return found


@contextlib.contextmanager
def _wrapped_help() -> Iterator[None]:
    """Wrap the description of a command, which tyro prints without regard to the terminal's width."""
    said, width = io.StringIO(), max(LEAST_WIDTH, shutil.get_terminal_size().columns)
    said.isatty = sys.stdout.isatty  # type: ignore[method-assign]
    os.environ["COLUMNS"] = str(width)  # in less, tyro leaves descriptions a column one letter wide
    try:
        with contextlib.redirect_stdout(said):
            yield
    finally:
        for line in said.getvalue().replace("``", "").splitlines():
            print(line.rstrip() if "\x1b" in line else textwrap.fill(line.rstrip(), width))


def _at_home(argument: str) -> str:
    """An argument with its ``~`` expanded as by a shell, which would leave that of ``--out=~/x`` alone."""
    flag, is_given, value = argument.partition("=")
    if argument.startswith("--") and is_given:
        return f"{flag}={os.path.expanduser(value)}"
    return os.path.expanduser(argument)


def _plainly(message: str) -> str:
    """What tyro says about a value, without its markup and, if only one type is possible, without naming that."""
    message = re.sub(r"\[/?bold\]", "", message)
    tried = re.findall(r"^- .*?: (.*)$", message, re.MULTILINE)
    return tried[0] if len(tried) == 1 else message


def _option(argument: str) -> str:
    """Which option, or which of the choices ``env:`` and ``selector:``, an argument gives; else the empty string."""
    if not argument.startswith("--"):
        choice = re.match(r"(env|selector):", argument)
        return choice[0] if choice else ""
    return re.sub(r"(^--|\.)no-", r"\1", argument.partition("=")[0].replace("_", "-"))


def _refuse(given: list[str], event: Any) -> None:
    """Raise ``RunError`` in place of tyro's framed messages; what is not known here stays with tyro."""
    argument = getattr(event, "argument", None)
    name = argument and argument.display_name()
    match type(event).__name__:
        case "InstantiationFailure":
            message = _plainly(event.message)
            raise RunError(f"{name}: {message}" if name else message)
        case "InvalidChoice":
            choices = event.choices
            if "None" in choices:  # tyro has made a set of them
                choices = sorted(set(choices) - {"None"})
            raise RunError(f"Unknown value '{event.value}' for {name}; choose from: {', '.join(map(repr, choices))}.")
        case "SubcommandConflict":
            chosen, flag = event.already_selected, event.trigger_flag
            raise RunError(f"{event.attempted} must come before {flag}, which is an option of {chosen}.")
        case "BadValue":
            raise RunError(f"Missing value for argument '{name}'.")
        case "UnrecognizedArgs":
            all_options, left = ([*map(_option, tokens)] for tokens in (given, event.tokens))
            for option in filter(None, left):  # some tyro takes no second time after env: or selector:
                if all_options.count(option) > left.count(option):
                    raise RunError(f"{option} is given twice; give it once.")
            raise RunError(f"Unrecognized options: {' '.join(event.tokens)}.")
        case "MissingArgs":
            arguments = [found.arg for found in event.missing_arguments]
            about = [(each.display_name(), each.field.helptext) for each in arguments]
            missing = [f"{name} ({text() if callable(text) else text})" for name, text in about]
            raise RunError(f"Missing from {event.prog}: {', '.join(missing)}")


@contextlib.contextmanager
def log_shown() -> Iterator[None]:
    """Show what Deimos logs, such as why goals are still uniform: a line each on stderr, above a progress bar."""
    logger, handler = logging.getLogger("deimos"), logging.StreamHandler()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lines of a table, labels to the left and values to the right; as wide as it must be, on any terminal."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = []
    for label, *values in (header, *rows):
        aligned = [value.rjust(width) for value, width in zip(values, widths[1:], strict=True)]
        lines.append("  ".join([label.ljust(widths[0]), *aligned]).rstrip())
    return "\n".join(lines)


class Stopped(KeyboardInterrupt):
    """A signal asked this process to end; its one argument is the signal's number."""


@contextlib.contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], int]]:
    """Let Ctrl-C, SIGTERM and SIGHUP stop after the iteration instead of within it; a second one stops at once.

    Gives a function that returns the number of the signal that came, or 0.
    """
    asked: list[int] = []
    with contextlib.ExitStack() as stack:

        def ask(number: int, frame: Any) -> None:
            asked.append(number)
            stack.close()  # the next one finds what was there before

        stack.enter_context(on_signals(ask))
        yield lambda: asked[0] if asked else 0


@contextlib.contextmanager
def on_signals(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Call a function on Ctrl-C and on the signals that clusters and terminals send before they are gone.

    Signals reach the main thread alone; in others nothing is changed. A SIGHUP that is ignored, as under nohup, stays
    so.
    """
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.getsignal(number) for number in numbers}
        before = {n: known for n, known in before.items() if n == signal.SIGINT or known is not signal.SIG_IGN}
    try:
        for number in before:
            signal.signal(number, handler)
        yield
    finally:
        for number, known in before.items():
            signal.signal(number, known)


def raise_stopped(number: int, frame: Any) -> None:
    """A handler of signals: raises ``Stopped``."""
    raise Stopped(number)


def quiet_warp() -> None:
    """Keep Warp's start-up report off the terminal, and its warning that there is no GPU; everything else shows."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)  # the warning is printed from C
        try:
            wp.init()
        except OSError as error:
            way_out = "set WARP_CACHE_PATH to a folder that can be written."
            raise RunError(
                f"Compiled kernels cannot be kept in {error.filename} ({error.strerror}); {way_out}"
            ) from error
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            said = [line for line in file.read().decode().splitlines() if "find or load the NVIDIA" not in line]
            if said:
                print(*said, sep="\n", file=sys.stderr)
