"""Locks: one holder at a time, free as soon as it ends, and never taken from another machine."""

import errno
import json
import os
import socket
import subprocess
import sys

import pytest

from deimos import lock
from deimos.checks import RunError

TAKER = """
import sys, time
from pathlib import Path
from deimos.checks import RunError
from deimos.lock import hold
folder = Path(sys.argv[1])
while not (folder / "go").exists():
    time.sleep(0.001)
try:
    with hold(folder / "lock", "It"):
        print(True, flush=True)
        sys.stdin.read()
except RunError:
    print(False, flush=True)
"""


def taker(folder):
    """A process that takes a folder's lock once there is a file ``go`` in it, and says whether it got it."""
    command = [sys.executable, "-c", TAKER, str(folder)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_one_of_many_gets_it(tmp_path):
    """Of several processes that reach for a lock at once exactly one gets it, and it is free once that is killed."""
    takers = [taker(tmp_path) for _ in range(3)]
    (tmp_path / "go").touch()
    said = [process.stdout.readline().strip() for process in takers]
    assert sorted(said) == ["False", "False", "True"]
    takers[said.index("True")].kill()
    for process in takers:
        process.communicate()
    with lock.hold(tmp_path / "lock", "It", one_machine=True):
        pass


def test_held_lock_names_its_holder(tmp_path):
    """A lock that is held is refused with process and machine, and can be taken as soon as it is given back."""
    path = tmp_path / "lock"
    with lock.hold(path, "The study"):
        message = f"The study is being worked on by process {os.getpid()} on {socket.gethostname()}"
        with pytest.raises(RunError, match=message), lock.hold(path, "The study"):
            pass
    assert path.read_text() == ""
    with lock.hold(path, "The study", one_machine=True):
        assert json.loads(path.read_text()) == {"machine": socket.gethostname(), "process": os.getpid()}


def test_patience_outlasts_a_holder_that_ends(tmp_path, monkeypatch):
    """Whoever has patience gets the lock once its holder has ended."""
    holder = taker(tmp_path)
    (tmp_path / "go").touch()
    assert holder.stdout.readline() == "True\n"
    monkeypatch.setattr(lock.time, "sleep", lambda seconds: holder.communicate())
    with lock.hold(tmp_path / "lock", "It", patience=60.0):
        assert holder.returncode == 0


@pytest.mark.parametrize("machine", ["elsewhere", socket.gethostname()])
def test_killed_holder_is_forgotten_on_its_own_machine_only(tmp_path, machine):
    """A file without a lock that names another machine is refused with the way out, where that is asked for."""
    path = tmp_path / "lock"
    text = json.dumps({"machine": machine, "process": 7})
    path.write_text(text)
    if machine == "elsewhere":
        message = f"It was last worked on by process 7 on elsewhere, and .*; once it has, delete {path}"
        with pytest.raises(RunError, match=message), lock.hold(path, "It", one_machine=True):
            pass
        assert path.read_text() == text
        with lock.hold(path, "It"):
            pass
        path.unlink()
    with lock.hold(path, "It", one_machine=True):
        pass


def test_what_goes_wrong_under_a_lock_is_no_failure_to_lock(tmp_path):
    """An error of the work itself comes through as it is, and the lock is given back."""
    with pytest.raises(OSError, match="disk full"), lock.hold(tmp_path / "lock", "It"):
        raise OSError("disk full")
    with lock.hold(tmp_path / "lock", "It"):
        pass


def test_file_system_without_locks_is_refused(tmp_path, monkeypatch):
    """A file system that cannot lock, or a folder that cannot be written, is said in one line."""

    def refuse(file):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(lock, "_lock", refuse)
    with (
        pytest.raises(RunError, match=r"lock cannot be locked \(No locks available"),
        lock.hold(tmp_path / "lock", "It"),
    ):
        pass
    with pytest.raises(RunError, match="No such file"), lock.hold(tmp_path / "missing" / "lock", "It"):
        pass


def test_who_has_only_just_taken_it_is_named(tmp_path, monkeypatch):
    """Between taking a lock and writing its name lies a moment; who comes then waits for the name."""
    path, name = tmp_path / "lock", json.dumps({"machine": "there", "process": 7})
    with path.open("a+") as file:
        lock._lock(file)
        monkeypatch.setattr(lock.time, "sleep", lambda seconds: print(name, end="", file=file, flush=True))
        with pytest.raises(RunError, match="It is being worked on by process 7 on there"), lock.hold(path, "It"):
            pass
        file.truncate(0)
        monkeypatch.setattr(lock.time, "sleep", lambda seconds: None)
        with pytest.raises(RunError, match="It is being worked on by another process"), lock.hold(path, "It"):
            pass
