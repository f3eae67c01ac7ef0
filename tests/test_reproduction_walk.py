"""From nothing to a robot that walks: the command that makes the table of docs/lab/quad.md."""

import csv
import json
from dataclasses import replace

import pytest

from reproduction import quad_walk

TINY = {"num_envs": 8, "env_steps": 72, "ppo": {"hidden": [8], "num_steps": 24}}


def call(monkeypatch, capsys, *arguments):
    """What the command prints."""
    monkeypatch.setattr("sys.argv", ["quad_walk", *map(str, arguments)])
    quad_walk.main()
    return capsys.readouterr().out


@pytest.fixture
def small(monkeypatch):
    """An evaluation of some seconds."""
    monkeypatch.setattr(quad_walk, "EVALUATION", replace(quad_walk.EVALUATION, worlds=4, steps=200))


def measured(folder):
    """The rows of what a run's iterations took."""
    with (folder / "processor.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_run_that_was_stopped_goes_on(tmp_path, small, monkeypatch, capsys):
    """Stopped after an iteration and continued, a run has every iteration once and its processor time adds up."""
    arguments = [tmp_path, "--seeds", 3, "--change", json.dumps(TINY)]
    call(monkeypatch, capsys, *arguments, "--minutes", 0)
    (first,) = measured(tmp_path / "seed_3")
    row = call(monkeypatch, capsys, *arguments).splitlines()[-1]
    rows = measured(tmp_path / "seed_3")
    assert [int(row["iteration"]) for row in rows] == [1, 2, 3]
    assert rows[0] == first
    seconds = [float(row["seconds"]) for row in rows]
    assert 0.0 < seconds[0] < seconds[1] < seconds[2]
    assert row.startswith(f"| 3 | {seconds[-1] / 60:.1f} | 0.")


def test_tracking_is_a_share(tmp_path, small, monkeypatch, capsys):
    """Tracking is the mean of exp(-error^2 / 0.25), as in the log of the rewards, whatever the terms weigh."""
    heavy = TINY | {"env": {"rewards": {"linear_tracking": 4.0}}}
    call(monkeypatch, capsys, tmp_path, "--seeds", 3, "--change", json.dumps(heavy), "--engines")
    with (tmp_path / "seed_3" / "progress.csv").open() as file:
        logged = list(csv.DictReader(file))
    for row, terms in zip(measured(tmp_path / "seed_3"), logged, strict=True):
        assert float(row["linear_tracking"]) == pytest.approx(float(terms["reward/linear_tracking"]) / (4.0 * 0.02))
        assert float(row["yaw_tracking"]) == pytest.approx(float(terms["reward/yaw_tracking"]) / (0.5 * 0.02))
        assert 0.0 < float(row["linear_tracking"]) < 1.0


def test_crashes_have_an_exact_interval():
    """Per robot-minute, with the interval of a Poisson count; ten crashes in ten robot-minutes are 0.48 to 1.84."""
    row = {"worlds": 30, "steps": 1000, "tracking": [0.81, 0.9], "crashes": 10, "errors": {}}
    assert quad_walk.cells(row) == "0.810 | 0.900 | 1.00 [0.48, 1.84]"
    assert quad_walk.cells(row | {"crashes": 0}) == "0.810 | 0.900 | 0.00 [0.00, 0.37]"
    assert quad_walk.cells(row | {"errors": {"end effector [m]": 0.0512}}).endswith("[0.48, 1.84] | 0.051")


def test_changes_reach_into_nested_fields():
    """A change replaces what it names and leaves what lies beside it."""
    changed = quad_walk.merged({"a": {"b": 1, "c": 2}, "d": 3, "e": None}, {"a": {"b": 5}, "e": {"f": 6}})
    assert changed == {"a": {"b": 5, "c": 2}, "d": 3, "e": {"f": 6}}
