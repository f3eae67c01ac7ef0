"""Braking beside crashing, in discounted return and in reward per step."""

import pytest

from reproduction import braking


@pytest.mark.parametrize("task", braking.TASKS.values(), ids=braking.TASKS)
def test_braking_wins_where_training_counts(task):
    """From states in which not braking crashes, braking has the larger discounted return, even if only this once.

    In mean reward per step crashing wins, because it puts a particle back to where goals can be followed.
    """
    found = braking.gains(task, worlds=400)
    always, once, never = (found[name].discounted for name in ("brakes", "brakes once", "never brakes"))
    assert always > 1.5 * never
    assert never < once < always
    assert found["never brakes"].per_step > found["brakes"].per_step


def test_command_prints_a_table(monkeypatch, capsys):
    """The command has a line for every reward and controller, with what braking gains."""
    monkeypatch.setattr(braking, "gains", lambda task: {
        "brakes": braking.Gain(50.0, 0.5), "never brakes": braking.Gain(25.0, 0.8),
    })  # fmt: skip
    monkeypatch.setattr("sys.argv", ["it"])
    braking.main()
    said = capsys.readouterr().out
    assert said.count("+100 %") == len(braking.TASKS) == 3
    assert "exponential, 5" in said
