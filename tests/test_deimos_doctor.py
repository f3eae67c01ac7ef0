"""What a machine has, what works on it, and the stages that wait for a GPU: here on a CPU."""

import json
import re
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import replay
import torch

from deimos.app import cli, console, doctor, gpu_stages
from deimos.app.train import FolderOptions
from deimos.checks import RunError
from deimos.goals.fear_selector import FearSelector
from deimos.run.trainer import Trainer
from deimos.sim import graphs

CPU = torch.device("cpu")
NEEDS_CUDA = ("tests", "waits", "graphs")


def test_says_what_there_is_and_what_works(capfd, monkeypatch):
    """The doctor names versions, driver and packages, trains particles and robots, and ends with 0 where that works."""
    assert cli.main(["doctor", "--device", "cpu"]) == 0
    said = capfd.readouterr().out
    for words in ("warp-lang", "NVIDIA driver", "kernel cache", "studies on a Ray cluster"):
        assert words in said
    assert said.count("works on cpu: reward") == 2
    assert "FAILS" not in said

    def fail(device):
        raise RuntimeError("no space\nleft")

    checks = [("kernel cache", fail, True), ("training robots", fail, False)]
    monkeypatch.setattr(doctor, "CHECKS", checks)
    assert cli.main(["doctor", "--device", "cpu"]) == 1
    assert "FAILS: no space left" in capfd.readouterr().out
    monkeypatch.setattr(doctor, "CHECKS", checks[1:])
    assert cli.main(["doctor", "--device", "cpu"]) == 0


def test_a_folder_is_no_package(monkeypatch, tmp_path, capsys):
    """A folder named like a package, as Weights & Biases leaves one with its logs, is not taken for it."""
    for name in ("wandb", "trimesh"):
        (tmp_path / name).mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(doctor, "CHECKS", [])
    monkeypatch.setattr(doctor, "PURPOSES", {"wandb": ("curves", "wandb"), "trimesh": ("terrain", "legged")})
    version = doctor.importlib.metadata.version

    def found(name):
        if name == "wandb":  # whatever is installed here
            raise doctor.importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(doctor.importlib.metadata, "version", found)
    assert cli.main(["doctor", "--device", "cpu"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"curves +- +pip install 'deimos-rl\[wandb\]'", said)
    assert re.search(r"terrain +\d\S+ +installed", said)


def test_a_cache_that_cannot_be_written_is_found(monkeypatch, tmp_path):
    """The kernel cache is measured, and one that cannot be written to is said with the way out."""
    import warp as wp

    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    (tmp_path / "kernel.o").write_bytes(b"0" * 2**20)
    assert doctor._check_cache("cpu") == f"{tmp_path}: 1 MiB in 1 files"
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    with pytest.raises(RunError, match="cannot be written to; set WARP_CACHE_PATH"):
        doctor._check_cache("cpu")


@pytest.mark.parametrize("name", [name for name in gpu_stages.STAGES if name not in NEEDS_CUDA])
def test_stages_run_on_a_cpu(name, tmp_path):
    """Every stage that needs no CUDA does its work at small sizes, writes JSON, and finds nothing wrong."""
    gpu_stages.main(name, "cpu", tmp_path / "found.json")
    report = json.loads((tmp_path / "found.json").read_text())
    assert report["found"].get("passed", True), report
    assert report["sizes"]["worlds"] == gpu_stages.SMALL.worlds


@pytest.mark.parametrize("frozen", [False, True])
def test_graphs_are_compared_with_calls(frozen, monkeypatch):
    """The stage on graphs finds the same numbers, with a stand-in for CUDA's, and a number that does not change."""
    replay.replay_on_cpu(monkeypatch)
    monkeypatch.setattr(gpu_stages, "GRAPH_ITERATIONS", 5)
    make = Trainer._make_steps

    def make_frozen(self):
        self._first_step.fill_(self.iteration * self.rollout.num_steps)
        make(self)

    if frozen:
        monkeypatch.setattr(Trainer, "_make_steps", make_frozen)
    found = gpu_stages.graphs(CPU, replace(gpu_stages.SMALL, robots=2))
    assert [part["passed"] for part in found.values()] == [not frozen] * 3
    assert all((part["equal iterations"] == 5) is not frozen for part in found.values())


@pytest.mark.parametrize("broken", ["draws", "obs"])
def test_agreement_finds_what_differs(broken, monkeypatch):
    """The stage that compares devices fails where a draw has other bits, and where observations are too far apart."""
    play, count = gpu_stages._play_particles, []

    def played(device, worlds):
        count.append(device)
        found = play(device, worlds)
        if len(count) > 1:
            found[broken][-1] = found[broken][-1] + 0.01
        return found

    monkeypatch.setattr(gpu_stages, "_play_particles", played)
    assert not gpu_stages.agreement(CPU, gpu_stages.SMALL)["passed"]


def test_the_report_is_written_after_every_stage(tmp_path, monkeypatch, capsys):
    """A stage that fails, or takes too long, is said in the report; the others run, and later calls add to it."""
    stages = {"versions": (gpu_stages.versions, 60.0), "tests": (gpu_stages.tests, 60.0), "rough": (None, 0.01)}
    monkeypatch.setattr(gpu_stages, "STAGES", stages)
    run, seen = doctor._run_stage, []

    def watched(name, device, limit):
        if (tmp_path / doctor.REPORT).exists():
            seen.append(sorted(json.loads((tmp_path / doctor.REPORT).read_text())["stages"]))
        return run(name, device, limit)

    monkeypatch.setattr(doctor, "_run_stage", watched)
    assert not doctor.run_stages(("versions", "rough"), CPU, tmp_path)
    assert doctor.run_stages(("tests",), CPU, tmp_path)
    assert seen == [["versions"], ["rough", "versions"]]
    report = json.loads((tmp_path / doctor.REPORT).read_text())["stages"]
    assert report["versions"]["found"]["torch"] == torch.__version__
    assert report["rough"]["error"] == "it took longer than 0 s"
    assert "pytest" in report["tests"]["skipped"]
    assert "versions: found" in capsys.readouterr().out


@pytest.mark.parametrize("passed", [True, False])
def test_a_check_within_a_stage_counts(passed, tmp_path, monkeypatch):
    """What only a part of a stage has found fails the whole."""
    found = {"FPS": 1.0, "graph against eager": {"largest difference": 1.0, "passed": passed}}
    monkeypatch.setattr(doctor, "_run_stage", lambda name, device, limit: {"found": found})
    assert doctor.run_stages(("flat",), CPU, tmp_path) is passed


def test_the_last_words_of_a_stage_are_kept(monkeypatch):
    """A stage whose process dies is an error in one line, beside all that it said."""
    program = "import sys; sys.exit('Traceback\\nCUDA error: an illegal access')"
    begin = doctor.subprocess.Popen
    monkeypatch.setattr(
        doctor.subprocess, "Popen", lambda command, **more: begin([sys.executable, "-c", program], **more)
    )
    found = doctor._run_stage("versions", CPU, 60.0)
    assert found["error"] == "CUDA error: an illegal access"
    assert found["said"].startswith("Traceback")


def test_a_stage_that_takes_too_long_ends_with_what_it_began(monkeypatch, tmp_path):
    """At its limit a stage is killed, and so are the processes that it has begun."""
    program = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        f"open({str(tmp_path / 'child')!r}, 'w').write(str(child.pid))\ntime.sleep(600)"
    )
    begin = doctor.subprocess.Popen
    monkeypatch.setattr(
        doctor.subprocess, "Popen", lambda command, **more: begin([sys.executable, "-c", program], **more)
    )
    limit = 2.0
    while not (tmp_path / "child").exists():  # a busy machine needs longer to begin it
        assert doctor._run_stage("versions", CPU, limit)["error"] == f"it took longer than {limit:.0f} s"
        limit *= 2
    child = int((tmp_path / "child").read_text())
    end = time.monotonic() + 60
    while Path(f"/proc/{child}").exists() and "(python" in Path(f"/proc/{child}/stat").read_text():
        if Path(f"/proc/{child}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":  # nobody has asked how it ended
            break
        assert time.monotonic() < end, "it lives on"
        time.sleep(0.05)


def test_science_continues_what_is_there(tmp_path):
    """Table 4.1 and a Quad run of the thesis's length are commands that parse; a run that was begun is resumed."""
    from benchmarks.__main__ import BenchOptions

    (_, _, _, *table), (_, _, _, _, *train) = doctor.science(torch.device("cuda", 0), tmp_path)
    assert console.parse(BenchOptions, table, "benchmarks").what == "table41"
    options = console.parse(FolderOptions, [word for word in train if word != "--preset" and word != "quad"], "train")
    assert options.num_envs * options.env_steps == pytest.approx(295e6, rel=0.01)
    assert options.ppo.hidden == (512, 256, 128)
    (tmp_path / "quad").mkdir()
    assert doctor.science(CPU, tmp_path)[1] == [
        sys.executable, "-m", "deimos", "train", "--resume", str(tmp_path / "quad")
    ]  # fmt: skip


def test_options_that_do_not_fit_are_refused(capfd):
    """Unknown stages, and what belongs to --gpu without it, are refused in one line; so is --gpu without a GPU."""
    for arguments, message in {
        "--gpu --stages flat moon": "stages must be some of versions, tests, waits, .*got 'moon'",
        "--science": "science belongs to --gpu; add it",
        "--gpu --device cuda:99": "CUDA device",
    }.items():
        assert cli.main(["doctor", *arguments.split()]) == 2
        assert re.search(message, capfd.readouterr().err)


def test_the_stage_of_waits_steps_a_director_that_does_not_wait(monkeypatch):
    """What the stage asks CUDA about runs, on both clocks, and reads nothing from the device."""
    replay.as_on_gpu(monkeypatch)
    step = gpu_stages.directed(16, CPU)
    for _ in range(12):
        with replay.counted() as calls:
            step()
        assert not calls.waits


def test_what_torch_says_of_its_search_is_no_wait(monkeypatch):
    """Of its warnings, those that name a wait count, each with its line; the one about the search itself does not."""

    def set_mode(mode):
        if mode == "warn":
            warnings.warn("Synchronization debug mode is a prototype feature and does not yet detect all", stacklevel=1)

    def work():
        if waiting:
            warnings.warn("called a synchronizing CUDA operation", stacklevel=1)

    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", set_mode)
    waiting = False
    assert gpu_stages._waits_in(work) == {}
    waiting = True
    (place,) = gpu_stages._waits_in(work).items()
    assert re.fullmatch(r"test_deimos_doctor\.py:\d+", place[0])
    assert place[1] == 1


def test_speeds_are_those_of_replays(monkeypatch):
    """Where there are graphs, the stages that measure speed time iterations in which everything was replayed."""
    replay.replay_on_cpu(monkeypatch)
    recorded, eager = [], []
    make = Trainer._make_steps

    class Noted(replay.Replay):
        def __init__(self, work, device):
            recorded.append(work)
            super().__init__(work, device)

    monkeypatch.setitem(graphs.RECORDERS, "cpu", Noted)
    monkeypatch.setattr(Trainer, "_make_steps", lambda self: eager.append(self) or make(self))
    # As with many worlds, in which fear has crashes to learn from at once.
    monkeypatch.setattr(FearSelector, "graph_key", lambda self: self._learnt_at > 0)

    def since(begin, device):
        """1 s for an iteration that was replayed, else more."""
        took = 1.0 + len(recorded) + len(eager)
        recorded.clear()
        eager.clear()
        return took

    monkeypatch.setattr(gpu_stages, "_since", since)
    found = gpu_stages.scales(CPU, gpu_stages.SMALL)
    steps = gpu_stages._config(1).ppo.num_steps
    assert {int(worlds): part["FPS"] for worlds, part in found.items()} == {
        n: n * steps for n in gpu_stages.SMALL.scales
    }
