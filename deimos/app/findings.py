"""What an evaluation has found, in words: a table in full words and units, and a sentence that says what it means."""

import math
from collections.abc import Callable, Sequence
from typing import Any

from deimos.app.console import number, table
from deimos.run.evaluation import worst

_LINES = (
    ("score (0: no action, 1: reference controller)", "score"),
    ("reward per step", "reward"),
    ("crashes per 1000 steps", "crashes_per_1000"),
    ("crashes per robot-minute", "crashes_per_minute"),
    ("goals", "interactions"),
    ("crashes, under first goals too", "crashes"),
    ("crashes under first goals, which nobody chose", "first_goal_crashes"),
    ("goals that the attacker learnt from", "adversary_interactions"),
    ("crashes that the attacker learnt from", "adversary_crashes"),
    ("attacker's AUROC (0.5: chance, 1: perfect)", "adversary_auroc"),
)


def describe(rows: list[dict], elsewhere: Sequence[dict] = ()) -> str:
    """A title, a table and a sentence on the rows of one evaluation; what no row has is left out.

    Args:
        rows: Those that ``deimos.run.evaluation.evaluate`` gives.
        elsewhere: Those of the same evaluation on another engine, which the table has too.
    """
    columns = [*rows, *elsewhere]
    lines = [("simulated by", [known(row.get("engine"), str) for row in columns])]
    lines += [("goals that ended in a crash", [percent(row["crash_rate"]) for row in columns])]
    lines += [(label, [known(row.get(key)) for row in columns]) for label, key in _LINES]
    lines += _per_part(columns)
    header, names = zip(("", ""), *[heading(row["goals"]) for row in columns], strict=True)
    shown = [[label, *values] for label, values in lines if any(value != "-" for value in values)]
    return f"Evaluation: {conditions(rows[0])}\n\n{table(header, [names, *shown])}\n\n{conclude(rows)}"


def heading(goals: str) -> tuple[str, str]:
    """What the goals of a row are called, in two lines: uniform ones, or those of an attacker."""
    return ("uniform goals", "(Naive)") if goals == "naive" else ("attacked by", goals)


def conditions(row: dict) -> str:
    """What an evaluation was made under."""
    engine = f", on {row['engine']}" if "engine" in row else ""
    return f"{row['worlds']:,} worlds x {row['steps']:,} steps, a goal every {row['goal_period']} steps{engine}"


def _per_part(rows: list[dict]) -> list[tuple[str, list[str]]]:
    """How well each part of a goal is met, where it has several, and how far from its goal each robot ended."""
    parts = rows[0].get("goal_groups", [""] * len(rows[0]["tracking"]))
    lines = [
        (f"tracking of the goal, {part} (0 to 1)", [known(row["tracking"][i]) for row in rows])
        for i, part in enumerate(parts)
        if len(parts) > 1  # a single one is the reward
    ]
    errors = rows[0].get("errors", {})
    return lines + [(f"median error, {name}", [known(row["errors"][name]) for row in rows]) for name in errors]


def conclude(rows: list[dict]) -> str:
    """What the shares of goals that ended in a crash mean, in a sentence."""
    shares = {row["goals"]: row["crash_rate"] for row in rows}
    if any(_is_missing(share) for share in shares.values()):
        return "No goal was pursued to its end, so nothing can be said of crashes."
    naive = shares.pop("naive")
    said = f"Under uniform goals {percent(naive) if naive else 'none'} of the goals end in a crash"
    for goals, share in shares.items():
        said += f"; {goals} " + ("raises that to " if share > naive else "gets no more than ") + percent(share)
    said += "."
    if without := [row["goals"] for row in rows if row.get("uninformed")]:
        said += (
            f" Goals of {' and '.join(without)} are uniform: there was nothing to learn from, so they prove nothing."
        )
    for most in worst([rows]) if len(shares) > 1 and any(shares.values()) else []:
        said += f" The worst attacker is {most['attacker']}: {percent(most['crash_rate'])} in the worlds that did not"
        said += " choose it."
    return said


def percent(share: float | None) -> str:
    """A share in percent; ``-`` where there is none."""
    return known(share, lambda value: f"{number(100 * value)} %")


def _is_missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def known(value: Any, spell: Callable[[Any], str] | None = None) -> str:
    """A value as it is spelled, by default whole numbers with all digits and others with three; ``-`` for none."""
    spell = spell or ("{:,d}".format if isinstance(value, int) else number)
    return "-" if _is_missing(value) else spell(value)
