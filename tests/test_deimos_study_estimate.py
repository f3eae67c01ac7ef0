"""What a study takes, told before it starts."""

import dataclasses

import pytest

from deimos.run.evaluation import EvalConfig
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle
from deimos.study import estimate, plan
from deimos.study.folder import StudyFolder
from deimos.study.results import RESULT_COLUMNS, Results, identity
from deimos.study.rounds import AttackRound

CONFIG = TrainConfig(
    env=particle.Config(goal_period=100), method="p25", num_envs=2000, env_steps=2000, threads=1, device="cpu"
)
CELL = plan.Cell(environment="directional", config=CONFIG, goal_periods=(100,))


def test_cost_counts_every_world_step(tmp_path):
    """Training, Naive and every attacker with what it learns from, and audits are counted."""
    study = StudyFolder(tmp_path)
    transitions, steps = estimate.cost(study, CELL)
    assert transitions == 84 * 24 * 2000
    evaluated = 3 * 2000 * 2000 + 2000 * 1500  # Naive, argmax and scripted; what argmax learns from
    assert steps == evaluated + 5 * 100 * (2000 + 100 * 50)
    bare = dataclasses.replace(CELL, audit_worlds=0, goal_periods=(50, 100))
    assert estimate.cost(study, bare) == (transitions, 2 * evaluated)
    study.add_rounds([AttackRound(attackers=("argmax-long",), seeds=(0, 1))])
    added = 2000 * 2000 + 2000 * 6000
    assert estimate.cost(study, CELL) == (transitions, steps + added)
    other = dataclasses.replace(CELL, config=dataclasses.replace(CONFIG, seed=2))
    assert estimate.cost(study, other) == (transitions, steps)


def test_dear_attackers_count_what_they_try():
    """An attacker that learns four times as long costs four times the steps, and clones count."""
    config = EvalConfig(worlds=100, steps=200, oracle_worlds=10, adversary_steps=50)
    assert estimate.evaluation_steps(config, ["argmax-long"]) == 100 * 200 + 100 * 4 * 50
    assert estimate.evaluation_steps(config, ["oracle"]) == 10 * 200 * 101 + 100 * 4 * 50


def test_estimate_is_of_finished_cells_where_there_are_any(tmp_path, monkeypatch):
    """The hours are those of the rates: of finished cells of a method, else of a short run; acting is measured."""
    study = StudyFolder(tmp_path)
    cells = [dataclasses.replace(CELL, config=dataclasses.replace(CONFIG, seed=seed)) for seed in range(3)]
    monkeypatch.setattr(estimate, "_measure", lambda cell: estimate.Speed(training=1000.0, acting=1e6))
    transitions, steps = estimate.cost(study, CELL)
    hours = 3 * (transitions / 1000.0 + steps / 1e6) / 3600
    found = estimate.estimate(study, cells)
    assert found.seconds == {cell.name: (transitions / 1000.0, steps / 1e6) for cell in cells}
    said = found.text
    assert said.startswith(
        f"3 run(s): {3 * transitions / 1e6:.1f} M transitions (FPS measured on a short run of each kind)"
    )
    assert said.endswith(f" = {hours:.2f} core-hours.")
    values = {str: "x", int: 1, float: 0.5, bool: False, tuple: (), dict: {}, list: []}
    row = {name: values[kind] for name, kind in RESULT_COLUMNS.items()}
    Results([row | identity(cells[0]) | {"fps": 50_000.0}]).write(tmp_path)
    said = estimate.estimate(study, cells).text
    assert "(FPS of the finished cells)" in said
    assert said.endswith(f" = {3 * (transitions / 50_000.0 + steps / 1e6) / 3600:.2f} core-hours.")


def test_a_large_design_is_estimated_by_a_sample(tmp_path, monkeypatch):
    """Of many kinds of cells a few are measured, and the others take as long as these in the mean."""
    study, measured = StudyFolder(tmp_path), []

    def measure(cell):
        measured.append(cell.config.env_steps)
        return estimate.Speed(training=1000.0 if len(measured) % 2 else 3000.0, acting=1e6)

    monkeypatch.setattr(estimate, "_measure", measure)
    cells = [
        dataclasses.replace(CELL, config=dataclasses.replace(CONFIG, env_steps=24 * 100 + i), audit_worlds=0)
        for i in range(0, -160, -2)
    ]
    costs = [estimate.cost(study, cell) for cell in cells]
    assert len({cell.setting for cell in cells}) == 80
    said = estimate.estimate(study, cells).text
    assert len(measured) == len(set(measured)) == 16
    assert "(FPS measured on a short run of 16 of 80 kinds)" in said
    seconds = sum(trained / 1500.0 + acted / 1e6 for trained, acted in costs)  # the mean of 1/1000 and 1/3000 is 1/1500
    assert float(said.split(" = ")[1].split()[0]) == pytest.approx(seconds / 3600, rel=0.02)


def test_a_kind_of_cells_is_measured_by_a_short_run():
    """Both rates are positive, and neither takes longer than a period of goals."""
    small = dataclasses.replace(
        CONFIG, env=particle.Config(goal_period=10), num_envs=16, eval=EvalConfig(worlds=16, steps=40)
    )
    found = estimate._measure(dataclasses.replace(CELL, config=small, goal_periods=(10,)))
    assert found.training > 0.0
    assert found.acting > found.training / 10


@pytest.mark.parametrize("iterations", [1, 3, 40, 84])
def test_audits_are_in_the_last_quarter(iterations):
    """The last audit is at the end of the training, and none is before its last quarter."""
    found = estimate.points(iterations)
    assert found[-1] == iterations
    assert len(found) <= 5
    assert found[0] >= round(0.75 * iterations)
