"""What an evaluation has found, in words: every number in full, and a sentence that says what it means."""

import math
import re

import pytest

from deimos.app.console import number, table
from deimos.app.findings import conclude, describe, percent


def evaluated(naive=0.005, adversary=0.36, **more):
    """The rows of an evaluation, as far as they are described."""
    shared = {
        "worlds": 2000, "steps": 1000, "goal_period": 100, "seed": 3, "score": 0.75, "reward": 0.8123, "crashes": 190,
        "crashes_per_1000": 0.0475, "crashes_per_minute": math.nan, "interactions": 38_000, "tracking": [0.8],
        "goal_groups": ["goal"], "errors": {}, "first_goal_crashes": 1,
    }  # fmt: skip
    collection = {"adversary_interactions": 20_000, "adversary_crashes": 1500, "adversary_auroc": 0.97}
    return [
        shared | {"goals": "naive", "crash_rate": naive} | more,
        shared | collection | {"goals": "argmax", "crash_rate": adversary, "uninformed": False} | more,
    ]


def attacked(goals, even, odd):
    """A row of an attacker that crashed so many of 100 goals each in worlds of even and of odd number."""
    return evaluated(adversary=(even + odd) / 200)[1] | {
        "goals": goals, "interactions": 200, "interaction_crashes": even + odd, "even_interactions": 100,
        "even_interaction_crashes": even,
    }  # fmt: skip


def few_crashes(naive, adversary):
    """The rows of a small evaluation whose attacker saw no crash in the worlds that it is tested on."""
    return evaluated(naive, adversary, interactions=299, adversary_crashes=4, adversary_auroc=math.nan)


@pytest.mark.parametrize(
    ("value", "spelled"),
    [
        (0.0, "0"), (1.0, "1"), (0.5, "0.5"), (0.123456, "0.123"), (12.3456, "12.3"), (999.4, "999"),
        (12345.6, "12,346"), (2.5e-6, "0.0000025"), (1e-12, "< 0.000001"), (-1e-12, "> -0.000001"), (-0.0, "0"),
        (-0.5678, "-0.568"), (-2e4, "-20,000"),
    ],
)  # fmt: skip
def test_a_number_keeps_its_first_digits(value, spelled):
    """Three significant digits at least, never a power of ten, and nothing but zero is 0."""
    assert number(value) == spelled


@pytest.mark.parametrize("transitions", [10**3, 10**6, 10**9])
def test_one_crash_is_never_zero(transitions):
    """However many steps there were, one crash is seen in every rate."""
    assert float(number(1000 / transitions)) == 1000 / transitions
    assert percent(1 / transitions) != "0 %"


def test_a_table_is_as_wide_as_it_must_be(monkeypatch):
    """Labels stand to the left, values to the right, and no terminal cuts them."""
    monkeypatch.setenv("COLUMNS", "20")
    lines = table(("", "first"), [("a long label that stays whole", "1"), ("short", "22")]).splitlines()
    assert lines[1] == "a long label that stays whole      1"
    assert lines[2] == "short                             22"


def test_everything_is_described_in_words():
    """Conditions, values with their units and counts in full; what no row has is left out, what one lacks is a dash."""
    text = describe(evaluated())
    lines = {line[:46].strip(): line[46:].split() for line in text.splitlines()}
    assert text.startswith("Evaluation: 2,000 worlds x 1,000 steps, a goal every 100 steps\n")
    assert lines["goals that ended in a crash"] == ["0.5", "%", "36", "%"]
    assert lines["goals"] == ["38,000", "38,000"]
    assert lines["crashes per 1000 steps"] == ["0.0475", "0.0475"]
    assert lines["goals that the attacker learnt from"] == ["-", "20,000"]
    assert "robot-minute" not in text
    assert "tracking" not in text  # of a goal in one part it is the reward


def test_an_unknown_auroc_is_said():
    """The row stays where no attacker could be tested; who learns nothing has a dash in it."""
    naive, attack = few_crashes(0.0, 0.2)
    naive.pop("adversary_auroc")
    text = describe([naive, attack])
    rows = {line[:46].strip(): line[46:].split() for line in text.splitlines()}
    assert rows["attacker's AUROC (0.5: chance, 1: perfect)"] == ["-", "unknown"]


def test_parts_of_a_goal_have_names():
    """Where a goal has several parts, what is said of each is said by its name; errors have their units."""
    parts = {"tracking": [0.9, 0.8, 0.0001], "goal_groups": ["velocity", "yaw rate", "end effector"]}
    text = describe(evaluated(errors={"end effector [m]": 0.03}, **parts))
    for name, value in zip(parts["goal_groups"], ("0.9", "0.8", "0.0001"), strict=True):
        (line,) = [line for line in text.splitlines() if line.startswith(f"tracking of the goal, {name}")]
        assert line.split()[-2:] == [value, value]
    assert "median error, end effector [m]" in text
    assert "group" not in text


def test_rows_of_an_earlier_version_are_described():
    """Rows without the names of a goal's parts and without values, as a file has them, still make a table."""
    rows = [{key: value for key, value in row.items() if key != "goal_groups"} for row in evaluated(score=None)]
    text = describe([row | {"tracking": [0.5, 0.6]} for row in rows])
    assert "score" not in text
    assert text.count("tracking of the goal") == 2


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        (evaluated(), "Under uniform goals 0.5 % of the goals end in a crash; argmax raises that to 36 %."),
        (evaluated(0.0, 0.2), "Under uniform goals none of the goals end in a crash; .* raises that to 20 %."),
        (evaluated(0.3, 0.3), ".* 30 % of the goals end in a crash; argmax gets no more than 30 %."),
        (
            few_crashes(0.0, 1 / 299),
            r"Under uniform goals none of the goals end in a crash; argmax gets 0\.334 %, which may be chance\. argmax "
            r"learnt from 4 crashes, too few to tell whether it learnt anything: its column proves nothing\.",
        ),
        (few_crashes(0.0, 0.2), r"Under uniform goals none of the goals end in a crash; argmax raises that to 20 %\."),
        (evaluated(0.0, 0.0), ".* none of the goals end in a crash; argmax gets no more than 0 %."),
        (
            [evaluated()[0], evaluated(uninformed=True)[1]],
            r".* 36 %\. Goals of argmax are uniform: there was nothing to learn from, so they prove nothing\.",
        ),
        (
            [evaluated()[0], attacked("argmax", 40, 10), attacked("scripted", 20, 30)],
            r".* scripted raises .* 25 %\. "
            r"The worst attacker is argmax: 10 % in the worlds that were not used to choose it\.",
        ),
        (evaluated(math.nan), "No goal was pursued to its end, so nothing can be said about crashes."),
        (evaluated(None), "No goal was pursued to its end, so nothing can be said about crashes."),
        (
            [*evaluated(), evaluated()[0] | {"goals": "oracle", "crash_rate": 0.5}],
            ".* raises that to 36 %; oracle raises that to 50 %.",
        ),
    ],
)
def test_a_sentence_says_what_it_means(rows, sentence):
    """The last words are what the shares of crashes mean; an attacker that knew nothing and the worst one are named."""
    assert re.fullmatch(sentence, conclude(rows))
