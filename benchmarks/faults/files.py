"""Damaged files of every kind: each is refused in one line that names it, or read with the same contents as before."""

import functools
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.faults.options import STUDY, known_run
from benchmarks.faults.trial import Verdict, attempt
from deimos.checks import RunError
from deimos.files import load_tensors
from deimos.learn.policy import load_policy
from deimos.run import training
from deimos.run.evaluation import EvalConfig, evaluate_run, read_evaluation
from deimos.run.folder import RunFolder
from deimos.sim.envs import quad
from deimos.study import archive, cell, cli
from deimos.study.folder import StudyFolder
from deimos.study.results import merge
from terrain.grid import flat

SECONDS = 20.0
SEALED = {"checkpoint.pt", "policy.pt", "ground.npz", "policies.zip", "fear.pt"}  # have checksums: no other contents
NESTED = "[" * 100_000 + "]" * 100_000


def _checkpoint(folder: Path) -> Any:
    run = RunFolder.open(folder)
    return repr(training.load(run, training.read_config(run)).state_dict())


def _evaluated(folder: Path) -> Any:
    return read_evaluation(RunFolder(folder))


def _table(name: str) -> Callable[[Path], Any]:
    def read(folder: Path) -> Any:
        RunFolder(folder).cut_csv(name, 2)
        return RunFolder(folder).read_csv(name)

    return read


def _cells(folder: Path) -> Any:
    study = StudyFolder(folder)
    return [cell.digest for cell in study.cells()], study.strays(), sorted(study.finished(study.cells()))


def _results(folder: Path) -> Any:
    return repr([*StudyFolder(folder).results().rows, *StudyFolder(folder).results().curves])


def _failures(folder: Path) -> Any:
    return [StudyFolder(folder).failures(cell) for cell in StudyFolder(folder).cells()]


def _unpacked(folder: Path) -> Any:
    study = StudyFolder(folder)
    for home in (folder / "cells").iterdir():
        shutil.rmtree(home)
    archive.unpack(study)
    return [(study.cell_path(cell) / "run" / "policy.pt").read_bytes() for cell in study.cells()]


def _ground(path: Path) -> Any:
    ground = quad.Config(terrain=str(path)).load_terrain()
    assert ground is not None
    return ground.heights.tolist()


READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "config.json": ("run", lambda folder: training.read_config(RunFolder.open(folder))),
    "checkpoint.pt": ("run", _checkpoint),
    "policy.pt": ("run", lambda folder: repr(load_policy(folder).state_dict())),
    "progress.csv": ("run", _table("progress.csv")),
    "timing.csv": ("run", _table("timing.csv")),
    "evaluation.json": ("run", _evaluated),
    "ground.npz": (".", lambda folder: _ground(folder / "ground.npz")),
    "cell.json": ("study", _cells),
    "result.json": ("study", _results),
    "failures.jsonl": ("study", _failures),
    "results.csv": ("study", _results),
    "curves.csv": ("study", _results),
    "policies.zip": ("study", _unpacked),
    "fear.pt": ("study", lambda folder: repr(load_tensors(next(folder.rglob("fear.pt")), "pool", 9, oldest=0))),
}
"""Every kind of file, by its name: its folder, and the function that reads it."""
EACH = 300
COUNT = EACH * len(READERS)


@functools.cache
def whole() -> Path:
    """A folder with an intact file of every kind."""
    place = Path(tempfile.mkdtemp(prefix="deimos-faults-"))
    known_run(place / "run")
    run = RunFolder(place / "run")
    evaluate_run(run, training.read_config(run).env, EvalConfig(worlds=8, steps=32, attackers=()), torch.device("cpu"))
    flat(size=2.0, cell=0.25).save(place / "ground.npz")
    study = StudyFolder(place / "study")
    cli.RunOptions(folder=study.path, file=STUDY, allow_uncommitted=True, seeds="1")
    return _with_study(place, study)


def _with_study(place: Path, study: StudyFolder) -> Path:
    """Add a study whose cells are finished."""
    from deimos.study import plan

    cells = plan.expand(plan.read(STUDY), seeds="1", methods=["p25"])
    study.add([replace(each, audit_worlds=0) for each in cells])
    for each in study.cells():
        assert cell.run(study, each)
        study.record_failure(each, "killed by SIGKILL")
        run = RunFolder(study.cell_path(each))
        if not (run.path / "fear.pt").exists():
            shutil.copy(place / "run" / "policy.pt", run.path / "fear.pt")
    merge(study.path, [study.path])
    archive.pack(study)
    torch.set_num_threads(1)
    return place


def attack(number: int, rng: np.random.Generator, place: Path) -> Verdict:
    """Damage a file, and read it as Deimos does."""
    name = list(READERS)[number % len(READERS)]
    home, read = READERS[name]
    copy = Path(shutil.copytree(whole(), place / "copy"))
    path = next((copy / home).rglob(name))
    before = _said(read, whole() / home if name != "policies.zip" else _copied(place, home))
    what = damage(path, rng)
    held = path.read_bytes() if path.is_file() and not path.is_symlink() else None
    ended = attempt(lambda: _answer(read, copy / home, before), place, SECONDS)
    said = (place / "stdout.txt").read_text(errors="replace").strip()
    fault = ""
    if ended.hung or ended.asked:
        fault = "it waited"
    elif ended.code not in (0, 2, 3):
        fault = "a traceback" if "Traceback" in ended.said else f"exit code {ended.code}"
    elif ended.code == 2 and (len(said.splitlines()) != 1 or not said.isprintable()):
        fault = "not one line"
    elif ended.code == 2 and not any(part in said for part in (path.name, path.parent.name)):
        fault = "the line does not name the file"
    elif ended.code == 3 and name in SEALED and (path.exists() or name != "policies.zip"):  # a study may lack one
        fault = "other contents were read"
    elif ended.code == 2 and held is not None and path.read_bytes() != held:
        fault = "the damaged file was changed"
    outcome = {0: "the same", 2: "refused", 3: "other contents"}.get(ended.code, "fault")
    return Verdict("fault" if fault else outcome, f"{name}: {what}", said or ended.said[-2000:], fault)


def _copied(place: Path, home: str) -> Path:
    return Path(shutil.copytree(whole() / home, place / "untouched"))


def _said(read: Callable[[Path], Any], folder: Path) -> str:
    return repr(read(folder))


def _answer(read: Callable[[Path], Any], folder: Path, before: str) -> int:
    """0 if a file is read with the same contents as before, 3 if with others, 2 if it is refused."""
    try:
        return 0 if _said(read, folder) == before else 3
    except (RunError, ValueError) as error:
        print(error)
        return 2


def damage(path: Path, rng: np.random.Generator) -> str:
    """Damage a file in some way; returns a description."""
    data, ways = path.read_bytes(), [_flip, _cut, _fill, _insert, _special, _double]
    ways += [_retype, _retype] if path.suffix == ".json" else []
    return ways[rng.integers(len(ways))](path, data, rng)


def _flip(path: Path, data: bytes, rng: np.random.Generator) -> str:
    changed, count = bytearray(data), int(rng.choice([1, 1, 1, 8, 64]))
    for place in rng.integers(0, len(data), count):
        changed[place] ^= 1 << int(rng.integers(8))
    path.write_bytes(changed)
    return f"{count} bits flipped"


def _cut(path: Path, data: bytes, rng: np.random.Generator) -> str:
    size = int(rng.integers(len(data)))
    path.write_bytes(data[:size] if rng.random() < 0.7 else data[size:])
    return f"cut at {size} of {len(data)}"


def _fill(path: Path, data: bytes, rng: np.random.Generator) -> str:
    a, b = sorted(rng.integers(0, len(data) + 1, 2))
    filling = bytes(b - a) if rng.random() < 0.5 else rng.bytes(b - a)
    path.write_bytes(data[:a] + filling + data[b:])
    return f"bytes {a} to {b} of {len(data)} overwritten with {'zeros' if not any(filling) else 'noise'}"


def _insert(path: Path, data: bytes, rng: np.random.Generator) -> str:
    place, text = int(rng.integers(len(data) + 1)), rng.choice(["\0", "\ufeff", "1" * 200_000, "{", ",", "\n", '"'])
    path.write_bytes(data[:place] + str(text).encode() + data[place:])
    return f"{str(text)[:10]!r} put in at {place} of {len(data)}"


def _double(path: Path, data: bytes, rng: np.random.Generator) -> str:
    path.write_bytes(data + data)
    return "doubled"


def _special(path: Path, data: bytes, rng: np.random.Generator) -> str:
    """Replace it by something that is not a regular file, or by entirely different contents."""
    path.unlink()
    way = str(rng.choice(["missing", "empty", "a folder", "a FIFO", "/dev/zero", "a dangling link", "nested", "text"]))
    if way == "a folder":
        path.mkdir()
    elif way == "a FIFO":
        os.mkfifo(path)
    elif way in ("/dev/zero", "a dangling link"):
        path.symlink_to("/dev/zero" if way == "/dev/zero" else "nowhere")
    elif way != "missing":
        path.write_text({"empty": "", "nested": NESTED}.get(way, "<html>not found</html>\n"))
    return way


def _retype(path: Path, data: bytes, rng: np.random.Generator) -> str:
    """Change the type of one value of a JSON file, or remove it."""
    whole = json.loads(data)
    value, key, parent = whole, None, None
    while isinstance(value, dict | list) and value and (parent is None or rng.random() < 0.8):
        keys: list[Any] = list(value) if isinstance(value, dict) else list(range(len(value)))
        parent, key = value, keys[rng.integers(len(keys))]
        value = value[key]
    others = [None, True, -1, 10**12, 10**400, 0.5, "x", "", [], [[]], {}, {"x": 1}, [1, "x"]]
    if parent is None or rng.random() < 0.1:
        path.write_text(json.dumps(others[rng.integers(len(others))]))
        return "another value altogether"
    parent[key] = other = others[rng.integers(len(others))]
    path.write_text(json.dumps(whole))
    return f"{key} = {str(other)[:20]}"
