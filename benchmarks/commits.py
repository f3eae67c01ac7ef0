"""This checkout against another commit: alternating whole training runs, compared by the times that they log.

The two versions share nothing but the command line, so any commit since 0.1.0 can be measured in the same run.
"""

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.table import Table

from benchmarks.timing import wide_console
from deimos.checks import RunError
from deimos.run.folder import RunFolder

HOME = Path(__file__).resolve().parent.parent
WARM = 3  # iterations at the start of a run that are not counted: kernels are compiled and memory is allocated there
JOBS = {
    # The main job, shortened; and so many worlds that the environment's step works in memory, not in caches.
    "2000 worlds": ["--num-envs", "2000", "--env-steps", "960"],
    "65536 worlds": ["--num-envs", "65536", "--env-steps", "192", "--ppo.epochs", "1"],
}


def measure(commit: str, rounds: int, threads: int) -> dict[str, Any]:
    """``compare`` with another commit of this repository.

    Raises:
        RunError: If the commit does not exist, or a run fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        _git("worktree", "add", "--detach", str(other), commit)
        try:
            return compare(other, rounds, threads)
        finally:
            _git("worktree", "remove", "--force", str(other))


def compare(other: Path, rounds: int, threads: int, jobs: dict[str, list[str]] = JOBS) -> dict[str, Any]:
    """Frames per second, the environment's step and the process's CPU time of two checkouts, and their ratios.

    Args:
        other: Folder of the other checkout.
        rounds: Alternating runs of each checkout and job, over which figures are medians.
        threads: CPU threads of a run.
        jobs: Options of ``train.py`` by name.
    """
    results: dict[str, Any] = {}
    for job, options in jobs.items():
        runs: dict[str, list[dict[str, float]]] = {"other": [], "this": []}
        for _ in range(rounds):
            for name, home in (("other", other), ("this", HOME)):
                runs[name].append(train_once(home, [*options, "--threads", str(threads)]))
        ratios = [
            {key: this[key] / that[key] for key in this} for this, that in zip(runs["this"], runs["other"], strict=True)
        ]
        results[job] = {name: _medians(found) for name, found in (runs | {"ratio": ratios}).items()}
    return results


def train_once(home: Path, options: list[str]) -> dict[str, float]:
    """Train in a checkout; waiting threads sleep, so that a busy machine disturbs less."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "train.py", "--device", "cpu", "--no-evaluation", *options, "--out", str(out)]
        env = os.environ | {"OMP_WAIT_POLICY": "passive"}
        before = os.times()
        done = subprocess.run(command, cwd=home, env=env, capture_output=True, text=True, check=False)
        after = os.times()
        if done.returncode != 0:
            raise RunError(f"{' '.join(command)} in {home} failed: {done.stderr.strip()}")
        rows = RunFolder(out).read_csv("timing.csv")[WARM:]
    return {
        "FPS": statistics.median(float(row["fps"]) for row in rows),
        "env, ms per iteration": 1000 * statistics.median(float(row["env"]) for row in rows),
        "CPU, s": after.children_user + after.children_system - before.children_user - before.children_system,
    }


def _medians(runs: list[dict[str, float]]) -> dict[str, float]:
    return {key: statistics.median(run[key] for run in runs) for key in runs[0]}


def _git(*arguments: str) -> None:
    done = subprocess.run(["git", *arguments], cwd=HOME, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RunError(f"git {arguments[0]} {arguments[1]} failed: {done.stderr.strip().splitlines()[-1]}")


def show(results: dict[str, Any], commit: str) -> None:
    """Print a table for each job."""
    for job, found in results.items():
        table = Table(title=f"{job}: this checkout beside {commit}", title_justify="left")
        for title in ("", commit, "this", "this / other"):
            table.add_column(title, justify="right" if title else "left")
        for key, ratio in found["ratio"].items():
            table.add_row(key, f"{found['other'][key]:.4g}", f"{found['this'][key]:.4g}", f"{ratio:.3f}")
        wide_console().print(table)
