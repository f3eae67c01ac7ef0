"""The commands behind the tables of the documentation, on made-up or tiny runs."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from deimos import terrain
from deimos.checks import RunError
from deimos.goals.fear import FearConfig
from deimos.goals.selectors import director
from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.evaluation import EvalConfig
from deimos.run.folder import RunFolder
from deimos.run.presets import preset
from deimos.sim.envs.particle import Config
from deimos.study import plan
from deimos.study.results import Results
from reproduction import fear_table, oracle_table, particle_population, quad_rough


def row(environment, seed, goals="naive", **values):
    """A row of a study, with all that the tables show."""
    shown = {"crashes_per_1000": 0.01 * seed, "crash_rate": 0.001, "score": 0.8, "reward": 0.7, "interactions": 100,
             "interaction_crashes": 1, "adversary_auroc": math.nan, "weak_adversary": None}  # fmt: skip
    return shown | {"environment": environment, "method": "uniform", "seed": seed, "goals": goals} | values


def test_table_of_populations_has_medians_and_ranges(capsys):
    """Every cell of the populations has a row against each kind of goals, with the median of its five seeds."""
    attacked = {"interaction_crashes": 7, "crash_rate": 0.5, "adversary_auroc": 0.9}
    rows = []
    for variant, seed in itertools.product(("directional", "relative"), range(5)):
        hurt = attacked | {"crashes_per_1000": 1.0 + seed, "weak_adversary": seed == 0}
        rows += [row(variant, seed), row(variant, seed, "argmax", **hurt)]
    particle_population.print_populations(rows[::-1])
    lines = capsys.readouterr().out.splitlines()
    assert "| relative | uniform | naive | 0.020 (0.000-0.040) | 0.0010 | 0.800 (0.800-0.800) | 0.7000 |  |" in lines
    hurt = [line for line in lines if "| 3.000 (1.000-5.000) | 0.5000 |" in line]
    assert ["0.900 (1 of 5 uninformed)" in line for line in hurt] == [True, True]
    assert "non-first interaction: median 5 [5, 5], each 5, 5, 5, 5, 5." in lines[-1]


def test_table_of_pilots_says_what_differs(capsys):
    """A pilot has a row with its flags and the crashes of its training, by eighths."""
    pilots = plan.read(particle_population.STUDIES / "pilots.toml")["environment"]
    rows = [row(each["name"], 0, crashes_per_1000=0.25) for each in pilots]
    curves = [{"environment": each["name"], "crashes_per_1000": tuple(range(16))} for each in pilots]
    particle_population.print_pilots(Results(rows, curves), pilots)
    lines = capsys.readouterr().out.splitlines()
    eighths = "0.5, 2.5, 4.5, 6.5, 8.5, 10, 12, 14 | 0.250 | 0.800 |"
    assert lines[2] == f"| directional | defaults | {eighths}"
    assert f"| directional | `--env.reward exponential --env.reward-length 5` | {eighths}" in lines
    assert f"| directional | `--ppo.hidden 128 128` | {eighths}" in lines
    assert f"| directional | `--env.stagger-goals` | {eighths}" in lines
    assert lines[-1] == f"| absolute | `--env.reward reciprocal` | {eighths}"


def test_population_is_a_study(tmp_path, monkeypatch, capsys):
    """The command has ``deimos study`` train what is missing of the population, and prints and keeps its rows."""
    rows = [row("directional", seed, goals) for seed in range(2) for goals in ("naive", "adversary")]
    asked = []

    class Options:
        def __init__(self, **options):
            asked.append(options)

        def run(self):
            Results([each | {"hash": f"{each['seed']}"} for each in rows], []).write(tmp_path)

    monkeypatch.setattr(particle_population, "RunOptions", Options)
    monkeypatch.setattr("sys.argv", ["it", str(tmp_path), "--workers", "3"])
    particle_population.main()
    assert asked == [{"folder": tmp_path, "file": particle_population.STUDIES / "population.toml", "workers": 3}]
    assert "| directional | uniform | adversary | 0.005 (0.000-0.010) |" in capsys.readouterr().out
    kept = RunFolder(tmp_path).read_json("population.json")
    assert ([each["seed"] for each in kept["evaluations"]], kept["audits"]) == ([0, 0, 1, 1], [])


def test_audits_follow_the_training(tmp_path, monkeypatch):
    """A run is audited after each stage of its training, which continues, and what was audited is kept."""
    config = training.TrainConfig(
        env=Config(goal_period=20, max_speed=100.0, max_force=50.0), num_envs=128, ppo=PPOConfig(hidden=(8,)),
        selector=director.Config(fear=FearConfig(min_per_class=4)), evaluation=False, threads=1,
    )  # fmt: skip
    monkeypatch.setattr(
        particle_population, "TrainConfig", lambda method, seed, env_steps, **rest: replace(config, env_steps=env_steps)
    )
    monkeypatch.setattr(particle_population, "AUDITED", (96, 144))
    monkeypatch.setattr(particle_population, "CONTEXTS", 2)
    found = particle_population.audit(tmp_path, 0)
    assert [(row["steps"], row["iteration"]) for row in found] == [(96, 4), (144, 6)]
    monkeypatch.setattr(particle_population, "audit_fear", lambda *arguments: pytest.fail("audited again"))
    assert particle_population.audit(tmp_path, 0) == found


def test_audits_are_printed(capsys):
    """A row of ``audit_fear`` with its seed and steps is one row of the table; without audits there is none."""
    row = {"auroc": 0.8, "low": 0.75, "high": 0.85, "contexts": 200, "tried": 210, "crash_rate": 0.02, "iteration": 84}
    particle_population.print_audits([])
    assert capsys.readouterr().out == ""
    particle_population.print_audits([row | {"seed": 3, "steps": 2000}])
    assert "| 3 | 2000 | 200 of 210 | 0.020 | 0.800 | [0.750, 0.850] |" in capsys.readouterr().out


def test_table_of_rough_ground_has_quarters(tmp_path):
    """The quarters of a run have their means over worlds, levels and memory, and the figure is drawn."""
    path = tmp_path / "worlds.npz"
    reward = np.repeat(np.arange(1.0, 21.0)[:, None], 6, axis=1)
    np.savez(
        path, reward=reward, level=np.full((20, 6), 1.5), invalid=np.ones(20), memory=np.full(20, 900.0),
        seconds=np.arange(60.0, 1260.0, 60.0),
    )  # fmt: skip
    lines = quad_rough.table(path).splitlines()
    assert lines[2] == "| 1 | +3.00000 [+3.00000, +3.00000] | 1.50 | 900 |"
    assert lines[5] == "| 4 | +18.00000 [+18.00000, +18.00000] | 1.50 | 900 |"
    assert "Last quarter less first, over 6 worlds: +15.00000 [+15.00000, +15.00000]." in lines
    assert "20 of 2880 world-steps invalid." in lines
    assert lines[-1] == "20 iterations, 20.0 minutes."
    quad_rough.draw(path, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 1000


def test_table_of_tiles_weighs_them_by_their_worlds():
    """Kinds of ground have their levels in order, and means over tiles count every world once."""
    stratum = {"crashes": 0, "tracking": [0.5, 0.9]}
    row = {
        "strata": {
            "stairs-up 0": stratum | {"worlds": 3, "success": 1.0},
            "stairs-up 10": stratum | {"worlds": 1, "success": 0.0},
            "slope-up 0": stratum | {"worlds": 1, "success": 0.5, "tracking": [0.7, 0.9]},
            "slope-up 10": stratum | {"worlds": 1, "success": 0.25},
        }
    }
    assert quad_rough.tiles(row).splitlines() == [
        "| ground | 0 | 10 | all |",
        "|---|---|---|---|",
        "| slope-up | 0.50 (0.70) | 0.25 (0.50) | 0.38 (0.60) |",
        "| stairs-up | 1.00 (0.50) | 0.00 (0.50) | 0.75 (0.50) |",
        "| all | 0.88 (0.55) | 0.12 (0.50) | 0.62 (0.53) |",
    ]


def test_run_on_rough_ground_goes_on(tmp_path, monkeypatch, capsys):
    """Stopped after an iteration and called again, a run has a row for every iteration, and then is left alone."""
    grid = terrain.preset("go1", levels=2, columns=2, cell=0.1, tile=4.0)
    terrain.build(grid).save(tmp_path / "tiles.npz")
    full, ppo = preset("quad-rough"), PPOConfig(hidden=(8,), num_steps=24, epochs=1)
    env = replace(full.env, terrain=str(tmp_path / "tiles.npz"), goal_period=10, episode_steps=20)
    tiny = replace(full, env=env, num_envs=4, env_steps=48, ppo=ppo)
    monkeypatch.setattr(quad_rough, "preset", {"quad-rough": tiny}.get)
    monkeypatch.setattr(quad_rough, "EVALUATION", replace(quad_rough.EVALUATION, worlds=4, steps=40))
    for minutes, iterations in ((0, 1), (60, 2), (0, 2)):
        monkeypatch.setattr("sys.argv", ["quad_rough", str(tmp_path / "run"), "--minutes", str(minutes)])
        quad_rough.main()
        printed = capsys.readouterr().out
        assert f"{iterations} iterations, " in printed
        assert "| ground | 0 | 1 | all |" in printed


def test_table_of_the_oracle_asks_every_rule(tmp_path, monkeypatch):
    """A run gives the crashes of every rule's choices by fear and by truth, and those of three Adversaries."""
    env = Config(goal_period=10, max_speed=200.0, max_force=200.0)
    config = training.TrainConfig(
        env=env, method="uniform", num_envs=16, env_steps=48, ppo=PPOConfig(hidden=(8,), epochs=1), evaluation=False,
        device="cpu", threads=1,
    )  # fmt: skip
    trainer, folder = training.start(config, tmp_path / "run", None)
    training.train(trainer, folder)
    monkeypatch.setattr(oracle_table, "WORLDS", 8)
    monkeypatch.setattr(oracle_table, "STEPS", 41)
    evaluation = EvalConfig(worlds=32, steps=40, adversary_steps=40)
    monkeypatch.setattr(oracle_table, "EvalConfig", lambda: evaluation)
    same, closed = oracle_table.measure(folder.path)
    assert np.shape(same) == (len(oracle_table.RULES), 2)
    assert len(closed) == 3
    assert all(0.0 <= rate <= 1.0 for rate in [*np.ravel(same), *closed])
    assert same[-1][1] == max(truth for _, truth in same)  # who knows the truth and wants a crash gets most
    assert oracle_table.spread(np.array([0.1, 0.2, 0.6])) == "0.2000 (0.1000-0.6000)"


def test_table_of_fear_trains_and_audits(tmp_path, monkeypatch, capsys):
    """A method is trained once, audited five times, kept in the file, and has a line in the table."""
    audits = iter([RunError("all are safe"), *[{"auroc": x, "contexts": 300} for x in (0.6, 0.8, 0.9, 0.9)]])

    def audit(trainer, contexts):
        assert (contexts, trainer.config.env.variant) == (200, "directional")
        found = next(audits)
        if isinstance(found, RunError):
            raise found
        return found

    monkeypatch.setattr(fear_table, "VARIANTS", {"directional": 480})
    monkeypatch.setattr(fear_table, "audit_fear", audit)
    file = tmp_path / "new" / "rows.csv"
    command = [str(file), "--seeds", "1000", "--methods", "p75", "--variants", "directional"]
    for _ in range(2):  # the second time all is there
        monkeypatch.setattr("sys.argv", ["fear_table", *command])
        fear_table.main()
    (row,) = fear_table.read(file)
    assert row["auroc"] == "nan 0.6 0.8 0.9 0.9"
    assert row["contexts"] == "0 200 200 200 200"
    assert float(row["fitted"]) == 1.0  # with memory, from the first fit on
    assert 0 <= int(row["waited"]) <= 6  # T steps and two rollouts
    assert row["seed"] == "1000"
    assert 50.0 <= float(row["percentile"]) < 87.5
    printed = capsys.readouterr().out
    assert "0.800" in printed
    assert "1 of 4" in printed


@pytest.mark.parametrize("module", [fear_table, oracle_table, particle_population, quad_rough])
def test_commands_explain_themselves(module, monkeypatch, capsys):
    """Each is a command that names its way to be called."""
    monkeypatch.setattr("sys.argv", ["it", "--help"])
    with pytest.raises(SystemExit) as end:
        module.main()
    assert end.value.code == 0
    assert f"python -m {module.__name__} runs/" in capsys.readouterr().out
