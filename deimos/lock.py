"""File locks that end with the process that holds them, however it ends: the operating system releases them."""

import contextlib
import json
import os
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from deimos.checks import RunError
from deimos.files import open_file

POLL_SECONDS = 0.1
NAME_POLLS = 10  # for the name of a process that has just taken a lock

if sys.platform == "win32":
    import msvcrt

    def _lock(file: IO[str]) -> None:
        file.seek(2**30)  # a locked byte cannot be read, but others must read the name in the file
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(file: IO[str]) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextlib.contextmanager
def hold(path: Path, what: str, *, patience: float = 0.0, one_machine: bool = False) -> Iterator[None]:
    """Hold a lock for as long as the context lasts.

    The file names its holder's machine and process until the context ends; after a kill it still does, unlocked.

    Args:
        path: The file; made if it is not there.
        what: What it stands for, for messages.
        patience: How long to wait for another holder to end [s].
        one_machine: Whether to refuse a file that names another machine although it is not locked: network file
            systems need not pass locks on.

    Raises:
        RunError: If another process holds it, or another machine may do so, or the file cannot be locked.
    """
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(open_file(path, "a+"))
            while not _is_taken(file):
                if patience <= 0.0:
                    raise RunError(f"{what} is being worked on by {_name_of_holder(file)}.")
                time.sleep(POLL_SECONDS)
                patience -= POLL_SECONDS
        except OSError as error:
            raise RunError(f"{path} cannot be locked ({error.strerror}).") from error
        machine, holder = _holder(file)
        if one_machine and machine not in ("", socket.gethostname()):
            raise RunError(
                f"{what} was last worked on by {holder}, and whether that has ended cannot be seen from here; once it "
                f"has, delete {path}."
            )
        file.truncate(0)
        stack.callback(file.truncate, 0)
        file.write(json.dumps({"machine": socket.gethostname(), "process": os.getpid()}))
        file.flush()
        yield


def _is_taken(file: IO[str]) -> bool:
    """Take the lock of a file unless another process has it; returns whether it was taken."""
    try:
        _lock(file)
    except (BlockingIOError, PermissionError):  # on POSIX and on Windows
        return False
    return True


def _name_of_holder(file: IO[str]) -> str:
    """Describe the holder of a file's lock; waits for one that has only just taken it to write its name."""
    for _ in range(NAME_POLLS):
        machine, holder = _holder(file)
        if machine:
            break
        time.sleep(POLL_SECONDS)
    return holder


def _holder(file: IO[str]) -> tuple[str, str]:
    """The machine that a lock file names, and machine and process in words; an empty machine if it names none."""
    file.seek(0)
    try:
        found = json.loads(file.read())
        return found["machine"], f"process {found['process']} on {found['machine']}"
    except (ValueError, KeyError, TypeError):
        return "", "another process"  # it is just being written, or has just been wiped
