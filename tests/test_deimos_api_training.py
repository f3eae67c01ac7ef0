"""Training from a program as the command line does it: presets, resuming, callbacks, progress, kept policies."""

import re
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import deimos
from deimos.app import cli
from deimos.checks import RunError
from deimos.goals.selectors import director
from deimos.learn.ppo import PPOConfig
from deimos.run import presets, training
from deimos.run.evaluation import EvalConfig, weights_hash
from deimos.run.folder import POLICIES, RunFolder
from deimos.sim.envs import particle, quad, quad_arm

CONFIG = deimos.TrainConfig(
    env=particle.Config(goal_period=8), ppo=PPOConfig(num_steps=8, hidden=(8,), epochs=1), num_envs=16, env_steps=40,
    device="cpu", threads=1, log=(), save_every=2, eval=EvalConfig(worlds=8, steps=40, attackers=("scripted",)),
)  # fmt: skip


@pytest.fixture(scope="module")
def rows():
    """The rows that the callback of ``whole`` was called with."""
    return []


@pytest.fixture(scope="module")
def whole(tmp_path_factory, rows):
    """A run from beginning to end."""
    return deimos.train(CONFIG, tmp_path_factory.mktemp("api") / "whole", callback=rows.append)


@pytest.fixture
def copied(whole, tmp_path):
    """A copy of it, to be evaluated."""
    return Path(shutil.copytree(whole, tmp_path / "copy"))


def kept(run):
    """What a run is known by."""
    names = ("progress.csv", "policy.pt", "policies/000002.pt", "policies/000004.pt", "evaluation.json")
    return {name: (run / name).read_bytes() for name in names}


def test_a_callback_is_given_the_rows_of_progress(whole, rows):
    """Every iteration, with all its columns; what is not False lets the run go on."""
    written = RunFolder(whole).read_csv("progress.csv")
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4, 5]
    assert [{name: repr(value) if value == value else "" for name, value in row.items()} for row in rows] == written


@pytest.mark.parametrize("last", [3, 5])
def test_a_callback_stops_a_run_that_is_resumed(whole, tmp_path, last):
    """False ends it after that iteration, the last one too, without an evaluation; resumed, it is as if it had not."""
    run = deimos.train(CONFIG, tmp_path / "run", callback=lambda row: row["iteration"] < last)
    assert [row["iteration"] for row in RunFolder(run).read_csv("progress.csv")] == [str(i + 1) for i in range(last)]
    assert training.load_checkpoint(RunFolder(run))["iteration"] == last
    assert not (run / "evaluation.json").exists()
    assert deimos.train(resume=run) == run
    assert kept(run) == kept(whole)


def test_a_callback_that_raises_leaves_the_last_checkpoint(whole, tmp_path):
    """Its error is the caller's, and the run is resumed as if it had been killed; leftovers of it are gone."""

    def fail(row):
        if row["iteration"] == 4:
            (path / "policies" / "000006.pt.0123abcd.partial").touch()
            raise KeyError("mine")

    path = tmp_path / "run"
    with pytest.raises(KeyError, match="mine"):
        deimos.train(CONFIG, path, callback=fail)
    assert list(RunFolder(path).of_iterations(POLICIES)) == [2, 4]
    seen = []
    deimos.train(resume=str(path), callback=lambda row: seen.append(list(RunFolder(path).of_iterations(POLICIES))))
    assert seen == [[], [2], [2], [2, 4], [2, 4]]  # from the checkpoint before the first iteration
    assert kept(path) == kept(whole)
    assert len(list((path / "policies").iterdir())) == 2


def test_a_resumed_run_takes_a_larger_budget(whole, tmp_path):
    """``env_steps`` is the new budget, as on the command line."""
    run = deimos.train(replace(CONFIG, env_steps=24, evaluation=False), tmp_path / "run")
    deimos.train(resume=run, env_steps=40, device="cpu", graph="off")
    assert (run / "progress.csv").read_bytes() == (whole / "progress.csv").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env_steps": 48}, "env_steps is for resume; a new run has it in config"),
        ({"device": "cpu"}, "device is for resume; a new run has it in config"),
        ({"resume": "run", "config": CONFIG}, "config is not for resume"),
        ({"resume": "run", "init_from": "run"}, "init_from is not for resume"),
        ({"resume": "run"}, "run is not a run folder"),
        ({"init_from": "run"}, "run is not a run folder"),
        ({"init_from": "run", "branch_from": "."}, "is not a run folder"),
    ],
)
def test_arguments_that_exclude_each_other_are_refused(tmp_path, monkeypatch, arguments, message):
    """In one line, before anything is made."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunError, match=message):
        deimos.train(**arguments)
    assert not list(tmp_path.iterdir())


def test_a_run_begins_with_the_networks_of_another(whole, tmp_path):
    """``init_from`` takes them: where only critics learn, the policy stays that of the other run."""
    config = replace(CONFIG, seed=5, critic_warmup=9, evaluation=False)
    run = deimos.train(config, tmp_path / "run", init_from=whole)
    assert weights_hash(deimos.load_policy(run).actor) == weights_hash(deimos.load_policy(whole).actor)


def test_progress_is_shown_where_somebody_watches(tmp_path, monkeypatch, capfd):
    """On a terminal, in a notebook, or where it is wanted; elsewhere a program's stderr stays its own."""
    monkeypatch.setattr("deimos.run.progress.PLAIN_SECONDS", -1.0)
    monkeypatch.setattr("deimos.run.progress.PLAIN_SHARE", 0.0)

    def said(name, **options):
        deimos.train(CONFIG, tmp_path / name, **options)
        return capfd.readouterr().err

    assert said("silent") == ""
    line = r"training: [\d,]+ FPS, reward [-\d.]+, crashes/1000 \d+, 20%\n"
    wanted = said("wanted", progress=True)
    with monkeypatch.context() as patch:
        patch.setattr("rich.console._is_jupyter", lambda: True)
        notebook = said("notebook")
    for text in (wanted, notebook):
        assert re.match(line, text), text
        assert "\nevaluating: " in text
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes stderr for a terminal
    assert "training: " in said("terminal")
    assert said("unwanted", progress=False) == ""


def test_kept_policies_change_no_number(whole, tmp_path):
    """The same run without them has the same rows and the same last policy."""
    plain = deimos.train(replace(CONFIG, save_every=0), tmp_path / "plain")
    assert not (plain / "policies").exists()
    for name in ("progress.csv", "policy.pt"):
        assert (plain / name).read_bytes() == (whole / name).read_bytes()
    with pytest.raises(ValueError, match="save_every must be at least 0, got -1"):
        deimos.TrainConfig(save_every=-1)


def test_a_kept_policy_is_loaded_evaluated_and_played(copied, tmp_path, capsys):
    """It acts, its rows stand beside those of the last one, which keeps its summary, and a command takes it too."""
    policy = deimos.load_policy(copied / "policies" / "000002.pt")
    assert policy.scaled(torch.zeros(2, 12)).shape == (2, 3)
    before = RunFolder(copied).read_json("evaluation.json")
    assert cli.main(["evaluate", str(copied)]) == 0
    summary = (copied / "summary.png").read_bytes()
    rows = deimos.evaluate(copied, iteration=2)
    assert {row["weights"] for row in rows} == {weights_hash(policy.actor)}
    capsys.readouterr()
    assert cli.main(["evaluate", str(copied), "--iteration", "2"]) == 0
    assert "(Naive)" in capsys.readouterr().out
    evaluated = RunFolder(copied).read_json("evaluation.json")
    assert evaluated[: len(before)] == before
    assert [(row["goals"], row["weights"]) for row in evaluated[len(before) :]] == [
        (row["goals"], row["weights"]) for row in rows
    ]
    assert (copied / "summary.png").read_bytes() == summary
    pictures = tmp_path / "pictures"
    size = "--seconds 0.1 --fps 10 --width 64 --height 48".split()
    assert cli.main(["play", str(copied), "--iteration", "4", "--frames", str(pictures), *size]) == 0
    assert list(pictures.glob("*.png"))
    capsys.readouterr()
    message = "has kept no policy of iteration 3; it has those of: 2, 4."
    for command in (["evaluate"], ["play", "--frames", str(tmp_path / "none")]):
        assert cli.main([*command, str(copied), "--iteration", "3"]) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(RunError, match=message):
        deimos.evaluate(copied, iteration=3)


def test_attackers_mean_the_same_by_command_and_in_python(copied, capsys):
    """Who is named attacks in place of those that the run was set up with; none is nobody."""
    for flags, names in ((["argmax"], ("argmax",)), ([], ())):
        capsys.readouterr()
        sizes = {"worlds": 4, "steps": 16}
        assert cli.main(["evaluate", str(copied), "--worlds", "4", "--steps", "16", "--attackers", *flags]) == 0
        table = capsys.readouterr().out
        assert ("argmax" in table, "scripted" in table) == ("argmax" in names, False)
        assert [row["goals"] for row in deimos.evaluate(copied, attackers=names, **sizes)] == ["naive", *names]
    for changes in ({"pool": "pool.pt"}, {"oracle_worlds": 3}):
        with pytest.raises(RunError, match=r"of the attacker (pooled|oracle)"):
            deimos.evaluate(copied, **changes)


def test_a_preset_is_changed_field_by_field():
    """A dictionary changes some fields of a configuration, a configuration takes its place, the rest stays."""
    base, selector = deimos.preset("quad-walk"), director.Config(percentile=60.0)
    assert base == presets.preset("quad_walk")
    assert base.ppo.init_std == 0.6
    made = deimos.preset("quad-walk", seed=3, env={"terrain": "rough", "rewards": {"torque": -1.0}}, ppo={"epochs": 2})
    rewards = replace(base.env.rewards, torque=-1.0)
    env = replace(base.env, terrain="rough", rewards=rewards)
    assert made == replace(base, seed=3, env=env, ppo=replace(base.ppo, epochs=2))
    assert deimos.preset("quad", selector=selector, env=quad.Config(noise=False)).goals == selector
    assert deimos.preset("quad", method="p75").env == quad.Config()


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("quad-wlak", {}, "Unknown preset 'quad-wlak'; choose from: .*quad-walk"),
        ("quad", {"sed": 3}, "TrainConfig has no sed; it has: .*seed"),
        ("quad", {"env": {"terain": "rough"}}, "quad.Config has no terain; it has: .*terrain"),
        ("quad", {"seed": -1}, r"seed must be in \[0, 2\^32\), got -1"),
        ("quad", {"env": quad_arm.Config()}, "The preset 'quad' is for quad, not for deimos.sim.envs.quad_arm.Config"),
        ("quad", {"env": "rough"}, "env must be a deimos.sim.env.EnvConfig, got 'rough'"),
        ("quad-walk", {"selector": director.Config()}, "method 'uniform' and a selector cannot be combined"),
    ],
)
def test_a_preset_refuses(name, changes, message):
    """What there is not, and what does not fit, by name."""
    with pytest.raises(ValueError, match=message):
        deimos.preset(name, **changes)


def test_robots_with_the_learner_of_particles_are_warned_of(tmp_path, monkeypatch):
    """Once, at the caller's line, where it is the default that was left as it is; runs from folders are not."""
    for config in (quad.Config(), quad_arm.Config()):
        name = "quad-arm" if isinstance(config, quad_arm.Config) else "quad"
        assert f"deimos.preset('{name}')" in presets.advice(deimos.TrainConfig(env=config))
        assert not presets.advice(deimos.TrainConfig(env=config, ppo=PPOConfig(init_std=0.6)))
        assert not presets.advice(deimos.preset(name))
    assert not presets.advice(deimos.TrainConfig())
    monkeypatch.setattr(particle, "PRESETS", {"particle": {"ppo": {"init_std": 0.6}}}, raising=False)
    config = replace(CONFIG, ppo=PPOConfig(), evaluation=False, env_steps=24)
    with pytest.warns(UserWarning, match=r"particle is trained with the default ppo.*preset\('particle'\)") as found:
        run = deimos.train(config, tmp_path / "run")
    assert [warning.filename for warning in found] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        deimos.train(resume=run, env_steps=48)
        deimos.train(out=tmp_path / "branch", branch_from=run)
        training.start(config, tmp_path / "start")
