"""One attack in a separate process, and its outcome."""

import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

GRACE_SECONDS = 60.0  # that a process has to end after being asked to
MEMORY = 6 * 2**30  # bytes that an attack may allocate
POLL_SECONDS = 0.02


@dataclass(frozen=True)
class Verdict:
    """The outcome of an attack."""

    outcome: str
    """The kind of answer: refused, accepted, the same, caught, ..."""
    what: str
    """The attack."""
    said: str = ""
    """The answer."""
    fault: str = ""
    """What was wrong with it; empty if it is as it must be."""
    figures: dict[str, Any] = field(default_factory=dict)
    """Numbers that were measured."""


Attack = Callable[[int, np.random.Generator, Path], Verdict]
"""Attacks once: takes the number of the attack, its random generator, and an empty folder."""


@dataclass(frozen=True)
class Ended:
    """How a process ended."""

    code: int
    """Its exit code; negative for the signal that ended it."""
    said: str
    """Its output on stderr."""
    asked: bool
    """Whether it was asked to end because its time was up."""
    hung: bool
    """Whether it did not end then and was killed."""


def attempt(work: Callable[[], Any], place: Path, seconds: float, stop: int = signal.SIGTERM) -> Ended:
    """Do some work in a fork of this process, which starts at once since everything is loaded.

    Args:
        work: Returns the exit code; ``None`` is 0. An error that it raises is a traceback and 1.
        place: The folder that it works in.
        seconds: When it is asked to end [s].
        stop: The signal that asks it to end.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    process = os.fork()
    if process == 0:
        os._exit(_work(work, place))
    asked = hung = False
    end = time.monotonic() + seconds
    while True:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            break
        if time.monotonic() > end:
            hung = asked
            os.kill(process, signal.SIGKILL if asked else stop)
            asked, end = True, time.monotonic() + GRACE_SECONDS
        time.sleep(POLL_SECONDS)
    said = (place / "stderr.txt").read_text(errors="replace") if (place / "stderr.txt").exists() else ""
    return Ended(os.waitstatus_to_exitcode(status), said, asked, hung)


def _work(work: Callable[[], Any], place: Path) -> int:
    """What the fork does."""
    try:
        os.chdir(place)
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))  # other programs use this machine too
        for number, name in enumerate(("stdout.txt", "stderr.txt"), 1):
            os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        code = work()
        sys.stdout.flush()
        sys.stderr.flush()
        return 0 if code is None else int(code)
    except BaseException:  # whatever happened, the parent's loop must not continue here
        traceback.print_exc()
        sys.stderr.flush()
        return 1


def judged(what: str, ended: Ended) -> Verdict:
    """The outcome of a command: it did what was asked, said in one line why not, or ended when asked to."""
    lines = [line for line in ended.said.splitlines() if line.strip()]
    last = lines[-1] if lines else ""
    fault = ""
    if ended.hung:
        fault = "it did not end when it was asked to"
    elif "Traceback" in ended.said:
        fault = "a traceback"
    elif ended.code < 0:
        fault = f"ended by {signal.Signals(-ended.code).name}"
    elif ended.asked and ended.code not in (0, 2, 128 + signal.SIGTERM):
        fault = f"exit code {ended.code} after SIGTERM"
    elif not ended.asked and ended.code not in (0, 2):
        fault = f"exit code {ended.code}"
    elif ended.code == 2 and not last.startswith("deimos: "):
        fault = "no reason was given"
    outcome = "stopped" if ended.asked else "accepted" if ended.code == 0 else "refused"
    return Verdict("fault" if fault else outcome, what, ended.said[-2000:] if fault else last[:300], fault)
