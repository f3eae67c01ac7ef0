"""Pilots, the pool and the table of attackers: the rules that choose, and the files that are committed."""

import csv
import hashlib
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from deimos.goals.fear import FearConfig
from deimos.goals.methods import METHODS, method
from deimos.learn.ppo import PPOConfig
from deimos.run.attack import attacker
from deimos.run.evaluation import EvalConfig, make_target
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle
from reproduction import attackers_table, legged_bases, particle_pool, pilots
from reproduction.pilots import Pilot, choose, means, sizes
from reproduction.runs import finished

CPU = torch.device("cpu")
TINY = EvalConfig(
    worlds=12, steps=80, adversary_steps=40, oracle_worlds=2, attackers=("scripted",),
    fear=FearConfig(epochs=2, min_per_class=1),
)  # fmt: skip


def tiny(env, **changes):
    """A run of seconds."""
    small = {"num_envs": 12, "env_steps": 48, "ppo": PPOConfig(hidden=(8,), epochs=1), "eval": TINY}
    return TrainConfig(**{"env": env, "device": "cpu", "threads": 1} | small | changes)


def test_a_finished_run_is_not_made_again(tmp_path):
    """The second call trains and evaluates nothing, gives the same rows, and one that was killed early begins anew."""
    config = tiny(particle.Config(goal_period=20))
    (tmp_path / "run").mkdir()  # killed before its first checkpoint
    folder, rows = finished(config, tmp_path / "run")
    before = {path.name: path.read_bytes() for path in folder.path.iterdir()}
    assert [row["goals"] for row in rows] == ["naive", "scripted"]
    again = finished(config, tmp_path / "run")[1]
    assert [row["crash_rate"] for row in again] == pytest.approx([row["crash_rate"] for row in rows], nan_ok=True)
    assert before == {path.name: path.read_bytes() for path in folder.path.iterdir()}
    assert finished(replace(config, evaluation=False), tmp_path / "other")[1] == []


def table(**selectors):
    """Rates in two settings and the score as a share of Uniform's, by selector and configuration."""
    return {
        (selector, name): (np.array(found[:2]), found[2])
        for selector, own in selectors.items() for name, found in own.items()
    }  # fmt: skip


def test_a_default_stays_unless_beaten_everywhere():
    """Another configuration must be safer in both settings, and as good; of several the safest is taken."""
    start = {"a": (0.2, 0.2, 0.9), "half": (0.1, 0.3, 1.0), "idle": (0.0, 0.0, 0.5)}
    assert choose(table(s=start), "s", "a") == "a"
    assert choose(table(s=start | {"b": (0.19, 0.19, 0.96)}, other={"x": (0.0, 0.0, 1.0)}), "s", "a") == "b"
    assert choose(table(s=start | {"b": (0.19, 0.19, 0.9), "c": (0.01, 0.1, 0.92)}), "s", "a") == "c"
    assert choose(table(s=start | {"b": (0.2, 0.1, 1.0)}), "s", "a") == "a"


def test_sizes_of_the_penalty():
    """The small one is the safest that costs nothing, the large one the safest above it."""
    own = {"3": (0.2, 0.2, 1.0), "10": (0.1, 0.1, 0.98), "30": (0.05, 0.05, 0.9), "100": (0.02, 0.06, 0.5)}
    assert sizes(table(penalty=own)) == ("10", "100")
    assert sizes(table(penalty=own | {"3": (0.0, 0.0, 1.0)})) == ("3", "100")
    assert sizes(table(penalty={name: (*found[:2], 0.5) for name, found in own.items()})) == ("3", "100")
    assert sizes(table(penalty={name: (*found[:2], 1.0) for name, found in own.items()})) == ("30", "100")


def evaluation(rate, score):
    """Rows of a policy with as many crashes in even worlds as in odd ones."""

    def row(goals, rate):
        crashes = round(1000 * rate)
        return {"goals": goals, "crash_rate": rate, "score": score, "interactions": 2000, "even_interactions": 1000,
                "interaction_crashes": 2 * crashes, "even_interaction_crashes": crashes}  # fmt: skip

    return [row("naive", rate / 10), row("argmax", rate), row("argmax-long", rate / 2), row("scripted", 0.0)]


def test_rules_are_applied_to_what_is_complete(tmp_path, capsys):
    """Scores are shares of Uniform's in the same setting, and a seed that lacks a policy is left out for all."""
    found = []
    for seed in pilots.SEEDS:
        for setting, scale in (("A", 1.0), ("B", 2.0)):
            for selector, configuration, _ in pilots.configurations():
                rate, score = (0.2, scale) if selector == "uniform" else (0.1 * scale, 0.98 * scale)
                if configuration == "beta 0.5":
                    rate *= 0.5
                found.append(pilots.pilot(setting, selector, configuration, seed, evaluation(rate, score)))
    assert means(found[:33], ["A", "B"]) == {}
    for part in (found[:34], found[:-1], found):  # the mean over seeds is that of the first one here
        known = means(part, ["A", "B"])
        assert len(known) == 17
        rates, score = known["q-fear", "beta 0.9"]
        assert rates == pytest.approx([0.1, 0.2])
        assert score == pytest.approx(0.98)
    assert {pilot.attacker for pilot in found} == {"argmax"}
    pilots.show(found[:-1], tmp_path / "pilots.csv")
    said = capsys.readouterr().out
    assert "| q-fear | beta 0.9 | 10.00, 20.00 | 15.00 | 0.980 |\n" in said
    assert "| A | q-fear | beta 0.5 | 0.50, 0.50 | 5.00, 5.00 | 2.50, 2.50 | 0.00, 0.00 | 5.00, 5.00 | 0.980" in said
    assert "weighted: mix 0.5, alpha 1 (the default was mix 0.5, alpha 1)\n" in said
    assert "q-fear: beta 0.5 (the default was beta 0.9)\npenalties: size 3 and size 10\n" in said
    with (tmp_path / "pilots.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(found) - 1
    assert rows[-1]["worst"] == "0.2"


def test_pilots_go_elsewhere_without_headroom(tmp_path, monkeypatch):
    """Where nobody crashes Uniform in B, Absolute takes its place, and B's runs stay; else B has all of them."""
    for rate, expected in ((0.02, {"A": 34, "B": 34}), (0.01, {"A": 34, "B": 2, "B-absolute": 34})):
        made = {}

        def record(root, setting, env, seeds, chosen, made=made):
            for seed in seeds:
                for selector, configuration, _ in chosen:
                    made[setting, selector, configuration, seed] = env

        def known(root, made=made, rate=rate):
            return [Pilot(
                setting=key[0], selector=key[1], configuration=key[2], seed=key[3], worst=rate, attacker="argmax",
                rates=dict.fromkeys(("naive", *pilots.EVALUATION.attackers), 0.0), score=1.0,
            ) for key in made]  # fmt: skip

        monkeypatch.setattr(pilots, "run", record)
        monkeypatch.setattr(pilots, "read", known)
        monkeypatch.setattr("sys.argv", ["it", str(tmp_path)])
        pilots.main()
        settings = [key[0] for key in made]
        assert {name: settings.count(name) for name in dict.fromkeys(settings)} == expected
    assert {env.variant for key, env in made.items() if key[0] == "B-absolute"} == {"absolute"}


def test_pilots_take_part_in_no_study():
    """No number of a setting is a default, and every selector has the same budget, its default among it."""
    for env in (*pilots.SETTINGS.values(), pilots.INSTEAD):
        usual = particle.Config(variant=env.variant)
        for name in ("max_force", "max_speed", "goal_period", "goal_half_side"):
            assert getattr(env, name) != getattr(usual, name)
    assert {len(own) for own in pilots.SELECTORS.values()} == {4}
    for name, default in pilots.DEFAULTS.items():
        assert default in pilots.SELECTORS[name]
        assert method(name) in pilots.SELECTORS[name].values()


def test_pilots_are_read_where_they_are_made(tmp_path, monkeypatch):
    """What a tiny run leaves is found again, under its setting, configuration and seed."""
    monkeypatch.setattr(pilots, "EVALUATION", replace(TINY, attackers=("argmax", "argmax-long", "scripted")))
    monkeypatch.setattr(pilots, "TrainConfig", lambda env, **changes: tiny(env, **changes | {"num_envs": 12}))
    chosen = [each for each in pilots.configurations() if each[1] in ("", "mix 0.25, alpha 0.5")]
    env = particle.Config(goal_period=20, max_speed=100.0, max_force=100.0)
    pilots.run(tmp_path, "A", env, pilots.SEEDS[:1], chosen)
    found = pilots.read(tmp_path)
    assert [(p.setting, p.selector, p.configuration, p.seed) for p in found] == [
        ("A", "uniform", "", 9101), ("A", "weighted", "mix 0.25, alpha 0.5", 9101),
    ]  # fmt: skip


CHECKSUMS = dict(line.split()[::-1] for line in (particle_pool.POOL / "SHA256SUMS").read_text().splitlines())


@pytest.mark.parametrize("name", list(CHECKSUMS))
def test_committed_pools_are_informed(name):
    """The file of a variant or of a base is what its checksum says, small, and informs an attacker of its worlds."""
    path = particle_pool.POOL / name
    assert hashlib.sha256(path.read_bytes()).hexdigest() == CHECKSUMS[name]
    assert path.stat().st_size < 200_000
    robot, _, number = path.stem.partition("_base_")
    if number:
        bases = legged_bases.ROBOTS[robot]
        config = legged_bases.base_config(bases, len(bases.stages) - 1, int(number) - 1)
    else:
        config = particle_pool.VARIANTS[robot]
    target = make_target(lambda obs: obs, config.env, replace(TINY, pool=path), CPU)  # nobody acts
    attack = attacker("pooled").prepare(target)
    assert not attack.facts["uninformed"]
    assert attack.facts["adversary_crashes"] > (0 if number else 1000)  # few policies that walk teach a base's
    assert attack.facts["adversary_auroc"] > (0.5 if number else 0.8)


def test_pool_is_made_of_balanced_policies(tmp_path, monkeypatch):
    """Every method of the pool has the same seeds, which a study does not have, and the same steps to learn from."""
    assert min(particle_pool.SEEDS) > 1000
    assert set(particle_pool.METHODS) <= set(METHODS)
    made, asked = [], []

    def fake(config, path):
        made.append((config.method, config.seed, config.env_steps))
        return finished(tiny(config.env, evaluation=False), path)

    monkeypatch.setattr(particle_pool, "finished", fake)
    monkeypatch.setattr(particle_pool, "POOL", tmp_path)
    monkeypatch.setattr(particle_pool, "make_pool", lambda targets, path: asked.extend(targets))
    particle_pool.pool("absolute", tmp_path / "runs")
    assert sorted(made) == sorted((name, seed, 5000) for name in particle_pool.METHODS for seed in particle_pool.SEEDS)
    assert len({id(target.policy) for target in asked}) == 10
    assert {target.steps for target in asked} == {1500}


def test_table_of_attackers_has_all_of_them_and_planted_policies(tmp_path, monkeypatch, capsys):
    """Each attacker has a line with an interval, how often it was the worst, and what it did to planted policies."""
    sizes = replace(TINY, attackers=("argmax", "scripted"))
    monkeypatch.setattr(attackers_table, "attacks", lambda variant: sizes)
    monkeypatch.setattr(attackers_table, "PLANTED_WORLDS", 12)
    fast = tiny(particle.Config(goal_period=20, max_speed=200.0, max_force=200.0))
    monkeypatch.setattr(attackers_table, "VARIANTS", {"directional": fast})
    for extra in ([], ["--show"]):
        monkeypatch.setattr("sys.argv", ["it", str(tmp_path), "--variants", "directional", *extra])
        attackers_table.main()
        lines = capsys.readouterr().out.splitlines()
        assert [line.split("|")[1].strip() for line in lines[3:]] == ["naive", "argmax", "scripted"]
        assert all(line.endswith(" |") and line.count("(") == 3 for line in lines[3:])
        cells = [cell.strip() for cell in lines[-1].split("|")]
        assert cells[-3] == "0"
        assert float(cells[-2]) > 90
    assert sum(int(line.split("|")[5].split()[0]) for line in lines[4:]) == len(attackers_table.SEEDS)


def test_the_newest_row_of_an_attacker_is_shown():
    """A folder keeps the rows of an earlier pool, which another row of the same name replaces in the table."""
    rows = [{"goals": "scripted", "n": 0}, {"goals": "pooled", "n": 1}, {"goals": "naive", "n": 2}]
    newest = attackers_table._newest([*rows, {"goals": "pooled", "n": 3}])
    assert [(row["goals"], row["n"]) for row in newest] == [("naive", 2), ("pooled", 3), ("scripted", 0)]


def test_intervals_of_rates():
    """Wilson's interval holds the rate, and none of 400 is at most 1 %."""
    assert attackers_table.interval({"interaction_crashes": 0, "interactions": 400, "crash_rate": 0.0}) == "0 (0-0.951)"
    found = attackers_table.interval({"interaction_crashes": 200, "interactions": 400, "crash_rate": 0.5})
    assert found == "50 (45.1-54.9)"
    assert math.isclose(float(attackers_table.percent(0.01234)), 1.23)
