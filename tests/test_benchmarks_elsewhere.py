"""The experiment in Stable-Baselines3's loop: who is counted, and the table that it goes on with."""

import numpy as np
import pytest

from benchmarks import elsewhere


class Pusher:
    """A linear policy."""

    def __init__(self, gains):
        self.gains = np.array(gains)

    def predict(self, obs, deterministic):
        """To the right where the sum is positive."""
        assert deterministic
        return (obs @ self.gains > 0).astype(int), None


BALANCES = Pusher([0.1, 0.3, 6.0, 1.0, 0.0])
FOLLOWS = Pusher([0.3, 0.5, 8.0, 1.5, -0.3])


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Evaluations of seconds."""
    monkeypatch.setattr(elsewhere, "WORLDS", 8)
    monkeypatch.setattr(elsewhere, "STEPS", 1000)


def test_first_goals_do_not_count():
    """A cart that falls at once has pursued first goals alone, so that nothing is counted."""
    outcomes = elsewhere.play(Pusher([0.0, 0.0, 0.0, 0.0, 0.0]), elsewhere.anywhere, seed=0)
    assert len(outcomes.crashed) == 0


def test_every_period_has_one_outcome():
    """A cart that never crashes in episodes of 500 steps survives four chosen goals in each, to its last step."""
    outcomes = elsewhere.play(BALANCES, elsewhere.anywhere, seed=0)
    assert not outcomes.crashed.any()
    # 1000 steps: an episode of 500, the step that resets the world, and 499, of which 99 do not make a period.
    assert np.bincount(outcomes.world).tolist() == [4 + 3] * 8
    assert outcomes.inputs.shape == (56, 6)
    assert (np.abs(outcomes.inputs[:, 4:]) <= elsewhere.LARGEST).all()


def test_attackers_crash_a_follower():
    """A policy that follows goals off its track crashes on request, and the network learns what to ask for."""
    beyond = elsewhere.play(FOLLOWS, elsewhere.beyond, seed=0)
    naive = elsewhere.play(FOLLOWS, elsewhere.anywhere, seed=0)
    assert beyond.rate() > naive.rate() > 0
    feared = elsewhere.most_feared(naive, seed=0)
    asked = feared(
        np.tile([2.0, 0.5, 0.0, 0.0], (20, 1)).astype(np.float32),
        np.zeros((20, 1), np.float32),
        np.random.default_rng(0),
    )
    assert asked.mean() > 1.5
    assert elsewhere.most_feared(elsewhere.play(BALANCES, elsewhere.anywhere, seed=0), seed=0) is None


def test_the_table_goes_on_where_it_was(monkeypatch, tmp_path, capsys):
    """A second call trains nothing again, and all that was declared is in the table and in what is printed."""
    monkeypatch.setattr(elsewhere, "METHODS", {"uniform": ("uniform", 0.0), "p75": ("p75", 0.0)})
    monkeypatch.setattr(elsewhere, "STEPS", 300)
    options = elsewhere.Options(seeds=(100, 101), steps=2048, table=tmp_path / "rows.csv")
    elsewhere.main(options)
    text = options.table.read_text()
    found = elsewhere.rows(options.table)
    assert [(row["method"], row["seed"]) for row in found] == [
        ("uniform", "100"),
        ("p75", "100"),
        ("uniform", "101"),
        ("p75", "101"),
    ]
    assert set(elsewhere.SHOWN) <= set(found[0])
    monkeypatch.setattr(elsewhere, "train", None)
    elsewhere.main(options)
    assert options.table.read_text() == text
    assert "2 policies of each method" in capsys.readouterr().out
