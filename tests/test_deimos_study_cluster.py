"""Studies on clusters: one cell by its number, as Slurm's arrays ask for it, and what Ray is asked for."""

import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from deimos.checks import RunError
from deimos.study import cell as worker
from deimos.study import cli, on_ray, plan
from deimos.study.estimate import Estimate
from deimos.study.folder import StudyFolder

EXAMPLES = Path(__file__).parent.parent / "examples" / "cluster"


@pytest.fixture
def study(tmp_path, short_study):
    """A study of two cells, none of which was begun."""
    text = short_study(480, seeds=2, methods=["uniform"], head="audit_worlds = 0")
    (tmp_path / "study.toml").write_text(text)
    made = StudyFolder(tmp_path / "study")
    made.add(plan.expand(plan.read(tmp_path / "study.toml")))
    return made


def test_a_cell_by_its_number(study, capsys, monkeypatch):
    """The command works on that cell alone, is stopped and continued, and leaves a finished cell as it is."""
    first, second = study.cells()
    options = cli.CellOptions(folder=study.path, number=1)
    asked = []
    with pytest.raises(SystemExit) as stop:
        options.run(stopped=lambda: len(asked) > 2 or asked.append(0))
    assert stop.value.code == 130
    assert f"{second.name} was stopped" in capsys.readouterr().err
    assert 0 < len((study.cell_path(second) / "run" / "progress.csv").read_text().splitlines()) < 21
    with study.hold():  # nobody needs to hold the whole study
        options.run()
    assert capsys.readouterr().out == f"{study.cell_path(second)}\n"
    assert study.finished([first, second]) == {second.digest}
    assert not (study.cell_path(first) / "run").exists()
    monkeypatch.setattr(worker, "run", lambda *args: pytest.fail("a finished cell was begun again"))
    options.run()
    for number in (-1, 2):
        with pytest.raises(RunError, match=rf"number must be in \[0, 2\), the cells of .*study; got {number}"):
            cli.CellOptions(folder=study.path, number=number).run()


def test_slurms_script_works_on_the_cell_of_its_task(study, tmp_path):
    """The script that users copy trains the cell of its array's task, and lets it end when Slurm says TERM."""
    command = tmp_path / "bin" / "deimos"
    command.parent.mkdir()
    command.write_text(f'#!/bin/bash\nexec "{sys.executable}" -m deimos "$@"\n')
    command.chmod(0o755)
    surroundings = os.environ | {"PATH": f"{command.parent}:{os.environ['PATH']}", "SLURM_ARRAY_TASK_ID": "0"}
    arguments = ["bash", str(EXAMPLES / "array.sbatch"), str(study.path)]
    task = subprocess.Popen(arguments, env=surroundings, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    cell = study.cells()[0]
    end = time.monotonic() + 300
    while not (study.cell_path(cell) / "run" / "progress.csv").exists() and time.monotonic() < end:
        time.sleep(0.02)
    task.send_signal(signal.SIGTERM)
    said = task.communicate()[1]
    if task.returncode:  # it may have been quicker
        assert task.returncode == 128 + signal.SIGTERM, said
        assert not study.finished([cell])
        subprocess.run(arguments, env=surroundings, stdout=subprocess.DEVNULL, check=True)
    assert study.finished(study.cells()) == {cell.digest}


def test_slurms_scripts_are_shell():
    """Both scripts are bash without errors of syntax, and ask for a signal to the shell, which hands it on by exec."""
    for path in (EXAMPLES / "array.sbatch", EXAMPLES / "ray.sbatch"):
        subprocess.run(["bash", "-n", str(path)], check=True)
    text = (EXAMPLES / "array.sbatch").read_text()
    assert re.search(r"^#SBATCH --signal=B:TERM@\d+$", text, re.MULTILINE)
    assert text.rstrip().splitlines()[-1].startswith("exec deimos study cell ")


class FakeRay(ModuleType):
    """Ray as far as the engine uses it: tasks are threads of this process."""

    class RayError(Exception):
        """Something was lost."""

    def __init__(self):
        super().__init__("ray")
        self.exceptions = SimpleNamespace(RayError=self.RayError)
        self.asked, self.cancelled, self.set = [], [], threading.Event()
        self.lost = 0  # tasks that are lost before they begin

    def init(self, **options):
        """Connect."""

    def cluster_resources(self):
        """What the cluster has."""
        return {"CPU": 12.0, "GPU": 2.0}

    def nodes(self):
        """The machines, of which one was lost."""
        plain, lost = {"CPU": 8.0, "memory": 1e9}, {"CPU": 64.0, "GPU": 8.0}
        machines = ((plain, True), (plain | {"CPU": 4.0, "GPU": 2.0}, True), (lost, False))
        return [{"Alive": lives, "Resources": has} for has, lives in machines]

    def get_runtime_context(self):
        """Where this is."""
        return SimpleNamespace(get_node_id=lambda: "here")

    def remote(self, **options):
        """Make an actor or a task of something."""
        if "max_calls" not in options:
            stop = SimpleNamespace(remote=self.set.set), SimpleNamespace(remote=lambda: self.set)
            return lambda kind: SimpleNamespace(remote=lambda: SimpleNamespace(set=stop[0], wait=stop[1]))

        def task(function):
            def begin(more, arguments):
                self.asked.append(options | more)
                return lambda: function(*arguments)

            return SimpleNamespace(
                options=lambda **more: SimpleNamespace(remote=lambda *arguments: begin(more, arguments))
            )

        return task

    def get(self, what):
        """Wait for something."""
        if what is None:
            return None
        if isinstance(what, threading.Event):
            return what.wait()
        if self.lost:
            self.lost -= 1
            raise self.RayError("The worker died\nunexpectedly.")
        return what()

    def cancel(self, task, *, force):
        """Cancel a task."""
        assert force
        self.cancelled.append(task)


class Answers:
    """What works on cells on a machine of the cluster: it says what it was asked for, and waits if it is told to."""

    begun, answer, patience = [], None, None

    def __init__(self, study):
        self._stopped = threading.Event()

    def run(self, cell):
        """Answer."""
        self.begun.append(cell.name)
        if self.patience:
            assert self._stopped.wait(self.patience), "nobody stopped it"
        return self.answer

    def stop(self):
        """Stop waiting."""
        self._stopped.set()


@pytest.fixture
def ray(monkeypatch):
    """A Ray whose machines answer without work."""
    fake = FakeRay()
    strategies = ModuleType("ray.util.scheduling_strategies")
    strategies.NodeAffinitySchedulingStrategy = lambda node, soft: (node, soft)
    modules = {"ray": fake, "ray.util": ModuleType("ray.util"), "ray.util.scheduling_strategies": strategies}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(on_ray, "LocalProcesses", Answers)
    monkeypatch.setattr(Answers, "begun", [])
    return fake


def test_a_cell_asks_ray_for_what_it_uses(study, ray):
    """A cell takes a CPU for each of its threads, a GPU if it wants one, and what is lost is tried again by Ray."""
    plain = study.cells()[0]
    engine = on_ray.OnRay(study)
    assert engine.run(plain) is None
    assert Answers.begun == [plain.name]
    (asked,) = ray.asked
    assert asked == {"max_calls": 1, "max_retries": 3, "name": plain.name, "num_cpus": 1, "num_gpus": 0.0}
    larger = replace(plain, config=replace(plain.config, threads=3, device="cuda"))
    assert engine._resources(larger) == {"num_cpus": 3, "num_gpus": 1.0}
    assert on_ray.OnRay(study, gpus=0.25)._resources(larger) == {"num_cpus": 3, "num_gpus": 0.25}
    assert engine.room([plain] * 50) == 12
    assert engine.room([plain] * 3) == 3
    assert engine.room([plain, larger] * 50) == 2
    assert on_ray.OnRay(study, gpus=0.25).room([larger] * 50) == 4


def test_what_no_machine_has_room_for_is_named(study, ray):
    """Ray would wait without a word for more GPUs, or more CPUs beside them, than a machine that lives has."""
    engine, cell = on_ray.OnRay(study), study.cells()[0]
    made = {
        (threads, device): replace(cell, config=replace(cell.config, threads=threads, device=device))
        for threads in (4, 8, 9) for device in ("cpu", "cuda")
    }  # fmt: skip
    assert not engine.lacking([made[8, "cpu"], made[4, "cuda"]])
    assert not on_ray.OnRay(study, gpus=2.0).lacking([made[4, "cuda"]])
    for threads, device, gpus in ((9, "cpu", None), (8, "cuda", None), (4, "cuda", 3.0)):
        said = on_ray.OnRay(study, gpus).lacking([made[threads, device]])
        assert re.fullmatch(rf"No machine .* has the {threads} CPU\(s\) and \d GPU\(s\) that .* takes", said)


def test_a_study_says_what_it_waits_for(study, ray, monkeypatch, capsys):
    """A cluster may grow, so the command begins, and says what is lacking; it counts no cell that is finished."""
    monkeypatch.setattr(FakeRay, "nodes", lambda self: [])
    monkeypatch.setattr(cli, "estimate", lambda *args, **more: Estimate("", {}))
    monkeypatch.setattr(Answers, "answer", "out of luck")
    with pytest.raises(RunError, match="2 of 2 cells failed"):
        cli.RunOptions(folder=study.path, engine="ray").run()
    assert "takes: it waits until one joins (see --device" in capsys.readouterr().err
    monkeypatch.setattr(StudyFolder, "finished", lambda self, cells: {cell.digest for cell in cells})
    cli.RunOptions(folder=study.path, engine="ray").run()
    assert "waits" not in capsys.readouterr().err


def test_what_ray_loses_is_a_line(study, ray, monkeypatch):
    """A cell that is lost more often than Ray tries it has failed in one line; so has one whose folder is not seen."""
    engine, cell = on_ray.OnRay(study), study.cells()[0]
    ray.lost = 1
    assert engine.run(cell) == "The worker died unexpectedly."
    monkeypatch.setattr(Answers, "answer", "killed by SIGSEGV")
    assert engine.run(cell) == "killed by SIGSEGV"
    elsewhere = on_ray.OnRay(StudyFolder(study.path / "nowhere"))
    assert "nowhere" in elsewhere.run(cell)
    engine.kill()
    assert engine.run(cell) is None
    assert not ray.cancelled


def test_a_stop_reaches_the_machines(study, ray, monkeypatch):
    """Cells that run on other machines are let end, and no further one begins; the last resort is to cancel them."""
    monkeypatch.setattr(Answers, "patience", 60.0)
    engine, (first, second) = on_ray.OnRay(study), study.cells()
    thread = threading.Thread(target=engine.run, args=(first,))
    thread.start()
    while not Answers.begun:
        time.sleep(0.01)
    engine.kill()
    assert len(ray.cancelled) == 1
    engine.stop()
    thread.join(60.0)
    assert not thread.is_alive()
    assert engine.run(second) is None
    assert Answers.begun == [first.name]


def test_machines_work_where_the_runner_does(study, ray, monkeypatch, tmp_path):
    """Files and plug-ins of a study are seen from its runner's working directory, wherever Ray was started."""
    monkeypatch.chdir(tmp_path)
    get, seen = ray.get, []

    def elsewhere(what):
        if callable(what):  # a task
            os.chdir("/")
        return get(what)

    monkeypatch.setattr(ray, "get", elsewhere)
    monkeypatch.setattr(Answers, "run", lambda self, cell: seen.append(Path.cwd()))
    assert on_ray.OnRay(study).run(study.cells()[0]) is None
    assert seen == [tmp_path]


def test_a_study_runs_on_ray(study, ray, monkeypatch):
    """The option gives every open cell to Ray, as many at a time as there is room for, and no finished one."""
    finished = study.cells()[0]
    monkeypatch.setattr(StudyFolder, "finished", lambda self, cells: {finished.digest} & {c.digest for c in cells})
    monkeypatch.setattr(Answers, "answer", "out of luck")
    monkeypatch.setattr(cli, "estimate", lambda *args, **more: Estimate("", {}))
    with pytest.raises(RunError, match=r"1 of 2 cells failed, .*: out of luck"):
        cli.RunOptions(folder=study.path, engine="ray").run()
    assert Answers.begun == [study.cells()[1].name] * 2


@pytest.mark.parametrize("options", [{"engine": "ray"}, {"estimate": True}, {}])
def test_what_cannot_be_measured_here(study, ray, monkeypatch, capsys, options):
    """Cells that other machines work on need not be measured here, which has no GPU perhaps; those of this one must."""

    def measure(cell):
        raise RunError("There is no CUDA device here.")

    monkeypatch.setattr("deimos.study.estimate._measure", measure)
    command = cli.RunOptions(folder=study.path, **options)
    if not options:
        with pytest.raises(RunError, match="no CUDA device"):
            command.run()
        return
    if options.get("engine"):
        monkeypatch.setattr(Answers, "answer", "out of luck")
        with pytest.raises(RunError, match="2 of 2 cells failed"):
            command.run()
    else:
        command.run()
    said = capsys.readouterr().err
    assert re.match(r"2 run\(s\): .* M transitions \+ .*; how long they take cannot be measured here \(There is", said)


def test_an_estimate_can_be_stopped(study, monkeypatch, capsys):
    """Ctrl-C while kinds of cells are measured ends the command, says how it continues, and begins no cell."""
    monkeypatch.setattr("deimos.study.estimate._measure", lambda cell: pytest.fail("measured all the same"))
    with pytest.raises(SystemExit) as stop:
        cli.RunOptions(folder=study.path).run(stopped=lambda: True)
    assert stop.value.code == 130
    assert f"continue with: deimos study run {study.path}" in capsys.readouterr().err
    assert not any((study.cell_path(cell) / "run").exists() for cell in study.cells())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gpus": 1.0}, "gpus are given to cells by a Ray cluster; add --engine ray"),
        ({"gpus": -1.0, "engine": "ray"}, r"gpus must be in \[0, inf\), got -1.0"),
        ({"gpus": math.inf, "engine": "ray"}, r"gpus must be in \[0, inf\), got inf"),
        ({"workers": 0, "engine": "ray"}, "workers must be at least 1, got 0"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path, options, message):
    """Options that contradict each other are refused when they are parsed."""
    with pytest.raises(ValueError, match=message):
        cli.RunOptions(folder=tmp_path, **options)
