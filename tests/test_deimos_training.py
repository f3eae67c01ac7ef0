"""A run as a whole: killed, resumed, stopped, poisoned, out of disk, and begun with another's networks."""

import errno
import os
import random
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from short_training import CONFIG
from states import assert_same

import deimos
from deimos.app import cli
from deimos.checks import RunError, SimulationError
from deimos.files import load_tensors
from deimos.run import training
from deimos.run.folder import RunFolder

HOME = Path(deimos.__file__).resolve().parent.parent


FLAGS = (
    "--num-envs 64 --env-steps 480 --seed 3 --threads 1 --device cpu --no-evaluation --ppo.hidden 16 16 "
    "--env.goal-period 16 --env.max-speed 40 --env.spawn-range 900 "
    "selector:director --selector.candidates 20 --selector.fear.min-per-class 4"
).split()


EARLY = 5  # iterations after which everything that can be lost has been in use


# The command line itself, with another time between checkpoints and a bound on the size of the files of iterations.
DRIVER = """
import resource, sys
from deimos.app import cli
from deimos.run import training

def train(*arguments, original=training.train):
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), -1))
    return original(*arguments)

training.CHECKPOINT_SECONDS = float(sys.argv[1])
training.train = train
sys.exit(cli.main(["train", *sys.argv[3:]]))
"""


def run(config, path, iterations=None):
    """Train in this process, for a number of iterations or to the end; returns the trainer and the folder."""
    trainer, folder = training.start(config, path, None)
    go_on(trainer, folder, iterations)
    return trainer, folder


def go_on(trainer, folder, iterations=None):
    """Train for a number of iterations more, or to the end."""
    last = None if iterations is None else trainer.iteration + iterations
    training.train(trainer, folder, stopped=lambda: trainer.iteration == last)


def resume(path):
    """Resume a run and finish it, by the command line."""
    assert cli.main(["train", "--resume", str(path)]) == 0


def rows(path):
    """Rows of a run's ``progress.csv``."""
    return RunFolder(path).read_csv("progress.csv")


def checkpoint(path):
    """What a run's checkpoint holds."""
    return training.load_checkpoint(RunFolder(path))


def assert_same_run(path, expected):
    """Two runs have the same ``progress.csv``, checkpoint and policy, bit for bit, and timed the same iterations."""
    assert (path / "progress.csv").read_bytes() == (expected / "progress.csv").read_bytes()
    assert_same(checkpoint(path), checkpoint(expected))
    policies = [load_tensors(folder / "policy.pt", "policy", 1) for folder in (path, expected)]
    assert_same(*policies)
    timed = [[row["iteration"] for row in RunFolder(folder).read_csv("timing.csv")] for folder in (path, expected)]
    assert timed[0] == timed[1]


def files(path):
    """Contents of every file of a folder."""
    return {file.name: file.read_bytes() for file in path.iterdir()}


def start_process(path, checkpoint_seconds, file_size=-1):
    """The run of ``FLAGS`` in a process of its own, whose files may not grow beyond a size [bytes]."""
    command = [sys.executable, "-c", DRIVER, str(checkpoint_seconds), str(file_size), *FLAGS, "--out", str(path)]
    return subprocess.Popen(
        command, cwd=HOME, env=os.environ | {"OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )


def send_when(process, number, ready):
    """Send a signal as soon as something holds; returns the exit code and stderr."""
    deadline = time.monotonic() + 60
    while not ready() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.001)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=60)
    return process.returncode, stderr.decode()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Folder of a run that nothing disturbed, made by the command line."""
    path = tmp_path_factory.mktemp("training") / "undisturbed"
    assert cli.main(["train", *FLAGS, "--out", str(path)]) == 0
    return path


def test_the_run_exercises_the_director(undisturbed):
    """The run that others are compared with has its full length, and its fear network learns early."""
    table = rows(undisturbed)
    assert [int(row["iteration"]) for row in table] == list(range(1, CONFIG.iterations + 1))
    assert all(row["fear/auroc"] and row["fear/loss"] for row in table[EARLY:])
    assert any(row["fear/loss"] for row in table[: EARLY - 1])
    assert checkpoint(undisturbed)["loop"]["selector"]["fear"]["fitted"]


@pytest.mark.parametrize("checkpoint_seconds", [0.05, 1e9], ids=["between checkpoints", "at the first"])
def test_resume_after_a_kill_is_exact(undisturbed, tmp_path, checkpoint_seconds):
    """Killed at a random iteration and resumed, a run ends as the undisturbed one did, bit for bit."""
    path = tmp_path / "run"
    least = EARLY if checkpoint_seconds < 1 else 0  # the first checkpoint is made before the first iteration
    count = random.randint(EARLY, 12)

    def ready():
        return len(rows(path)) >= count and checkpoint(path)["iteration"] >= least

    code, stderr = send_when(start_process(path, checkpoint_seconds), signal.SIGKILL, ready)
    assert code == -signal.SIGKILL, stderr
    assert count <= len(rows(path)) < CONFIG.iterations
    assert least <= checkpoint(path)["iteration"] <= len(rows(path))
    if least:  # by the script itself
        command = [sys.executable, "train.py", "--resume", str(path)]
        subprocess.run(command, cwd=HOME, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=True, capture_output=True)
    else:
        resume(path)
    assert_same_run(path, undisturbed)


def test_interrupt_leaves_a_checkpoint_to_resume_from(undisturbed, tmp_path):
    """On Ctrl-C the iteration is finished and saved, the exit code is 130, and the resumed run is exact."""
    path = tmp_path / "run"
    process = start_process(path, 1e9)
    code, stderr = send_when(process, signal.SIGINT, lambda: len(rows(path)) >= 3)
    assert code == 130, stderr
    assert "Traceback" not in stderr
    done = checkpoint(path)["iteration"]
    assert 3 <= done == len(rows(path)) < CONFIG.iterations
    assert stderr.splitlines()[-1] == f"Stopped after iteration {done}; resume with --resume {path}"
    resume(path)
    assert_same_run(path, undisturbed)


def test_larger_budget_equals_one_from_the_start(undisturbed, tmp_path):
    """A run resumed with a larger budget ends as one that had it from the start."""
    path = tmp_path / "run"
    run(replace(CONFIG, env_steps=200), path)
    assert len(rows(path)) == 9  # 200 steps are eight rollouts and a bit
    assert cli.main(["train", "--resume", str(path), "--env-steps", "480"]) == 0
    assert_same_run(path, undisturbed)
    assert training.read_config(RunFolder.open(path)) == CONFIG


def test_smaller_budget_is_refused(undisturbed, capsys):
    """A resumed run takes no smaller budget, and the refusal changes nothing."""
    before = files(undisturbed)
    assert cli.main(["train", "--resume", str(undisturbed), "--env-steps", "479"]) == 2
    assert "--env-steps must be at least the 480 already set, got 479" in capsys.readouterr().err
    assert files(undisturbed) == before


def test_resume_of_a_finished_run_changes_no_number(undisturbed, tmp_path):
    """Resuming a run whose budget is used up trains nothing more."""
    path = tmp_path / "run"
    run(CONFIG, path)
    resume(path)
    assert_same_run(path, undisturbed)


def test_same_seed_same_run(undisturbed, tmp_path):
    """The same seed gives the same run, bit for bit; another seed gives another."""
    run(CONFIG, tmp_path / "same")
    assert_same_run(tmp_path / "same", undisturbed)
    run(replace(CONFIG, seed=4), tmp_path / "other", iterations=1)
    assert rows(tmp_path / "other")[0] != rows(undisturbed)[0]


def poison_actor(trainer):
    """Make one weight invalid of the actor."""
    trainer.ppo.actor.mean[0].weight.data[3, 2] = torch.nan


def poison_critic(trainer):
    """Make one weight invalid of the critic."""
    trainer.ppo.critic[2].bias.data[1] = torch.nan


def poison_fear(trainer):
    """Make one weight invalid of the fear network."""
    trainer.loop.selector.fear.network[0].weight.data[0, 0] = torch.inf


def poison_world(name):
    """Make one number of world 17 invalid."""

    def poison(trainer):
        trainer.env.tensors[name][17, 1] = torch.nan

    return poison


@pytest.mark.parametrize(
    ("poison", "message"),
    [
        (poison_actor, r"Iteration 3: World 0: its action .*is not finite"),
        (poison_critic, r"Iteration 3: The weight (actor|critic)\.\S+ is not finite"),
        (poison_fear, r"Iteration 3: A weight of the fear network is not finite"),
        (poison_world("position"), r"Iteration 3: World 17: its .*position.* is not finite"),
        (poison_world("velocity"), r"Iteration 3: World 17: its .*velocity.* is not finite"),
        (poison_world("goal"), r"Iteration 3: World 17: its .*goal.* is not finite"),
    ],
    ids=["actor", "critic", "fear", "position", "velocity", "goal"],
)  # fmt: skip
def test_nan_stops_the_run_and_keeps_the_checkpoint(tmp_path, poison, message):
    """NaN in a weight or a world stops the run, says where, and leaves the previous checkpoint, which loads."""
    trainer, folder = run(CONFIG, tmp_path / "run", iterations=2)
    before = (folder.path / "checkpoint.pt").read_bytes(), (folder.path / "policy.pt").read_bytes()
    poison(trainer)
    with pytest.raises(SimulationError, match=message):
        go_on(trainer, folder)
    assert ((folder.path / "checkpoint.pt").read_bytes(), (folder.path / "policy.pt").read_bytes()) == before
    assert len(rows(folder.path)) == 2
    loaded = training.load(folder, CONFIG)
    assert loaded.iteration == 2
    go_on(loaded, folder, iterations=1)  # and is sound
    assert len(rows(folder.path)) == 3


def test_nan_is_one_line_on_the_command_line(tmp_path, monkeypatch, capfd):
    """A run that NaN stops ends with one line that names iteration, world and quantity, and exit code 2."""
    collect = training.Trainer.collect

    def poisoned(trainer):
        if trainer.iteration == 1:  # before the second
            trainer.env.tensors["position"][5] = torch.nan
        collect(trainer)

    monkeypatch.setattr(training.Trainer, "collect", poisoned)
    assert cli.main(["train", *FLAGS, "--out", str(tmp_path / "run")]) == 2
    last = capfd.readouterr().err.splitlines()[-1]
    assert re.match(r"deimos: Iteration 2: World 5: its .*position.* is not finite", last)


def no_space(*args):
    """What the system says of a full disk."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def fill_disk_at_sync(path, monkeypatch):
    """The disk turns out to be full when the file is brought to it."""
    monkeypatch.setattr(os, "fsync", no_space)


def fill_disk_in_torch(path, monkeypatch):
    """The disk fills up within ``torch.save``, which then raises an error of its own."""

    def save(data, file):
        file.write(b"half of it")
        raise RuntimeError("[enforce fail at inline_container.cc:665] . unexpected pos 64 vs 0")

    monkeypatch.setattr(torch, "save", save)


def fill_disk_for_good(path, monkeypatch):
    """Every write to the temporary file fails, really."""
    monkeypatch.setattr(deimos.files, "open_file", lambda name, mode: open("/dev/full", "wb"))


def forbid_writing(path, monkeypatch):
    """The folder is read-only; before root, who may write anywhere, this has to be pretended."""
    if os.geteuid() != 0:
        path.chmod(0o555)
        return
    opened = os.open

    def open_read_only(name, flags, *args, **kwargs):
        if flags & (os.O_WRONLY | os.O_RDWR):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), name)
        return opened(name, flags, *args, **kwargs)

    monkeypatch.setattr(os, "open", open_read_only)


@pytest.mark.parametrize("break_disk", [fill_disk_at_sync, fill_disk_in_torch, fill_disk_for_good, forbid_writing])
def test_failed_write_keeps_the_last_checkpoint(tmp_path, break_disk):
    """A checkpoint that cannot be written raises RunError, leaves the previous one and nothing half-written."""
    trainer, folder = run(CONFIG, tmp_path / "run", iterations=1)
    before = files(folder.path)
    trainer.iterate()
    with pytest.MonkeyPatch.context() as patch:
        break_disk(folder.path, patch)
        try:
            with pytest.raises(RunError, match=r"checkpoint\.pt could not be written .*; what was there is untouched"):
                training.save(trainer, folder)
        finally:
            folder.path.chmod(0o755)
    assert files(folder.path) == before
    assert training.load(folder, CONFIG).iteration == 1
    training.save(trainer, folder)  # there is space again
    assert training.load(folder, CONFIG).iteration == 2


def test_run_resumes_after_the_disk_was_full(undisturbed, tmp_path, monkeypatch):
    """A run that a full disk stopped at a checkpoint resumes from the last good one, bit for bit."""
    path = tmp_path / "run"
    trainer, folder = training.start(CONFIG, path, None)
    synced = []

    def sync_twice(descriptor):
        synced.append(descriptor)
        if len(synced) > 10:  # two tables, a checkpoint and a policy, twice, and the tables of the third
            no_space()

    with monkeypatch.context() as patch:
        patch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(os, "fsync", sync_twice)
        with pytest.raises(RunError, match="No space left on device"):
            go_on(trainer, folder)
    assert checkpoint(path)["iteration"] == 2
    assert len(rows(path)) == 3
    resume(path)
    assert_same_run(path, undisturbed)


def test_full_disk_is_one_line_on_the_command_line(undisturbed, tmp_path):
    """Where no file can grow any more the run ends in one line with exit code 2, whoever met it, and can be resumed."""
    path = tmp_path / "run"
    process = start_process(path, 1e9, file_size=4096)  # TensorBoard's file is the first to reach it
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 2
    assert b"Traceback" not in stderr
    assert re.fullmatch(r"deimos: .* could not be .*written \(.*File too large.*", stderr.decode().splitlines()[-1])
    assert 0 < len(rows(path)) < CONFIG.iterations
    resume(path)
    assert_same_run(path, undisturbed)


def test_full_disk_at_a_row_keeps_the_checkpoint(undisturbed, tmp_path):
    """Where not even a row of progress.csv can be written the run ends in RunError and the checkpoint loads."""
    _, folder = run(CONFIG, tmp_path / "run", iterations=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(deimos.run.folder, "open_file", lambda name, mode="rb", **how: open("/dev/full", mode, **how))
        with pytest.raises(RunError, match=r"progress\.csv could not be written \(No space left on device\)"):
            folder.append_csv("progress.csv", {"iteration": 2})
    assert training.load(folder, CONFIG).iteration == 1


def test_torn_last_row_is_written_again(undisturbed, tmp_path):
    """A row that was cut in the middle is dropped and written again by the resumed run."""
    _, folder = run(CONFIG, tmp_path / "run", iterations=4)
    for name in ("progress.csv", "timing.csv"):
        with (folder.path / name).open("a") as file:
            file.write("5,1")
    resume(folder.path)
    assert_same_run(folder.path, undisturbed)


def test_init_from_takes_weights_only(undisturbed, tmp_path):
    """A run that starts from another has its networks and nothing else: neither optimiser, worlds nor iteration."""
    trainer, folder = training.start(replace(CONFIG, seed=8), tmp_path / "run", undisturbed)
    fresh = training.Trainer(replace(CONFIG, seed=8), torch.device("cpu")).state_dict()
    expected = fresh | {
        "ppo": fresh["ppo"] | {name: checkpoint(undisturbed)["ppo"][name] for name in ("actor", "critic")}
    }
    assert_same(trainer.state_dict(), expected)
    assert folder.read_json("config.json")["init_from"] == str(undisturbed)
    go_on(trainer, folder, iterations=1)
    assert [row["iteration"] for row in rows(folder.path)] == ["1"]


def test_init_from_refuses_other_observations(undisturbed, tmp_path):
    """Networks of the same size that have learnt to read other observations are refused, and no folder is made."""
    config = replace(CONFIG, env=replace(CONFIG.env, variant="relative"))
    with pytest.raises(RunError, match="do not fit this run"):
        training.start(config, tmp_path / "run", undisturbed)
    assert not (tmp_path / "run").exists()


def test_run_that_cannot_begin_leaves_no_folder(tmp_path, monkeypatch):
    """Where not even the configuration can be written, no half-made folder stays in the way of a second try."""
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", no_space)
        with pytest.raises(RunError, match=r"could not be written \(.*No space left on device"):
            training.start(CONFIG, tmp_path / "run", None)
    assert not (tmp_path / "run").exists()
    training.start(CONFIG, tmp_path / "run", None)


@pytest.mark.parametrize(
    "other",
    [
        {"env": replace(CONFIG.env, variant="absolute")},
        {"env": replace(CONFIG.env, goal_period=CONFIG.env.goal_period + 1)},
        {"method": "uniform", "selector": None},
        {"num_envs": CONFIG.num_envs + 1},
    ],
    ids=["variant", "period", "selector", "worlds"],
)
def test_checkpoint_of_another_task_is_refused(undisturbed, other):
    """The shapes of its tensors may fit; what it was made for must too."""
    with pytest.raises(RunError, match="belongs to another environment or network size: it was made for"):
        training.load(RunFolder.open(undisturbed), replace(CONFIG, **other))


@pytest.mark.parametrize(
    ("change", "message"),
    [({"hidden": (16, 8)}, "size mismatch"), ({"activation": "tanh"}, "ppo.activation must be relu, as in the origin")],
)
def test_init_from_refuses_other_networks(undisturbed, tmp_path, change, message):
    """Networks of another size, or that would compute something else, are refused, and no folder is made."""
    config = replace(CONFIG, ppo=replace(CONFIG.ppo, **change))
    with pytest.raises(RunError, match=f"do not fit this run: .*{message}"):
        training.start(config, tmp_path / "run", undisturbed)
    assert not (tmp_path / "run").exists()


def test_rows_are_on_the_disk_before_their_checkpoint(tmp_path, monkeypatch):
    """A power failure leaves no checkpoint without its rows: the tables are flushed first."""
    flushed = []
    monkeypatch.setattr(os, "fsync", lambda file: flushed.append(Path(os.readlink(f"/proc/self/fd/{file}")).name))
    run(CONFIG, tmp_path / "run", 2)
    order = [name.partition(".pt.")[0] for name in flushed]
    assert order[-4:] == ["progress.csv", "timing.csv", "checkpoint", "policy"]
