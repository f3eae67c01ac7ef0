"""What a study keeps of its policies and of their trainings, and what later attackers make of them."""

import dataclasses
import hashlib
import math
import re
import shutil
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest
import torch

from deimos import plugins
from deimos.checks import RunError
from deimos.lock import hold
from deimos.run import attackers
from deimos.run.evaluation import evaluate, read_evaluation
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.study import cell as worker
from deimos.study import cli, plan
from deimos.study.audits import Audits
from deimos.study.folder import StudyFolder
from deimos.study.results import evaluated, identity
from deimos.study.rounds import rounds

WORST = ("worst", "worst_attacker", "worst_interactions")  # they depend on who attacked
LONG = {"attackers": ("argmax-long",), "allow_uncommitted": True}

ATTACK = """
import sys
from pathlib import Path
from deimos.study import cli
cli.AttackOptions(folder=Path(sys.argv[1]), attackers=("argmax-long",), allow_uncommitted=True).run()
"""

PLUGIN = '''
"""Uniform goals under another name, in a module that is not installed."""

from dataclasses import dataclass

from deimos import plugins
from deimos.goals import selectors
from deimos.goals.selectors import uniform


@dataclass(frozen=True, kw_only=True)
class Config(uniform.Config):
    """See ``uniform.Config``."""


plugins.register(selectors, "even", __name__)
'''


@pytest.fixture(scope="module")
def file(tmp_path_factory, short_study):
    """The study in a TOML file."""
    path = tmp_path_factory.mktemp("toml") / "study.toml"
    path.write_text(short_study(960))
    return path


@pytest.fixture(scope="module")
def whole(file, tmp_path_factory):
    """The study, finished."""
    study = StudyFolder(tmp_path_factory.mktemp("studies") / "whole")
    study.add(plan.expand(plan.read(file)))
    assert all([worker.run(study, cell) for cell in study.cells()])
    return study


def copied(whole, folder):
    """A copy of a study."""
    shutil.copytree(whole.path, folder)
    return StudyFolder(folder)


def table(study, without=()):
    """Its results without what depends on the clock, NaN made comparable, in a fixed order."""
    rows = [{k: repr(v) for k, v in row.items() if k not in ("fps", *without)} for row in study.results().rows]
    return sorted(rows, key=lambda row: (row["hash"], row["goals"]))


def test_audits_leave_no_trace_in_the_training(whole, tmp_path):
    """A cell's training is the same bit for bit without audits, and audits stand in its training curve."""
    study = StudyFolder(tmp_path / "study")
    study.add([dataclasses.replace(cell, audit_worlds=0) for cell in whole.cells()])
    for cell, twin in zip(study.cells(), whole.cells(), strict=True):
        assert cell.digest != twin.digest
        assert worker.run(study, cell)
        mine, its = (folder.cell_path(each) for folder, each in ((study, cell), (whole, twin)))
        assert (mine / "run" / "progress.csv").read_bytes() == (its / "run" / "progress.csv").read_bytes()
        assert not (mine / "audits.json").exists()
        assert [*RunFolder(its).read_json("audits.json")] == ["32", "34", "36", "38", "40"]
    assert all(math.isnan(line["speed"]) for line in study.results().curves)
    curves = {line["method"]: line for line in whole.results().curves}
    for line in curves.values():
        known = [value for value in line["exact_percentile"] if not math.isnan(value)]
        assert known
        assert all(0.0 <= value <= 100.0 for value in known)
        assert len(line["exact_contexts"]) == 5
        assert sum(line["goal_map"]) > 0
        assert line["speed"] > 0.0
    assert all(map(math.isnan, curves["uniform"]["auroc"]))
    assert all(0.0 <= value <= 1.0 for value in curves["p25"]["risk"])
    assert curves["p25"]["fear_fitted"][-1] == 1.0


def test_interrupted_audits_are_the_same(whole, tmp_path):
    """A training that is stopped in the midst of its audits ends with the audits of one that was not."""
    study = StudyFolder(tmp_path / "study")
    study.add([cell for cell in whole.cells() if cell.config.method == "p25"])
    (cell,) = study.cells()
    home = study.cell_path(cell)
    assert not worker.run(study, cell, stopped=lambda: (home / "audits.json").exists())
    assert [*RunFolder(home).read_json("audits.json")] == ["32"]
    assert worker.run(study, cell)
    assert (home / "audits.json").read_bytes() == (whole.cell_path(cell) / "audits.json").read_bytes()


def test_what_holds_no_audits_is_refused(tmp_path):
    """A file of audits that is JSON of another kind is named."""
    home = RunFolder.create(tmp_path / "cell")
    home.write_json("audits.json", [1])
    with pytest.raises(RunError, match=r"audits\.json must hold a table of audits, got list"):
        Audits(home, TrainConfig(), 4)


def test_cell_keeps_its_fear_network(whole):
    """A Director's cell has its fear network as a file for the attacker ``pooled``; Uniform's has none."""
    for cell in whole.cells():
        path = whole.cell_path(cell) / "fear.pt"
        assert path.exists() == (cell.config.method == "p25")
        if path.exists():
            sizes = dataclasses.replace(cell.config.eval, pool=path, attackers=("pooled",))
            rows = evaluate(lambda obs: torch.zeros(len(obs), 3), cell.config.env, sizes, torch.device("cpu"))
            assert [(row["goals"], row.get("uninformed")) for row in rows] == [("naive", None), ("pooled", False)]


def test_attack_adds_rows_and_survives_a_kill(whole, tmp_path, capsys):
    """Further attackers add a row for every policy, each once, also where the command was killed in the middle."""
    once, killed = (copied(whole, tmp_path / name) for name in ("once", "killed"))
    cli.AttackOptions(folder=once.path, **LONG).run()
    runner = subprocess.Popen([sys.executable, "-c", ATTACK, str(killed.path)], stderr=subprocess.DEVNULL)
    end = time.monotonic() + 120
    while len(killed.results().rows) == 6:
        assert time.monotonic() < end, "nobody was attacked"
        time.sleep(0.02)
    runner.kill()
    runner.wait()
    for cell in killed.cells():  # its worker ends by itself
        with hold(killed.cell_path(cell) / "lock", cell.name, patience=60.0):
            pass
    cli.RunOptions(folder=killed.path).run()
    assert table(killed) == table(once)
    assert [row["goals"] for row in table(once)] == ["'argmax'", "'argmax-long'", "'naive'", "'scripted'"] * 2
    cli.AttackOptions(folder=once.path, seeds="5-7", attackers=("search",), allow_uncommitted=True).run()
    assert len(once.results().rows) == 8
    assert "No policy has one of the seeds 5-7 yet, so nothing is attacked now." in capsys.readouterr().err
    kept = [row for row in table(once, WORST) if row["goals"] != "'argmax-long'"]
    assert kept == table(whole, WORST)


def test_rows_say_which_attacker_made_them(whole, tmp_path, monkeypatch, new_plugins):
    """An attacker that is none of Deimos' own stands in the code of its rows with the hash of its file."""
    source = b'"""Scripted under another name."""\n\nfrom deimos.run.attackers.scripted import Config as Scripted\n'
    source += b"from dataclasses import dataclass\n\n\n@dataclass(frozen=True)\nclass Config(Scripted):\n    ...\n"
    (tmp_path / "my_attacker.py").write_bytes(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    plugins.register(attackers, "mine", "my_attacker")
    cell = whole.cells()[0]
    run = RunFolder(whole.cell_path(cell) / "run")
    rows = read_evaluation(run)
    rows.append(rows[0] | {"goals": "mine"})
    made_by = {row["goals"]: row["code"] for row in evaluated(cell, run, rows, "0123")}
    digest = hashlib.sha256(source).hexdigest()[:12]
    assert made_by == {**dict.fromkeys(("naive", "argmax", "scripted"), "0123"), "mine": f"0123 my_attacker={digest}"}


@pytest.mark.parametrize("name", ["particle_a", "particle_b"])
def test_kept_policies_are_the_cells_of_their_rows(tmp_path, name):
    """What an earlier version has finished keeps its hashes and can be attacked; what is open there is refused."""
    kept = Path(__file__).parent.parent / "docs" / "results" / name
    for table in ("results.csv", "curves.csv"):
        shutil.copy(kept / table, tmp_path)
    with zipfile.ZipFile(kept / "policies.zip") as every, zipfile.ZipFile(tmp_path / "policies.zip", "w") as some:
        for entry in [entry for entry in every.namelist() if re.match(r"relative-p\S+-s0-", entry)]:
            some.writestr(entry, every.read(entry))
    study = StudyFolder(tmp_path)
    cli.UnpackOptions(folder=study.path).run()
    cells, rows = study.cells(), {row["hash"]: row for row in study.results().rows}
    assert len(cells) >= 3
    for cell in cells:
        own = identity(cell)
        assert {name: rows[cell.digest][name] or "" for name in own} == {name: own[name] or "" for name in own}
    assert study.finished(cells) == {cell.digest for cell in cells}
    (study.cell_path(cells[0]) / "result.json").unlink()
    with pytest.raises(RunError, match="was made by another version of Deimos, whose defaults or methods differ"):
        study.cells()


def test_study_file_may_name_further_attackers(file, tmp_path):
    """What a file's ``[[attack]]`` says is added to the study: some seeds meet more attackers."""
    description = plan.read(file) | {"attack": [{"attackers": ["search"], "seeds": [0]}, {"attackers": ["search"]}]}
    study = StudyFolder(tmp_path)
    for _ in range(2):
        study.add_rounds(rounds(description))
    assert [(each.attackers, each.seeds) for each in study.rounds()] == [(("search",), (0,)), (("search",), ())]
    for table, message in (
        ({"attackers": ["nobody"]}, "Unknown attacker 'nobody'"),
        ({"attackers": []}, "attackers must be one or more names, got none"),
        ({"attackers": ["search"], "seeds": "x"}, "seeds must be a number of seeds"),
        ({"who": ["search"]}, r"An \[\[attack\]\] has no who; it has: attackers, seeds"),
    ):
        with pytest.raises(RunError, match=message):
            rounds({"attack": [table]})
    (tmp_path / "attack.json").write_text('[{"attackers": 3}]')
    with pytest.raises(RunError, match=r"attack\.json does not list attackers"):
        study.rounds()


def test_unfinished_study_is_not_attacked(file, tmp_path):
    """A study that holds nothing, or cells without a policy, is refused with the way out."""
    with pytest.raises(RunError, match=r"holds no policies: neither cells nor policies\.zip"):
        cli.AttackOptions(folder=tmp_path, **LONG).run()
    study = StudyFolder(tmp_path)
    study.add(plan.expand(plan.read(file)))
    with pytest.raises(RunError, match="2 of 2 cells are not finished; finish them first: deimos study run"):
        cli.AttackOptions(folder=tmp_path, **LONG).run()


def test_archive_stands_for_the_cells(whole, tmp_path, capsys):
    """The archive has the same bytes whenever it is packed, and with the tables it is enough to attack a study."""
    study, other = (copied(whole, tmp_path / name) for name in ("study", "other"))
    cli.ExportOptions(folder=study.path).run()
    cli.PackOptions(folder=study.path).run()
    path = study.path / "policies.zip"
    first = path.read_bytes()
    path.unlink()
    cli.PackOptions(folder=study.path).run()
    assert path.read_bytes() == first
    assert "policies.zip: 2 policies" in capsys.readouterr().out
    shutil.rmtree(study.path / "cells")
    for each in (study, other):
        cli.AttackOptions(folder=each.path, **LONG).run()
    assert table(study) == table(other)
    for cell in whole.cells():
        for part in ("run/policy.pt", "run/config.json", "cell.json"):
            assert (study.cell_path(cell) / part).read_bytes() == (whole.cell_path(cell) / part).read_bytes()
    cli.PackOptions(folder=study.path).run()
    assert path.read_bytes() == first


def test_study_that_goes_on_from_its_tables_can_be_attacked(whole, file, tmp_path):
    """Where cells were made from a file for rows of the tables, their policies come from the archive, or are missed."""
    study, other = (copied(whole, tmp_path / name) for name in ("study", "other"))
    cli.ExportOptions(folder=study.path).run()
    cli.PackOptions(folder=study.path).run()
    shutil.rmtree(study.path / "cells")
    archive = (study.path / "policies.zip").rename(tmp_path / "policies.zip")
    cli.RunOptions(folder=study.path, file=file, allow_uncommitted=True).run()  # nothing is open
    for command in (cli.AttackOptions(folder=study.path, **LONG), cli.PoolOptions(folder=study.path)):
        with pytest.raises(RunError, match=r"2 of 2 cells have rows in the tables of .*, but no policy there"):
            command.run()
    archive.rename(study.path / "policies.zip")
    for each in (study, other):
        cli.AttackOptions(folder=each.path, **LONG).run()
    assert table(study) == table(other)


def test_archive_alone_gives_the_policies_back(whole, tmp_path, capsys):
    """Without tables too the policies come back, where they are not there yet; and there must be an archive."""
    study = copied(whole, tmp_path / "study")
    with pytest.raises(RunError, match=r"holds no policies\.zip"):
        cli.UnpackOptions(folder=study.path).run()
    cli.PackOptions(folder=study.path).run()
    shutil.rmtree(study.cell_path(study.cells()[0]))
    cli.UnpackOptions(folder=study.path).run()
    assert capsys.readouterr().out.endswith(f"1 policies put back into {study.path / 'cells'}\n")
    assert study.cells() == whole.cells()
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunError, match="has no finished cell whose policy could be packed"):
        cli.PackOptions(folder=tmp_path / "empty").run()


def test_archive_takes_any_name_of_an_environment(whole, tmp_path):
    """Letters of any language, which a study's file may use, go into an archive and come back."""
    study = StudyFolder(tmp_path / "study")
    first = whole.cells()[0]
    cell = dataclasses.replace(first, environment="Hügel.1")
    study.add([cell])
    shutil.copytree(whole.cell_path(first) / "run", study.cell_path(cell) / "run")
    shutil.copy(whole.cell_path(first) / "result.json", study.cell_path(cell))
    cli.PackOptions(folder=study.path).run()
    shutil.rmtree(study.path / "cells")
    cli.UnpackOptions(folder=study.path).run()
    assert study.cells() == [cell]


@pytest.mark.parametrize(
    "name", ["../evil", "../cell.json", "./cell.json", "a/b/policy.pt", "x/cell.json.exe", "/etc/cell.json"]
)
def test_foreign_archive_is_refused(tmp_path, name):
    """An archive that would write anything but the files of cells is refused, and nothing of it is written."""
    with zipfile.ZipFile(tmp_path / "policies.zip", "w") as archive:
        archive.writestr(name, "x")
    with pytest.raises(RunError, match=r"policies\.zip is not an archive of policies, or it is broken"):
        cli.UnpackOptions(folder=tmp_path).run()
    assert [path.name for path in tmp_path.iterdir()] == ["policies.zip"]


def test_cells_of_another_commit_are_refused(whole, file, tmp_path):
    """A cell that was begun by other code is continued neither by the runner nor by its worker, and never mixed."""
    study = StudyFolder(tmp_path / "study")
    cell = whole.cells()[0]
    study.add([dataclasses.replace(cell, sources=cell.sources | {"code": "0123456789ab"})])
    with pytest.raises(RunError, match=r"was made from 0123456789ab, and this is .*: cells of two versions never mix"):
        cli.RunOptions(folder=study.path).run()
    with pytest.raises(RunError, match="was made from 0123456789ab"):
        worker.run(study, study.cells()[0])
    with pytest.raises(RunError, match="made by 2 versions of the code"):
        cli.RunOptions(folder=study.path, file=file, allow_uncommitted=True).run()
    assert len(study.cells()) == 1


def test_study_imports_its_plugins(tmp_path, monkeypatch, new_plugins, short_study):
    """A selector of a module that the study names trains in its workers; with another source it is another cell."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_selector.py").write_text(PLUGIN)
    file = tmp_path / "study.toml"
    file.write_text(short_study(960, methods=["even"], head='plugins = ["my_selector"]'))
    study = StudyFolder(tmp_path / "study")
    cli.RunOptions(folder=study.path, file=file, allow_uncommitted=True).run()
    assert {row["method"] for row in study.results().rows} == {"even"}
    (cell,) = study.cells()
    assert cell.plugins == ("my_selector",)
    (tmp_path / "my_selector.py").write_text(PLUGIN + "# changed\n")
    (other,) = plan.expand(plan.read(file))
    assert (other.digest != cell.digest, other.setting == cell.setting) == (True, True)
    assert other.selector != cell.selector  # two versions of a method are no population
    (study.cell_path(cell) / "result.json").unlink()
    with pytest.raises(RunError, match="the file of 'my_selector' is not the one that it was made with"):
        worker.run(study, cell)
    file.write_text(short_study(960, head='plugins = ["no_such_module"]'))
    with pytest.raises(RunError, match="plugins: the module no_such_module cannot be imported"):
        plan.expand(plan.read(file))


def test_run_that_lost_its_configuration_is_made_again(whole, tmp_path, capsys):
    """A checkpoint without the configuration that it belongs to is no run: that is said, and the cell begins again."""
    study = StudyFolder(tmp_path / "study")
    study.add(whole.cells()[:1])
    (cell,) = study.cells()
    run = study.cell_path(cell) / "run"
    run.mkdir()
    (run / "checkpoint.pt").write_text("whatever")
    assert worker.main([str(study.path), cell.name]) == 0
    assert capsys.readouterr().err == f"{run} holds no config.json; the cell starts again.\n"
    assert table(study, WORST) == [row for row in table(whole, WORST) if row["hash"] == repr(cell.digest)]


def test_strays_are_said(whole, tmp_path, capsys):
    """A folder of a cell that does not say what it is counts for nothing, is named, and is made again from the file."""
    study = copied(whole, tmp_path / "study")
    cell = study.cells()[0]
    (study.cell_path(cell) / "cell.json").unlink()
    cli.ShowOptions(folder=study.path).run()
    assert f"1 folder(s) in {study.path / 'cells'} hold no cell.json ({cell.name} first)" in capsys.readouterr().err
    study.add([cell])
    assert (study.strays(), len(study.cells())) == ([], 2)
    (study.cell_path(cell) / "failures.jsonl").write_text('junk}\n[1]\n{"error": "it died"}\n{"err')
    assert study.failures(cell) == ["it died"]
