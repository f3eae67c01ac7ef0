"""The attacks at length: what counts as a fault is told from what does not, and what was cut off goes on."""

import json
import os
import signal
import time
import tomllib

import numpy as np
import pytest

from benchmarks.faults import __main__ as faults
from benchmarks.faults import files, kills, tomls
from benchmarks.faults.trial import Ended, Verdict, attempt, judged
from deimos.checks import RunError


@pytest.mark.parametrize(
    ("ended", "outcome", "fault"),
    [
        (Ended(0, "", False, False), "accepted", ""),
        (Ended(2, "deimos: worlds must be at least 1, got 0.\n", False, False), "refused", ""),
        (Ended(143, "Stopped after iteration 2\n", True, False), "stopped", ""),
        (Ended(2, "usage\n", False, False), "fault", "no reason was given"),
        (Ended(1, "Traceback (most recent call last):\n", False, False), "fault", "a traceback"),
        (Ended(-signal.SIGSEGV, "", False, False), "fault", "ended by SIGSEGV"),
        (Ended(-signal.SIGKILL, "", True, True), "fault", "it did not end when it was asked to"),
        (Ended(1, "", True, False), "fault", "exit code 1 after SIGTERM"),
    ],
)
def test_a_fault_is_told_from_an_answer(ended, outcome, fault):
    """A refusal in a line, a success and an end that was asked for are no faults; everything else is."""
    found = judged("x", ended)
    assert (found.outcome, found.fault) == (outcome, fault)


def test_an_attempt_is_a_process_of_its_own(tmp_path):
    """What work says, returns, raises and waits for stays in a copy of the process, which ends in time."""
    here = os.getcwd()

    def talk():
        os.write(2, b"said")  # beneath what pytest has put in place of sys.stderr
        return 2

    assert attempt(talk, tmp_path, 60.0) == Ended(2, "said", False, False)
    ended = attempt(lambda: 1 / 0, tmp_path, 60.0)
    assert ended.code == 1
    ended = attempt(lambda: time.sleep(600), tmp_path, 0.1, signal.SIGKILL)
    assert (ended.code, ended.asked, ended.hung) == (-signal.SIGKILL, True, False)
    assert os.getcwd() == here


def test_what_was_cut_off_goes_on(tmp_path, monkeypatch, capsys):
    """The same command makes the attacks that are left, each of the same draws as in one go; faults are printed."""
    made = []

    def attack(number, rng, place):
        made.append((number, int(rng.integers(1000))))
        return Verdict("fault", "it", "said", "bad") if number == 2 else Verdict("refused", "it", figures={"x": number})

    monkeypatch.setattr(tomls, "attack", attack)
    for count in (2, 4):
        found = faults.run(faults.FaultOptions(kind="tomls", count=count, seed=3, json=tmp_path / "x.json"))
    assert [number for number, _ in made] == [0, 1, 2, 3]
    cut = made.copy()
    faults.run(faults.FaultOptions(kind="tomls", count=4, seed=3, json=tmp_path / "y.json"))
    assert made[4:] == cut
    assert found["outcomes"] == {"refused": 3, "fault": 1}
    assert [(each["outcome"], "fault" in each) for each in found["kept"][1:]] == [
        ("refused", False), ("fault", True), ("refused", False),
    ]  # fmt: skip
    assert "2: it\n  bad: said" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "x.json").read_text())["tomls"]["kept"]) == 4
    with pytest.raises(RunError, match="holds attacks of seed 3, got 0"):
        faults.run(faults.FaultOptions(kind="tomls", json=tmp_path / "x.json"))


def test_changed_studies_are_toml():
    """What is changed in a study is written as TOML that says it, so that its refusals are about the change."""
    for seed in range(20):
        study = tomls.changed(np.random.default_rng(seed))
        assert repr(tomllib.loads(tomls.dumps(study))) == repr(study)


@pytest.mark.parametrize("seed", range(12))
def test_damage_changes_a_file(tmp_path, seed):
    """Every kind of damage leaves something else than the file that was there."""
    path = tmp_path / "config.json"
    data = json.dumps({"a": [1.5, {"b": "text"}], "c": 3}).encode()
    path.write_bytes(data)
    what = files.damage(path, np.random.default_rng(seed))
    assert what
    assert not path.is_file() or path.is_symlink() or path.read_bytes() != data


def test_kills_meet_what_was_asked_for():
    """Every selector is killed at least five times, either engine of Quad ten times, and ten runs within a save."""
    methods = [method for method, engine in kills.RUNS if engine is None]
    assert min(methods.count(method) for method in kills.SELECTORS) >= 5
    for engine in ("native", "warp"):
        assert sum(found == engine for _, found in kills.RUNS) >= 10
    assert len(kills.RUNS) == kills.COUNT >= 100
    assert len(range(0, kills.COUNT, kills.SAVES)) >= 10
