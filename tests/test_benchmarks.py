"""The benchmarks, in tiny: every one runs, prints its table, and counts operations as its networks have them."""

import json
import types
from dataclasses import replace
from functools import partial

import pytest
import torch
from deimos.terrain import presets
from torch import nn

from benchmarks import __main__ as benchmarks
from benchmarks import (
    commits,
    director,
    engine_training,
    engines,
    flops,
    learner,
    particle,
    quad,
    stability,
    table41,
    terrain,
    timing,
    training,
)
from deimos.checks import RunError, SimulationError
from deimos.goals.methods import method
from deimos.goals.selectors import rnd, vds
from deimos.learn.ppo import PPOConfig
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs.particle import Config
from reproduction.thesis import TABLE_4_1

CPU = torch.device("cpu")
TINY = TrainConfig(env=Config(goal_period=12), num_envs=64, ppo=PPOConfig(hidden=(8,)), evaluation=False)


def test_ratio_is_the_median_over_rounds(monkeypatch):
    """What is compared is measured in turn, the first round does not count, and a ratio is the rounds' median."""
    done = []
    seconds = timing.in_turn({"a": lambda: done.append("a"), "b": lambda: done.append("b")}, 2, CPU)
    assert done == ["a", "b"] * 3
    assert {name: len(values) for name, values in seconds.items()} == {"a": 2, "b": 2}
    assert timing.ratio([2.0, 9.0, 4.0], [1.0, 1.0, 1.0]) == 4.0
    assert (timing.short(2.5e9), timing.short(61_234_567.0), timing.short(12.0)) == ("2.5 G", "61.2 M", "12")


def test_forward_operations_are_those_of_the_layers():
    """A network for one row multiplies and adds once for every weight."""
    net = nn.Sequential(nn.Linear(5, 7), nn.ReLU(), nn.Linear(7, 3), nn.ReLU(), nn.Linear(3, 2))
    assert flops.forward(5, (7, 3), 2) == sum(2 * p.numel() for p in net.parameters() if p.dim() == 2)
    # The context's share of the first layer once, all else for every candidate.
    assert flops.scoring(4, 1, (7, 3), 2, 10) == 2 * 4 * 7 + 10 * 2 * (1 * 7 + 7 * 3 + 3 * 2)


def test_operations_of_a_learner_are_counted_by_its_networks():
    """PPO's bound is three passes of actor and critic over every transition and epoch."""
    trainer = Trainer(replace(TINY, method="uniform"), CPU)
    weights = [p for net in (trainer.ppo.actor.mean, trainer.ppo.critic) for p in net.parameters() if p.dim() == 2]
    rows = trainer.rollout.reward.numel() * TINY.ppo.epochs
    assert flops.of_learner(TINY.ppo, trainer.env) == 3 * 2 * sum(p.numel() for p in weights) * rows


def test_operations_of_selectors():
    """Fear, surprise and disagreement cost what their networks do; a critic that is not trained is saved."""
    env, ppo = Config(goal_period=12).build(64, CPU, 0), TINY.ppo
    decisions = 24 * 64 / 12
    assert flops.of_selector(method("uniform"), ppo, env) == 0.0
    fear = 2 * (12 * 64 + 100 * (3 * 64 + 64)) * decisions + 3 * 2 * (15 * 64 + 64) * 128
    assert flops.of_selector(method("p25"), ppo, env) == pytest.approx(fear)
    config = rnd.Config(target=4, predictor=6, features=2, candidates=10, epochs=1)
    score = 2 * (12 * 10 + 10 * (3 * 10 + 10 * 2))
    fit = 2 * (15 * 4 + 4 * 2) + 3 * 2 * (15 * 6 + 6 * 2)
    assert flops.of_selector(config, ppo, env) == pytest.approx(decisions * (score + fit))
    config = vds.Config(hidden=(5,), critics=3, candidates=10, epochs=2, role="auxiliary")
    critic = 2 * (12 * 5 + 5)
    both = 24 * 64 * 3 * critic * 7 + decisions * 10 * 3 * critic
    assert flops.of_selector(config, ppo, env) == pytest.approx(both)
    saved = 3 * 2 * (12 * 8 + 8) * 24 * 64 * ppo.epochs
    assert flops.of_selector(replace(config, role="replace"), ppo, env) == pytest.approx(both - saved)


def test_particle_is_measured(capsys):
    """The step of Particle Gym is timed beside torch and NumPy, with what it moves and counts."""
    row = particle.measure_env(65_536, CPU, 1)
    assert {"kernel [steps/s]", "env.step [steps/s]", "eager torch [steps/s]", "numpy [steps/s]"} < set(row)
    assert row["bytes/s"] == 4 * particle.WORDS_PER_STEP * row["kernel [steps/s]"]
    assert all(value > 0 for value in row.values())
    particle.print_env([row], 1, "cpu")
    assert "65,536" in capsys.readouterr().out


def test_training_is_measured(capsys):
    """Every method has its speed beside Uniform's, its shares of an iteration, and its bound."""
    methods = {name: method(name) for name in ("uniform", "p25", "vds")}
    result = training.measure_training(TINY, methods, {"uniform": 2, "p25": 1}, CPU, 1, warm_up=1)
    rows = {row["method"]: row for row in result["rows"]}
    assert set(rows) == set(methods)
    assert (rows["uniform"]["ratio to uniform"], rows["uniform"]["limit"]) == (1.0, 1.0)
    assert 0 < rows["p25"]["limit"] < 1
    assert (rows["p25"]["thesis"], rows["vds"]["thesis"]) == (0.5, None)
    assert sum(rows["p25"]["shares"].values()) == pytest.approx(1.0)
    training.print_training("tiny", result)
    assert "FLOP bound" in capsys.readouterr().out


def test_methods_that_are_timed_exist():
    """Both tables of methods hold Uniform, which the others are compared with."""
    assert "uniform" in training.METHODS_TIMED
    assert "uniform" in quad.METHODS_TIMED


def test_engines_are_measured(capsys):
    """Both engines step in turn on both grounds, with the native one's bare steps, and every ratio is of two times."""
    result = engines.measure(CPU, 2, num_envs=2)
    names = {f"{name}, {ground}" for name in ("native", "bare native", "mujoco-warp") for ground in ("flat", "rough")}
    assert result["us on the clock"].keys() == result["us of all cores"].keys() == names
    assert all(value > 0 for value in result["us on the clock"].values())
    ratios = [value for value in result.values() if isinstance(value, float)]
    assert len(ratios) == 6
    assert all(value > 0 for value in ratios)
    engines.show(result)
    assert "2 robots that walk" in capsys.readouterr().out
    with pytest.raises(ValueError, match="device must be cpu for the native engine, got cuda"):
        engines.measure(torch.device("cuda"), 1)


def test_training_on_engines_is_measured(capsys):
    """Both engines train on both grounds, and with an update that costs nothing more their ratio would be the limit."""
    result = engine_training.measure(CPU, 1, num_envs=4)
    assert result["rows"].keys() == {f"{name}, {ground}" for name in ("native", "warp") for ground in ("flat", "rough")}
    for ground in ("flat", "rough"):
        fast, slow = (result["rows"][f"{name}, {ground}"]["fps"] for name in ("native", "warp"))
        assert result[f"native / mujoco-warp, {ground}"] == pytest.approx(fast / slow)
        assert result[f"limit, {ground}"] > 0
    engine_training.show(result)
    assert "Training, 4 robots" in capsys.readouterr().out
    with pytest.raises(ValueError, match="device must be cpu for the native engine, got cuda"):
        engine_training.measure(torch.device("cuda"), 1)


def test_stability_is_measured(capsys, monkeypatch):
    """World-steps are simulated and counted, with the invalid ones, crashes, levels and memory, and NaN is an error."""
    result = stability.measure(CPU, 1000, num_envs=20)
    assert (result["world_steps"], result["engine"]) == (1000, "native")
    assert result["invalid_share"] == result["invalid"] / 1000
    assert len(result["memory"]) == len(result["mean_level"]) == 25
    assert min(result["memory"]) > 100
    stability.show(result)
    assert "20 Go1s on rough ground, native" in capsys.readouterr().out
    broken = types.SimpleNamespace(scaled=lambda obs: obs[:, :12] * 0.0 + torch.nan)
    monkeypatch.setattr(stability, "load_policy", lambda *_: broken)
    with pytest.raises(SimulationError, match="its action is not finite"):
        stability.measure(CPU, 1000, num_envs=20)


def test_memory_after_builds_is_measured(monkeypatch, capsys):
    """Memory and CPU time are read after every environment on rough ground that was made and dropped."""
    monkeypatch.setattr(stability, "measure_builds", partial(stability.measure_builds, 2))
    result = benchmarks.run(benchmarks.BenchOptions(what="builds", device="cpu", threads=1))
    found, seconds = result["memory"], result["seconds"]
    assert len(found) == len(seconds) == 2
    assert min(found) > 100
    said = capsys.readouterr().out
    assert "MiB after each build: " + " ".join(f"{value:.0f}" for value in found) in said
    assert "CPU time of each [s]: " + " ".join(f"{value:.2f}" for value in seconds) in said


def test_quad_is_measured(capsys):
    """A legged environment is timed beside the bare simulator, on flat and on rough ground."""
    result = quad.measure_env("quad", CPU, 1, num_envs=2)
    assert set(result["control steps/s"]) == {"env.step, flat", "bare, flat", "env.step, rough", "bare, rough"}
    quad.print_env("quad", result)
    assert "env.step / bare, flat" in capsys.readouterr().out


def test_director_is_measured(capsys, monkeypatch):
    """The Director in other people's loops has a time per step for each way and number of worlds, and a share."""
    small = {"rsl_rl": partial(director.share_of_rsl_rl, num_envs=32)}
    small |= {"sb3": partial(director.share_of_sb3, num_envs=2, num_steps=64)}
    monkeypatch.setattr(director, "SHARES", small)
    ways = ("uniform", "p25", "p25, candidates drawn", "p25, their clock")
    result = director.measure(CPU, 1, sizes=(1, 50), period=10, ways=ways)
    assert [row["num_envs"] for row in result["sizes"]] == [1, 50]
    for row in result["sizes"]:
        assert set(row["us per step"]) == set(ways)
        for way, value in row["us per step"].items():
            assert row["world-steps/s"][way] == pytest.approx(row["num_envs"] / value * 1e6)
    assert all(0 < result["shares"][name] < 1 for name in small)
    director.show(result)
    assert "world-steps/s" in capsys.readouterr().out


def test_terrain_is_measured(capsys):
    """The making of both presets, here of small grids, is timed by mesh and rays."""
    grids = [presets.preset(name, levels=2, columns=3, cell=0.2) for name in presets.preset_names()]
    result = terrain.measure(CPU, 2, grids)
    assert [row["preset"] for row in result["making"]] == presets.preset_names()
    for row in result["making"]:
        assert row["rays [1/s]"] == pytest.approx(row["samples"] / row["rays [s]"])
        assert 0 < row["mesh [s]"] < 60
    terrain.show(result)
    said = capsys.readouterr().out
    for word in ("legged-gym", "M rays/s", "Peak memory"):
        assert word in said


def test_numbers_are_written(tmp_path, monkeypatch, capsys):
    """The command measures what is asked for and writes its numbers with versions, threads and device."""
    monkeypatch.setattr(
        director, "measure",
        lambda device, rounds: {
            "period": 1, "sizes": [{"num_envs": 1, "us per step": {}}], "shares": {"rsl_rl": 0.0}, "rounds": rounds,
        },
    )  # fmt: skip
    path = tmp_path / "numbers.json"
    threads = torch.get_num_threads()
    try:
        arguments = ["director", "--rounds", "2", "--json", str(path), "--device", "cpu", "--threads", "1"]
        assert benchmarks.main(arguments) == 0
    finally:
        torch.set_num_threads(threads)
    found = json.loads(path.read_text())
    assert (found["rounds"], found["threads"], found["device"]) == (2, 1, "cpu")
    assert "torch" in found["versions"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing from python -m benchmarks"),
        (["pendulum"], "pendulum"),
        (["particle", "--rounds", "0"], "rounds must be at least 1, got 0"),
        (["particle", "--json", "nowhere/x.json"], "json must be in a folder that exists, got nowhere/x.json"),
    ],
)
def test_mistake_is_refused(arguments, message, capsys):
    """A mistake in the command is said before anything is measured, with exit code 2."""
    assert benchmarks.main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert message in said


def test_two_checkouts_are_compared(capsys):
    """Both are run in turn, and the ratios are those of what they wrote down."""
    options = ["--num-envs", "16", "--env-steps", "120", "--ppo.hidden", "8"]
    results = commits.compare(commits.HOME, 1, 1, {"tiny": options})
    tiny = results["tiny"]
    for key in ("FPS", "env, ms per iteration", "CPU, s"):
        assert tiny["ratio"][key] == pytest.approx(tiny["this"][key] / tiny["other"][key])
    commits.show(results, "HEAD")
    assert "this / other" in capsys.readouterr().out


def test_a_commit_that_is_none_is_one_line():
    """A name that git does not know is said."""
    with pytest.raises(RunError, match="git worktree add failed"):
        commits.measure("no-such-commit", 1, 1)


def test_a_run_that_fails_is_said():
    """An option that a version does not know ends the comparison with what it said."""
    with pytest.raises(RunError, match=r"train\.py .* failed: .*nonsense"):
        commits.compare(commits.HOME, 1, 1, {"bad": ["--nonsense", "1"]})


def test_the_learner_is_measured(capsys):
    """Kernel and torch are timed on the same minibatch, with and without a busy core, beside a large product."""
    case = learner.Case("tiny", 5, (8,), 2, 3, "elu", 100)
    # Of a row: the actor's products are 5 x 8 and 8 x 2, a critic's 5 x 8 and 8 x 1; the first needs two passes.
    assert learner.operations(case) == 2 * 100 * ((2 * 40 + 3 * 16) + 3 * (2 * 40 + 3 * 8))
    rows = learner.measure(1, [case])
    assert [(row["by"], row["busy core"]) for row in rows] == [
        ("kernel", False), ("torch", False), ("kernel", True), ("torch", True),
    ]  # fmt: skip
    for row in rows:
        assert row["ms"] * row["GFLOP/s"] == pytest.approx(learner.operations(case) / 1e6)
        assert 0 < row["share"] < 10
    learner.show(rows)
    assert "tiny, a core busy" in capsys.readouterr().out


@pytest.fixture
def small_table(monkeypatch):
    """Two columns of Table 4.1, in tiny: one whose goals fall due together, one of robots."""
    robots = table41.columns("native", CPU)["quad"].config
    small = replace(robots, num_envs=2, ppo=replace(robots.ppo, hidden=(8,)), env=robots.env.with_goal_period(25))
    found = {
        "directional": table41.Column(TINY, ("uniform", "p25")), "quad": table41.Column(small, ("uniform", "cl")),
    }  # fmt: skip
    monkeypatch.setattr(table41, "columns", lambda engine, device: found)
    return found


def test_table_41_continues_where_it_stopped(small_table, tmp_path, capsys):
    """Rounds hold all methods of all environments, stop when time is up, and go on in another call from the file."""
    path = tmp_path / "table.json"
    command = ["table41", "--rounds", "3", "--json", str(path), "--device", "cpu", "--threads", "1"]
    threads = torch.get_num_threads()
    try:
        assert benchmarks.main([*command, "--seconds", "1e-3"]) == 0
        (first,) = json.loads(path.read_text())["table41"]
        assert "2 rounds are left; the same command continues." in capsys.readouterr().out
        assert benchmarks.main(command) == 0
        assert benchmarks.main([*command, "--rounds", "4", "--engine", "warp"]) == 2
    finally:
        torch.set_num_threads(threads)
    found = json.loads(path.read_text())
    assert (found["engine"], found["device"], len(found["table41"])) == ("native", "cpu", 3)
    assert found["table41"][0] == first
    assert {name: list(own) for name, own in first["seconds"].items()} == {
        "directional": ["uniform", "p25"], "quad": ["uniform", "cl"],
    }  # fmt: skip
    said = capsys.readouterr()
    assert "holds rounds of other engine: one table is one commit on one machine" in said.err
    assert "3 rounds; " in said.out
    assert "load of the host" in said.out


def test_table_41_compares_within_rounds(small_table, capsys):
    """A ratio is the median of the rounds', with quartiles, so that a round that is slow for all counts for nothing."""
    turns = [1.0, 2.0, 10.0]
    ratios = [0.5, 0.8, 0.9]
    rounds = [
        {"seconds": {name: {"uniform": t, "p25": t / r, "cl": t} for name in small_table}, "load": t, "cores": 1.0}
        for t, r in zip(turns, ratios, strict=True)
    ]
    rows = {(row["environment"], row["method"]): row for row in table41.speeds(small_table, rounds)}
    p25 = rows["directional", "p25"]
    assert (p25["low"], p25["ratio"], p25["high"]) == pytest.approx((0.65, 0.8, 0.85))
    assert rows["quad", "cl"]["ratio"] == 1.0
    # 12 steps of 64 worlds take one iteration of 24; a robot's goals fall due in every iteration.
    assert rows["directional", "uniform"]["fps"] == 64 * 24 / 2.0
    table41.show(small_table, rounds)
    said = capsys.readouterr().out
    assert "0.80 [0.65, 0.85]; 0.83" in said  # 274 / 329 in the thesis
    assert "load of the host 2.0 (1.0 to 10.0)" in said


def test_table_41_has_the_columns_of_the_thesis():
    """Every environment of the thesis is there, trained with its methods, robots on the engine that is asked for."""
    found = table41.columns("warp", CPU)
    assert list(found) == ["absolute", "relative", "directional", "quad", "quad_arm"]
    assert {name: set(column.methods) for name, column in found.items()} == {
        name: set(own) for name, own in TABLE_4_1.items()
    }  # fmt: skip
    assert {column.config.env.engine for name, column in found.items() if "quad" in name} == {"warp"}
    assert found["absolute"].config.env.variant == "absolute"
    assert {name: column.iterations for name, column in found.items()} == {
        "absolute": 5, "relative": 5, "directional": 5, "quad": 1, "quad_arm": 1,
    }  # fmt: skip
