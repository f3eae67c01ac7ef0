"""Uniform policies under goals of a rising percentile of fear."""

import math

import pytest
import torch

from deimos.goals import picks
from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.evaluation import EvalConfig, play
from deimos.run.oracle import Clones
from deimos.sim.envs.particle import HALF_SIDE, Config
from deimos.study.folder import StudyFolder
from deimos.study.plan import Cell
from reproduction import shifted_goals

ENV = Config(goal_period=20, max_speed=100.0, max_force=50.0)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A study of one Uniform policy that has hardly learnt, and of one of p25."""
    folder = StudyFolder(tmp_path_factory.mktemp("study"))
    for method in ("uniform", "p25"):
        config = training.TrainConfig(
            env=ENV, method=method, num_envs=16, env_steps=48, ppo=PPOConfig(hidden=(8,), epochs=1), evaluation=False,
            device="cpu", threads=1, eval=EvalConfig(worlds=64, steps=100, adversary_steps=40, oracle_worlds=16),
        )  # fmt: skip
        cell = Cell(environment="directional", config=config, goal_periods=(20,))
        folder.add([cell])
        trainer, run = training.start(config, folder.cell_path(cell) / "run", None)
        training.train(trainer, run)
    return folder


def test_rules_deliver_what_they_say():
    """A blind follower gets goals whose delivered percentile rises with the rule, and crashes more and more often."""
    build = lambda count: ENV.build(count, CPU, 0)  # noqa: E731
    act = build(1).reference_policy(brake=False)
    danger = shifted_goals.exact(Clones(build, act))
    found = []
    for rule, percentile in shifted_goals.RULES.values():
        env = build(512)
        selector = shifted_goals.Ranked(env, danger, rule, percentile, 25)
        assert math.isnan(selector.delivered)
        rate = play(env, act, selector, 200)["crash_rate"]
        found.append((selector.delivered, rate))
    delivered, rates = zip(*found, strict=True)
    assert delivered == tuple(sorted(delivered))
    assert delivered[1] == pytest.approx(50.0, abs=3.0)  # p0 is Uniform; some 1500 goals, four standard errors
    assert rates[0] < rates[1] < rates[-1]


def test_danger_is_the_truth():
    """Exact danger ranks a goal that sends a particle into the wall above one that brings it back."""
    env = ENV.build(2, CPU, 0)
    env.tensors["position"][:] = torch.tensor([0.9 * HALF_SIDE, 0.0, 0.0])
    env.tensors["velocity"][:] = 0.0
    act = env.reference_policy(brake=False)
    danger = shifted_goals.exact(Clones(lambda count: ENV.build(count, CPU, 0), act))
    rows = torch.arange(2)
    candidates = torch.tensor([[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]]).expand(2, 2, 3).contiguous()
    score = danger(env, rows, env.obs[:, :9], env.obs[:, 9:], candidates)
    assert (picks.by_rule(score, torch.zeros(2), "argmax", 0.0) == 0).all()
    assert (score[:, 1] == -ENV.goal_period).all()


def test_policies_of_a_study_are_judged_once(study, monkeypatch, capsys):
    """The Uniform policies have a row for each rule and kind of fear, and a second call makes none again."""
    monkeypatch.setattr("sys.argv", ["it", str(study.path)])
    shifted_goals.main()
    rows = shifted_goals.read(study.path)
    assert {(row["environment"], row["seed"], row["goal_period"]) for row in rows} == {("directional", 0, 20)}
    found = {fear: {row["rule"]: row for row in rows if row["fear"] == fear} for fear in ("exact", "learnt")}
    assert list(found["exact"]) == list(shifted_goals.RULES)
    assert set(found["learnt"]) in ({*shifted_goals.RULES}, set())  # where it has met a crash
    assert found["exact"]["p0"]["percentile"] == pytest.approx(50.0, abs=8.0)
    assert found["exact"]["coop"]["percentile"] <= found["exact"]["antagonist"]["percentile"]
    assert all(math.isfinite(row["score"]) and 0 <= row["crash_rate"] <= 1 for row in rows)
    assert "14 rows in" in capsys.readouterr().out or not found["learnt"]
    monkeypatch.setattr(shifted_goals, "evaluate", lambda *arguments: pytest.fail("made again"))
    shifted_goals.main()
    assert shifted_goals.read(study.path) == rows


def test_no_rows_are_no_error(tmp_path):
    """A study without the file has no such rows."""
    assert shifted_goals.read(tmp_path) == []
