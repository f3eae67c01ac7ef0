"""A study on a Ray cluster of two machines, both on this one: `python .ci/check_ray.py` (extras study and cluster).

A worker is killed, then a whole machine; the study finishes with the table of a local one, no cell is recorded as
failed, and a second run starts nothing.
"""

import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

import ray
from ray.cluster_utils import Cluster

from deimos.study import cli
from deimos.study.folder import StudyFolder
from deimos.study.on_ray import OnRay

STUDY = """
seeds = 1
audit_worlds = 0
methods = ["uniform", "p25"]
[train]
num_envs = 16
env_steps = 1920
device = "cpu"
ppo = { hidden = [8], epochs = 1 }
eval = { worlds = 16, steps = 40, adversary_steps = 40 }
[[environment]]
name = "directional"
env = { kind = "particle", variant = "directional", goal_period = 10, max_speed = 200.0, max_force = 200.0 }
"""


def table(study: StudyFolder) -> list[list[tuple[str, str]]]:
    """The results without timings, in a fixed order."""
    rows = [[(name, repr(value)) for name, value in row.items() if name != "fps"] for row in study.results().rows]
    return sorted(rows)


def train_in(study: StudyFolder) -> dict[int, str]:
    """Processes that work on cells of a study, with the names of the cells."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().decode().split("\0")
        except OSError:  # it has ended
            continue
        if "deimos.study.cell" in words and str(study.path) in words:
            found[int(path.parent.name)] = words[-2]
    return found


def wait_until(what: str, condition, seconds: float = 900.0) -> None:  # noqa: ANN001
    """Wait for something to become true, or end the program."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            sys.exit(f"It never came true: {what}")
        time.sleep(0.05)


def parent(process: int) -> int:
    """The parent of a process."""
    return int(Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[1])


def main() -> None:
    """Run the check; ends with an error if something does not hold."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder).resolve() / "study.toml"
        file.write_text(STUDY)
        here, there = (StudyFolder(file.with_name(name)) for name in ("local", "ray"))
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
        machines = [cluster.add_node(num_cpus=1) for _ in range(2)]
        os.environ["RAY_ADDRESS"] = cluster.address
        options = cli.RunOptions(folder=there.path, file=file, engine="ray", allow_uncommitted=True)
        runner = threading.Thread(target=options.run)
        runner.start()

        wait_until("two cells at a time", lambda: len(train_in(there)) == 2)
        victim, name = next(iter(train_in(there).items()))
        wait_until("a first checkpoint", (there.path / "cells" / name / "run" / "checkpoint.pt").exists)
        os.kill(parent(victim), signal.SIGKILL)  # Ray's worker; its children end with it
        wait_until(
            "the cell goes on elsewhere", lambda: name in train_in(there).values() and victim not in train_in(there)
        )
        cluster.remove_node(machines[0], allow_graceful=False)  # a machine is lost
        runner.join()

        cells = there.cells()
        assert there.finished(cells) == {cell.digest for cell in cells}
        assert not any(there.failures(cell) for cell in cells), [there.failures(cell) for cell in cells]
        cli.RunOptions(folder=here.path, file=file, allow_uncommitted=True).run()
        assert table(there) == table(here)

        OnRay.run = lambda *_: sys.exit("A finished cell was begun again.")  # type: ignore[method-assign]
        cli.RunOptions(folder=there.path, file=file, engine="ray", allow_uncommitted=True).run()
        assert table(there) == table(here)
        ray.shutdown()
        cluster.shutdown()
    print("A study on a Ray cluster of two: a worker and a machine were lost, and the table is that of a local one.")


if __name__ == "__main__":
    main()
