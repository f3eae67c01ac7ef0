"""Files for the attacker ``pooled``, one for every environment of a study, made by one command."""

import shutil
import subprocess
import sys

import pytest

from deimos.checks import RunError
from deimos.files import load_tensors
from deimos.run.attackers.pooled import SCHEMA
from deimos.study import cell as worker
from deimos.study import cli, plan, pools
from deimos.study.folder import StudyFolder

FACTORS = """
[factors]
env.max_speed = [200.0, 1.0]
"""  # the slow particles are never at a wall within an evaluation


@pytest.fixture(scope="module")
def screening(short_study, tmp_path_factory):
    """A finished study of two settings, of which one has no crashes."""
    home = tmp_path_factory.mktemp("screening")
    text = short_study(96, methods=["uniform"]).replace("adversary_steps = 40", "adversary_steps = 200")
    (home / "study.toml").write_text(text + FACTORS)
    study = StudyFolder(home / "study")
    study.add(plan.expand(plan.read(home / "study.toml")))
    return study


def finish(study):
    """Finish its cells."""
    assert all([worker.run(study, cell) for cell in study.cells()])


def test_a_pool_for_every_setting(screening, short_study, tmp_path, capsys):
    """Each network has learnt from its own setting, or says that it could not; another study attacks with them all."""
    with pytest.raises(RunError, match="2 of 2 cells are not finished; finish them first: deimos study run"):
        cli.PoolOptions(folder=screening.path).run()
    finish(screening)
    cli.PoolOptions(folder=screening.path).run()
    fast, slow = (screening.path / "pools" / f"directional.{i}.pt" for i in (0, 1))
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith(f"{fast}: ")
    assert said[0].endswith(" crashes")
    assert said[1] == f"{slow}: no crashes, or only crashes: the attacker's goals are uniform"
    facts = [load_tensors(path, "pool", SCHEMA)["facts"] for path in (fast, slow)]
    assert [each["uninformed"] for each in facts] == [False, True]
    assert facts[0]["adversary_crashes"] > 0 == facts[1]["adversary_crashes"]

    file = tmp_path / "attacked.toml"
    head = f"pools = '{screening.path / 'pools'}'\n"
    text = short_study(96, methods=["uniform"], head=head).replace("steps = 40,", 'steps = 40, attackers = ["pooled"],')
    file.write_text(text + FACTORS)
    study = StudyFolder(tmp_path / "study")
    study.add(plan.expand(plan.read(file), seeds="7"))
    finish(study)
    rows = {row["environment"]: row for row in study.results().rows if row["goals"] == "pooled"}
    assert [rows[f"directional.{i}"]["uninformed"] for i in (0, 1)] == [False, True]
    assert rows["directional.0"]["adversary_crashes"] == facts[0]["adversary_crashes"]


def test_a_pool_that_is_there_stays(screening, tmp_path):
    """What was killed in the middle continues: files that are there keep their bytes, those that lack are made."""
    finish(screening)
    out = tmp_path / "pools"
    cli.PoolOptions(folder=screening.path, out=out).run()
    fast, slow = sorted(out.iterdir())
    first = slow.read_bytes()
    slow.unlink()
    fast.write_bytes(b"made before")
    command = [sys.executable, "-m", "deimos", "study", "pool", str(screening.path), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    first_line, second = done.stdout.splitlines()
    assert first_line == f"{fast}: exists already"
    assert second.startswith(f"{slow}: no crashes")
    assert fast.read_bytes() == b"made before"
    assert slow.read_bytes() == first


def test_what_was_given_up_stops_nobody_else(screening, tmp_path, capsys):
    """A cell that failed once is open; one that was given up has no pool and is named, and the others have theirs."""
    shutil.copytree(screening.path, tmp_path / "study")
    study = StudyFolder(tmp_path / "study")
    lost, kept = study.cells()
    assert worker.run(study, kept)
    (study.cell_path(lost) / "result.json").unlink(missing_ok=True)
    study.record_failure(lost, "it broke")
    with pytest.raises(RunError, match="1 of 2 cells are not finished"):
        cli.PoolOptions(folder=study.path, out=tmp_path / "pools").run()
    study.record_failure(lost, "it broke again")
    cli.PoolOptions(folder=study.path, out=tmp_path / "pools").run()
    said = capsys.readouterr()
    assert [path.stem for path in (tmp_path / "pools").iterdir()] == [kept.environment]
    assert said.out.startswith(f"{tmp_path / 'pools' / kept.environment}.pt: ")
    assert said.err == f"{lost.environment}: no file, since a cell of it was given up\n"


def test_a_study_without_policies_has_no_pools(tmp_path):
    """A folder without cells is refused."""
    with pytest.raises(RunError, match="holds no policies"):
        cli.PoolOptions(folder=tmp_path).run()


def test_a_folder_for_pools_is_tried_before_the_work(screening, tmp_path, monkeypatch):
    """One that cannot be written to is refused before anything is trained."""
    monkeypatch.setattr(pools, "_is_finished", lambda study, cell: True)
    monkeypatch.setattr(pools, "load_policy", lambda *args: pytest.fail("worked in vain"))
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(RunError, match=f"The folder {tmp_path} cannot be written to"):
        cli.PoolOptions(folder=screening.path, out=tmp_path).run()
