"""Damaged files, files that are none, signals and numbers that a run cannot use: one line, and nothing is lost."""

import dataclasses
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import deimos
from deimos.app import cli, console
from deimos.checks import RunError, SimulationError
from deimos.files import file_name, load_arrays, load_tensors, open_file, save_tensors, write_whole
from deimos.goals.selectors import director
from deimos.learn.ppo import PPOConfig
from deimos.run import memory, training
from deimos.run.evaluation import EvalConfig, check_memory, evaluate_run, read_evaluation
from deimos.run.failure import check_finite
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle
from terrain.grid import Terrain, flat

HOME = Path(deimos.__file__).resolve().parent.parent
CPU = torch.device("cpu")
CONFIG = TrainConfig(
    env=particle.Config(goal_period=8), method="uniform", ppo=PPOConfig(hidden=(8,), num_steps=8, minibatches=2),
    evaluation=False, num_envs=16, env_steps=8 * 6, device="cpu", threads=1,
)  # fmt: skip
# Anything that a person, an editor or a disk may leave: the property holds for each, so few examples do.
FEW = settings(max_examples=40, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
ROWS = b"iteration,reward\r\n1,0.5\r\n2,\r\n3,-1e-05\r\n"


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


def attempt(do, error):
    """What a call gives, and what it says where it raises an error of a class, in a line that can be printed."""
    try:
        return do(), ""
    except error as raised:
        assert str(raised).isprintable()  # noqa: PT017 (of a property: it may raise or not)
        return None, str(raised)


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


@FEW
@given(place=st.integers(0, len(ROWS) - 1), byte=st.integers(0, 255), insert=st.booleans())
def test_a_damaged_table_is_one_line_or_whole(tmp_path_factory, place, byte, insert):
    """With any byte flipped or put in, the rows are numbers in order, or one line names file and line."""
    folder = RunFolder(tmp_path_factory.mktemp("csv"))
    data = ROWS[:place] + bytes([byte]) + ROWS[place + (not insert) :]
    (folder.path / "progress.csv").write_bytes(data)
    rows, said = attempt(lambda: folder.read_csv("progress.csv"), RunError)
    if rows is None:
        assert f"{folder.path / 'progress.csv'}, line " in said
    else:
        iterations = [int(row["iteration"]) for row in rows]
        assert iterations == sorted(set(iterations))
        assert {*map(len, rows)} <= {len(rows[0]) if rows else 0}
    assert (folder.path / "progress.csv").read_bytes() == data


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (ROWS.partition(b"\n")[2], "line 1: the names of the columns"),
        (ROWS + ROWS, "line 5: could not convert string to float"),
        (ROWS + ROWS.partition(b"\n")[2], "line 5: its iteration must be above 3, got 1"),
        (ROWS + b"4,\x00\r\n", "line 5: "),
        (ROWS + b"4," + b"1" * 200_000 + b"\r\n", "line 5: field larger"),
        (ROWS + b"4,\xff\r\n", "line 5: could not convert"),
        (ROWS + b"4,1,2\r\n", "line 5: it must have 2 cells, got 3"),
    ],
)
def test_what_is_wrong_with_a_table_is_said(tmp_path, data, message):
    """Without its header, doubled, with a NUL, a long field or foreign bytes, a table is refused by its line."""
    (tmp_path / "timing.csv").write_bytes(data)
    with pytest.raises(RunError, match=f"timing.csv, {message}"):
        RunFolder(tmp_path).cut_csv("timing.csv", 2)
    assert (tmp_path / "timing.csv").read_bytes() == data


def test_an_editors_mark_is_no_damage(tmp_path):
    """A byte-order mark, and lines without a carriage return, are read as if they were not there."""
    (tmp_path / "progress.csv").write_bytes(b"\xef\xbb\xbf" + ROWS.replace(b"\r", b""))
    assert lines(RunFolder(tmp_path)) == ["1", "2", "3"]


def test_half_a_number_is_half_a_row(tmp_path):
    """A line without its end is left out although it has all cells: its last number may be half."""
    (tmp_path / "progress.csv").write_bytes(ROWS + b"4,0.2")
    folder = RunFolder(tmp_path)
    assert lines(folder) == ["1", "2", "3"]
    folder.cut_csv("progress.csv", 4)
    assert (tmp_path / "progress.csv").read_bytes() == ROWS


def test_rows_may_say_more_than_before(tmp_path):
    """A resumed run of a later version has more columns: no number ends up below another name."""
    folder = RunFolder(tmp_path)
    folder.append_csv("progress.csv", {"iteration": 1, "reward": 0.5})
    RunFolder(tmp_path).append_csv("progress.csv", {"iteration": 2, "crashes": np.int64(7), "reward": np.float32(0.25)})
    RunFolder(tmp_path).append_csv("progress.csv", {"iteration": 3, "reward": float("nan")})
    assert folder.read_csv("progress.csv") == [
        {"iteration": "1", "reward": "0.5", "crashes": ""},
        {"iteration": "2", "reward": "0.25", "crashes": "7"},
        {"iteration": "3", "reward": "", "crashes": ""},
    ]


def test_what_is_no_number_is_named(tmp_path):
    """A plug-in that says a text in its row is told which, before anything is written."""
    with pytest.raises(TypeError, match=r"mine must be a number, got 'high'"):
        RunFolder(tmp_path).append_csv("progress.csv", {"iteration": 1, "mine": "high"})
    assert not (tmp_path / "progress.csv").exists()


NESTED = "[" * 100_000 + "]" * 100_000
ROW = {"goals": "naive", "weights": "0", "worlds": 4, "steps": 16, "goal_period": 8, "crash_rate": None, "score": 0.5}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (NESTED, "cannot be read"),
        ("\xff", "cannot be read"),
        ('[{"goals": "naive"},', "cannot be read .*line 1"),
        ("{}", "must hold a list of rows, got dict"),
        ("[7]", "row 1: it must be a table, got int"),
        (json.dumps([ROW, ROW | {"worlds": "4"}]), "row 2: worlds must be a number, got '4'"),
        (json.dumps([ROW | {"goals": ["naive"]}]), "row 1: goals must be a text"),
        (json.dumps([ROW | {"score": True}]), "row 1: score must be a number, got True"),
    ],
)
def test_damaged_evaluations_are_one_line(tmp_path, text, message):
    """An evaluation.json that is none, or whose rows have wrong types, is named and stays as it is."""
    path = tmp_path / "evaluation.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(RunError, match=f"evaluation.json.*{message}"):
        read_evaluation(RunFolder(tmp_path))
    assert path.read_bytes() == text.encode("latin-1")


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


@pytest.mark.parametrize(
    ("spoil", "name"),
    [(friction, "env.position"), (moments, "optimizer.square"), (rate, "optimizer.learning_rate"), (weight, "weight")],
)
def test_a_checkpoint_is_never_poisoned(run, spoil, name):
    """A number that is not finite stops the run before the last good checkpoint is replaced, and is named."""
    trainer, folder = training.resume(run.path)
    before = (run.path / "checkpoint.pt").read_bytes()
    spoil(trainer)
    with pytest.raises(SimulationError, match=rf"Iteration 3: 1 of the \d+ numbers of \S*{name} are not finite"):
        training.save(trainer, folder)
    assert (run.path / "checkpoint.pt").read_bytes() == before


@pytest.mark.parametrize("selector", ["plr", "q-fear", "rnd", "p75"])
def test_what_is_not_known_may_be_saved(selector):
    """A selector's marks of what it does not know yet are no fault."""
    trainer = training.build(dataclasses.replace(CONFIG, method=selector), CPU)
    check_finite(trainer)
    for _ in range(2):
        trainer.iterate()
    check_finite(trainer)


def test_what_stopped_a_run_is_written_down(run, monkeypatch):
    """The report names quantity, worlds and last rows; the state beside it has the rollout that led there."""
    trainer, folder = training.resume(run.path)
    iterate = type(trainer).iterate

    def poisoned(self):
        row = iterate(self)
        if self.iteration == 5:
            self.env.tensors["position"][[2, 9]] = torch.nan
        return row

    monkeypatch.setattr(type(trainer), "iterate", poisoned)
    with pytest.raises(SimulationError, match=r"Iteration 6: .*What it was about is in .*failure\.json"):
        training.train(trainer, folder)
    report = run.read_json("failure.json")
    assert report["versions"]["deimos"] == deimos.__version__
    assert [row["iteration"] for row in report["last_rows"]] == ["1", "2", "3", "4", "5"]
    assert [(found["step"], found["world"]) for found in report["invalid"]] == [(0, 2), (0, 9)]
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


def test_what_is_no_file_is_not_replaced(tmp_path):
    """A pipe or a device keeps its place when a file of its name is to be written."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RunError, match="not a regular file"):
        write_whole(tmp_path / "pipe", lambda file: file.write(b"new"))
    assert (tmp_path / "pipe").is_fifo()
    assert os.listdir(tmp_path) == ["pipe"]


def test_a_disk_that_fills_up_keeps_the_last_good_file(tmp_path):
    """Where a file may not grow any more in the middle of a save, the old one stays whole and no part of the new."""
    path, limits = tmp_path / "checkpoint.pt", resource.getrlimit(resource.RLIMIT_FSIZE)
    save_tensors(path, {"schema": 1, "x": torch.zeros(10)})
    before = path.read_bytes()
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(RunError, match=r"could not be written .*what was there is untouched"):
            save_tensors(path, {"schema": 1, "x": torch.zeros(10**6)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["checkpoint.pt"]


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    """Bytes of a terrain file."""
    path = tmp_path_factory.mktemp("ground") / "flat.npz"
    flat(size=2.0, cell=0.25).save(path)
    return path.read_bytes()


@settings(FEW, max_examples=80)
@given(place=st.integers(0), bit=st.integers(0, 7), cut=st.booleans())
def test_a_damaged_terrain_is_one_line_or_the_same(ground, tmp_path_factory, place, bit, cut):
    """With any bit flipped, or cut off anywhere, a terrain file is refused in one line or its ground is unchanged."""
    data = bytearray(ground)
    data[place % len(data)] ^= 1 << bit
    path = tmp_path_factory.mktemp("npz") / "ground.npz"
    path.write_bytes(data[: place % len(data)] if cut else data)
    found, said = attempt(lambda: Terrain.load(path), ValueError)
    if found is None:
        assert said.startswith(f"{path} is not a terrain file")
    else:
        assert np.array_equal(found.heights, flat(size=2.0, cell=0.25).heights)


def test_an_array_that_claims_too_much_is_refused(tmp_path, monkeypatch):
    """What a header promises is compared with what the file holds before anything of that size is allocated."""
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (5000000, 5000), }"
    array = b"\x93NUMPY\x01\x00" + (len(header) + 1).to_bytes(2, "little") + header + b"\n" + bytes(64)
    (tmp_path / "a.npy").write_bytes(array)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("heights.npy", array)
    monkeypatch.setattr(np.lib.format, "read_array", None)  # it would allocate
    for name in ("a.npy", "a.npz"):
        with pytest.raises(ValueError, match=r"float32\[5000000, 5000\] takes 100000000000 bytes, got 64"):
            load_arrays(tmp_path / name)


def test_an_archive_that_claims_too_much_is_refused(tmp_path):
    """A member that says to be larger than its bytes could ever unpack to is refused."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("heights.npy", bytes(1000))
    data = bytearray((tmp_path / "a.npz").read_bytes())
    place = data.index(b"PK\x01\x02") + 24
    data[place : place + 4] = (2**31).to_bytes(4, "little")
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(ValueError, match=r"heights.npy claims 2147483648 bytes and has \d+"):
        load_arrays(tmp_path / "a.npz")


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    """Bytes of a file of tensors."""
    path = tmp_path_factory.mktemp("tensors") / "x.pt"
    save_tensors(path, {"schema": 1, "x": torch.arange(8)})
    return path.read_bytes()


@FEW
@given(place=st.integers(0), bit=st.integers(0, 7))
def test_damaged_tensors_are_one_line_or_the_same(tensors, tmp_path_factory, place, bit):
    """With any bit flipped, a file of tensors is refused in one line or its numbers are unchanged."""
    data = bytearray(tensors)
    data[place % len(data)] ^= 1 << bit
    path = tmp_path_factory.mktemp("pt") / "x.pt"
    path.write_bytes(data)
    found, said = attempt(lambda: load_tensors(path, "checkpoint", 1), RunError)
    if found is None:
        assert said.startswith(str(path))
    else:
        assert torch.equal(found["x"], torch.arange(8))


@FEW
@given(names=st.lists(st.text(min_size=1, max_size=30), min_size=2, max_size=2, unique=True))
def test_a_name_is_a_file_name(tmp_path_factory, names):
    """Whatever a name holds, a file of it can be made in its folder, and no two names share one."""
    folder = tmp_path_factory.mktemp("names")
    for name in names:
        (folder / file_name(name)).write_text(name)
    assert len(os.listdir(folder)) == 2
    assert file_name("particle-4.0_x") == "particle-4.0_x"
    assert len(file_name("x" * 1000)) < 128


@FEW
@given(value=st.one_of(st.integers(), st.floats(), st.text(max_size=5), st.booleans(), st.none()))
def test_options_are_taken_or_refused_in_one_line(capfd, value):
    """Whatever is given for a size, it is a whole number in range, or it is refused in one line with its name."""
    taken, said = attempt(lambda: EvalConfig(worlds=value), ValueError)
    if taken is None:
        assert said.startswith("worlds must be")
    else:
        assert 1 <= value < 2**31
        assert int(value) == value
