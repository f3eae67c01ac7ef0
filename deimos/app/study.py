"""``deimos study``: the commands of ``deimos.study.cli``."""

import signal
from functools import partial
from typing import Any

from deimos.app import console
from deimos.study.cli import COMMANDS, LONG, PoolOptions


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos study``."""
    commands = {name: (options.__doc__.splitlines()[0], partial(_run, options)) for name, options in COMMANDS.items()}
    console.dispatch(commands, "Trains and compares populations of policies.", arguments, program)


def _run(options: Any, arguments: list[str], program: str) -> None:
    parsed = console.parse(options, arguments, program)
    if isinstance(parsed, (*LONG, PoolOptions)):  # they simulate, if only to estimate how long it takes
        console.quiet_warp()
    if isinstance(parsed, LONG):
        with console.stop_on_interrupt() as stopped, console.progress("study") as report:
            try:
                parsed.run(lambda: bool(stopped()), report)
            except SystemExit:
                raise SystemExit(128 + (stopped() or signal.SIGINT)) from None
    else:
        parsed.run()
