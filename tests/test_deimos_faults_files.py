"""Damaged files and files that are none, names that are markup: one line, and nothing is lost."""

import json
import os
import resource
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deimos.checks import RunError
from deimos.files import file_name, load_arrays, load_tensors, save_tensors, write_whole
from deimos.run.config import from_dict
from deimos.run.evaluation import EvalConfig, read_evaluation
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.study import archive, plan
from deimos.study.document import to_html, to_markdown
from deimos.study.folder import StudyFolder
from deimos.study.results import TABLES
from terrain.grid import Terrain, flat

# Anything that a person, an editor or a disk may leave: the property holds for each, so few examples do.
FEW = settings(max_examples=40, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
ROWS = b"iteration,reward\r\n1,0.5\r\n2,\r\n3,-1e-05\r\n"


def iterations(folder):
    """Iterations of a run's ``progress.csv``."""
    return [row["iteration"] for row in folder.read_csv("progress.csv")]


def attempt(do, error):
    """What a call gives, and what it says where it raises an error of a class, in a line that can be printed."""
    try:
        return do(), ""
    except error as raised:
        assert str(raised).isprintable()  # noqa: PT017 (of a property: it may raise or not)
        return None, str(raised)


@FEW
@given(place=st.integers(0, len(ROWS) - 1), byte=st.integers(0, 255), insert=st.booleans())
def test_a_damaged_table_is_one_line_or_whole(tmp_path_factory, place, byte, insert):
    """With any byte flipped or put in, the rows are numbers in order, or one line names file and line."""
    folder = RunFolder(tmp_path_factory.mktemp("csv"))
    data = ROWS[:place] + bytes([byte]) + ROWS[place + (not insert) :]
    (folder.path / "progress.csv").write_bytes(data)
    rows, said = attempt(lambda: folder.read_csv("progress.csv"), RunError)
    if rows is None:
        assert f"{folder.path / 'progress.csv'}, line " in said
    else:
        found = [int(row["iteration"]) for row in rows]
        assert found == sorted(set(found))
        assert {*map(len, rows)} <= {len(rows[0]) if rows else 0}
    assert (folder.path / "progress.csv").read_bytes() == data


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (ROWS.partition(b"\n")[2], "line 1: the names of the columns"),
        (ROWS + ROWS, "line 5: could not convert string to float"),
        (ROWS + ROWS.partition(b"\n")[2], "line 5: its iteration must be above 3, got 1"),
        (ROWS + b"4,\x00\r\n", "line 5: "),
        (ROWS + b"4," + b"1" * 200_000 + b"\r\n", "line 5: field larger"),
        (ROWS + b"4,\xff\r\n", "line 5: could not convert"),
        (ROWS + b"4,1,2\r\n", "line 5: it must have 2 cells, got 3"),
    ],
)
def test_what_is_wrong_with_a_table_is_said(tmp_path, data, message):
    """Without its header, doubled, with a NUL, a long field or foreign bytes, a table is refused by its line."""
    (tmp_path / "timing.csv").write_bytes(data)
    with pytest.raises(RunError, match=f"timing.csv, {message}"):
        RunFolder(tmp_path).cut_csv("timing.csv", 2)
    assert (tmp_path / "timing.csv").read_bytes() == data


def test_an_editors_mark_is_no_damage(tmp_path):
    """A byte-order mark, and lines without a carriage return, are read as if they were not there."""
    (tmp_path / "progress.csv").write_bytes(b"\xef\xbb\xbf" + ROWS.replace(b"\r", b""))
    assert iterations(RunFolder(tmp_path)) == ["1", "2", "3"]


def test_half_a_number_is_half_a_row(tmp_path):
    """A line without its end is left out although it has all cells: its last number may be half."""
    (tmp_path / "progress.csv").write_bytes(ROWS + b"4,0.2")
    folder = RunFolder(tmp_path)
    assert iterations(folder) == ["1", "2", "3"]
    folder.cut_csv("progress.csv", 4)
    assert (tmp_path / "progress.csv").read_bytes() == ROWS


def test_rows_may_say_more_than_before(tmp_path):
    """A resumed run of a later version has more columns: no number ends up below another name."""
    folder = RunFolder(tmp_path)
    folder.append_csv("progress.csv", {"iteration": 1, "reward": 0.5})
    RunFolder(tmp_path).append_csv("progress.csv", {"iteration": 2, "crashes": np.int64(7), "reward": np.float32(0.25)})
    RunFolder(tmp_path).append_csv("progress.csv", {"iteration": 3, "reward": float("nan")})
    assert folder.read_csv("progress.csv") == [
        {"iteration": "1", "reward": "0.5", "crashes": ""},
        {"iteration": "2", "reward": "0.25", "crashes": "7"},
        {"iteration": "3", "reward": "", "crashes": ""},
    ]


def test_a_table_that_begins_anew_has_its_names(tmp_path):
    """Where a run goes on from before its first row, the rows that follow stand below the names of their columns."""
    folder = RunFolder(tmp_path)
    folder.append_csv("progress.csv", {"iteration": 1, "reward": 0.5})
    folder.cut_csv("progress.csv", 0)
    folder.append_csv("progress.csv", {"iteration": 1, "reward": 0.25})
    assert folder.read_csv("progress.csv") == [{"iteration": "1", "reward": "0.25"}]


def test_what_is_no_number_is_named(tmp_path):
    """A plug-in that says a text in its row is told which, before anything is written."""
    with pytest.raises(TypeError, match=r"mine must be a number, got 'high'"):
        RunFolder(tmp_path).append_csv("progress.csv", {"iteration": 1, "mine": "high"})
    assert not (tmp_path / "progress.csv").exists()


NESTED = "[" * 100_000 + "]" * 100_000
ROW = {"goals": "naive", "weights": "0", "worlds": 4, "steps": 16, "goal_period": 8, "crash_rate": None, "score": 0.5}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (NESTED, "cannot be read"),
        ("\xff", "cannot be read"),
        ('[{"goals": "naive"},', "cannot be read .*line 1"),
        ("{}", "must hold a list of rows, got dict"),
        ("[7]", "row 1: it must be a table, got int"),
        (json.dumps([ROW, ROW | {"worlds": "4"}]), "row 2: worlds must be a number, got '4'"),
        (json.dumps([ROW | {"goals": ["naive"]}]), "row 1: goals must be a text"),
        (json.dumps([ROW | {"score": True}]), "row 1: score must be a number, got True"),
    ],
)
def test_damaged_evaluations_are_one_line(tmp_path, text, message):
    """An evaluation.json that is none, or whose rows have wrong types, is named and stays as it is."""
    path = tmp_path / "evaluation.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(RunError, match=f"evaluation.json.*{message}"):
        read_evaluation(RunFolder(tmp_path))
    assert path.read_bytes() == text.encode("latin-1")


def test_what_is_no_file_is_not_replaced(tmp_path):
    """A pipe or a device keeps its place when a file of its name is to be written."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RunError, match="not a regular file"):
        write_whole(tmp_path / "pipe", lambda file: file.write(b"new"))
    assert (tmp_path / "pipe").is_fifo()
    assert os.listdir(tmp_path) == ["pipe"]


def test_a_disk_that_fills_up_keeps_the_last_good_file(tmp_path):
    """Where a file may not grow any more in the middle of a save, the old one stays whole and no part of the new."""
    path, limits = tmp_path / "checkpoint.pt", resource.getrlimit(resource.RLIMIT_FSIZE)
    save_tensors(path, {"schema": 1, "x": torch.zeros(10)})
    before = path.read_bytes()
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(RunError, match=r"could not be written .*what was there is untouched"):
            save_tensors(path, {"schema": 1, "x": torch.zeros(10**6)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["checkpoint.pt"]


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    """Bytes of a terrain file."""
    path = tmp_path_factory.mktemp("ground") / "flat.npz"
    flat(size=2.0, cell=0.25).save(path)
    return path.read_bytes()


@settings(FEW, max_examples=80)
@given(place=st.integers(0), bit=st.integers(0, 7), cut=st.booleans())
def test_a_damaged_terrain_is_one_line_or_the_same(ground, tmp_path_factory, place, bit, cut):
    """With any bit flipped, or cut off anywhere, a terrain file is refused in one line or its ground is unchanged."""
    data = bytearray(ground)
    data[place % len(data)] ^= 1 << bit
    path = tmp_path_factory.mktemp("npz") / "ground.npz"
    path.write_bytes(data[: place % len(data)] if cut else data)
    found, said = attempt(lambda: Terrain.load(path), ValueError)
    if found is None:
        assert said.startswith(f"{path} is not a terrain file")
    else:
        assert np.array_equal(found.heights, flat(size=2.0, cell=0.25).heights)


def test_an_array_that_claims_too_much_is_refused(tmp_path, monkeypatch):
    """What a header promises is compared with what the file holds before anything of that size is allocated."""
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (5000000, 5000), }"
    array = b"\x93NUMPY\x01\x00" + (len(header) + 1).to_bytes(2, "little") + header + b"\n" + bytes(64)
    (tmp_path / "a.npy").write_bytes(array)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("heights.npy", array)
    monkeypatch.setattr(np.lib.format, "read_array", None)  # it would allocate
    for name in ("a.npy", "a.npz"):
        with pytest.raises(ValueError, match=r"float32\[5000000, 5000\] takes 100000000000 bytes, got 64"):
            load_arrays(tmp_path / name)


def test_an_archive_that_claims_too_much_is_refused(tmp_path):
    """A member that says to be larger than its bytes could ever unpack to is refused."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("heights.npy", bytes(1000))
    data = bytearray((tmp_path / "a.npz").read_bytes())
    place = data.index(b"PK\x01\x02") + 24
    data[place : place + 4] = (2**31).to_bytes(4, "little")
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(ValueError, match=r"heights.npy claims 2147483648 bytes and has \d+"):
        load_arrays(tmp_path / "a.npz")


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    """Bytes of a file of tensors."""
    path = tmp_path_factory.mktemp("tensors") / "x.pt"
    save_tensors(path, {"schema": 1, "x": torch.arange(8)})
    return path.read_bytes()


@FEW
@given(place=st.integers(0), bit=st.integers(0, 7))
def test_damaged_tensors_are_one_line_or_the_same(tensors, tmp_path_factory, place, bit):
    """With any bit flipped, a file of tensors is refused in one line or its numbers are unchanged."""
    data = bytearray(tensors)
    data[place % len(data)] ^= 1 << bit
    path = tmp_path_factory.mktemp("pt") / "x.pt"
    path.write_bytes(data)
    found, said = attempt(lambda: load_tensors(path, "checkpoint", 1), RunError)
    if found is None:
        assert said.startswith(str(path))
    else:
        assert torch.equal(found["x"], torch.arange(8))


@FEW
@given(names=st.lists(st.text(min_size=1, max_size=30), min_size=2, max_size=2, unique=True))
def test_a_name_is_a_file_name(tmp_path_factory, names):
    """Whatever a name holds, a file of it can be made in its folder, and no two names share one."""
    folder = tmp_path_factory.mktemp("names")
    for name in names:
        (folder / file_name(name)).write_text(name)
    assert len(os.listdir(folder)) == 2
    assert file_name("particle-4.0_x") == "particle-4.0_x"
    assert len(file_name("x" * 1000)) < 128


@FEW
@given(value=st.one_of(st.integers(), st.floats(), st.text(max_size=5), st.booleans(), st.none()))
def test_options_are_taken_or_refused_in_one_line(capfd, value):
    """Whatever is given for a size, it is a whole number in range, or it is refused in one line with its name."""
    taken, said = attempt(lambda: EvalConfig(worlds=value), ValueError)
    if taken is None:
        assert said.startswith("worlds must be")
    else:
        assert 1 <= value < 2**31
        assert int(value) == value


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env": {"kind": ["x"]}}, "must name its 'kind'"),
        ({"env": {"kind": "particle", "max_speed": 10**400}}, "max_speed must be a number, got 1000"),
        ({"env": {"kind": "particle", "max_speed": "fast"}}, "max_speed must be a number, got 'fast'"),
        ({"env": {"kind": "particle", "goal_period": True}}, "goal_period must be a whole number, got True"),
        ({"env": {"kind": "particle", "variant": 3}}, "variant must be one of"),
        ({"evaluation": "no"}, "evaluation must be true or false, got 'no'"),
        ({"ppo": {"clip_value": 1}}, "clip_value must be true or false, got 1"),
        ({"eval": {"pool": 7}}, "pool must be a path, got 7"),
        ({"seed": 0.5}, "seed must be a whole number, got 0.5"),
        ({"method": ["p25"]}, r"method must be a text, got \['p25'\]"),
        ({"ppo": 3}, "PPOConfig must be a table of its fields, got 3"),
    ],
)
def test_a_value_of_another_type_is_refused_by_its_key(changes, message):
    """Whatever type a file gives a field, the field is named, and nothing is taken for what it is not."""
    with pytest.raises(ValueError, match=message):
        from_dict(TrainConfig, changes)


def test_a_pipe_in_a_study_is_refused(tmp_path):
    """Nobody waits for a pipe in place of a study's file, a table, an archive or a list of failures."""
    study, cell = StudyFolder(tmp_path), SimpleNamespace(name="a")
    (tmp_path / "cells" / "a").mkdir(parents=True)
    for name in ("study.toml", "results.csv", "policies.zip", "cells/a/failures.jsonl"):
        os.mkfifo(tmp_path / name)
    reads = plan.read, StudyFolder.results, archive.unpack, lambda study: study.failures(cell)
    for read, place in zip(reads, (tmp_path / "study.toml", study, study, study), strict=True):
        with pytest.raises(RunError, match="not a regular file"):
            read(place)
    with pytest.raises(RunError, match="No such device"):  # the system's word for a pipe that nobody reads
        study.record_failure(cell, "killed")


def test_what_a_damaged_table_of_a_study_says_can_be_printed(tmp_path):
    """Zeros that a disk has left in the names of columns, or in a cell, are spelled out in one line."""
    columns = list(TABLES["curves.csv"])
    for text in ("hash,met\0hod\n", ",".join(columns) + "\n" + ",".join("\0" for _ in columns) + "\n"):
        (tmp_path / "curves.csv").write_text(text)
        found, said = attempt(StudyFolder(tmp_path).results, RunError)
        assert found is None
        assert "curves.csv" in said


def test_a_page_holds_no_tags_of_names():
    """A name that is a tag is a text on a page, in HTML as in Markdown, and signs that are none stay."""
    blocks = ["## <b>a</b>", [{"<script>": "p < 0.05 </script> a|b"}]]
    assert "<script>" not in to_html(blocks, Path())
    page = to_markdown(blocks, "figures")
    assert "&lt;script> |" in page
    assert "| p < 0.05 &lt;/script> a\\|b |" in page
