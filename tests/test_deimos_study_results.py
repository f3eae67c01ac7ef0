"""The results of a study: read from cells and from tables, exported whole, and merged."""

import csv
import math
import os
from pathlib import Path

import pytest

from deimos.checks import RunError
from deimos.run.folder import RunFolder
from deimos.study import results
from deimos.study.data import Data, Where
from deimos.study.results import CURVE_COLUMNS, RESULT_COLUMNS, Results, merge, read_table, settings, write_table

COLUMNS = {"name": str, "count": int, "rate": float, "weak": bool, "points": tuple, "errors": dict}


@pytest.fixture
def path(tmp_path):
    """Where a table is."""
    return tmp_path / "table.csv"


def row(name, **more):
    """A row of a table with a column of every kind."""
    return {"name": name, "count": 3, "rate": 0.1 + 0.2, "weak": False, "points": (1.0, 0.25),
            "errors": {"end effector [m]": 0.1 + 0.2, "a, b": math.inf}} | more  # fmt: skip


def result(hash, goals="naive", **more):
    """A row of an evaluation."""
    values = {str: "x", int: 1, float: 0.5, bool: False, tuple: (), dict: {}, list: []}
    own = {"hash": hash, "seed": int(hash), "goals": goals}
    own |= {"worst": math.nan, "worst_attacker": None, "worst_interactions": math.nan}  # nobody attacked it
    return {name: values[kind] for name, kind in RESULT_COLUMNS.items()} | own | more


def curve(hash):
    """The training curve of a cell."""
    values = {str: "x", int: 1, float: 0.5, tuple: (), dict: {}}
    line = {name: values[kind] for name, kind in CURVE_COLUMNS.items()} | {"method": "y", "seed": 0, "hash": hash}
    return line | dict.fromkeys(("env_steps", "reward", "crashes_per_1000", "selected_fraction"), (1.0,))


def fill(folder, rows, curves=()):
    """A folder of tables."""
    folder.mkdir()
    Results(list(rows), list(curves)).write(folder)


def fill_cell(folder, rows, line):
    """A folder with the result of one cell."""
    path = folder / "cells" / "one"
    path.mkdir(parents=True)
    RunFolder(path).write_json("result.json", {"schema": results.SCHEMA, "rows": rows, "curve": line})


def test_rows_come_back_as_they_were(path):
    """Numbers are exact, and what is missing is NaN or None."""
    assert read_table(path, COLUMNS) == []
    write_table(path, COLUMNS, [row("a, b"), row("c", rate=math.nan, weak=None, points=(), errors={})])
    first, second = read_table(path, COLUMNS)
    assert first == row("a, b")
    assert math.isnan(second["rate"])
    assert (second["weak"], second["points"], second["errors"]) == (None, (), {})


@pytest.mark.parametrize("kept", [1, 10, 30])
def test_torn_line_is_not_read(path, kept):
    """What a kill of version 0.1.0 left of a line is not read."""
    write_table(path, COLUMNS, [row("a"), row("b")])
    text = path.read_text()
    whole = text[: text.rstrip("\n").rfind("\n") + 1]
    path.write_text(text[: len(whole) + kept])
    assert [each["name"] for each in read_table(path, COLUMNS)] == ["a"]


def test_other_schema_is_refused(path):
    """A file with other columns is refused with their names; their order does not matter."""
    path.write_text("name,count,speed\n")
    message = r"table\.csv is a table of another schema; missing: rate, weak, points, errors; unknown: speed"
    with pytest.raises(RunError, match=message):
        read_table(path, COLUMNS)
    path.write_text("count,name\n3,a\n")
    assert read_table(path, {"name": str, "count": int}) == [{"name": "a", "count": 3}]
    path.write_text("\ufeffcount,name\n3,a\n", encoding="utf-8")  # as spreadsheets mark it
    assert read_table(path, {"name": str, "count": int}) == [{"name": "a", "count": 3}]


def test_broken_value_is_refused(path):
    """A value that does not fit its column is refused with its line, and so is a line with too few."""
    write_table(path, COLUMNS, [row("a")])
    text = path.read_text()
    whole = text[: text.rindex('"{')]  # but for the last column, a table of errors
    for broken in (text.replace(",3,", ",three,"), text.replace("False", "no"), text + "b,1\n", whole + "[1]\n"):
        path.write_text(broken)
        with pytest.raises(RunError, match=r"table\.csv, line [23], does not fit its columns"):
            read_table(path, COLUMNS)


def test_table_that_cannot_be_written_leaves_the_old_one(path, monkeypatch):
    """A table is whole at every moment: an error while it is written leaves the one of before."""
    write_table(path, COLUMNS, [row("a")])
    before = path.read_bytes()

    def refuse(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(RunError, match=r"table\.csv could not be written \(.*No space left on device\)"):
        write_table(path, COLUMNS, [row("b")])
    assert path.read_bytes() == before


def test_cells_come_before_tables(tmp_path):
    """A folder's results are those of its cells, and of its tables what no cell has; null in a cell's is NaN."""
    fill(tmp_path / "a", [result("1", crashes=9), result("2")], [curve("1"), curve("2")])
    rows = [result("1", errors={"reach": None}, score=None), result("1", goals="adversary", tracking=[0.5, 1])]
    fill_cell(tmp_path / "a", rows, curve("1") | {"reward": [2.0]})
    found = Results.read(tmp_path / "a")
    assert [(each["hash"], each["goals"], each["crashes"]) for each in found.rows] == [
        ("1", "naive", 1), ("1", "adversary", 1), ("2", "naive", 1),
    ]  # fmt: skip
    assert math.isnan(found.rows[0]["score"])
    assert math.isnan(found.rows[0]["errors"]["reach"])
    assert found.rows[1]["tracking"] == (0.5, 1.0)
    assert [(line["hash"], line["reward"]) for line in found.curves] == [("1", (2.0,)), ("2", (1.0,))]


@pytest.mark.parametrize("text", ['{"schema": 99}', "[]", "{"])
def test_result_of_another_schema_is_refused(tmp_path, text):
    """A cell's result that is broken or of another version is refused in one line that names it."""
    path = tmp_path / "cells" / "one" / "result.json"
    path.parent.mkdir(parents=True)
    path.write_text(text)
    with pytest.raises(RunError, match=r"one/result\.json (is not the result of a cell of schema 1|cannot be read)"):
        Results.read(tmp_path)


def test_tables_of_version_0_1_0_are_read(tmp_path):
    """A column that had another name in version 0.1.0 is read under its name of today."""
    fill(tmp_path / "a", [result("1")], [curve("1")])
    path = tmp_path / "a" / "curves.csv"
    path.write_text(path.read_text().replace("selected_fraction", "selected_share"))
    assert Results.read(tmp_path / "a").curves == [curve("1")]


def test_tables_without_later_columns_are_read(tmp_path):
    """A table that was written before a column existed has nothing in it; what goal groups are called is kept since."""
    named = result("1", tracking=(0.5, 1.0), goal_groups=["velocity", "end effector"])
    fill(tmp_path / "a", [named])
    assert Results.read(tmp_path / "a").rows == [named]
    path = tmp_path / "a" / "results.csv"
    with path.open(newline="") as file:
        (old,) = csv.DictReader(file)
    del old["goal_groups"]
    path.write_text(",".join(old) + "\n" + ",".join(old.values()) + "\n")
    (found,) = Results.read(tmp_path / "a").rows
    assert found == named | {"goal_groups": []}
    named_parts = Data(Results([named])).parts(Where("x", "naive", 1))
    assert list(named_parts.values()) == ["tracking of velocity", "tracking of end effector"]
    assert "tracking of goal group 0" in Data(Results([found])).parts(Where("x", "naive", 1)).values()


def test_training_curve_is_cut_into_stretches():
    """A curve has the means over stretches of the training and the steps at their ends, whatever the column's name."""
    rows = [
        {"env_steps": str(24 * i), "reward": str(i), "crashes_per_1000": "0.5", "selected_share": "1"}
        for i in range(1, 6)
    ]
    found = results._curve(rows, 2)
    assert found == {
        "env_steps": [48.0, 120.0], "reward": [1.5, 4.0], "crashes_per_1000": [0.5, 0.5],
        "selected_fraction": [1.0, 1.0],
    }  # fmt: skip


def test_curve_of_fear_knows_where_it_stood_still():
    """A stretch says in which share of its rollouts fear was fitted, and is NaN where a column has no value."""
    rows = [
        {"env_steps": "24", "reward": "1", "crashes_per_1000": "0", "selected_fraction": "1", "fear/auroc": auroc,
         "fear/loss": loss, "fear/chosen": "0.5"}
        for auroc, loss in (("", ""), ("", ""), ("0.5", ""), ("0.7", "0.3"))
    ]  # fmt: skip
    found = results._curve(rows, 2)
    assert found["fear_fitted"] == [0.0, 0.5]
    assert math.isnan(found["fear_auroc"][0])
    assert found["fear_auroc"][1] == pytest.approx(0.6)
    assert found["fear_chosen"] == [0.5, 0.5]
    assert "goal_percentile" not in found


def test_rows_have_the_crashes_on_every_kind_of_ground():
    """They can be pooled over kinds, and one on which no goal has ended does not spoil a row."""
    strata = {
        kind: {"worlds": 2, "interaction_crashes": crashed, "interactions": goals}
        for kind, crashed, goals in (("stairs-up 3", 5, 20), ("slope 0", 0, 18), ("waves 1", 0, 0))
    }
    assert results._by_kind({"strata": strata}) == {"stairs-up 3": [5, 20], "slope 0": [0, 18], "waves 1": [0, 0]}
    assert results._by_kind({}) == {}


def attacked(hash, goals, even, odd):
    """A row of 20 interactions, half of them in even worlds, with as many crashes in either."""
    return result(
        hash,
        goals,
        interactions=20,
        interaction_crashes=even + odd,
        even_interactions=10,
        even_interaction_crashes=even,
    )


def test_worst_is_of_attackers_that_all_have_met(tmp_path):
    """Even worlds choose the worst attacker and odd ones report it; one that not every policy met does not count."""
    rows = [
        result("1"), attacked("1", "argmax", 3, 1), attacked("1", "scripted", 2, 9), attacked("1", "search", 9, 9),
        result("2"), attacked("2", "argmax", 0, 5), attacked("2", "scripted", 4, 2),
    ]  # fmt: skip
    fill(tmp_path / "a", rows)
    found = {row["hash"]: (row["worst_attacker"], row["worst"], row["worst_interactions"])
             for row in Results.read(tmp_path / "a").rows}  # fmt: skip
    assert found == {"1": ("argmax", 0.1, 10), "2": ("scripted", 0.2, 10)}
    fill(tmp_path / "b", [attacked("2", "search", 6, 3)])
    rows[:] = [row for row in rows if row["hash"] == "1"]
    fill(tmp_path / "c", rows)
    assert {row["worst_attacker"] for row in Results.read(tmp_path / "c").rows} == {"search"}


def test_merge_adds_what_is_new(tmp_path):
    """Merging adds the rows of every source once, counts what was there, and says what differs."""
    fill(tmp_path / "a", [result("1"), result("2")])
    fill(tmp_path / "b", [result("2"), result("3"), result("1", crashes=7)], [curve("3")])
    assert merge(tmp_path / "c", [tmp_path / "a", tmp_path / "b"]) == (3, 2, 1)
    found = Results.read(tmp_path / "c")
    assert [each["hash"] for each in found.rows] == ["1", "2", "3"]
    assert found.rows[0]["crashes"] == 1
    assert [each["hash"] for each in found.curves] == ["3"]
    assert merge(tmp_path / "c", [tmp_path / "a"]) == (0, 2, 0)


def test_merge_keeps_the_settings(tmp_path):
    """Of every environment the configuration of a cell stays with the tables, also through a second merge."""
    for seed, (name, worlds) in enumerate((("a", 16), ("b", 32))):
        fill(tmp_path / name, [result(str(seed))])
        home = RunFolder.create(tmp_path / name / "cells" / name)
        home.write_json("cell.json", {"environment": f"on_{name}", "config": {"num_envs": worlds}})
    merge(tmp_path / "c", [tmp_path / "a", tmp_path / "b"])
    merge(tmp_path / "d", [tmp_path / "c"])
    assert settings(tmp_path / "d") == {"on_a": {"num_envs": 16}, "on_b": {"num_envs": 32}}
    merge(tmp_path / "a", [tmp_path / "a"])
    assert not (tmp_path / "a" / "settings").exists()  # it has the cells themselves
    (tmp_path / "c" / "settings" / "on_a.json").write_text('{"environment": "on_a"}')
    with pytest.raises(RunError, match="does not describe a cell"):
        settings(tmp_path / "c")


def test_merge_adds_what_other_attackers_did_to_the_same_policies(tmp_path):
    """Two folders whose policies met different attackers make one with the rows of all, but for other weights.

    Those left out are counted among what differs.
    """
    fill(tmp_path / "a", [result("1"), result("1", goals="mine", code="y mine=0")])
    fill(tmp_path / "b", [result("1"), result("1", goals="yours", code="z yours=0")])
    fill(tmp_path / "c", [result("1", goals="theirs", weights="y")])
    assert merge(tmp_path / "all", [tmp_path / "a", tmp_path / "b", tmp_path / "c"]) == (3, 2, 1)
    assert [row["goals"] for row in Results.read(tmp_path / "all").rows] == ["naive", "mine", "yours"]
    fill(tmp_path / "d", [result("2", goals="mine", code="y mine=1")])
    with pytest.raises(RunError, match=r"'x', mine, were made by 2 versions of the code \(y mine=0, y mine=1\)"):
        merge(tmp_path / "all", [tmp_path / "d"])


def test_attacks_of_elsewhere_stay_beside_the_cells(tmp_path):
    """What was merged into a folder that has the cells counts there, and an export keeps it; other weights do not."""
    fill_cell(tmp_path / "a", [result("1")], curve("1"))
    fill(tmp_path / "b", [result("1"), result("1", goals="mine"), result("1", goals="theirs", weights="y")])
    assert merge(tmp_path / "a", [tmp_path / "b"]) == (1, 2, 1)
    for _ in range(2):
        assert [row["goals"] for row in Results.read(tmp_path / "a").rows] == ["naive", "mine"]
        assert merge(tmp_path / "a", [tmp_path / "a"]) == (0, 2, 0)


def test_export_writes_the_tables_of_cells(tmp_path):
    """A folder that is merged with itself has tables that give the results of its cells again."""
    fill_cell(tmp_path / "a", [result("1")], curve("1"))
    assert merge(tmp_path / "a", [tmp_path / "a"]) == (0, 1, 0)
    assert read_table(tmp_path / "a" / "results.csv", RESULT_COLUMNS) == [result("1")]
    assert read_table(tmp_path / "a" / "curves.csv", CURVE_COLUMNS) == [curve("1")]


OTHERS = {
    "setting": ({"setting": "y"}, "environment 'x' were run with 2 different settings"),
    "code": ({"code": "y"}, "environment 'x', naive, were made by 2 versions of the code"),
    "selector": ({"selector": "y"}, "'x' stands for 2 different selectors in environment 'x'"),
    "doubled policy": ({"seed": 1}, "two rows of environment x, method x, seed 1"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_merge_refuses_what_is_no_one_study(tmp_path, name):
    """Folders of another setting, another selector or the same policy from another cell are not merged."""
    change, message = OTHERS[name]
    fill(tmp_path / "a", [result("1")])
    fill(tmp_path / "b", [result("2", **change)])
    with pytest.raises(RunError, match=message):
        merge(tmp_path / "c", [tmp_path / "a", tmp_path / "b"])
    assert not os.path.exists(tmp_path / "c")
    with pytest.raises(RunError, match=message):
        merge(tmp_path / "a", [tmp_path / "b"])
    assert len(Results.read(tmp_path / "a").rows) == 1


def test_merge_checks_before_it_writes(tmp_path):
    """An empty source, or one of another schema, is refused and the target is not made."""
    fill(tmp_path / "a", [result("1")])
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunError, match="empty holds no results; it is empty, or not a study's folder"):
        merge(tmp_path / "c", [tmp_path / "a", tmp_path / "empty"])
    (tmp_path / "empty" / "results.csv").write_text("reward\n")
    with pytest.raises(RunError, match="another schema; missing: environment"):
        merge(tmp_path / "c", [tmp_path / "a", tmp_path / "empty"])
    assert not os.path.exists(tmp_path / "c")
