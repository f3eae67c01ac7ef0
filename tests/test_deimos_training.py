"""A run as a whole: killed, resumed, stopped, poisoned and out of disk; and what its files hold."""

import errno
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import deimos
from deimos import plugins
from deimos.app import cli
from deimos.checks import RunError, SimulationError
from deimos.files import load_tensors
from deimos.goals.fear import FearConfig
from deimos.goals.methods import METHODS, method
from deimos.goals.selector import SelectorConfig
from deimos.goals.selectors import director, rnd, uniform
from deimos.learn.ppo import PPOConfig
from deimos.learn.rollout import Rollout
from deimos.nn.random import Purpose, normals
from deimos.run import presets, training
from deimos.run.config import from_dict, kind, to_dict
from deimos.run.evaluation import EvalConfig
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim import envs
from deimos.sim.env import EnvConfig
from deimos.sim.envs import particle

HOME = Path(deimos.__file__).resolve().parent.parent

# Fast particles that start anywhere and get a goal every 16 steps: some crash, some survive, and the fear network
# learns from the first iterations on. Its window, 2 T, is longer than a rollout, so it too outlives a checkpoint.
CONFIG = TrainConfig(
    env=particle.Config(goal_period=16, max_speed=40.0, spawn_range=900.0),
    selector=director.Config(candidates=20, fear=FearConfig(min_per_class=4)),
    ppo=PPOConfig(hidden=(16, 16)),
    evaluation=False,
    seed=3,
    num_envs=64,
    env_steps=480,
    device="cpu",
    threads=1,
)
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


def assert_same(found, expected, name=""):
    """Two nested dictionaries are the same in every number, bit for bit, NaN included."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys(), name
        for key in expected:
            assert_same(found[key], expected[key], f"{name}/{key}")
    elif isinstance(expected, torch.Tensor):
        torch.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True, msg=name)
    else:
        assert found == expected or (found != found and expected != expected), name


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
    assert "--env-steps must exceed the 480 already set, got 479" in capsys.readouterr().err
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


@pytest.mark.parametrize(
    "selector",
    [
        method("p75"),
        method("vds"),
        rnd.Config(target=64, predictor=128, features=128),  # so large that torch shares out the weights' decomposition
    ],
    ids=kind,
)
def test_threads_change_no_number(selector, tmp_path, monkeypatch):
    """On one thread and on several, all of which have work, ``progress.csv`` has the same bytes."""
    monkeypatch.setattr("deimos.nn.cpu.MIN_OPERATIONS", 1.0)
    config = replace(CONFIG, num_envs=1500, env_steps=48, selector=selector)
    before, written = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            run(replace(config, threads=threads), tmp_path / str(threads))
            written.append((tmp_path / str(threads) / "progress.csv").read_bytes())
    finally:
        torch.set_num_threads(before)
    assert written[0].count(b"\n") == 3
    assert written[1] == written[2] == written[0]


@pytest.mark.parametrize("name", ["p75", "rnd", "vds"])
def test_the_hosts_default_dtype_changes_no_number(name):
    """Where torch's default is float64, a trainer is built and learns in float32, with the same numbers."""
    config, found = replace(CONFIG, selector=None, method=name), []
    for dtype in (torch.float32, torch.float64):
        torch.set_default_dtype(dtype)
        try:
            trainer = training.Trainer(config, torch.device("cpu"))
            found.append([str(trainer.iterate()) for _ in range(4)])
        finally:
            torch.set_default_dtype(torch.float32)
    assert found[0] == found[1]


def test_seed_reaches_everything():
    """The seed decides the weights of every network, their noise and order of learning, and the worlds and goals."""
    one, other = (training.Trainer(replace(CONFIG, seed=seed), torch.device("cpu")) for seed in (3, 4))
    for part in (
        lambda trainer: trainer.ppo.actor.mean[0].weight,
        lambda trainer: trainer.ppo.critic[0].weight,
        lambda trainer: trainer.ppo.generator.get_state(),
        lambda trainer: trainer.loop.selector.fear.network[0].weight,
        lambda trainer: trainer.loop.selector.fear.generator.get_state(),
        lambda trainer: trainer.env.tensors["position"],
        lambda trainer: trainer.env.tensors["goal"],
        lambda trainer: trainer.env.sample_goals(torch.arange(2), 3),
        lambda trainer: trainer.env.draw(torch.arange(2)),
    ):
        assert not torch.equal(part(one), part(other))


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
        if len(synced) > 4:  # two checkpoints and two policies
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
    with pytest.raises(RunError, match="that of another environment or network size: it was made for"):
        training.load(RunFolder.open(undisturbed), replace(CONFIG, **other))


def test_init_from_refuses_another_size(undisturbed, tmp_path):
    """Networks of another size are refused, and no folder is made."""
    config = replace(CONFIG, ppo=replace(CONFIG.ppo, hidden=(16, 8)))
    with pytest.raises(RunError, match=r"do not fit this run: .*size mismatch"):
        training.start(config, tmp_path / "run", undisturbed)
    assert not (tmp_path / "run").exists()


CONFIGS = {
    **{f"method {name}": TrainConfig(method=name) for name in METHODS},
    **{f"selector of {name}": TrainConfig(selector=method(name)) for name in METHODS},
    "default": TrainConfig(),
    "all else": TrainConfig(
        env=particle.Config(
            variant="relative", goal_period=7, max_speed=3.3, max_force=float("inf"), goal_range=0.1,
            reward="reciprocal", reward_length=1e-3, spawn_range=999.0, time_limit=55, stagger_goals=True,
            obs_scale="raw", crash_penalty=2.5,
        ),
        selector=director.Config(
            percentile=33.3, rule="argmin", candidates=17, probe=0.05, control="shuffled", memory=3, gate=True,
            fear=FearConfig(
                hidden=(5,), activation="tanh", learning_rate=0.1, epochs=3, minibatches=2, min_per_class=2, workspace=3
            ),
        ),
        ppo=PPOConfig(
            num_steps=5, epochs=2, minibatches=3, learning_rate=1 / 3, desired_kl=0.0, discount=1.0, gae_lambda=0.0,
            clip=0.1, clip_value=False, value_coef=0.5, entropy_coef=0.0, max_grad_norm=7.0, reward_scale=2.0,
            hidden=(3, 2, 1), activation="elu", init_std=0.7, normalize_observations=True,
        ),
        eval=EvalConfig(
            worlds=3, steps=99, seed=0, adversary_steps=4, attackers=("oracle",), oracle_worlds=2, pool=Path("pool.pt"),
            fear=FearConfig(
                hidden=(9, 9, 9), activation="elu", learning_rate=1.0, epochs=1, minibatches=1, min_per_class=9,
                workspace=1,
            ),
        ),
        evaluation=False, seed=2**32 - 1, num_envs=11, env_steps=13, critic_warmup=3, device="cpu",
        threads=2, tf32=True, log=("wandb", "tensorboard"), video_every=4,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CONFIGS)
def test_config_round_trips(tmp_path, name):
    """A configuration comes back the same from config.json, infinity included."""
    config = CONFIGS[name]
    folder = RunFolder.create(tmp_path / "run")
    folder.write_json("config.json", {"schema": training.SCHEMA, "config": to_dict(config)})
    assert json.loads((folder.path / "config.json").read_text())["schema"] == training.SCHEMA
    found = training.read_config(folder)
    assert found == config
    assert found.goals == config.goals
    assert hash(found) == hash(config)  # lists have become tuples again


def test_config_differs_from_the_default_in_every_field():
    """The configuration that shall round-trip leaves no field at its default."""

    def same(config, default, name):
        if hasattr(config, "__dataclass_fields__") and type(config) is type(default):
            for field in config.__dataclass_fields__:
                yield from same(getattr(config, field), getattr(default, field), f"{name}.{field}")
        elif config == default:
            yield name

    found = list(same(CONFIGS["all else"], replace(TrainConfig(), selector=director.Config()), ""))
    assert found == [".method"]  # which excludes a selector


@pytest.mark.parametrize(
    ("cls", "data", "message"),
    [
        (TrainConfig, {"sed": 1}, "deimos.run.trainer.TrainConfig has no sed; it has: critic_warmup, device, env"),
        (TrainConfig, {"env": {"kind": "moon"}}, "deimos.sim.envs has no 'moon'; it has: .*particle"),
        (EnvConfig, {"variant": "relative"}, "deimos.sim.envs must name its 'kind'"),
        (SelectorConfig, {"kind": "director", "percentile": 101}, r"percentile must be in \[0, 100\], got 101"),
    ],
)
def test_config_refuses_what_it_does_not_know(cls, data, message):
    """An unknown field, plugin or value in a stored configuration is named, not skipped."""
    with pytest.raises(ValueError, match=message):
        from_dict(cls, data)


@pytest.mark.parametrize("obs_scale", ["unit", "raw"])
@pytest.mark.parametrize("variant", ["absolute", "directional", "relative"])
def test_policy_acts_as_the_actor_in_physical_units(tmp_path, variant, obs_scale):
    """The saved policy does for physical observations what the actor does for the environment's, bounded alike."""
    config = replace(
        CONFIG, env=replace(CONFIG.env, variant=variant, obs_scale=obs_scale, max_force=0.3), selector=uniform.Config()
    )
    trainer = training.Trainer(config, torch.device("cpu"))
    trainer.collect()
    with torch.no_grad():  # so that about half of the actions are cut
        size = trainer.ppo.actor(trainer.env.obs).abs().median()
        for parameter in trainer.ppo.actor.mean[-1].parameters():
            parameter *= 0.3 / size
    training.save(trainer, RunFolder.create(tmp_path / "run"))
    policy = deimos.load_policy(tmp_path / "run")

    env, state = trainer.env, trainer.env.tensors
    goal = state["goal"] - state["position"] if variant == "relative" else state["goal"]
    physical = torch.cat([state["velocity"], state["position"], state["force"], goal], dim=1)
    mean = trainer.ppo.actor(env.obs).detach()
    expected = mean.clamp(-0.3, 0.3)
    assert (mean != expected).any()  # some are cut
    assert (mean == expected).any()  # and some are not
    # Scaling back and forth costs a rounding or two of numbers up to 2250, seen through two layers.
    torch.testing.assert_close(policy(physical), expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(policy.scaled(env.obs), expected, rtol=0, atol=1e-6)
    assert policy.goal_slice == env.goal_slice
    assert policy.layout == env.layout
    assert [field.unit for field in policy.layout] == [
        "u/step",
        "u",
        "u/step^2",
        "u/step" if variant == "directional" else "u",
    ]
    assert policy.dt == env.dt
    assert policy.action_bound == 0.3


def test_policy_without_a_bound_is_not_cut(tmp_path):
    """A policy trained without a bound on the force loads, and its actions are the actor's own."""
    config = replace(CONFIG, env=replace(CONFIG.env, max_force=float("inf")))
    trainer = training.Trainer(config, torch.device("cpu"))
    trainer.ppo.actor.mean[-1].bias.data += 1e6
    training.save(trainer, RunFolder.create(tmp_path / "run"))
    policy = deimos.load_policy(tmp_path / "run" / "policy.pt")
    assert (policy(torch.zeros(2, 12)) > 1e5).all()


def test_missing_or_foreign_policy_is_refused(tmp_path):
    """A folder without a policy, and a file that is none, raise RunError."""
    with pytest.raises(RunError, match="There is no policy at"):
        deimos.load_policy(tmp_path)
    torch.save({"schema": 1, "layout": [], "actor": {}}, tmp_path / "policy.pt")
    with pytest.raises(RunError, match="is not a policy of this version"):
        deimos.load_policy(tmp_path)


def test_what_led_to_an_invalid_state_is_left_out():
    """Every transition of a world since its last reset gets weight 0 when the world breaks, and no other one."""
    rollout = Rollout(5, 3, 12, 3, torch.device("cpu"))
    rollout.terminated[1, 0] = True  # world 0 is reset after step 1 and breaks at step 3
    rollout.invalid[3, 0] = rollout.truncated[3, 0] = True
    rollout.invalid[0, 1] = rollout.truncated[0, 1] = True  # world 1 breaks at once
    rollout.exclude_invalid()
    expected = torch.tensor([[1, 1, 0, 0, 1], [0, 1, 1, 1, 1], [1, 1, 1, 1, 1]], dtype=torch.float32)
    assert torch.equal(rollout.weight.t(), expected)


def test_too_many_worlds_are_refused_before_memory_is_taken():
    """The message says how much would be needed; nothing is allocated first, or the system would kill the process."""
    with pytest.raises(
        RunError, match=r"2000000000 worlds, each at least \d+ KiB, need more than [\d,]+ GiB of memory, .*use fewer"
    ):
        training.build(TrainConfig(num_envs=2_000_000_000), torch.device("cpu"))


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (RuntimeError("the engine has lost\nits map"), "^the engine has lost its map$"),
        (SimulationError("qpos is not finite"), "^qpos is not finite$"),
        (RuntimeError(), "^RuntimeError$"),
        (ValueError("goal_period must be even"), "^goal_period must be even$"),
        (MemoryError(), r"^64 worlds could not be allocated \(MemoryError\); use fewer"),
        (RuntimeError("Failed to allocate 9 bytes on device 'cpu'"), r"^64 worlds could not be allocated \(Failed to"),
        (RuntimeError("CUDA out of memory"), "^64 worlds could not be allocated"),
        (ValueError("Maximum allowed dimension exceeded"), "^64 worlds could not be allocated"),
    ],
)
def test_what_stops_a_run_from_being_built_is_named(monkeypatch, error, message):
    """Only what is for want of memory is said to be; every other reason is given as it is, in one line."""

    def fail(*arguments):
        raise error

    monkeypatch.setattr(particle.Config, "build", fail)
    with pytest.raises(RunError, match=message):
        training.build(CONFIG, torch.device("cpu"))


def test_a_preset_is_a_training_configuration():
    """Every environment has a preset of its own name, and every preset builds a configuration for its environment."""
    for name in plugins.names(envs):
        assert presets.environment(name) == name
    for name in presets.names():
        assert kind(presets.preset(name).env) == presets.environment(name)
    with pytest.raises(ValueError, match=r"no preset 'nonsense'; there are: .*particle"):
        presets.preset("nonsense")


def test_exploration_is_addressed_by_world_and_step():
    """The first rollout draws the noise of steps 0 to T - 1, the second goes on after it."""
    trainer = training.Trainer(CONFIG, torch.device("cpu"))
    steps, worlds = CONFIG.ppo.num_steps, torch.arange(CONFIG.num_envs)
    for first in (0, steps):
        trainer.iterate()
        numbers = torch.arange(first, first + steps).unsqueeze(1)
        expected = normals(CONFIG.seed, Purpose.EXPLORATION, worlds, numbers, 3)
        assert torch.equal(trainer.rollout.noise, expected)


def test_a_rollout_keeps_no_graph():
    """What an environment or a caller hands over with gradients is recorded without."""
    rollout = Rollout(2, 3, 4, 1, torch.device("cpu"))
    wanting = torch.ones(3, requires_grad=True)
    no, yes = torch.zeros(3, dtype=torch.bool), torch.ones(3, dtype=torch.bool)
    rollout.record(
        0, obs=wanting.unsqueeze(1).expand(3, 4), reward=2 * wanting, terminated=no, truncated=yes, invalid=no,
        weight=wanting, cut_off=torch.arange(3),
    )  # fmt: skip
    kept = [value for value in vars(rollout).values() if isinstance(value, torch.Tensor)]
    assert not any(value.requires_grad for value in [*kept, *rollout.cut_off()])


def test_a_run_leaves_all_global_streams_alone():
    """Building, training and saving under selectors with networks moves neither torch's nor NumPy's global stream."""
    before = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002
    for name in ("p75", "rnd", "vds"):
        config = TrainConfig(
            env=particle.Config(goal_period=4), method=name, ppo=PPOConfig(hidden=(8,)), num_envs=16, evaluation=False
        )
        trainer = training.Trainer(config, torch.device("cpu"))
        for _ in range(2):
            trainer.iterate()
        trainer.load_state_dict(trainer.state_dict())
    assert torch.equal(torch.get_rng_state(), before[0])
    assert str(np.random.get_state()) == str(before[1])  # noqa: NPY002
