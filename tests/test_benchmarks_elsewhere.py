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
    assert outcomes.rate() == outcomes.rate(0) == 1.0


def test_every_period_has_one_outcome():
    """A cart that never crashes in episodes of 500 steps survives four chosen goals in each, to its last step."""
    outcomes = elsewhere.play(BALANCES, elsewhere.anywhere, seed=0)
    assert not outcomes.crashed.any()
    # 1000 steps: an episode of 500, the step that resets the world, and 499, of which 99 do not make a period.
    assert np.bincount(outcomes.world).tolist() == [4 + 3] * 8
    assert outcomes.inputs.shape == (56, 6)
    assert (np.abs(outcomes.inputs[:, 4:]) <= elsewhere.LARGEST).all()


def test_goals_of_the_last_period_do_not_count(monkeypatch):
    """A goal whose T steps the evaluation does not see is left out, also where the cart crashes on it."""
    monkeypatch.setattr(elsewhere, "STEPS", 2 * elsewhere.PERIOD - 1)
    assert len(elsewhere.play(FOLLOWS, elsewhere.beyond, seed=0).crashed) == 0
    monkeypatch.setattr(elsewhere, "STEPS", 2 * elsewhere.PERIOD)
    assert len(elsewhere.play(FOLLOWS, elsewhere.beyond, seed=0).crashed) > 4


def test_attackers_crash_a_follower():
    """A policy that follows goals off its track crashes where it is asked to."""
    beyond = elsewhere.play(FOLLOWS, elsewhere.beyond, seed=0)
    naive = elsewhere.play(FOLLOWS, elsewhere.anywhere, seed=0)
    assert beyond.rate() > naive.rate() > 0


def test_the_most_feared_goals_are_those_that_crashed():
    """Fitted to outcomes where places to the right ended in a crash, the network asks for these."""
    rng = np.random.default_rng(0)
    inputs = rng.uniform(-2, 2, (1000, 6)).astype(np.float32)
    outcomes = elsewhere.Outcomes(inputs, np.arange(1000) % 8, inputs[:, 5] > 1.5, 0.0)
    choose = elsewhere.most_feared(outcomes, seed=0)
    assert choose(inputs[:20, :4], inputs[:20, 4:5], rng).min() > 1.5
    outcomes.crashed[:] = False
    assert elsewhere.most_feared(outcomes, seed=0) is None


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
