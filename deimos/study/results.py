"""The results of a study: a row per policy and evaluation, and one per training curve.

A cell leaves its own in ``result.json``. The tables ``results.csv`` and ``curves.csv`` are what is exported, merged and
kept; a folder's results are those of its cells, and the rows of its tables that no cell there has: those of other
cells, and of other attackers on these cells' policies.
"""

import csv
import io
import json
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import deimos
from deimos.checks import RunError, one_line
from deimos.files import file_name, first_line, read_bytes, write_bytes
from deimos.run.attack import attacker
from deimos.run.evaluation import worst
from deimos.run.folder import RunFolder
from deimos.study.plan import Cell
from deimos.study.source import hashes

SCHEMA = 1  # of result.json
SETTINGS = "settings"  # folder of what a merge keeps of cells, a file for each environment
Row = dict[str, Any]

_CELL: dict[str, type] = {
    "environment": str, "method": str, "seed": int, "hash": str, "setting": str, "selector": str, "num_envs": int,
    # The environment in the study's file, the levels of its factors there, and the code that made the row.
    "base_environment": str, "levels": dict, "code": str,
    "block": str,  # a hash of the files that differ from seed to seed; empty if all seeds have the same
}  # fmt: skip
RESULT_COLUMNS = _CELL | {
    # What was run.
    "env_steps": int, "trained_period": int,
    # How it was evaluated.
    "goals": str, "goal_period": int, "eval_seed": int, "worlds": int, "steps": int,
    # What came out.
    "reward": float, "score": float, "return_per_step": float, "crashes": int, "crashes_per_1000": float,
    "interactions": int, "interaction_crashes": int, "crash_rate": float, "tracking": tuple, "goal_groups": list,
    "errors": dict, "crashes_by_kind": dict,
    "first_goal_steps": int, "first_goal_crashes": int,
    "adversary_steps": int, "adversary_interactions": int, "adversary_crashes": int, "adversary_auroc": float,
    "weak_adversary": bool, "uninformed": bool, "even_interactions": int, "even_interaction_crashes": int,
    # Under the worst attacker that all policies of its environment and T met; see ``evaluation.worst``.
    "worst": float, "worst_attacker": str, "worst_interactions": int,
    # By what.
    "fps": float, "weights": str, "device": str, "versions": str,
}  # fmt: skip
MEANS = {
    "reward": "reward", "crashes_per_1000": "crashes_per_1000", "selected_fraction": "selected_fraction",
    "goal_percentile": "goal_percentile", "fear_chosen": "fear/chosen", "fear_auroc": "fear/auroc",
    "explained_variance": "explained_variance", "level": "level",
}  # fmt: skip
"""Columns of a training curve, and those of ``progress.csv`` that they are means of."""
AUDITS: dict[str, type] = {
    "exact_percentile": tuple, "exact_contexts": tuple, "auroc": tuple, "auroc_contexts": tuple, "risk": tuple,
    "goal_map": tuple, "speed": float,
}  # fmt: skip
"""What ``deimos.study.audits`` finds late in a training."""
CURVE_COLUMNS = _CELL | dict.fromkeys(("env_steps", *MEANS, "fear_fitted"), tuple) | AUDITS
TABLES = {"results.csv": RESULT_COLUMNS, "curves.csv": CURVE_COLUMNS}
FORMER_NAMES = {"selected_share": "selected_fraction"}
"""Columns of version 0.1.0 that have other names today."""
LATER_COLUMNS = {
    "goal_groups", "uninformed", "even_interactions", "even_interaction_crashes", "base_environment", "levels", "code",
    "block",
    "worst", "worst_attacker", "worst_interactions", "goal_percentile", "fear_chosen", "fear_auroc", "fear_fitted",
    "explained_variance", "level", "crashes_by_kind", *AUDITS,
}  # fmt: skip
"""Columns that its tables lack."""


@dataclass
class Results:
    """What a study has found."""

    rows: list[Row] = field(default_factory=list)
    """One per policy and evaluation, with ``RESULT_COLUMNS``."""
    curves: list[Row] = field(default_factory=list)
    """One per training, with ``CURVE_COLUMNS``."""

    @classmethod
    def read(cls, folder: Path, *, may_be_empty: bool = True) -> "Results":
        """The results of a study's folder, or of one that holds tables only.

        Raises ``RunError`` if a file is broken or of another schema, or if results are required and missing.
        """
        found = cls()
        for path in sorted(folder.glob("cells/*/result.json")):
            own = cls.of_cell(path.parent)
            found.rows += own.rows
            found.curves += own.curves
        # A merge puts what attackers did elsewhere to the policies of these cells into the tables alone.
        found.add(cls(*(read_table(folder / name, columns) for name, columns in TABLES.items())), attacks=True)
        found.find_worst()
        if not found.rows and not may_be_empty:
            raise RunError(f"{folder} holds no results; it is empty, or not a study's folder.")
        return found

    @classmethod
    def of_cell(cls, home: Path) -> "Results":
        """Those of one cell's folder; none if it has not finished. Raises ``RunError`` as ``read`` does."""
        path = home / "result.json"
        if not path.exists():
            return cls()
        data = RunFolder(home).read_json(path.name)
        try:
            if data["schema"] != SCHEMA:
                raise ValueError(f"its schema is {data['schema']}")
            return cls([_row(RESULT_COLUMNS, row) for row in data["rows"]], [_row(CURVE_COLUMNS, data["curve"])])
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise RunError(f"{path} is not the result of a cell of schema {SCHEMA} ({one_line(error)}).") from error

    def add(self, other: "Results", *, attacks: bool = False) -> int:
        """Take over the rows of cells that are not here yet; returns how many rows of evaluations were added.

        With ``attacks``, also the rows of other attackers on the very policies that are here.
        """
        known, drawn = ({row["hash"]: row["weights"] for row in self.rows}, {row["hash"] for row in self.curves})
        met = {_evaluation(row) for row in self.rows}
        fresh = [
            row for row in other.rows
            if row["hash"] not in known
            or (attacks and known[row["hash"]] == row["weights"] and _evaluation(row) not in met)
        ]  # fmt: skip
        self.rows += fresh
        self.curves += [line for line in other.curves if line["hash"] not in drawn]
        return len(fresh)

    def find_worst(self) -> None:
        """Fill in the columns of the worst attacker, which depend on what all policies of an environment met."""
        policies: dict[tuple, dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
        for row in self.rows:
            policies[row["environment"], row["goal_period"]][row["hash"]].append(row)
        for group in policies.values():
            found = worst([*group.values()])
            for rows, its in zip(group.values(), found or [{}] * len(group), strict=True):
                values = (its.get("crash_rate", math.nan), its.get("attacker"), its.get("interactions", math.nan))
                for row in rows:
                    row |= dict(zip(("worst", "worst_attacker", "worst_interactions"), values, strict=True))

    def check(self) -> None:
        """Raise ``RunError`` if what cannot be compared is mixed, or if a policy is there twice.

        One of the two would silently be ignored.
        """
        check_comparable([*self.rows, *self.curves])
        policy = ("environment", "method", "seed")
        for rows, names in ((self.rows, (*policy, "goals", "goal_period")), (self.curves, policy)):
            for key, count in Counter(tuple(row[name] for name in names) for row in rows).items():
                if count > 1:
                    what = ", ".join(f"{name} {value}" for name, value in zip(names, key, strict=True))
                    raise RunError(f"There are two rows of {what}; keep one of them in the folder.")

    def write(self, folder: Path) -> None:
        """Write the tables, each as ``write_table`` does; numbers of a curve have five digits."""
        for rows, (name, columns) in zip((self.rows, self.curves), TABLES.items(), strict=True):
            write_table(folder / name, columns, rows)


def result(cell: Cell, run: RunFolder, rows: Iterable[Row], audited: Row | None = None) -> Row:
    """What a finished cell writes to its ``result.json``, from its run, the rows of its evaluations and its audits."""
    curve = _curve(run.read_csv("progress.csv")) | (audited or {})
    rows = evaluated(cell, run, rows, cell.sources.get("code"))
    return {"schema": SCHEMA, "rows": rows, "curve": identity(cell) | curve}


def evaluated(cell: Cell, run: RunFolder, rows: Iterable[Row], code: str | None) -> list[Row]:
    """Rows of evaluations of a cell, as ``result.json`` has them; ``code`` evaluated it.

    An attacker that is not one of Deimos' own is part of the code of its rows, by the hash of its file.
    """
    stored = run.read_json("config.json")
    names = ("deimos", "commit", "python", "torch", "warp-lang", "numpy")
    shared = identity(cell) | {
        "env_steps": stored["config"]["env_steps"],
        "trained_period": cell.config.env.goal_period,
        "fps": median([float(row["fps"]) for row in run.read_csv("timing.csv")] or [math.nan]),
        "device": stored["config"]["device"],
        "versions": " ".join(f"{name}={stored['versions'][name]}" for name in names),
    }
    # Evaluations have their own seed, and a hash of their task, under names that here mean the cell's.
    own = {"seed": cell.config.seed, "environment": cell.environment}
    full = [
        shared | row | {
            "eval_seed": row["seed"], "code": _made_by(row["goals"], code), "crashes_by_kind": _by_kind(row),
        } | own for row in rows
    ]  # fmt: skip
    # Where a goal has one group of components, its tracking is the reward.
    return [row if len(row["tracking"]) > 1 else row | {"tracking": ()} for row in full]


def _by_kind(row: Row) -> dict[str, list[int]]:
    """Interactions that crashed, and all, in worlds of every kind, where there are kinds."""
    return {kind: [own["interaction_crashes"], own["interactions"]] for kind, own in row.get("strata", {}).items()}


def _made_by(goals: str, code: str | None) -> str | None:
    """What made the rows of an evaluation, of Deimos' own ``code`` and an attacker's."""
    module = type(attacker(goals)).__module__ if goals != "naive" else deimos.__name__
    if module.partition(".")[0] == deimos.__name__:
        return code
    return " ".join([*([code] if code else []), *(f"{name}={value}" for name, value in hashes([module], {}).items())])


def _curve(rows: list[dict[str, str]], points: int = 100) -> Row:
    """Means of the columns of ``progress.csv`` over as many stretches as ``points``, or fewer."""
    rows = [{FORMER_NAMES.get(name, name): value for name, value in row.items()} for row in rows]
    count = min(points, len(rows))
    stretches = [rows[len(rows) * i // count : len(rows) * (i + 1) // count] for i in range(count)]
    curves = {name: values for name, column in MEANS.items() if (values := _means(stretches, column))}
    losses = [[row.get("fear/loss") for row in part] for part in stretches]
    if rows and "fear/loss" in rows[0]:  # it is empty where a rollout taught fear nothing
        curves["fear_fitted"] = [sum(bool(loss) for loss in part) / len(part) for part in losses]
    return {"env_steps": [float(part[-1]["env_steps"]) for part in stretches]} | curves


def _means(stretches: Sequence[Sequence[dict[str, str]]], column: str) -> list[float]:
    """Means of a column, NaN where a stretch has no value of it; empty where the selector does not log it."""
    if not stretches or column not in stretches[0][0]:
        return []
    values = [[float(row[column]) for row in part if row[column]] for part in stretches]
    return [sum(part) / len(part) if part else math.nan for part in values]


def identity(cell: Cell) -> Row:
    """The columns that a cell's rows of both kinds begin with."""
    return {
        "environment": cell.environment, "method": cell.config.label, "seed": cell.config.seed,
        "hash": cell.digest, "setting": cell.setting, "selector": cell.selector, "num_envs": cell.config.num_envs,
        "base_environment": cell.base_environment or cell.environment, "levels": cell.levels,
        "code": cell.sources.get("code"), "block": cell.block,
    }  # fmt: skip


def merge(target: Path, sources: Sequence[Path]) -> tuple[int, int, int]:
    """Add the rows of other folders to the tables of one, and keep the settings of their environments.

    Args:
        target: The folder whose tables are written; made if it is not there.
        sources: Study folders; all are checked before anything is written.

    Returns:
        How many rows of evaluations were added, how many were not, since their cell is there already, and how many of
        those have different numbers in the source, or are of a policy with other weights.

    Raises:
        RunError: If a folder has no results or those of another schema, or they do not make one study.
    """
    merged = Results.read(target)
    added = present = differing = 0
    numbers = ("weights", "crashes", "reward")
    for source in sources:
        found = Results.read(source, may_be_empty=False)
        fresh = merged.add(found, attacks=True)
        ours, theirs = (
            [(_evaluation(row), [_text(row[name]) for name in numbers]) for row in rows]
            for rows in (merged.rows, found.rows)
        )
        kept = dict(ours)
        added, present = added + fresh, present + len(found.rows) - fresh
        differing += sum(kept.get(key) != values for key, values in theirs)  # a policy with other weights has no row
    merged.check()
    merged.find_worst()
    target.mkdir(parents=True, exist_ok=True)
    merged.write(target)
    for source in sources:
        if source.resolve() != target.resolve():
            for name, config in settings(source).items():
                (target / SETTINGS).mkdir(exist_ok=True)
                RunFolder(target / SETTINGS).write_json(
                    f"{file_name(name)}.json", {"environment": name, "config": config}
                )
    return added, present, differing


def settings(folder: Path) -> dict[str, dict]:
    """The configuration of a cell of every environment, as JSON types: of a folder's cells, or what a merge kept.

    Raises ``RunError`` if a file is broken.
    """
    found = {}
    for path in sorted(folder.glob(f"{SETTINGS}/*.json")) + sorted(folder.glob("cells/*/cell.json")):
        cell = RunFolder(path.parent).read_json(path.name)
        try:
            found[str(cell["environment"])] = dict(cell["config"])
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(f"{path} does not describe a cell ({one_line(error)}).") from error
    return found


def without_results(folder: Path, results: Results) -> list[str]:
    """Names of the cells of a study's folder without results: given up, or not finished yet."""
    there = {row["hash"][:8] for row in results.rows}  # as a cell's name ends
    names = [path.parent.name for path in sorted(folder.glob("cells/*/cell.json"))]
    return [name for name in names if name.rpartition("-")[2] not in there]


def _evaluation(row: Row) -> tuple:
    """The cell and the evaluation that a row is of."""
    return row["hash"], row["goals"], row["goal_period"]


def check_comparable(rows: Iterable[Row]) -> None:
    """Raise ``RunError`` unless an environment has one setting, a method in it one selector, and a seed one block.

    ``rows`` are of either kind, or the identities of cells.
    """
    settings, selectors, codes, blocks = defaultdict(set), defaultdict(set), defaultdict(set), defaultdict(set)
    for row in rows:
        blocks[row["environment"], row["seed"]].add(row.get("block") or "")
        codes[row["environment"], row.get("goals", "training")].add(row["code"])
        settings[row["environment"]].add(row["setting"])
        selectors[row["environment"], row["method"]].add(row["selector"])
    for (environment, what), found in codes.items():
        if len(found) > 1:
            raise RunError(
                f"The rows of environment '{environment}', {what}, were made by {len(found)} versions of the code "
                f"({', '.join(sorted(map(str, found)))}) and cannot be compared; keep those of one in a folder."
            )
    for environment, found in settings.items():
        if len(found) > 1:
            raise RunError(
                f"The cells of environment '{environment}' were run with {len(found)} different settings "
                f"({', '.join(sorted(found))}) and cannot be compared; keep one setting in a folder."
            )
    for (environment, method), found in selectors.items():
        if len(found) > 1:
            raise RunError(
                f"Method '{method}' stands for {len(found)} different selectors in environment '{environment}' "
                f"({', '.join(sorted(found))}), which are not one population; keep one of them in a folder."
            )
    for (environment, seed), found in blocks.items():
        if len(found) > 1:
            raise RunError(
                f"The cells of seed {seed} in environment '{environment}' began with {len(found)} different sets of "
                f"files ({', '.join(sorted(found))}) and are not pairs; keep those of one in a folder."
            )


def check_cells(rows: Iterable[Row]) -> None:
    """Raise ``RunError`` unless every policy is of one cell, and every cell in one environment.

    Of two cells of a policy, one would be trained in vain, since ``Results.check`` refuses their rows; two names of one
    cell would share its one result. ``rows`` as in ``check_comparable``.
    """
    policies, homes = defaultdict(set), defaultdict(set)
    for row in rows:
        policies[row["environment"], row["method"], row["seed"]].add(row["hash"])
        homes[row["hash"]].add(row["environment"])
    for (environment, method, seed), found in policies.items():
        if len(found) > 1:
            raise RunError(
                f"There are {len(found)} different cells of environment '{environment}', method '{method}', seed "
                f"{seed} ({', '.join(sorted(found))}): the plug-ins or audit_worlds have changed. Put them back, or "
                f"begin a new study."
            )
    for found in homes.values():
        if len(found) > 1:
            raise RunError(
                f"Environments {', '.join(sorted(found))} have the same settings, so their cells are the same; keep "
                f"one of them (of a design, take fewer points or more levels)."
            )


def read_table(path: Path, columns: dict[str, type]) -> list[Row]:
    """All whole rows of a table, in which empty cells are NaN in columns of numbers, else None; none if it is missing.

    Raises ``RunError`` if it has other columns, or a value that does not fit its column.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise RunError(f"{path} cannot be read ({first_line(error)}).") from error
    lines = csv.reader(text[: text.rfind("\n") + 1].splitlines())  # version 0.1.0 may have left half a line
    rows: list[Row] = []
    try:
        names = _names(path, next(lines, columns), columns)
        for values in lines:
            rows.append(_row(columns, dict(zip(names, values, strict=True))))
    except (csv.Error, RecursionError, ValueError) as error:  # the second where a cell is nested too deeply
        raise RunError(
            f"{path}, line {lines.line_num}, does not fit its columns ({ascii(one_line(error))[1:-1]})."
        ) from error
    return rows


def _names(path: Path, found: Iterable[str], columns: dict[str, type]) -> list[str]:
    """Today's names of a table's columns; ``RunError`` if they are not those that it must have."""
    names = [FORMER_NAMES.get(name, name) for name in found]
    missing, unknown = [n for n in columns if n not in {*names, *LATER_COLUMNS}], [n for n in names if n not in columns]
    if missing or unknown:
        lists = f"missing: {', '.join(missing) or 'none'}; unknown: {', '.join(unknown) or 'none'}"
        raise RunError(f"{path} is a table of another schema; {ascii(lists)[1:-1]}.")
    return names


def write_table(path: Path, columns: dict[str, type], rows: Iterable[Row]) -> None:
    """Write a table, whole or not at all; raises ``RunError`` if it cannot be written."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_text(row.get(name)) for name in columns] for row in rows)
    write_bytes(path, out.getvalue().encode())


def _row(columns: dict[str, type], given: Row) -> Row:
    """A row with the values of all columns; see ``_value``."""
    return {name: _value(kind, given.get(name)) for name, kind in columns.items()}


def _value(kind: type, given: Any) -> Any:
    """The value of a column, from the text in a table or from JSON; what is missing is NaN in columns of numbers."""
    if kind is tuple:
        parts = given.split() if isinstance(given, str) else given or ()
        return tuple(math.nan if part is None else float(part) for part in parts)
    if kind in (dict, list):
        found: Any = json.loads(given) if given and isinstance(given, str) else given or kind()
        if not issubclass(type(found), kind):
            raise ValueError(f"{str(given)!r:.80} is not a {'table' if kind is dict else 'list'}")
        return found if kind is list else {name: math.nan if value is None else value for name, value in found.items()}
    if given is None or given == "":
        return math.nan if kind in (int, float) else None
    if kind is bool and str(given) not in ("True", "False"):
        raise ValueError(f"'{given}' is neither True nor False")
    return str(given) == "True" if kind is bool else kind(given)


def _text(value: Any) -> str:
    """A cell of a table."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, tuple):
        return " ".join(f"{part:.5g}" for part in value)
    if isinstance(value, dict | list):
        return json.dumps(value) if value else ""
    return str(value)
