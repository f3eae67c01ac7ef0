"""``deimos study``: the commands of ``deimos.study.cli``."""

from collections.abc import Callable
from typing import Any

from deimos.app import console
from deimos.study.cli import COMMANDS


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos study``."""
    commands = {
        name: ((options.__doc__ or "").splitlines()[0], _command(options, function))
        for name, (options, function) in COMMANDS.items()
    }
    console.dispatch(commands, "Trains and compares populations of policies.", arguments, program)


def _command(options: Any, function: Callable[..., None]) -> console.Command:
    def command(arguments: list[str], program: str) -> None:
        parsed = console.parse(options, arguments, program)
        if program.endswith(" run"):  # the one that takes long
            with console.stop_on_interrupt() as stopped:
                function(parsed, stopped)
        else:
            function(parsed)

    return command
