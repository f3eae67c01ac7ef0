"""What every command of the tool shares: one line for an error, a bar for what takes long."""

import ast
import contextlib
import dataclasses
import inspect
import io
import os
import re
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterator
from typing import Any

import tyro

from .world import Progress


class UsageError(Exception):
    """Something that the user can mend."""


def run(command: Callable[[], None], program: str) -> int:
    """Run a command; whatever the user can mend ends in one line on stderr and exit code 2."""
    try:
        command()
    except (UsageError, ValueError) as error:
        return _fail(program, str(error))
    except OSError as error:
        return _fail(program, f"{error.filename or 'A file'} could not be read or written ({error.strerror or error}).")
    except MemoryError:
        return _fail(program, "There is not enough memory; enlarge cell, or ask for fewer levels or columns.")
    except KeyboardInterrupt:
        _fail(program, "Interrupted; what was written before is whole.")
        return 130
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    return 0


def _fail(program: str, message: str) -> int:
    print(f"{program}: {' '.join(message.split())}", file=sys.stderr)
    return 2


def parse(options: Any, arguments: list[str], program: str) -> Any:
    """Parse by tyro, whose framed complaints become one line.

    Raises:
        UsageError: If the arguments are wrong.
        SystemExit: If only help was asked for.
    """
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(options, args=arguments, prog=program)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise UsageError(_unframed(complaint.getvalue())) from None


def _unframed(text: str) -> str:
    """The first paragraph inside tyro's frame."""
    lines = [line.strip("│| ") for line in text.splitlines()[1:]]
    parts = re.split(r"(?m)^[╰─╯+-]+$", "\n".join(lines))
    message = next((part for part in parts if part.strip()), text)
    return re.sub(r"^\s*Error parsing \w+:", "", message)


@contextlib.contextmanager
def progress_bar() -> Iterator[Progress]:
    """A bar on the terminal that shows the stage and its share, and vanishes at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
    screen = Console(stderr=True)
    with Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda stage, share: bar.update(task, description=stage, completed=share)


def field_docs(cls: type) -> dict[str, str]:
    """The docstring below each field of a dataclass and of those that it inherits from, on one line."""
    docs: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(body, ast.ClassDef)
        for field, after in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(after, ast.Expr):
                docs[field.target.id] = " ".join(str(ast.literal_eval(after.value)).split())
    return docs


def quiet_warp() -> None:
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
