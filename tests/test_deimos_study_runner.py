"""Studies run for real, on tiny budgets: stopped, killed, resumed, with workers that die."""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import deimos
from deimos.checks import RunError
from deimos.lock import hold
from deimos.run import evaluation
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.study import cell as worker
from deimos.study import cli, plan, runner
from deimos.study.engine import LocalProcesses, last_words
from deimos.study.folder import StudyFolder
from deimos.study.results import result

ITERATIONS = 80

RUN = """
import sys
from pathlib import Path
from deimos.study import cli
cli.RunOptions(folder=Path(sys.argv[1]), workers=2).run()
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory, short_study):
    """The study in a TOML file."""
    path = tmp_path_factory.mktemp("toml") / "study.toml"
    path.write_text(short_study(1920))
    return path


@pytest.fixture(scope="module")
def whole(file, tmp_path_factory):
    """The study run without interruption."""
    folder = tmp_path_factory.mktemp("studies") / "whole"
    cli.RunOptions(folder=folder, file=file, workers=2, allow_uncommitted=True).run()
    return StudyFolder(folder)


def table(study):
    """Its results without what depends on the clock, NaN made comparable, in a fixed order."""
    rows = [{name: repr(value) for name, value in row.items() if name != "fps"} for row in study.results().rows]
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


def test_the_scale_of_the_score_is_computed_once(whole):
    """All cells of a task share its scale, which is that of an evaluation by itself; another task has its own."""
    (kept,) = RunFolder(whole.path).read_rows("scales.json")
    cell = whole.cells()[0]
    path, config = whole.cell_path(cell) / "run", cell.config
    rows = evaluation.evaluate_run(RunFolder.open(path), config.env, config.eval, torch.device("cpu"))
    stored = {row["goals"]: row["score"] for row in whole.results().rows if row["hash"] == cell.digest}
    assert {row["goals"]: row["score"] for row in rows} == stored
    task = {name: value for name, value in kept.items() if name not in ("measure", "low", "high")}
    assert whole.scale(task, pytest.fail) == (kept["measure"], kept["low"], kept["high"])
    other = StudyFolder(whole.path.parent / "other")
    other.path.mkdir()
    missing = ("return_per_step", math.nan, math.nan)
    for name, scale in (("a", ("matching", 0.25, 1.0)), ("b", missing), ("c", (kept["measure"], 0.1, 1.0 / 3.0))):
        assert other.scale({"environment": name}, lambda scale=scale: scale) is scale
        assert repr(other.scale({"environment": name}, pytest.fail)) == repr(scale)


def test_study_leaves_its_tables(whole):
    """A finished study has a row per policy and evaluation, a curve per run, run folders, and nobody works on it."""
    cells = whole.cells()
    rows = whole.results().rows
    assert [(row["method"], row["goals"]) for row in sorted(rows, key=lambda r: (r["method"], r["goals"]))] == [
        (method, goals) for method in ("p25", "uniform") for goals in ("argmax", "naive", "scripted")
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
        assert (row["environment"], row["base_environment"], row["levels"]) == ("directional", "directional", {})
        assert row["code"] == cell.sources["code"]
        assert 0.0 <= row["worst"] <= 1.0
        assert row["worst_attacker"] in ("argmax", "scripted")
        assert (row["setting"], row["selector"]) == (cell.setting, cell.selector)
        assert "torch=" in row["versions"]
        assert (row["tracking"], row["errors"]) == ((), {})  # a particle's goal is all of a piece
        legged = twin | {"tracking": [0.6, 0.7], "errors": {"reach": 0.02}}
        (row,) = result(cell, RunFolder(whole.cell_path(cell) / "run"), [legged])["rows"]
        assert (row["tracking"], row["errors"]) == ([0.6, 0.7], {"reach": 0.02})
    curves = whole.results().curves
    assert {line["hash"] for line in curves} == set(by_digest)
    assert all(line["env_steps"][-1] == 1920 and len(line["crashes_per_1000"]) == ITERATIONS for line in curves)
    assert whole.finished(cells) == set(by_digest)
    for path in (whole.path, *map(whole.cell_path, cells)):
        assert (path / "lock").read_text() == ""


def test_a_cell_takes_its_own_evaluations_only(whole, tmp_path, monkeypatch):
    """What somebody else evaluated in a cell's run is none of its results, and its own evaluations are not repeated."""
    folder = tmp_path / "copy"
    shutil.copytree(whole.path, folder)
    study = StudyFolder(folder)
    cell = study.cells()[0]
    path = study.cell_path(cell)
    before = RunFolder(path).read_json("result.json")
    deimos.evaluate(path / "run", worlds=8, seed=7)
    (path / "result.json").unlink()
    monkeypatch.setattr("deimos.run.evaluation.evaluate", lambda *args: pytest.fail("evaluated again"))
    assert worker.run(study, cell)
    assert RunFolder(path).read_json("result.json") == before


def test_finished_study_starts_nothing(whole, file, monkeypatch):
    """Giving the command again adds no row and starts no process."""
    paths = [whole.cell_path(cell) / "result.json" for cell in whole.cells()]
    before = [path.read_bytes() for path in paths]
    monkeypatch.setattr(LocalProcesses, "run", lambda self, cell: pytest.fail("something was started"))
    cli.RunOptions(folder=whole.path, file=file, allow_uncommitted=True).run()
    assert [path.read_bytes() for path in paths] == before


def test_stopped_and_killed_study_ends_with_the_same_table(whole, file, tmp_path):
    """A study interrupted, then killed with SIGKILL, ends with the table of one that was not, no cell twice."""
    study = StudyFolder(tmp_path / "broken")
    options = cli.RunOptions(folder=study.path, file=file, workers=2, allow_uncommitted=True)
    with pytest.raises(SystemExit) as stop:
        options.run(stopped=lambda: min(iterations(study).values(), default=0) >= 2)
    assert stop.value.code == 130
    stopped_at = iterations(study)
    assert all(2 <= count < ITERATIONS for count in stopped_at.values())
    assert not any(study.failures(cell) for cell in study.cells())
    kept = {name: rows[: stopped_at[name]] for name, rows in timing(study).items()}

    runner = subprocess.Popen([sys.executable, "-c", RUN, str(study.path)], stderr=subprocess.DEVNULL)
    wait_until(lambda: any(count > stopped_at[name] for name, count in iterations(study).items()))
    runner.kill()
    runner.wait()
    for cell in study.cells():  # its workers end by themselves
        with hold(study.cell_path(cell) / "lock", cell.name, patience=60.0):
            pass
    assert len(study.results().rows) < 6

    cli.RunOptions(folder=study.path, workers=2).run()
    assert table(study) == table(whole)
    assert len(study.results().rows) == 6
    assert len(study.results().curves) == 2
    again = {name: rows[: stopped_at[name]] for name, rows in timing(study).items()}
    assert again == kept  # what was trained before the stop was not trained again


def test_worker_that_dies_is_retried_once_then_given_up(file, tmp_path, capsys):
    """A cell whose worker is killed twice is recorded as failed while the rest finish; later it can be tried again."""
    study = StudyFolder(tmp_path / "study")
    study.add(plan.expand(plan.read(file)))
    victim = next(cell for cell in study.cells() if cell.config.method == "p25")
    killed = []

    def kill(progress):
        for process in [] if victim.name not in progress.running else [*engine._running]:
            if victim.name in process.args and process.pid not in killed:
                process.kill()
                killed.append(process.pid)

    engine = LocalProcesses(study)
    end = runner.Runner(study, engine, 2).run(kill, lambda: False)
    assert len(killed) == 2
    error = "killed by SIGKILL (out of memory?)"
    assert study.failures(victim) == [error, error]
    assert end.failed == {victim.name: error}
    assert (end.finished, end.total, end.running) == (1, 2, {})
    assert {row["method"] for row in study.results().rows} == {"uniform"}

    with pytest.raises(
        RunError, match=rf"1 of 2 cells failed, {victim.name.replace('+', '.')} first: killed by SIGKILL"
    ):
        cli.RunOptions(folder=study.path).run()
    cli.ShowOptions(folder=study.path).run()
    assert f"{victim.name} failed: {error}" in capsys.readouterr().out
    cli.RunOptions(folder=study.path, retry_failed=True).run()
    said = capsys.readouterr()
    assert said.out == f"{study.path}\n"
    assert said.err.startswith("1 run(s): 0.0 M transitions (FPS measured on a short run of each kind) + ")
    assert said.err.endswith(f" core-hours.\nNext: deimos study report {study.path}\n")
    assert study.finished(study.cells()) == {cell.digest for cell in study.cells()}


def test_study_that_is_worked_on_is_refused(whole):
    """A second runner, here or on another machine, is refused in one line that names the first."""
    command = cli.RunOptions(folder=whole.path)
    with whole.hold(), pytest.raises(RunError, match=f"whole is being worked on by process {os.getpid()} on "):
        command.run()
    lock = whole.path / "lock"
    lock.write_text('{"machine": "elsewhere", "process": 7}')
    with pytest.raises(RunError, match="whole was last worked on by process 7 on elsewhere"):
        command.run()
    lock.unlink()
    command.run()


def test_cell_that_is_worked_on_is_refused(whole, tmp_path, monkeypatch):
    """A cell is worked on by one process at a time, whatever engine began it."""
    study = StudyFolder(tmp_path / "study")
    study.add(whole.cells()[:1])
    (cell,) = study.cells()
    monkeypatch.setattr(worker, "PATIENCE_SECONDS", 0.0)
    with hold(study.cell_path(cell) / "lock", "x"), pytest.raises(RunError, match=f"Cell {cell.name} is being worked"):
        worker.run(study, cell)
    assert not (study.cell_path(cell) / "run").exists()


class Answers:
    """An engine that works on nothing and gives answers in turn."""

    def __init__(self, *answers):
        self.answers = list(answers)
        self.stopped = 0

    def run(self, cell):
        """The next answer."""
        return self.answers.pop(0)

    def stop(self):
        """Take note of it."""
        self.stopped += 1

    def kill(self):
        """There is nothing to end."""


def test_any_engine_is_retried_once(whole, tmp_path):
    """An engine that says what failed, or leaves no result, is asked once more; a stop is passed on to it once."""
    study = StudyFolder(tmp_path / "study")
    study.add(whole.cells()[:1])
    (cell,) = study.cells()
    engine = Answers("the node is lost", None)
    end = runner.Runner(study, engine, 1).run(lambda progress: None, lambda: False)
    assert study.failures(cell) == ["the node is lost", "it ended without results"]
    assert end.failed == {cell.name: "it ended without results"}
    study.forget_failures()
    engine = Answers(None)
    asked = iter([False, *[True] * 9])
    engine.run = lambda cell: wait_until(lambda: engine.stopped)
    end = runner.Runner(study, engine, 1).run(lambda progress: None, lambda: next(asked))
    assert (engine.stopped, end.finished, end.failed, study.failures(cell)) == (1, 0, {}, [])


def test_a_signal_to_all_processes_is_no_failure(file, tmp_path):
    """A worker that ends by the signal that ends the study, be it a moment earlier, has not failed."""
    study = StudyFolder(tmp_path / "study")
    study.add(plan.expand(plan.read(file))[:1])
    (cell,) = study.cells()
    end = runner.Runner(study, Answers(None), 1).run(lambda progress: None, lambda: True)
    assert (end.finished, end.failed, study.failures(cell)) == (0, {}, [])
    command = [sys.executable, "-m", "deimos.study.cell", str(study.path), cell.name]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        wait_until(lambda: (study.cell_path(cell) / "run" / "progress.csv").exists(), seconds=300)
        process.terminate()
        assert process.wait() == 130 or study.finished([cell])  # it may have been quicker
    assert (study.cell_path(cell) / "run" / "checkpoint.pt").exists()


def test_what_is_left_counts_evaluations(whole, tmp_path, monkeypatch):
    """Training and evaluations count by what they are expected to take, and what was done before as no progress."""
    study = StudyFolder(tmp_path / "study")
    study.add(whole.cells())
    first, second = study.cells()
    clock = iter([0.0])
    monkeypatch.setattr(runner, "time", SimpleNamespace(monotonic=lambda: next(clock, 10.0)))
    run, source = (each.cell_path(first) / "run" for each in (study, whole))
    run.mkdir()
    lines = (source / "timing.csv").read_text().splitlines(keepends=True)
    (run / "timing.csv").write_text("".join(lines[: 1 + ITERATIONS // 4]))
    rows = RunFolder(source).read_rows("evaluation.json")
    seen, of = [], 1 / len(rows)

    def work(cell):
        """Train the first cell to its end, then evaluate it under some of its goals."""
        for name, text in (("timing.csv", "".join(lines)), ("evaluation.json", json.dumps(rows[:1]))):
            (run / name).write_text(text)
            before = len(seen)
            wait_until(lambda before=before: len(seen) > before + 1)
        wait_until(lambda: engine.stopped)

    engine = Answers()
    engine.run = work
    takes = {first.name: (40.0, 60.0), second.name: (100.0, 100.0)}
    monkeypatch.setattr(runner, "POLL_SECONDS", 0.02)
    runner.Runner(study, engine, 1, takes).run(seen.append, lambda: seen[-1].running.get(first.name) == (1.0, of))
    trained = next(each for each in seen if each.running.get(first.name) == (1.0, 0.0))
    assert trained.share == pytest.approx(0.5 * 0.4)
    assert trained.seconds_left == pytest.approx(10.0 * (60.0 + 200.0) / (0.75 * 40.0))
    evaluated = next(each for each in seen if each.running.get(first.name) == (1.0, of))
    assert evaluated.share == pytest.approx(0.5 * (0.4 + 0.6 * of))
    assert evaluated.seconds_left == pytest.approx(10.0 * (60.0 * (1 - of) + 200.0) / (0.75 * 40.0 + 60.0 * of))


def test_failure_is_told_by_its_last_line(tmp_path):
    """The line of a failure is the last that the worker said, or the signal that ended it."""
    log = tmp_path / "log.txt"
    log.write_text("Traceback (most recent call last):\n  ...\nValueError: 3 is too many\n\n")
    assert last_words(1, log) == "ValueError: 3 is too many"
    assert last_words(-signal.SIGSEGV, log) == "killed by SIGSEGV"
    log.write_text("\n")
    assert last_words(1, log) == "exit code 1 without results"


def test_failure_that_cannot_be_recorded_is_said(tmp_path):
    """Where the disk is full, the error names the file, and how the cell failed."""
    study = StudyFolder(tmp_path)
    cell = plan.Cell(environment="a", config=TrainConfig(), goal_periods=(100,))
    (study.cell_path(cell) / "failures.jsonl").mkdir(parents=True)
    with pytest.raises(RunError, match=r"failures\.jsonl could not be written .* it was to say how .*: killed by X"):
        study.record_failure(cell, "killed by X")


def test_a_worker_takes_no_module_of_the_working_directory(whole, tmp_path, monkeypatch):
    """A file of the user's that has the name of one of Python's modules is not imported in its place."""
    (tmp_path / "statistics.py").write_text("raise RuntimeError('not this one')\n")
    monkeypatch.chdir(tmp_path)
    study = StudyFolder(whole.path.absolute())
    assert LocalProcesses(study).run(study.cells()[0]) is None


def test_cell_of_another_version_is_refused(whole, tmp_path):
    """A cell whose configuration means something else today is refused, by the runner and by its worker."""
    study = StudyFolder(tmp_path / "study")
    study.add(whole.cells()[:1])
    (cell,) = study.cells()
    study.cell_path(cell).rename(study.path / "cells" / "directional-p25-s0-00000000")
    with pytest.raises(RunError, match="was made by another version of Deimos"):
        cli.RunOptions(folder=study.path).run()


def test_worker_without_results_has_failed(whole, tmp_path, monkeypatch):
    """A worker that ends well but leaves no rows counts as dead: its cell is not started for ever."""
    study = StudyFolder(tmp_path / "study")
    study.add(whole.cells()[:1])
    begun = []

    def idle(*arguments, **options):
        begun.append(popen([sys.executable, "-c", ""], stdin=subprocess.PIPE, bufsize=0))
        return begun[-1]

    popen = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", idle)
    end = runner.Runner(study, LocalProcesses(study), 1).run(lambda progress: None, lambda: False)
    assert len(begun) == 2
    assert list(end.failed.values()) == ["it ended without results"]


def test_broken_run_is_one_line_of_a_worker(whole, tmp_path, capsys):
    """A worker whose run folder is damaged says so in one line and ends with code 2."""
    study = StudyFolder(tmp_path / "study")
    study.add(whole.cells()[:1])
    (cell,) = study.cells()
    run = study.cell_path(cell) / "run"
    run.mkdir()
    (run / "checkpoint.pt").write_text("not a checkpoint")
    (run / "config.json").write_text("{}")
    assert worker.main([str(study.path), cell.name]) == 2
    assert capsys.readouterr().err == f"{Path(run) / 'config.json'} does not belong to a run of schema 1.\n"
