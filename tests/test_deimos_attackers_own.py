"""Attackers of one's own: how they are found, the networks that they ask for, and the facts that their rows have."""

import importlib
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from deimos.checks import RunError
from deimos.goals.fear import FearConfig
from deimos.run import attackers
from deimos.run.attack import Attack, learn_fear, names
from deimos.run.attackers import scripted
from deimos.run.attackers.scripted import Scripted
from deimos.run.evaluation import EvalConfig, evaluate, make_target
from deimos.sim.envs import particle

CPU = torch.device("cpu")
TASK = particle.Config(goal_period=20)
SMALL = EvalConfig(worlds=20, steps=60, adversary_steps=100, attackers=("scripted",))


def stay(obs):
    """A policy that never moves."""
    return torch.zeros(len(obs), 3)


ATTACKER = """
from dataclasses import dataclass
from deimos.run.attack import Attack, AttackerConfig, uniform_goals

@dataclass(frozen=True)
class Config(AttackerConfig):
    def prepare(self, target):
        return Attack(uniform_goals, {"uninformed": True})
"""


def test_a_file_is_an_attacker(tmp_path, monkeypatch):
    """One file in the package's folder, and nothing else, makes an attacker of its name, with hyphens."""
    (tmp_path / "like_naive.py").write_text(ATTACKER)
    monkeypatch.setattr(attackers, "__path__", [*attackers.__path__, str(tmp_path)])
    importlib.invalidate_caches()
    assert "like-naive" in names()
    naive, same = evaluate(stay, TASK, replace(SMALL, attackers=("like-naive",)), CPU)
    assert (same["goals"], same["reward"]) == ("like-naive", naive["reward"])


def test_an_entry_point_is_an_attacker(tmp_path, monkeypatch):
    """A module of another distribution that is registered under ``deimos.attackers`` is an attacker too."""
    (tmp_path / "other_attacker.py").write_text(ATTACKER)
    (tmp_path / "other-1.0.dist-info").mkdir()
    (tmp_path / "other-1.0.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (tmp_path / "other-1.0.dist-info/entry_points.txt").write_text("[deimos.attackers]\nfar-off = other_attacker\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "far-off" in names()
    assert EvalConfig(attackers=("far-off",)).worlds_against("far-off") == 2000


def test_an_attacker_may_want_another_network():
    """Who asks for another network, more worlds or another seed gets it, and the others keep theirs."""
    target = make_target(stay, TASK, SMALL, CPU)
    shared, facts = learn_fear(target, 100, own_goals=False)
    facts["adversary_steps"] = 7  # what is done to a row's facts is nothing to the next
    for change in ({"fear": FearConfig(hidden=(7,))}, {"worlds": 50}, {"seed": 3}):
        other, _ = learn_fear(replace(target, **change), 100, own_goals=False)
        assert other is not shared
        assert other.config == change.get("fear", SMALL.fear)
    again, facts = learn_fear(replace(target, progress=print), 100, own_goals=False)
    assert again is shared
    assert facts["adversary_steps"] == 100


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"crashes": 3, "score": 0.5}, "Facts of the attacker scripted must not repeat names of the row, got cr"),
        ({"steps": 3}, "must not repeat names of the row, got steps"),
        ({"tried": [1, 2]}, r"The fact tried of the attacker scripted must be a number or a text, got \[1, 2\]"),
    ],
)
def test_facts_do_not_replace_what_was_measured(monkeypatch, facts, message):
    """Facts that a row of the evaluation cannot hold beside its own numbers are refused by their names."""
    monkeypatch.setattr(scripted.Config, "prepare", lambda self, target: Attack(Scripted, facts))
    with pytest.raises(RunError, match=message):
        evaluate(stay, TASK, SMALL, CPU)


def test_facts_may_be_numbers_of_numpy_and_torch(monkeypatch):
    """They are written as Python's."""
    facts = {"adversary_steps": np.int64(3), "adversary_auroc": torch.tensor(0.5), "kind": "mine", "uninformed": False}
    monkeypatch.setattr(scripted.Config, "prepare", lambda self, target: Attack(Scripted, facts))
    row = evaluate(stay, TASK, SMALL, CPU)[1]
    assert json.loads(json.dumps(row))["adversary_steps"] == 3
    assert (row["adversary_auroc"], row["kind"], row["uninformed"]) == (0.5, "mine", False)
