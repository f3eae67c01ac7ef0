"""The tables of a study: they only grow, survive kills, take several writers, and are merged."""

import math
import os
import subprocess
import sys

import pytest

from deimos.run.folder import RunError
from deimos.study.results import RESULT_COLUMNS, GrowingTable, curves, merge, results

COLUMNS = {"name": str, "count": int, "rate": float, "weak": bool, "points": tuple, "errors": dict}

WRITER = """
import sys
from pathlib import Path
from deimos.study.results import GrowingTable
table = GrowingTable(Path(sys.argv[1]), {"name": str, "count": int}, ("name",))
for i in range(20):
    table.append([{"name": f"both-{i}", "count": i}, {"name": f"{sys.argv[2]}-{i}", "count": i}])
"""


@pytest.fixture
def table(tmp_path):
    """A table with a column of every kind."""
    return GrowingTable(tmp_path / "table.csv", COLUMNS, ("name",))


def row(name, **more):
    """A row of that table."""
    return {"name": name, "count": 3, "rate": 0.1 + 0.2, "weak": False, "points": (1.0, 0.25),
            "errors": {"end effector [m]": 0.1 + 0.2, "a, b": math.inf}} | more  # fmt: skip


def result(hash, goals="naive", **more):
    """A row of the table of evaluations."""
    values = {str: "x", int: 1, float: 0.5, bool: False, tuple: (), dict: {}}
    own = {"hash": hash, "seed": int(hash), "goals": goals}
    return {name: values[kind] for name, kind in RESULT_COLUMNS.items()} | own | more


def test_rows_come_back_as_they_were(table):
    """Numbers are exact, and what is missing is NaN or None."""
    assert table.read() == []
    assert table.append([row("a, b"), row("c", rate=math.nan, weak=None, points=(), errors={})]) == 2
    first, second = table.read()
    assert first == row("a, b")
    assert math.isnan(second["rate"])
    assert (second["weak"], second["points"], second["errors"]) == (None, (), {})


def test_key_is_entered_once(table):
    """A row whose key is there already is left out, and the file keeps every byte that it had."""
    table.append([row("a")])
    before = table.path.read_bytes()
    assert table.append([row("a", count=9), row("b"), row("b")]) == 1
    assert table.path.read_bytes().startswith(before)
    assert [(each["name"], each["count"]) for each in table.read()] == [("a", 3), ("b", 3)]


@pytest.mark.parametrize("kept", [1, 10, 30])
def test_torn_line_is_cut_off(table, kept):
    """What a kill leaves of a line is not read, and does not harm the next row."""
    table.append([row("a"), row("b")])
    text = table.path.read_text()
    whole = text[: text.rstrip("\n").rfind("\n") + 1]
    table.path.write_text(text[: len(whole) + kept])
    assert [each["name"] for each in table.read()] == ["a"]
    assert table.append([row("b"), row("c")]) == 2
    assert [each["name"] for each in table.read()] == ["a", "b", "c"]


def test_two_processes_append_at_once(tmp_path):
    """Two writers lose no row and double none."""
    path = tmp_path / "table.csv"
    writers = [subprocess.Popen([sys.executable, "-c", WRITER, str(path), name]) for name in ("one", "two")]
    assert [writer.wait() for writer in writers] == [0, 0]
    names = [each["name"] for each in GrowingTable(path, {"name": str, "count": int}, ("name",)).read()]
    assert sorted(names) == sorted(f"{kind}-{i}" for kind in ("both", "one", "two") for i in range(20))


def test_other_schema_is_refused(table):
    """A file with other columns is refused with their names, and is not written to."""
    table.path.write_text("name,count,speed\n")
    message = r"table\.csv is a table of another schema; missing: rate, weak, points, errors; unknown: speed"
    for use in (table.read, lambda: table.append([row("a")])):
        with pytest.raises(RunError, match=message):
            use()
    table.path.write_text("count,name,rate,weak,points,errors\n")
    with pytest.raises(RunError, match="its columns stand in another order"):
        table.read()
    assert table.path.read_text() == "count,name,rate,weak,points,errors\n"


def test_broken_value_is_refused(table):
    """A value that does not fit its column is refused with its line."""
    table.append([row("a")])
    table.path.write_text(table.path.read_text().replace(",3,", ",three,"))
    with pytest.raises(RunError, match=r"table\.csv, line 2, does not fit its columns"):
        table.read()


def test_merge_adds_what_is_new(tmp_path):
    """Merging adds the rows of every source once, counts what was there, and says what differs."""
    results(tmp_path / "a").path.parent.mkdir()
    results(tmp_path / "b").path.parent.mkdir()
    results(tmp_path / "a").append([result("1"), result("2")])
    results(tmp_path / "b").append([result("2"), result("3"), result("1", crashes=7)])
    line = {"environment": "x", "method": "y", "seed": 0, "hash": "3", "setting": "x", "selector": "x", "num_envs": 1}
    numbers = dict.fromkeys(("env_steps", "reward", "crashes_per_1000", "selected_share"), (1.0,))
    curves(tmp_path / "b").append([line | numbers])
    assert merge(tmp_path / "c", [tmp_path / "a", tmp_path / "b"]) == (3, 2, 1)
    assert [each["hash"] for each in results(tmp_path / "c").read()] == ["1", "2", "3"]
    assert results(tmp_path / "c").read()[0]["crashes"] == 1
    assert [each["hash"] for each in curves(tmp_path / "c").read()] == ["3"]
    assert merge(tmp_path / "c", [tmp_path / "a"]) == (0, 2, 0)


OTHERS = {
    "setting": ({"setting": "y"}, "environment 'x' were run with 2 different settings"),
    "selector": ({"selector": "y"}, "'x' stands for 2 different selectors in environment 'x'"),
    "doubled policy": ({"seed": 1}, "two rows of environment x, method x, seed 1"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_merge_refuses_what_is_no_one_study(tmp_path, name):
    """Folders of another setting, another selector or the same policy from another cell are not merged."""
    change, message = OTHERS[name]
    for folder, row in (("a", result("1")), ("b", result("2", **change))):
        (tmp_path / folder).mkdir()
        results(tmp_path / folder).append([row])
    with pytest.raises(RunError, match=message):
        merge(tmp_path / "c", [tmp_path / "a", tmp_path / "b"])
    assert not os.path.exists(tmp_path / "c")
    with pytest.raises(RunError, match=message):
        merge(tmp_path / "a", [tmp_path / "b"])
    assert len(results(tmp_path / "a").read()) == 1


def test_merge_checks_before_it_writes(tmp_path):
    """An empty source, or one of another schema, is refused and the target is not made."""
    results(tmp_path / "a").path.parent.mkdir()
    results(tmp_path / "a").append([result("1")])
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunError, match="empty holds no results; it is empty, or no study folder"):
        merge(tmp_path / "c", [tmp_path / "a", tmp_path / "empty"])
    (tmp_path / "empty" / "results.csv").write_text("reward\n")
    with pytest.raises(RunError, match="another schema; missing: environment"):
        merge(tmp_path / "c", [tmp_path / "a", tmp_path / "empty"])
    assert not os.path.exists(tmp_path / "c")
