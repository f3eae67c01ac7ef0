"""The tables of a study: CSV files that only grow, one line per policy and evaluation, or per training curve."""

import csv
import fcntl
import io
import json
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from deimos.run.folder import RunError

RESULT_COLUMNS: dict[str, type] = {
    # What was run.
    "environment": str, "method": str, "seed": int, "hash": str, "setting": str, "selector": str,
    "num_envs": int, "env_steps": int, "trained_period": int,
    # How it was judged.
    "goals": str, "goal_period": int, "eval_seed": int, "worlds": int, "steps": int,
    # What came out.
    "reward": float, "score": float, "return_per_step": float, "crashes": int, "crashes_per_1000": float,
    "interactions": int, "interaction_crashes": int, "crash_rate": float, "tracking": tuple, "errors": dict,
    "first_goal_steps": int, "first_goal_crashes": int,
    "adversary_steps": int, "adversary_interactions": int, "adversary_crashes": int, "adversary_auroc": float,
    "weak_adversary": bool,
    # By what.
    "fps": float, "weights": str, "device": str, "versions": str,
}  # fmt: skip
RESULT_KEY = ("hash", "goals", "goal_period")
TIMED = ("fps",)
"""Columns that two runs of the same cell may differ in."""

CURVE_COLUMNS: dict[str, type] = {
    "environment": str, "method": str, "seed": int, "hash": str, "setting": str, "selector": str, "num_envs": int,
    "env_steps": tuple, "reward": tuple, "crashes_per_1000": tuple, "selected_share": tuple,
}  # fmt: skip
CURVE_KEY = ("hash",)


class GrowingTable:
    """A CSV file with fixed columns to which several processes, on several machines, may append.

    Rows of a key that is there already are left out. All rows of one ``append`` are one write under a
    lock, and what a kill has left of half a line is cut off before the next.
    """

    def __init__(self, path: Path, columns: dict[str, type], key: tuple[str, ...]) -> None:
        self.path = path
        self.columns = columns
        self.key = key

    def read(self) -> list[dict[str, Any]]:
        """All whole rows; none if there is no file. Empty cells are NaN in columns of numbers, else None.

        Raises:
            RunError: If the file has other columns, or holds what is no value of its column.
        """
        try:
            text = self.path.read_text()
        except FileNotFoundError:
            return []
        except (OSError, ValueError) as error:
            raise RunError(f"{self.path} cannot be read ({error}).") from error
        return self._parse(text)

    def append(self, rows: Iterable[dict[str, Any]]) -> int:
        """Add the rows whose key is new; returns how many.

        Raises:
            RunError: If the file has other columns or cannot be written.
        """
        try:
            with self.path.open("a+b") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                file.seek(0)
                text = file.read().decode()
                whole = text[: text.rfind("\n") + 1]
                known = {self.key_of(row) for row in self._parse(whole)}
                fresh = {self.key_of(row): row for row in rows if self.key_of(row) not in known}
                if fresh:
                    file.truncate(len(whole.encode()))
                    file.write(self._format(fresh.values(), header=not whole).encode())
                    file.flush()
                    os.fsync(file.fileno())
                return len(fresh)
        except OSError as error:
            raise RunError(f"{self.path} could not be written ({error.strerror}).") from error

    def key_of(self, row: dict[str, Any]) -> tuple:
        """What tells a row from all others."""
        return tuple(row[name] for name in self.key)

    def _parse(self, text: str) -> list[dict[str, Any]]:
        lines = text[: text.rfind("\n") + 1].splitlines()
        if not lines:
            return []
        found = next(csv.reader(lines[:1]))
        if found != list(self.columns):
            missing = [name for name in self.columns if name not in found]
            unknown = [name for name in found if name not in self.columns]
            both = (("missing", missing), ("unknown", unknown))
            parts = [f"{what}: {', '.join(names)}" for what, names in both if names]
            reason = "; ".join(parts) or "its columns stand in another order"
            raise RunError(f"{self.path} is a table of another schema; {reason}.")
        rows = []
        for number, values in enumerate(csv.reader(lines[1:]), start=2):
            try:
                rows.append({
                    name: _value(kind, text) for (name, kind), text in zip(self.columns.items(), values, strict=True)
                })  # fmt: skip
            except ValueError as error:
                raise RunError(f"{self.path}, line {number}, does not fit its columns ({error}).") from error
        return rows

    def _format(self, rows: Iterable[dict[str, Any]], header: bool) -> str:
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        if header:
            writer.writerow(self.columns)
        for row in rows:
            writer.writerow([_text(row.get(name)) for name in self.columns])
        return out.getvalue()


def results(folder: Path) -> GrowingTable:
    """The table of evaluations of a study folder."""
    return GrowingTable(folder / "results.csv", RESULT_COLUMNS, RESULT_KEY)


def curves(folder: Path) -> GrowingTable:
    """The table of training curves of a study folder."""
    return GrowingTable(folder / "curves.csv", CURVE_COLUMNS, CURVE_KEY)


def merge(target: Path, sources: Iterable[Path]) -> tuple[int, int, int]:
    """Add the rows of other study folders to one.

    Args:
        target: The folder that grows; made if it is not there.
        sources: Study folders; checked before anything is written.

    Returns:
        How many rows of evaluations were added, how many were there already, and how many of those
        have other numbers in the source: of those the first stay.

    Raises:
        RunError: If a source has no results, a table has another schema, or the folders do not make one study.
    """
    tables = [(results(source).read(), curves(source).read()) for source in sources]
    for source, (rows, _) in zip(sources, tables, strict=True):
        if not rows:
            raise RunError(f"{source} holds no results; it is empty, or no study folder.")
    ours = results(target)
    known = {ours.key_of(row): row for row in ours.read()}
    drawn = {curves(target).key_of(line): line for line in curves(target).read()}
    present = differing = 0
    for rows, lines in tables:
        for row in rows:
            old = known.setdefault(ours.key_of(row), row)
            if old is not row:
                present += 1
                differing += any(_text(old[name]) != _text(row[name]) for name in ("weights", "crashes", "reward"))
        drawn = {curves(target).key_of(line): line for line in lines} | drawn
    check_one_population(list(known.values()), list(drawn.values()))
    target.mkdir(parents=True, exist_ok=True)
    added = 0
    for rows, lines in tables:
        added += ours.append(rows)
        curves(target).append(lines)
    return added, present, differing


def check_one_population(rows: list[dict[str, Any]], lines: list[dict[str, Any]]) -> None:
    """Refuse tables of evaluations and of training curves that do not make one study.

    Raises:
        RunError: If what cannot be compared is mixed, or a policy stands there twice.
    """
    check_comparable([*rows, *lines])
    _check_single(rows, ("environment", "method", "seed", "goals", "goal_period"))
    _check_single(lines, ("environment", "method", "seed"))


def check_comparable(rows: Iterable[dict[str, Any]]) -> None:
    """Refuse to mix what cannot be compared: an environment has one setting, and a method in it one selector.

    Args:
        rows: Rows of either table, or cells' identities.

    Raises:
        RunError: If there are more.
    """
    settings: dict[str, set[str]] = {}
    selectors: dict[tuple[str, str], set[str]] = {}
    for row in rows:
        settings.setdefault(row["environment"], set()).add(row["setting"])
        selectors.setdefault((row["environment"], row["method"]), set()).add(row["selector"])
    for environment, found in settings.items():
        if len(found) > 1:
            raise RunError(
                f"The cells of environment '{environment}' were run with {len(found)} different settings "
                f"({', '.join(sorted(found))}) and cannot be compared; keep one setting in a folder."
            )
    for (environment, name), found in selectors.items():
        if len(found) > 1:
            raise RunError(
                f"Method '{name}' stands for {len(found)} different selectors in environment '{environment}' "
                f"({', '.join(sorted(found))}), which are no one population; keep one of them in a folder."
            )


def _check_single(rows: Iterable[dict[str, Any]], names: tuple[str, ...]) -> None:
    """Refuse a policy that is there twice: one of the two would silently count for nothing."""
    known: set[tuple] = set()
    for row in rows:
        key = tuple(row[name] for name in names)
        if key in known:
            what = ", ".join(f"{name} {value}" for name, value in zip(names, key, strict=True))
            raise RunError(f"There are two rows of {what}; keep one of them in the table.")
        known.add(key)


def _value(kind: type, text: str) -> Any:
    if kind is tuple:
        return tuple(float(part) for part in text.split())
    if kind is dict and text:
        return json.loads(text)
    if text == "":
        return {int: math.nan, float: math.nan, dict: {}}.get(kind)
    if kind is bool:
        if text not in ("True", "False"):
            raise ValueError(f"'{text}' is neither True nor False")
        return text == "True"
    return kind(text)


def _text(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, tuple | list):
        return " ".join(f"{part:.5g}" for part in value)
    if isinstance(value, dict):
        return json.dumps(value) if value else ""
    return repr(value) if isinstance(value, float) else str(value)
