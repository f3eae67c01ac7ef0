"""Training and evaluation from a program, and runs of earlier versions."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import deimos
from deimos.app import cli
from deimos.checks import RunError
from deimos.goals.selectors import uniform
from deimos.learn.ppo import PPOConfig
from deimos.run.api import configure_evaluation
from deimos.run.evaluation import EvalConfig
from deimos.run.folder import RunFolder
from deimos.sim.envs import particle, quad
from deimos.study.plan import Cell

OLD = Path(__file__).parent / "data" / "run_0_1_0"  # python train.py of 0.1.0 with 32 worlds, 48 steps, hidden 8


class Unknown(uniform.Config):
    """A selector's configuration in a module that is registered nowhere."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A small run that a program has made."""
    config = deimos.TrainConfig(
        env=particle.Config(goal_period=8), ppo=PPOConfig(hidden=(8,)), num_envs=16, env_steps=48, device="cpu",
        threads=1, eval=EvalConfig(worlds=16, steps=40, adversary_steps=20),
    )  # fmt: skip
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        path = deimos.train(config, tmp_path_factory.mktemp("api") / "run")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    return path


def test_goals_of_an_evaluation_may_outlast_the_episodes_of_the_training():
    """Evaluations of robots have no time limit, so any T that their steps have room for will do."""
    config = deimos.TrainConfig(env=quad.Config(goal_period=20, episode_steps=40), eval=EvalConfig(steps=100))
    env, evaluation = configure_evaluation(config, 50, {})
    assert (env.goal_period, env.episode_steps, evaluation.steps) == (50, 0, 100)
    assert Cell(environment="quad", config=config, goal_periods=(20, 50)).goal_periods == (20, 50)


def test_a_program_trains_evaluates_and_acts(run):
    """Three calls lead from a configuration to actions; the evaluation is kept beside the one of the run's end."""
    assert [row["goals"] for row in RunFolder(run).read_json("evaluation.json")] == [
        "naive", "argmax", "scripted",
    ]  # fmt: skip
    rows = deimos.evaluate(run, goal_period=10, seed=3)
    assert [(row["goals"], row["goal_period"], row["seed"]) for row in rows] == [
        ("naive", 10, 3), ("argmax", 10, 3), ("scripted", 10, 3),
    ]  # fmt: skip
    assert len(RunFolder(run).read_json("evaluation.json")) == 6
    policy = deimos.load_policy(run)
    assert policy(torch.zeros(5, 12)).shape == (5, 3)


def test_the_same_evaluation_replaces_its_rows(run):
    """What was evaluated before with the same seed and sizes is not listed twice."""
    before = len(RunFolder(run).read_json("evaluation.json"))
    deimos.evaluate(run, worlds=16)
    assert len(RunFolder(run).read_json("evaluation.json")) == before


def test_numbers_of_numpy_are_evaluated(tmp_path):
    """A run of NumPy's numbers ends with an evaluation, and so does an evaluation for another T of theirs."""
    config = deimos.TrainConfig(
        env=particle.Config(goal_period=np.int64(4)), ppo=PPOConfig(hidden=(4,), num_steps=4), num_envs=np.int64(8),
        env_steps=4, method="uniform", device="cpu", threads=1, log=(),
        eval=EvalConfig(worlds=np.int64(8), steps=np.int64(12), seed=np.uint32(5), attackers=()),
    )  # fmt: skip
    run = deimos.train(config, tmp_path / "run")
    deimos.evaluate(run, goal_period=np.int64(3), worlds=np.int64(4))
    rows = [(row["goal_period"], row["worlds"], row["seed"]) for row in RunFolder(run).read_json("evaluation.json")]
    assert rows == [(4, 8, 5), (3, 4, 5)]


@pytest.mark.parametrize("changes", [{"worlds": 8}, {"adversary_steps": 30}])
def test_another_evaluation_stands_beside(run, changes):
    """An evaluation of other sizes, or by attackers that were made otherwise, leaves the earlier rows alone."""
    large = deimos.evaluate(run)
    before = RunFolder(run).read_json("evaluation.json")
    small = deimos.evaluate(run, **changes)
    after = RunFolder(run).read_json("evaluation.json")
    for row in (*large, small[1], small[2]):
        key = {name: row[name] for name in ("goals", "worlds", "reward", "crashes", "adversary_setting") if name in row}
        assert sum(each.items() >= key.items() for each in after) == 1, key
    assert len(after) == len(before) + (2 if "worlds" not in changes else 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 10}, "steps must be at least 2 T = 16, got 10"),
        ({"worlds": 0}, "worlds must be at least 1, got 0"),
        ({"words": 3}, "words"),
        ({"seed": 1e3}, "seed must be a whole number, got 1000.0"),
        ({"attackers": "oracle"}, "attackers must be a tuple of names, got 'oracle'"),
        ({"fear": {"epochs": 3}}, "fear must be a deimos.goals.fear.FearConfig, got {'epochs': 3}"),
        ({"pool": 3}, "pool must be a path, got 3"),
        ({"device": torch.device("cpu")}, r"device must be auto, cpu, cuda or cuda:N, got device\(type='cpu'\)"),
    ],
)
def test_evaluation_refuses(run, changes, message):
    """A value that is not allowed, or a name that is none, is said in one line."""
    with pytest.raises(RunError, match=message):
        deimos.evaluate(run, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env": "particle"}, "env must be a deimos.sim.env.EnvConfig, got 'particle'"),
        ({"selector": "p25"}, "selector must be a deimos.goals.selector.SelectorConfig, got 'p25'"),
        ({"ppo": {"hidden": [8]}}, "ppo must be a deimos.learn.ppo.PPOConfig, got {'hidden': "),
        ({"seed": 1e3}, "seed must be a whole number, got 1000.0"),
        ({"threads": 1.5}, "threads must be a whole number, got 1.5"),
        ({"log": "tensorboard"}, "log must be a tuple of names, got 'tensorboard'"),
        ({"device": torch.device("cpu")}, "device must be auto, cpu, cuda or cuda:N, got device"),
        ({"num_envs": 1, "ppo": PPOConfig(num_steps=1, minibatches=1)}, "hold 2 transitions or more, got 1"),
    ],
)
def test_a_configuration_refuses_other_types(changes, message):
    """A value of another type than its field's is said when the configuration is made, by the name of the field."""
    with pytest.raises(ValueError, match=message):
        deimos.TrainConfig(**changes)


@pytest.mark.parametrize("sizes", [64, (64.0,), ("64",), (8, 0)])
def test_hidden_layers_are_whole_numbers(sizes):
    """One number, or anything but whole ones, makes no layers."""
    with pytest.raises(ValueError, match=r"hidden must be one or more positive layer sizes, got \(?['68]"):
        PPOConfig(hidden=sizes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"evaluation": "no"}, "evaluation must be true or false, got 'no'"),
        ({"ppo": PPOConfig(hidden=(8,), clip_value=0)}, "clip_value must be true or false, got 0"),
        ({"selector": Unknown()}, "is not the Config of a plugin of deimos.goals.selectors; register its module with"),
    ],
)
def test_a_run_that_could_not_be_read_again_does_not_begin(tmp_path, changes, message):
    """What Python takes for true, or a selector that nobody could find again, is refused before there is a folder."""
    with pytest.raises(RunError, match=message):
        deimos.train(deimos.TrainConfig(num_envs=16, device="cpu", threads=1, **changes), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_run_folder_is_not_overwritten(run):
    """Training into a folder that exists is refused."""
    with pytest.raises(RunError, match="exists and is not overwritten"):
        deimos.train(out=run)


def test_policy_of_an_old_run_acts_and_is_evaluated(tmp_path):
    """A policy of 0.1.0 loads, and its run can be evaluated again."""
    path = tmp_path / "run"
    shutil.copytree(OLD, path)
    assert deimos.load_policy(path)(torch.zeros(2, 12)).shape == (2, 3)
    rows = deimos.evaluate(path, worlds=8)
    assert [row["worlds"] for row in rows] == [8, 8, 8]
    assert [row["goals"] for row in RunFolder(path).read_json("evaluation.json")] == [
        "naive", "adversary", "naive", "argmax", "scripted",
    ]  # fmt: skip


def test_dir_names_what_the_package_offers():
    """An interpreter completes what ``deimos`` offers before any of it was imported, and nothing private."""
    code = "import deimos; print(dir(deimos) == sorted(deimos.__all__))"
    home = Path(__file__).parent.parent
    assert subprocess.run([sys.executable, "-c", code], cwd=home, capture_output=True, check=True).stdout == b"True\n"


@pytest.mark.parametrize("schema", [1, 2])
def test_an_old_run_is_resumed_or_refused_in_one_line(tmp_path, capsys, schema):
    """A checkpoint of 0.1.0, or of an unreleased 0.2 before the last change, is not used half understood."""
    path = tmp_path / "run"
    shutil.copytree(OLD, path)
    torch.save(torch.load(path / "checkpoint.pt") | {"schema": schema}, path / "checkpoint.pt")
    branch = ["--branch-from", str(path), "--out", str(tmp_path / "branch")]
    for arguments in (["--resume", str(path), "--env-steps", "72"], branch):
        code = cli.main(["train", *arguments])
        said = capsys.readouterr().err.strip().splitlines()
        assert (code, len(said)) == (2, 1)
        assert f"has the schema {schema}, of an earlier version, and cannot be resumed or branched off" in said[0]
    assert not (tmp_path / "branch").exists()
