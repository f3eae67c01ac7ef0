"""Study files with a mistake: each is refused in one line that names the key, or is a different valid study."""

import copy
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults.options import STUDY
from benchmarks.faults.trial import Verdict, attempt, judged
from deimos.study import plan

COUNT = 300
SECONDS = 60.0
MOST_CELLS = 1000  # that such a small file may request
VALUES: list[Any] = [
    0, -1, 1, 10**6, 10**12, 2**31, 2**63 - 1, 0.5, -0.0, 1e308, float("nan"), float("inf"), True, False, "", "x",
    "0-9", "0-999999999", "../..", "/dev/zero", "\u202e", "[/red]", "<script>", "p75", "uniform", "particle", [], [[]],
    [1], [0.5, 1.5], ["x"], ["p25", "p25"], [{}], {}, {"x": 1}, {"kind": "particle"}, {"kind": ["x"]}, {"low": 1},
    {"low": 0.0, "high": 1.0, "log": True},
]  # fmt: skip
KEYS = ["seeds", "preset", "train", "base", "plugins", "goal_periods", "branch_from", "design", "attack", "x", ""]


def attack(number: int, rng: np.random.Generator, place: Path) -> Verdict:
    """Change, add, drop or double some keys of a study's file, or damage its text, and expand it to its cells."""
    if number % 3:
        text = dumps(changed(rng))
    else:
        text = damaged(rng)
    path = place / "study.toml"
    path.write_text(text, errors="surrogateescape")

    def read() -> None:
        cells = plan.expand(plan.read(path))
        assert len(cells) <= MOST_CELLS, f"{len(cells)} cells"

    ended = attempt(lambda: run(read), place, SECONDS)
    verdict = judged(text, ended)
    if ended.code == 2 and str(path) in text:
        return Verdict("fault", text, ended.said, "the file was not read")
    return verdict


def run(read: Any) -> int:
    """What the command line makes of an error."""
    from deimos.app import cli

    cli.COMMANDS["attack"] = (__name__, "")
    globals()["main"] = lambda arguments, program: read()
    return cli.main(["attack"])


def changed(rng: np.random.Generator) -> dict[str, Any]:
    """The study with one to three unusual keys."""
    study = copy.deepcopy(tomllib.loads(STUDY.read_text()))
    for _ in range(rng.integers(1, 4)):
        tables = [*_tables(study)]
        table = tables[rng.integers(len(tables))]
        key = str(rng.choice([*table, *KEYS])) if rng.random() < 0.8 or not table else str(rng.choice(list(table)))
        if rng.random() < 0.1:
            table.pop(key, None)
        else:
            table[key] = copy.deepcopy(VALUES[rng.integers(len(VALUES))])
    return study


def _tables(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, dict):
        yield value
    for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _tables(part)


def damaged(rng: np.random.Generator) -> str:
    """The study's text with something removed, inserted, doubled or nested deeply."""
    text, (a, b) = STUDY.read_text(), sorted(rng.integers(0, len(STUDY.read_text()), 2))
    depth = int(rng.choice([3, 100, 10_000]))
    ways = [
        text[:a], text[a:], text[:a] + text[b:], text + text[a:b],
        text[:a] + str(rng.choice(["\0", "\udcff", "\u2028", "]", "[", "{", "=", '"""', "\n[x]\n"])) + text[a:],
        text + "x = " + "[" * depth + "]" * depth, text + "x" + ".x" * depth + " = 1",
        text.replace("seeds = 2", "seeds = 1" + "0" * int(rng.choice([6, 12, 40, 5000]))), "\ufeff" + text,
    ]  # fmt: skip
    return ways[rng.integers(len(ways))]


def dumps(value: Any) -> str:
    """A table as TOML, its inner ones inline."""
    return "".join(f"{_text(key)} = {_inline(part)}\n" for key, part in value.items())


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_text(key)} = {_inline(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_inline, value)) + "]"
    return _text(value) if isinstance(value, str) else repr(value).lower()


def _text(value: str) -> str:
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
