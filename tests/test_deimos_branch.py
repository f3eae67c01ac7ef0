"""Runs that branch off another: what they take over, what is new, and what must not differ."""

import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch

from deimos.app import cli
from deimos.checks import RunError
from deimos.goals.selectors import director, vds
from deimos.learn.ppo import PPOConfig
from deimos.run import api, training
from deimos.run.branch import WARM_UP, branch_config, check_branch
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.env import DRAW_COUNTS
from deimos.sim.envs import particle, quad

CONFIG = TrainConfig(
    env=particle.Config(goal_period=16, max_speed=40.0, spawn_range=900.0), method="p25",
    ppo=PPOConfig(num_steps=8, hidden=(16, 16), normalize_observations=True), evaluation=False, seed=3,
    num_envs=64, env_steps=160, device="cpu", threads=1,
)  # fmt: skip

# The command line, with a checkpoint after every iteration.
DRIVER = """
import sys
from deimos.app import cli
from deimos.run import training

training.CHECKPOINT_SECONDS = 0.0
sys.exit(cli.main(["train", *sys.argv[1:]]))
"""


@pytest.fixture(scope="module")
def origin(tmp_path_factory):
    """The folder of a finished run."""
    return finish(*training.start(CONFIG, tmp_path_factory.mktemp("branch") / "origin")).path


def finish(trainer, folder, iterations=None):
    """Train to the end, or up to an iteration."""
    training.train(trainer, folder, stopped=lambda: trainer.iteration == iterations)
    return folder


def branched(origin, **changes):
    """The configuration of a branch on this machine."""
    base = branch_config(training.read_config(RunFolder(origin)))
    return replace(base, device="cpu", threads=1, **changes)


def weights(module):
    """A copy of all weights and statistics of a network."""
    return [value.clone() for value in module.state_dict().values()]


def test_a_branch_takes_over_what_was_learnt_and_the_worlds(origin, tmp_path):
    """Networks, statistics, optimiser and worlds are the origin's, bit for bit; all that is chance or choice is new."""
    config = branched(origin, method="uniform")
    trainer, folder = training.start(config, tmp_path / "run", branch_from=origin)
    state, fresh = training.load_checkpoint(RunFolder(origin)), training.Trainer(config, torch.device("cpu"))
    for part in ("actor", "critic", "optimizer"):
        expected, found = state["ppo"][part], trainer.ppo.state_dict()[part]
        assert found.keys() == expected.keys()
        assert all(torch.equal(found[name], expected[name]) for name in expected)
    for name, tensor in trainer.env.state_dict().items():
        source = fresh.env.state_dict() if name in DRAW_COUNTS else state["loop"]["env"]
        assert torch.equal(tensor, source[name]), name
    assert state["loop"]["interactions"]["active"].any()
    assert not trainer.loop.interactions.active.any()
    assert trainer.iteration == trainer.loop.interactions.now == 0
    assert torch.equal(trainer.ppo.generator.get_state(), fresh.ppo.generator.get_state())
    assert (config.seed, config.critic_warmup) == (CONFIG.seed + 1, WARM_UP)
    assert folder.read_json("config.json")["branch_from"] == str(origin)


@pytest.mark.parametrize("method", ["p75", "vds"])
def test_critics_learn_for_ten_rollouts_before_the_policy_does(origin, tmp_path, method):
    """Till then not a bit of the policy moves, statistics included, while the critic in use learns; then it does."""
    trainer, folder = training.start(branched(origin, method=method), tmp_path / "run", branch_from=origin)
    critic = trainer.loop.selector.nets.modules[0] if method == "vds" else trainer.ppo.critic
    actor, values, rate = weights(trainer.ppo.actor), weights(critic), trainer.ppo.learning_rate.clone()
    finish(trainer, folder, WARM_UP)
    assert all(torch.equal(*pair) for pair in zip(actor, weights(trainer.ppo.actor), strict=True))
    assert not any(torch.equal(*pair) for pair in zip(values, weights(critic), strict=True))
    assert torch.equal(rate, trainer.ppo.learning_rate)
    rows = folder.read_csv("progress.csv")
    assert all(row["surrogate_loss"] == row["kl"] == "" for row in rows)
    assert all((row["value_loss"] == "") == (method == "vds") for row in rows)
    finish(trainer, folder, WARM_UP + 1)
    assert not any(torch.equal(*pair) for pair in zip(actor, weights(trainer.ppo.actor), strict=True))
    assert folder.read_csv("progress.csv")[-1]["kl"] != ""


def test_a_branch_resumes_bit_for_bit_without_its_origin(origin, tmp_path):
    """Killed at any moment, in its warm-up too, and resumed, it writes the rows of the branch that never stopped."""
    config = branched(origin, method="vds")
    whole = finish(*training.start(config, tmp_path / "whole", branch_from=origin))
    stopped = tmp_path / "stopped"
    arguments = f"--branch-from {origin} --out {stopped} --method vds --device cpu --threads 1"
    process = subprocess.Popen([sys.executable, "-c", DRIVER, *arguments.split()], stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while len(RunFolder(stopped).read_csv("timing.csv")) < 5 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    folder = finish(*training.resume(stopped))
    assert folder.read_csv("progress.csv") == whole.read_csv("progress.csv")
    ours, theirs = (training.load_checkpoint(run)["ppo"]["actor"] for run in (folder, whole))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_what_must_not_differ_is_named(origin, tmp_path):
    """Whatever is neither the method nor one of the three of the task is refused in one line, and no folder is made."""
    base = branched(origin)
    others = {
        "num_envs": replace(base, num_envs=65),
        "ppo.discount": replace(base, ppo=replace(base.ppo, discount=0.9)),
        "env.max_speed": replace(base, env=replace(base.env, max_speed=41.0)),
        "env.kind": replace(base, env=quad.Config(goal_period=16)),
    }
    for name, config in others.items():
        with pytest.raises(ValueError, match=f"^{name} must be .*, as in the origin, got "):
            check_branch(config, base)
    with pytest.raises(RunError, match=r"cannot branch off .*origin: num_envs must be 64, as in the origin, got 65"):
        training.start(others["num_envs"], tmp_path / "run", branch_from=origin)
    assert not (tmp_path / "run").exists()
    with pytest.raises(RunError, match="--init-from and --branch-from cannot be combined"):
        training.start(base, tmp_path / "run", origin, origin)


def test_method_penalty_and_period_may_differ(origin, tmp_path):
    """A branch with another method, a crash penalty and another T runs, and its goals last as long as they should."""
    env = replace(CONFIG.env, crash_penalty=2.0, goal_period=24)
    config = branched(
        origin, env=env, log=(), video_every=9, selector=vds.Config(critics=2, role="auxiliary", hidden=(8,))
    )
    trainer, _ = training.start(config, tmp_path / "run", branch_from=origin)
    trainer.iterate()
    assert trainer.env.crash_penalty == 2.0
    assert trainer.env.goal_period == 24


def test_clocks_stay_spread_where_the_period_is_shorter(origin, tmp_path):
    """Goals that lasted longer at the origin do not all fall due at once: clocks keep their place in the new period."""
    period = CONFIG.env.goal_period // 4
    config = branched(origin, env=replace(CONFIG.env, goal_period=period))
    trainer, _ = training.start(config, tmp_path / "run", branch_from=origin)
    before = training.load_checkpoint(RunFolder(origin))["loop"]["env"]["goal_clock"]
    clock = trainer.env.tensors["goal_clock"]
    assert int((before >= period).sum()) > CONFIG.num_envs // 8
    assert torch.equal(clock, before % period)


def test_a_branch_by_the_command_line_and_in_python(origin, tmp_path):
    """``--branch-from`` starts from the run's own settings, takes what may differ, and equals the same in Python."""
    arguments = "--device cpu --threads 1 --env-steps 16 --no-evaluation selector:director --selector.percentile 60"
    path = tmp_path / "line"
    assert cli.main(["train", "--branch-from", str(origin), "--out", str(path), *arguments.split()]) == 0
    config = training.read_config(RunFolder(path))
    selector = director.Config(percentile=60.0)
    assert config == branched(origin, selector=selector, env_steps=16)
    api.train(config, tmp_path / "python", branch_from=origin)
    assert RunFolder(tmp_path / "python").read_csv("progress.csv") == RunFolder(path).read_csv("progress.csv")


def test_bad_ways_to_branch_are_one_line(origin, tmp_path, capfd):
    """A folder that is no run, and a preset besides, are refused in one line each."""
    for arguments, message in (
        (["--branch-from", str(tmp_path)], "is not a run folder"),
        (["--branch-from", str(origin), "--preset", "particle"], "--preset and --branch-from cannot be combined"),
        (["--branch-from", str(origin), "--num-envs", "65", "--out", str(tmp_path / "x")], "num_envs must be 64"),
    ):
        assert cli.main(["train", *arguments]) != 0
        error = capfd.readouterr().err.strip().splitlines()
        assert message in error[-1]
