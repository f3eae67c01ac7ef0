"""Leases: one holder at a time, taken over from the dead and from nobody else."""

import json
import os
import subprocess
import sys
import time

import pytest

from deimos.study import lease

TAKER = """
import sys, time
from pathlib import Path
from deimos.study import lease
folder = Path(sys.argv[1])
while not (folder / "go").exists():
    time.sleep(0.001)
print(lease.take(folder) is not None)
sys.stdin.read()
"""


def age(folder, seconds):
    """Make the newest claim look as if its holder had been silent for so long."""
    path = max(folder.glob("claim-*"))
    stamp = time.time() - seconds
    os.utime(path, (stamp, stamp))
    return path


def test_one_of_many_gets_it(tmp_path):
    """Of several processes that reach for a cell at once exactly one gets it, also after a holder's death."""
    for dead in (False, True):
        command = [sys.executable, "-c", TAKER, str(tmp_path)]
        takers = [subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(4)]
        (tmp_path / "go").touch()
        said = [taker.stdout.readline().strip() for taker in takers]
        for taker in takers:
            taker.communicate()
        assert sorted(said) == ["False", "False", "False", "True"], f"after a death: {dead}"
        (tmp_path / "go").unlink()


def test_held_lease_is_not_taken(tmp_path):
    """A living holder of this machine keeps its lease until it gives it back."""
    held = lease.take(tmp_path)
    assert held is not None
    assert lease.is_held(tmp_path)
    assert lease.take(tmp_path) is None
    assert held.renew()
    held.release()
    assert not lease.is_held(tmp_path)
    assert lease.take(tmp_path) is not None


def test_dead_holder_of_this_machine_loses_it_at_once(tmp_path):
    """A lease whose processes are all gone is free, and one with a process that still works is not."""
    held = lease.take(tmp_path)
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    held.name_holders([gone.pid, os.getpid()])
    assert lease.take(tmp_path) is None
    held.name_holders([gone.pid])
    assert lease.take(tmp_path) is not None


def test_silent_holder_elsewhere_loses_it(tmp_path):
    """A holder on another machine is believed for a minute, whatever its process numbers mean here."""
    held = lease.take(tmp_path)
    path = tmp_path / "claim-0"
    path.write_text(json.dumps({"machine": "elsewhere", "pids": [2**22 - 1]}))
    assert lease.take(tmp_path) is None
    age(tmp_path, lease.STALE_SECONDS - 10)
    assert lease.take(tmp_path) is None
    age(tmp_path, lease.STALE_SECONDS + 10)
    assert lease.take(tmp_path) is not None
    assert not held.renew()


def test_lease_that_is_being_written_is_held(tmp_path):
    """An empty claim belongs to somebody who is about to write it."""
    (tmp_path / "claim-0").touch()
    assert lease.is_held(tmp_path)
    assert lease.take(tmp_path) is None


@pytest.mark.parametrize("count", [12])
def test_claims_are_numbered_beyond_nine(tmp_path, count):
    """The highest number counts, not the last name in the alphabet."""
    for i in range(count):
        held = lease.take(tmp_path)
        assert held is not None
        assert (tmp_path / f"claim-{i}").exists()
        held.release()
