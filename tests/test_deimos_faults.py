"""Runs under attack: locks, signals, numbers that cannot be used, and what does not fit; nothing is lost."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

import deimos
from deimos.app import cli, console
from deimos.checks import RunError, SimulationError
from deimos.files import load_tensors, open_file
from deimos.goals.methods import METHODS
from deimos.goals.selector import with_parts
from deimos.goals.selectors import director
from deimos.learn.ppo import PPOConfig
from deimos.run import memory, training
from deimos.run.evaluation import EvalConfig, check_memory, evaluate_run, read_evaluation
from deimos.run.failure import check_finite
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle
from deimos.study import cli as study_cli

HOME = Path(deimos.__file__).resolve().parent.parent
CPU = torch.device("cpu")
CONFIG = TrainConfig(
    env=particle.Config(goal_period=8), method="uniform", ppo=PPOConfig(hidden=(8,), num_steps=8, minibatches=2),
    evaluation=False, num_envs=16, env_steps=8 * 6, device="cpu", threads=1,
)  # fmt: skip

WILD = PPOConfig(hidden=(8,), num_steps=8, minibatches=2, init_std=100.0)  # throws itself about, and crashes


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Folder of a short run."""
    trainer, folder = training.start(CONFIG, tmp_path_factory.mktemp("faults") / "run", None)
    training.train(trainer, folder, stopped=lambda: trainer.iteration == 3)
    return folder.path


@pytest.fixture
def run(trained, tmp_path):
    """A copy of it, of this test alone."""
    return RunFolder(shutil.copytree(trained, tmp_path / "run"))


def lines(folder):
    """Iterations of a run's ``progress.csv``."""
    return [row["iteration"] for row in folder.read_csv("progress.csv")]


def test_a_run_is_trained_by_one_process_at_a_time(run):
    """While a run is trained it can neither be resumed nor trained elsewhere, and nothing of it changes."""
    trainer, folder = training.resume(run.path)
    before = {path.name: path.read_bytes() for path in run.path.iterdir()}
    with run.hold():
        with pytest.raises(RunError, match=f"being worked on by process {os.getpid()}"):
            training.resume(run.path)
        with pytest.raises(RunError, match="being worked on by process"):
            training.train(trainer, folder)
        held = {path.name: path.read_bytes() for path in run.path.iterdir() if path.name != "lock"}
    assert held == {name: data for name, data in before.items() if name != "lock"}
    training.train(trainer, folder)
    assert lines(run) == ["1", "2", "3", "4", "5", "6"]


def test_a_second_resume_writes_no_row_twice(run):
    """Of two processes that have resumed a run before either trains, the later one writes the rows again."""
    pairs = [training.resume(run.path) for _ in range(2)]
    for trainer, folder in pairs:
        training.train(trainer, folder)
    assert lines(run) == ["1", "2", "3", "4", "5", "6"]


def test_a_killed_process_leaves_no_lock_and_no_litter(run):
    """The lock of a process that was killed is free, and what it had not finished writing is deleted."""
    code = (
        "import sys, time; from pathlib import Path; from deimos.run.folder import RunFolder\n"
        "with RunFolder(Path(sys.argv[1])).hold(): print('held', flush=True); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(run.path)], cwd=HOME, stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"held\n"
    (run.path / "checkpoint.pt.0123abcd.partial").write_bytes(b"half")
    (run.path / "notes.partial").write_bytes(b"somebody's")
    with pytest.raises(RunError, match=f"process {process.pid}"), run.hold():
        pass
    process.kill()
    process.communicate()
    with run.hold():
        assert [path.name for path in run.path.glob("*.partial")] == ["notes.partial"]


def test_rows_of_evaluations_at_the_same_time_are_all_kept(run):
    """Rows that another process adds while an evaluation is going on are there afterwards."""
    config = EvalConfig(worlds=4, steps=16, attackers=())
    (other,) = evaluate_run(run, CONFIG.env, config, CPU)
    (run.path / "evaluation.json").unlink()

    def meanwhile(stage, share):
        run.write_json("evaluation.json", [other])

    evaluate_run(run, CONFIG.env, EvalConfig(worlds=8, steps=16, attackers=()), CPU, meanwhile)
    assert [row["worlds"] for row in read_evaluation(run)] == [4, 8]


def test_evaluation_that_was_killed_keeps_its_rows(run):
    """A row is written before the next is begun; the same command goes on from there, to what it would have been."""
    config = EvalConfig(worlds=4, steps=16, attackers=("argmax", "scripted"), adversary_steps=16)
    evaluate_run(run, CONFIG.env, config, CPU)
    whole = read_evaluation(run)
    (run.path / "evaluation.json").unlink()

    def killed(stage, share):
        if stage.startswith("scripted"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate_run(run, CONFIG.env, config, CPU, killed)
    assert read_evaluation(run) == whole[:2]
    made = []
    evaluate_run(run, CONFIG.env, config, CPU, lambda *at: made.append(at[0]), again=False)
    assert read_evaluation(run) == whole
    assert not any(stage.startswith(("naive", "argmax")) for stage in made)
    turned = dataclasses.replace(config, attackers=("scripted", "argmax"))
    assert [row["goals"] for row in evaluate_run(run, CONFIG.env, turned, CPU, again=False)][1:] == [*turned.attackers]


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_signals_end_an_iteration_and_then_the_process(name):
    """The first signal is remembered; a second one meets what was there before, and afterwards all is as it was."""
    number = getattr(signal, name)
    before = signal.getsignal(number)
    with console.on_signals(console.raise_stopped):
        with console.stop_on_interrupt() as stopped:
            assert stopped() == 0
            signal.raise_signal(number)
            assert stopped() == number
            with pytest.raises(console.Stopped) as raised:
                signal.raise_signal(number)
        assert raised.value.args == (number,)
        assert signal.getsignal(number) is console.raise_stopped
    assert signal.getsignal(number) is before


def test_an_ignored_hangup_stays_ignored():
    """Under nohup a closed terminal ends nothing."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with console.stop_on_interrupt() as stopped:
            signal.raise_signal(signal.SIGHUP)
            assert not stopped()
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_is_one_line_and_its_exit_code(monkeypatch, capfd, name):
    """What is cut by a signal ends in one line and 128 plus the signal's number."""
    number = getattr(signal, name)
    monkeypatch.setattr(cli, "_run", lambda arguments: signal.raise_signal(number))
    assert cli.main([]) == 128 + number
    assert capfd.readouterr().err == "deimos: Interrupted; files written so far are intact.\n"


@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGHUP", 129), ("SIGINT", 130)])
def test_a_study_ends_by_the_signal_that_came(monkeypatch, tmp_path, name, code):
    """A study that a cluster ends lets its workers stop, and its exit code says by what."""
    asked = []

    def run(options, stopped, report):
        signal.raise_signal(getattr(signal, name))
        asked.append(stopped())
        raise SystemExit(130)

    monkeypatch.setattr(study_cli.RunOptions, "run", run)
    assert cli.main(["study", "run", str(tmp_path)]) == code
    assert asked == [True]


FLAGS = (
    "train --num-envs 16 --env-steps 48 --threads 1 --device cpu --no-evaluation --ppo.hidden 8 --ppo.num-steps 8 "
    "--ppo.minibatches 2 --method uniform"
).split()


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_leaves_a_checkpoint(monkeypatch, tmp_path, capfd, name):
    """A training that a cluster ends has saved the iteration that it was in, and says how to resume it."""
    number, iterate = getattr(signal, name), training.Trainer.iterate

    def signalled(trainer):
        row = iterate(trainer)
        if trainer.iteration == 2:
            signal.raise_signal(number)
        return row

    monkeypatch.setattr(training.Trainer, "iterate", signalled)
    assert cli.main([*FLAGS, "--out", str(tmp_path / "run")]) == 128 + number
    assert capfd.readouterr().err.splitlines()[-1] == (
        f"Stopped after iteration 2; resume with --resume {tmp_path / 'run'}"
    )
    assert training.load_checkpoint(RunFolder(tmp_path / "run"))["iteration"] == 2


def test_a_thread_can_train(tmp_path):
    """Where no signal can be caught, a command trains all the same."""
    codes = []
    thread = threading.Thread(target=lambda: codes.append(cli.main([*FLAGS, "--out", str(tmp_path / "run")])))
    thread.start()
    thread.join()
    assert codes == [0]
    assert len(lines(RunFolder(tmp_path / "run"))) == 6


def friction(trainer):
    """An infinite number in what the worlds are made of, which no step may ever show."""
    trainer.env.tensors["position"][5, 1] = torch.inf


def moments(trainer):
    """An infinite moment of Adam, which makes the weight's next steps 0."""
    trainer.ppo.optimizer._square[3] = torch.inf


def rate(trainer):
    """A learning rate that is no number."""
    trainer.ppo.optimizer.learning_rate.fill_(torch.nan)


def weight(trainer):
    """An infinite weight of the transitions of a world."""
    trainer.loop.core.weight[7] = torch.inf


def percentile(trainer):
    """An infinite percentile, where NaN would say that it is not known."""
    trainer.loop.core.percentile[7] = torch.inf


def huge(trainer):
    """A weight whose products are infinite in the next iteration."""
    trainer.ppo.actor.mean[0].weight.data[0, 0] = 3e38


@pytest.mark.parametrize(
    ("spoil", "name"),
    [
        (friction, "env.position"),
        (moments, "optimizer.square"),
        (rate, "optimizer.learning_rate"),
        (weight, "weight"),
        (percentile, "percentile"),
        (huge, r"actor\.mean\.0\.weight"),
    ],
)
def test_a_checkpoint_is_never_poisoned(run, spoil, name):
    """A number that is not finite stops the run before the last good checkpoint is replaced, and is named."""
    trainer, folder = training.resume(run.path)
    before = (run.path / "checkpoint.pt").read_bytes()
    spoil(trainer)
    with pytest.raises(SimulationError, match=rf"Iteration 3: 1 of the \d+ numbers of \S*{name} are not finite"):
        training.save(trainer, folder)
    assert (run.path / "checkpoint.pt").read_bytes() == before


def test_no_row_is_infinite(run):
    """What an infinite sum would have put into the log stops the run instead, by its name."""
    trainer, _ = training.resume(run.path)
    trainer.loop.core._delivered[7] = torch.inf
    with pytest.raises(SimulationError, match="Iteration 4: goal_percentile would be infinite"):
        trainer.iterate()


@pytest.mark.parametrize("method", [*METHODS, "p75", "p75-literal"])
def test_what_is_not_known_may_be_saved(method):
    """A selector's marks of what it does not know are no fault: not at first, and not once worlds have crashed."""
    env = particle.Config(goal_period=8, max_speed=200.0, max_force=100.0)
    trainer = training.build(dataclasses.replace(CONFIG, env=env, method=method, ppo=WILD), CPU)
    check_finite(trainer)
    rows = [trainer.iterate() for _ in range(12)]
    assert sum(row["crashes"] for row in rows) > 5
    check_finite(trainer)
    for memory_of in (part.memory for part in with_parts(trainer.loop.selector) if getattr(part, "memory", None)):
        assert memory_of.stored
        memory_of._crash[0, 0] = torch.nan
        with pytest.raises(SimulationError, match=r"memory\.crash"):
            check_finite(trainer)


def test_what_stopped_a_run_is_written_down(run, monkeypatch):
    """The report names quantity, worlds and last rows; the state beside it has the rollout that led there."""
    trainer, folder = training.resume(run.path)
    iterate = type(trainer).iterate

    def poisoned(self):
        row = iterate(self)
        if self.iteration == 5:
            self.env.tensors["position"][[2, 9]] = torch.nan
            self.rollout.last_obs.fill_(torch.nan)  # memory may hold anything where nothing is written
        return row

    monkeypatch.setattr(type(trainer), "iterate", poisoned)
    with pytest.raises(SimulationError, match=r"Iteration 6: .*Details are in .*failure\.json"):
        training.train(trainer, folder)
    report = run.read_json("failure.json")
    assert report["versions"]["deimos"] == deimos.__version__
    assert [row["iteration"] for row in report["last_rows"]] == ["1", "2", "3", "4", "5"]
    assert [(found["step"], found["world"]) for found in report["invalid"]] == [(0, 2), (0, 9)]
    assert {tuple(found["worlds"]) for found in report["not_finite"]} == {(2, 9)}
    assert len(report["invalid"][0]["action"]) == trainer.env.action_dim
    state = load_tensors(run.path / "failure.pt", "state", 1)
    assert state["rollout"]["obs"].shape[:2] == (CONFIG.ppo.num_steps + 1, CONFIG.num_envs)
    assert state["iteration"] == 6
    assert training.load_checkpoint(run)["iteration"] == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_envs": 2**31 - 1}, r"2147483647 worlds, .* need more than [\d,]+ GiB of memory.*\(num_envs\)"),
        ({"method": None, "selector": director.Config(candidates=10**9)}, r"1000000000 candidates .*\(candidates\)"),
        ({"evaluation": True, "eval": EvalConfig(worlds=2**31 - 1)}, "2147483647 worlds, .* need more than"),
        ({"evaluation": True, "eval": EvalConfig(steps=2**31 - 1)}, "2147483647 steps of 2000 .*, or lower steps"),
        ({"evaluation": True, "eval": EvalConfig(adversary_steps=10**9)}, "1000000000 steps .*lower adversary_steps"),
    ],
)
def test_what_does_not_fit_is_refused_before_it_starts(tmp_path, monkeypatch, change, message):
    """The line has the figure, whatever was too large, and no folder is made."""
    monkeypatch.setattr(memory, "total", lambda device: 64.0 * 2**30)
    with pytest.raises(RunError, match=message):
        training.start(dataclasses.replace(CONFIG, **change), tmp_path / "run", None)
    assert not (tmp_path / "run").exists()


def test_what_fits_is_not_refused():
    """The thesis's sizes are far from any limit, and a machine that does not say what it has refuses nothing."""
    check_memory(particle.Config(), EvalConfig(attackers=("argmax", "argmax-long")), CPU)
    memory.require("It", 1e6, CPU, "do not")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "There is not enough memory for this, or the limit"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 9"), "enough"),
        (RuntimeError("can't start new thread"), "does not let this process start another thread"),
        (ImportError("libtorch.so: failed to map segment", name="torch"), "torch cannot be loaded (libtorch.so: fail"),
    ],
)
def test_limits_of_a_process_are_one_line(monkeypatch, capfd, error, said):
    """What the system refuses to give while something loads or runs is said as what it is."""

    def fail(arguments):
        raise error

    monkeypatch.setattr(cli, "_run", fail)
    assert cli.main([]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert said in line


@pytest.mark.parametrize("gigabytes", [0.2, 0.4, 0.8])  # with more, Warp's compiler may run out, and LLVM aborts
def test_a_process_that_may_not_have_enough_says_so(tmp_path, gigabytes):
    """Wherever libraries stop loading for want of memory, it is one line with the reason, and no folder is left."""
    bounded = f'ulimit -v {int(gigabytes * 1e6)}; exec "$@"'
    done = subprocess.run(
        ["bash", "-c", bounded, "bash", sys.executable, "-m", "deimos", *FLAGS, "--out", "run"], cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(HOME), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    assert done.returncode in (0, 2)  # a smaller torch may fit
    assert (tmp_path / "run").exists() == (done.returncode == 0)
    if done.returncode:
        assert done.stderr.splitlines()[-1].startswith("deimos: ")


def test_other_errors_are_not_hidden(monkeypatch):
    """A fault of the program keeps its traceback."""

    def fail(arguments):
        raise RuntimeError("a fault of ours")

    monkeypatch.setattr(cli, "_run", fail)
    with pytest.raises(RuntimeError, match="ours"):
        cli.main([])


@pytest.mark.parametrize("name", ["checkpoint.pt", "config.json", "progress.csv", "evaluation.json"])
def test_a_pipe_is_refused(run, name):
    """A pipe in place of a file is refused at once: whoever opened it would wait for ever."""
    (run.path / name).unlink(missing_ok=True)
    os.mkfifo(run.path / name)
    reads = {"config.json": training.read_config, "checkpoint.pt": training.load_checkpoint,
             "evaluation.json": read_evaluation, "progress.csv": lines}  # fmt: skip
    with pytest.raises(RunError, match=rf"{name}.* \(it is not a regular file\)"):
        reads[name](run)


def test_somebody_elses_file_is_not_written_through_a_link(run, tmp_path):
    """Neither a lock, a table nor a whole file reaches what a link leads to."""
    theirs = tmp_path / "theirs"
    theirs.write_bytes(b"")
    for name in ("lock", "timing.csv"):
        (run.path / name).unlink(missing_ok=True)
        (run.path / name).symlink_to(theirs)
    (run.path / "notes.json").symlink_to(theirs)
    with pytest.raises(RunError, match=r"lock cannot be locked \(it is a link\)"), run.hold():
        pass
    with pytest.raises(RunError, match=r"timing.csv could not be written \(it is a link\)"):
        run.append_csv("timing.csv", {"iteration": 4})
    run.write_json("notes.json", [])
    with pytest.raises(OSError, match="it is a link"):
        open_file(run.path / "timing.csv", "w")
    assert theirs.read_bytes() == b""


def test_numbers_of_numpy_are_numbers(tmp_path):
    """A configuration of NumPy's numbers is stored as one of Python's, and gives the same run."""
    ppo = PPOConfig(hidden=(np.int64(8),), num_steps=np.int32(8), minibatches=2, learning_rate=np.float64(3e-4))
    config = dataclasses.replace(CONFIG, ppo=ppo, num_envs=np.int64(16), seed=np.uint32(1), env_steps=8)
    plain = dataclasses.replace(CONFIG, ppo=dataclasses.replace(CONFIG.ppo, learning_rate=3e-4), seed=1, env_steps=8)
    rows = []
    for name, each in (("numpy", config), ("python", plain)):
        trainer, folder = training.start(each, tmp_path / name, None)
        training.train(trainer, folder)
        rows.append((tmp_path / name / "progress.csv").read_bytes())
        assert training.read_config(folder).ppo.hidden == (8,)
    assert rows[0] == rows[1]


def test_what_cannot_begin_leaves_no_folder(tmp_path, monkeypatch):
    """Whatever goes wrong while a run's folder is filled, a second try finds nothing in its way."""

    def fail(trainer, folder):
        raise TypeError("a fault of a plug-in")

    monkeypatch.setattr(training, "save", fail)
    with pytest.raises(TypeError, match="plug-in"):
        training.start(CONFIG, tmp_path / "run", None)
    assert not (tmp_path / "run").exists()
