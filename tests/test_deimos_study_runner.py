"""Studies run for real, on tiny budgets: stopped, killed, resumed, with workers that die."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from deimos.run.folder import RunError, RunFolder
from deimos.study import cell as worker
from deimos.study import cli, lease, plan
from deimos.study.folder import StudyFolder, result_rows
from deimos.study.results import TIMED
from deimos.study.runner import Runner

STUDY = """
seeds = 1
methods = ["uniform", "p25"]
[train]
num_envs = 16
env_steps = 1920
device = "cpu"
ppo = { hidden = [8], epochs = 1 }
eval = { worlds = 16, steps = 40, adversary_steps = 40, adversary_patience = 1 }
[[environment]]
name = "directional"
env = { kind = "particle", variant = "directional", goal_period = 10, max_speed = 200.0, max_force = 200.0 }
"""
ITERATIONS = 80

RUN = """
import sys
from pathlib import Path
from deimos.study import cli
cli.run(cli.RunOptions(folder=Path(sys.argv[1]), workers=2))
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """The study in a TOML file."""
    path = tmp_path_factory.mktemp("toml") / "study.toml"
    path.write_text(STUDY)
    return path


@pytest.fixture(scope="module")
def whole(file, tmp_path_factory):
    """The study run without interruption."""
    folder = tmp_path_factory.mktemp("studies") / "whole"
    cli.run(cli.RunOptions(folder=folder, file=file, workers=2))
    return StudyFolder(folder)


def table(study):
    """Its results without what depends on the clock, NaN made comparable, in a fixed order."""
    rows = [{name: repr(value) for name, value in row.items() if name not in TIMED} for row in study.results.read()]
    return sorted(rows, key=lambda row: (row["hash"], row["goals"]))


def timing(study):
    """What every cell's iterations took, by its name."""
    paths = {cell.name: study.cell_path(cell) / "run" for cell in study.cells()}
    return {name: RunFolder(path).read_csv("timing.csv") for name, path in paths.items()}


def iterations(study):
    """Iterations that every cell has done, by its name."""
    return {name: len(rows) for name, rows in timing(study).items()}


def wait_until(condition, seconds=120):
    """Wait for something to become true."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never became true"
        time.sleep(0.02)


def test_study_leaves_its_tables(whole):
    """A finished study has a row per policy and evaluation, a curve per run, run folders, and nobody works on it."""
    cells = whole.cells()
    rows = whole.results.read()
    assert [(row["method"], row["goals"]) for row in sorted(rows, key=lambda r: (r["method"], r["goals"]))] == [
        (method, goals) for method in ("p25", "uniform") for goals in ("adversary", "naive")
    ]
    by_digest = {cell.digest: cell for cell in cells}
    for row in rows:
        cell = by_digest[row["hash"]]
        stored = RunFolder(whole.cell_path(cell) / "run").read_json("evaluation.json")
        twin = next(each for each in stored if each["goals"] == row["goals"])
        assert {name: row[name] for name in ("reward", "crashes", "weights")} == {
            name: twin[name] for name in ("reward", "crashes", "weights")
        }
        assert (row["seed"], row["eval_seed"]) == (0, twin["seed"])
        assert (row["setting"], row["selector"]) == (cell.setting, cell.selector)
        assert "torch=" in row["versions"]
        assert (row["tracking"], row["errors"]) == ((), {})  # a particle's goal is all of a piece
        legged = twin | {"tracking": [0.6, 0.7], "errors": {"reach": 0.02}}
        (row,) = result_rows(cell, RunFolder(whole.cell_path(cell) / "run"), [legged])
        assert (row["tracking"], row["errors"]) == ([0.6, 0.7], {"reach": 0.02})
    curves = whole.curves.read()
    assert {line["hash"] for line in curves} == set(by_digest)
    assert all(line["env_steps"][-1] == 1920 and len(line["crashes_per_1000"]) == ITERATIONS for line in curves)
    assert whole.finished(cells) == set(by_digest)
    assert not any(lease.is_held(whole.cell_path(cell)) for cell in cells)


def test_finished_study_starts_nothing(whole, file, monkeypatch):
    """Giving the command again adds no row and starts no process."""
    before = whole.results.path.read_bytes()
    monkeypatch.setattr(subprocess, "Popen", None)
    cli.run(cli.RunOptions(folder=whole.path, file=file))
    assert whole.results.path.read_bytes() == before


def test_stopped_and_killed_study_ends_with_the_same_table(whole, file, tmp_path):
    """A study interrupted, then killed with SIGKILL, ends with the table of one that was not, no cell twice."""
    study = StudyFolder(tmp_path / "broken")
    options = cli.RunOptions(folder=study.path, file=file, workers=2)
    with pytest.raises(SystemExit) as stop:
        cli.run(options, stopped=lambda: min(iterations(study).values(), default=0) >= 2)
    assert stop.value.code == 130
    stopped_at = iterations(study)
    assert all(2 <= count < ITERATIONS for count in stopped_at.values())
    assert not any(study.failures(cell) for cell in study.cells())
    kept = {name: rows[: stopped_at[name]] for name, rows in timing(study).items()}

    runner = subprocess.Popen([sys.executable, "-c", RUN, str(study.path)], stderr=subprocess.DEVNULL)
    wait_until(lambda: any(count > stopped_at[name] for name, count in iterations(study).items()))
    runner.kill()
    runner.wait()
    newest = [max(study.cell_path(cell).glob("claim-*")) for cell in study.cells()]
    pids = [pid for path in newest for pid in json.loads(path.read_text())["pids"]]
    wait_until(lambda: not any(lease._is_alive(pid) for pid in pids))
    assert len(study.results.read()) < 4

    cli.run(cli.RunOptions(folder=study.path, workers=2))
    assert table(study) == table(whole)
    assert len(study.results.read()) == 4
    assert len(study.curves.read()) == 2
    again = {name: rows[: stopped_at[name]] for name, rows in timing(study).items()}
    assert again == kept  # what was trained before the stop was not trained again


def test_worker_that_dies_is_retried_once_then_given_up(file, tmp_path, capsys):
    """A cell whose worker is killed twice is recorded as failed while the rest finish; later it can be tried again."""
    study = StudyFolder(tmp_path / "study")
    study.add(plan.expand(plan.read(file)))
    victim = next(cell for cell in study.cells() if cell.config.method == "p25")
    killed = []

    def kill(progress):
        for running in progress.running:
            if running.name == victim.name:
                pid = json.loads(max(study.cell_path(victim).glob("claim-*")).read_text())["pids"][1]
                if pid not in killed:
                    os.kill(pid, signal.SIGKILL)
                    killed.append(pid)

    end = Runner(study, 2).run(kill, lambda: False)
    assert len(killed) == 2
    error = "killed by SIGKILL (out of memory?)"
    assert study.failures(victim) == [error, error]
    assert end.failed == {victim.name: error}
    assert (end.finished, end.total, end.running) == (1, 2, [])
    assert {row["method"] for row in study.results.read()} == {"uniform"}

    with pytest.raises(
        RunError, match=rf"1 of 2 cells failed, {victim.name.replace('+', '.')} first: killed by SIGKILL"
    ):
        cli.run(cli.RunOptions(folder=study.path))
    cli.show(cli.ShowOptions(folder=study.path))
    assert f"{victim.name} failed: {error}" in capsys.readouterr().out
    cli.run(cli.RunOptions(folder=study.path, retry_failed=True))
    assert study.finished(study.cells()) == {cell.digest for cell in study.cells()}


def test_cell_held_elsewhere_is_left_alone(whole, file, tmp_path):
    """A runner waits for a cell that another machine works on, and does not touch it."""
    study = StudyFolder(tmp_path / "study")
    study.add(plan.expand(plan.read(file), methods=["uniform"]))
    (cell,) = study.cells()
    (study.cell_path(cell) / "claim-0").write_text(json.dumps({"machine": "elsewhere", "pids": [1]}))
    seen = []

    def report(progress):
        seen.append((progress.elsewhere, len(progress.running)))
        rows = [row for row in whole.results.read() if row["method"] == "uniform"]
        study.results.append(rows)  # the other machine finishes it

    end = Runner(study, 1).run(report, lambda: False)
    assert seen[0] == (1, 0)
    assert end.finished == 1
    assert not (study.cell_path(cell) / "run").exists()


def test_failure_is_told_by_its_last_line(tmp_path):
    """The line of a failure is the last that the worker said, or the signal that ended it."""
    from deimos.study.runner import _last_words

    log = tmp_path / "log.txt"
    log.write_text("Traceback (most recent call last):\n  ...\nValueError: 3 is too many\n\n")
    assert _last_words(1, log) == "ValueError: 3 is too many"
    assert _last_words(-signal.SIGSEGV, log) == "killed by SIGSEGV"
    assert _last_words(worker.STOPPED, log) == "exit code 130 without results"
    assert _last_words(0, log) == "exit code 0 without results"


def test_cell_of_another_version_is_refused(whole, tmp_path):
    """A cell whose configuration means something else today is refused, by the runner and by its worker."""
    study = StudyFolder(tmp_path / "study")
    study.add(whole.cells()[:1])
    (cell,) = study.cells()
    study.cell_path(cell).rename(study.path / "cells" / "directional-p25-s0-00000000")
    with pytest.raises(RunError, match="was made by another version of Deimos"):
        cli.run(cli.RunOptions(folder=study.path))


def test_worker_without_results_has_failed(whole, tmp_path, monkeypatch):
    """A worker that ends well but leaves no rows counts as dead: its cell is not started for ever."""
    study = StudyFolder(tmp_path / "study")
    study.add(whole.cells()[:1])
    begun = []

    def idle(*arguments, **options):
        begun.append(popen([sys.executable, "-c", ""]))
        return begun[-1]

    popen = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", idle)
    end = Runner(study, 1).run(lambda progress: None, lambda: False)
    assert len(begun) == 2
    assert list(end.failed.values()) == ["exit code 0 without results"]


def test_broken_run_is_one_line_of_a_worker(whole, tmp_path, capsys):
    """A worker whose run folder is damaged says so in one line and ends with code 2."""
    study = StudyFolder(tmp_path / "study")
    study.add(whole.cells()[:1])
    (cell,) = study.cells()
    run = study.cell_path(cell) / "run"
    run.mkdir()
    (run / "checkpoint.pt").write_text("not a checkpoint")
    handler = signal.getsignal(signal.SIGINT)
    try:
        assert worker.main([str(study.path), cell.name, str(os.getppid())]) == 2
    finally:
        signal.signal(signal.SIGINT, handler)
    assert capsys.readouterr().err == f"{Path(run)} is not a run folder: it holds no config.json.\n"
