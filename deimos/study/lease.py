"""Who works on a cell: numbered files, each made by exactly one process, whose age says whether it is alive.

The holder of a cell is the one that made its highest ``claim-N``. A lease that has run out is taken over by
making ``claim-(N + 1)``, which again only one can: nothing is ever deleted, so there is no moment at which
two could both succeed. All times are those of the file system, which the machines share.
"""

import contextlib
import json
import os
import socket
from collections.abc import Sequence
from pathlib import Path

STALE_SECONDS = 60.0  # a holder on another machine that is silent for so long is dead
RELEASED = 0  # time stamp of a lease that was given back


class Lease:
    """The right to work on a cell; see ``take``."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._next = path.with_name(f"claim-{_number(path) + 1}")

    def name_holders(self, pids: Sequence[int]) -> None:
        """Say which processes of this machine hold the lease: once all are dead it has run out."""
        self._path.write_text(json.dumps({"machine": machine(), "pids": list(pids)}))

    def renew(self) -> bool:
        """Show that the holder is alive; false if the lease has been taken over meanwhile."""
        os.utime(self._path)
        return not self._next.exists()

    def release(self) -> None:
        """Give the lease back, so that anybody may take the cell at once."""
        with contextlib.suppress(OSError):  # it would run out by itself
            os.utime(self._path, (RELEASED, RELEASED))


def take(folder: Path) -> Lease | None:
    """Take the lease of a cell.

    Args:
        folder: The cell's folder.

    Returns:
        The lease, or ``None`` if somebody else holds it.
    """
    newest = _newest(folder)
    if newest is not None and not _has_run_out(newest):
        return None
    path = folder / f"claim-{0 if newest is None else _number(newest) + 1}"
    holder = json.dumps({"machine": machine(), "pids": [os.getpid()]})
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
    except FileExistsError:
        return None
    with os.fdopen(descriptor, "w") as file:
        file.write(holder)
    return Lease(path)


def is_held(folder: Path) -> bool:
    """Whether somebody works on a cell."""
    newest = _newest(folder)
    return newest is not None and not _has_run_out(newest)


def machine() -> str:
    """Name of the machine and its space of process numbers: containers may share the one but not the other."""
    parts = [socket.gethostname()]
    with contextlib.suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
        parts.append(os.readlink("/proc/self/ns/pid"))
    return " ".join(parts)


def _newest(folder: Path) -> Path | None:
    return max(folder.glob("claim-*"), key=_number, default=None)


def _number(path: Path) -> int:
    return int(path.name.removeprefix("claim-"))


def _has_run_out(path: Path) -> bool:
    stamp = path.stat().st_mtime
    if stamp == RELEASED or _now(path.parent) - stamp > STALE_SECONDS:
        return True
    try:
        holder = json.loads(path.read_text())
        return holder["machine"] == machine() and not any(_is_alive(pid) for pid in holder["pids"])
    except (OSError, ValueError, KeyError, TypeError):
        return False  # it is being written; its age decides


def _now(folder: Path) -> float:
    """The time by the clock of the file system."""
    clock = folder / "clock"
    clock.touch()
    return clock.stat().st_mtime


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return not _is_zombie(pid)


def _is_zombie(pid: int) -> bool:
    with contextlib.suppress(OSError, IndexError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    return False
