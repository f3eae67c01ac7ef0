"""What an evaluation has found: a table in full words and units, and a sentence that says what it means."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from deimos.app.console import number, table
from deimos.goals.fear_selector import FearSelector
from deimos.run.evaluation import worst

_LINES = (
    ("reward per step", "reward"),
    ("crashes per 1000 steps", "crashes_per_1000"),
    ("crashes per robot-minute", "crashes_per_minute"),
    ("goals", "interactions"),
    ("all crashes", "crashes"),
    ("of these, under first goals", "first_goal_crashes"),
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
    ends = "standing still, 1: perfect tracking" if "matching" in rows[0] else "no action, 1: reference controller"
    named = ((f"score (0: {ends})", "score"), *_LINES)
    lines += [(label, [_cell(row, key) for row in columns]) for label, key in named]
    lines += _per_part(columns)
    header, names = zip(("", ""), *[heading(row["goals"]) for row in columns], strict=True)
    shown = [[label, *values] for label, values in lines if any(value != "-" for value in values)]
    return f"Evaluation: {conditions(rows[0])}\n\n{table(header, [names, *shown])}\n\n{conclude(rows)}"


def _cell(row: dict, key: str) -> str:
    """A value of a row; an attacker that has learnt, but from too few crashes to be tested, has an unknown AUROC."""
    is_unknown = key == "adversary_auroc" and _is_missing(row.get(key, 0.0))
    return "unknown" if is_unknown else known(row.get(key))


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
    if any(_is_missing(row["crash_rate"]) for row in rows):
        return "No goal was pursued to its end, so nothing can be said about crashes."
    (naive,), attacked = ([row for row in rows if (row["goals"] == "naive") == own] for own in (True, False))
    low = naive["crash_rate"]
    said = f"Under uniform goals {percent(low) if low else 'none'} of the goals end in a crash"
    for row in attacked:
        share = percent(row["crash_rate"])
        if row["crash_rate"] <= low:
            said += f"; {row['goals']} gets no more than {share}"
        else:
            said += f"; {row['goals']} " + (
                f"raises that to {share}" if _is_raised(row, naive) else f"gets {share}, which may be chance"
            )
    said += "."
    for row in attacked:
        if _is_untested(row) and not _is_raised(row, naive):
            said += (
                f" {row['goals']} learnt from {row['adversary_crashes']:,} crashes, too few to tell whether it learnt"
            )
            said += " anything: its column proves nothing."
    if without := [row["goals"] for row in rows if row.get("uninformed")]:
        said += (
            f" Goals of {' and '.join(without)} are uniform: there was nothing to learn from, so they prove nothing."
        )
    for most in worst([rows]) if len(attacked) > 1 and any(row["crash_rate"] for row in attacked) else []:
        said += f" The worst attacker is {most['attacker']}: {percent(most['crash_rate'])} in the worlds that were not"
        said += " used to choose it."
    return said


def _is_raised(row: dict, naive: dict) -> bool:
    """Whether more goals ended in a crash than under uniform goals, beyond chance: their intervals do not overlap."""
    (_, highest), (lowest, _) = (wilson(each["crash_rate"], each["interactions"]) for each in (naive, row))
    return bool(lowest > highest)


def _is_untested(row: dict) -> bool:
    """Whether an attacker has learnt from crashes, but too few for one in the worlds that it is tested on."""
    return "adversary_auroc" in row and _is_missing(row["adversary_auroc"]) and not row.get("uninformed")


def wilson(share: Any, count: Any) -> tuple[Any, Any]:
    """Bounds of the 95 % intervals of proportions, by Wilson's score (1927), each of the arguments' shape."""
    z = 1.959964  # of the normal distribution, two-sided
    middle, spread = share + z * z / (2 * count), z * np.sqrt(share * (1 - share) / count + (z / (2 * count)) ** 2)
    return (middle - spread) / (1 + z * z / count), (middle + spread) / (1 + z * z / count)


def risk_name(afraid: FearSelector) -> str:
    """Name of the numbers in (0, 1) that a fear network's calibration makes of its scores."""
    return "predicted crash probability" if afraid.is_calibrated else "fear (no probability)"


def percent(share: float | None) -> str:
    """A share in percent; ``-`` where there is none."""
    return known(share, lambda value: f"{number(100 * value)} %")


def _is_missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def known(value: Any, spell: Callable[[Any], str] | None = None) -> str:
    """A value as ``spell`` writes it, by default whole numbers with all digits, others with three; ``-`` for none."""
    spell = spell or ("{:,d}".format if isinstance(value, int) else number)
    return "-" if _is_missing(value) else spell(value)
