"""Studies whose cells branch off one run, and cells whose environment is built from files."""

import json
import shutil
from dataclasses import replace

import pytest

from deimos.checks import RunError
from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.branch import WARM_UP
from deimos.run.evaluation import EvalConfig
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle
from deimos.study import cell as worker
from deimos.study import plan
from deimos.study.folder import StudyFolder
from deimos.study.results import check_comparable, identity

CONFIG = TrainConfig(
    env=particle.Config(goal_period=8, max_speed=40.0), method="p25", ppo=PPOConfig(num_steps=8, hidden=(16, 16)),
    evaluation=False, seed=3, num_envs=32, env_steps=32, device="cpu", threads=1,
    eval=EvalConfig(worlds=16, steps=16, adversary_steps=16, attackers=("scripted",)),
)  # fmt: skip
QUAD = """
seeds = 1
methods = ["uniform"]
[[environment]]
name = "hills"
env = { kind = "quad", terrain = "hills.npz" }
"""


@pytest.fixture(scope="module")
def origin(tmp_path_factory):
    """The folder of a finished run."""
    trainer, folder = training.start(CONFIG, tmp_path_factory.mktemp("study") / "origin")
    training.train(trainer, folder)
    return folder.path


def described(origin, **changes):
    """A study of two methods that branch off a run."""
    table = {"name": "after", "train": {"env_steps": 16, "device": "cpu"}}
    return {
        "branch_from": str(origin),
        "methods": ["uniform", "p75"],
        "audit_worlds": 0,
        "environment": [table],
    } | changes


def test_cells_have_the_settings_of_the_run_that_they_branch_off(origin):
    """What the study does not say is the run's; seeds and methods are the grid's, and critics learn first."""
    cells = plan.expand(described(origin), seeds=[5, 6])
    assert [(cell.config.seed, cell.config.method) for cell in cells] == [
        (5, "uniform"), (5, "p75"), (6, "uniform"), (6, "p75"),
    ]  # fmt: skip
    first = cells[0]
    assert first.config == replace(
        CONFIG, method="uniform", seed=5, env_steps=16, critic_warmup=WARM_UP, evaluation=True
    )
    assert (first.branch_from, first.goal_periods) == (origin, (8,))
    assert len({cell.setting for cell in cells}) == 1
    table = {"name": "other", "branch_from": str(origin), "env": {"kind": "particle", "crash_penalty": 3.0}}
    (other,) = plan.expand({"methods": ["uniform"], "environment": [table]}, seeds=[5])
    assert (other.config.env, other.branch_from) == (replace(CONFIG.env, crash_penalty=3.0), origin)


def test_the_checkpoint_is_part_of_the_hash(origin, tmp_path):
    """The run counts by its checkpoint, wherever it lies; another checkpoint makes other cells."""
    (tmp_path / "moved").mkdir()
    for path in origin.iterdir():
        (tmp_path / "moved" / path.name).write_bytes(path.read_bytes())
    here, moved = (plan.expand(described(path), seeds=[0])[0] for path in (origin, tmp_path / "moved"))
    assert (here.digest, here.setting) == (moved.digest, moved.setting)
    with (tmp_path / "moved" / "checkpoint.pt").open("ab") as file:
        file.write(b"x")
    changed = plan.expand(described(tmp_path / "moved"), seeds=[0])[0]
    assert changed.digest != here.digest
    assert changed.setting != here.setting
    study = StudyFolder(tmp_path / "study")
    study.add([moved])
    with pytest.raises(RunError, match="the file of 'branch_from' is not the one that it was made with"):
        worker.run(study, study.cells()[0])


def moved(origin, path, added=b""):
    """A copy of a run, with more at the end of its checkpoint."""
    shutil.copytree(origin, path)
    with (path / "checkpoint.pt").open("ab") as file:
        file.write(added)


def test_every_seed_may_have_a_run_of_its_own(origin, tmp_path):
    """``{seed}`` in a text is the seed: methods share what their seed began with, and all seeds one setting."""
    for seed in (1, 2):
        moved(origin, tmp_path / f"run_{seed}", bytes(seed))
    (tmp_path / "pool_1").write_bytes(b"1")
    (tmp_path / "pool_2").write_bytes(b"2")
    study = described(str(tmp_path / "run_{seed}"), train={"eval": {"pool": str(tmp_path / "pool_{seed}")}})
    cells = plan.expand(study, seeds="1-2")
    found = [(cell.config.seed, cell.branch_from.name, cell.config.eval.pool.name, cell.by_seed) for cell in cells]
    assert found == [(seed, f"run_{seed}", f"pool_{seed}", ("pool", "branch_from")) for seed in (1, 1, 2, 2)]
    assert len({cell.setting for cell in cells}) == 1
    first, second, third, fourth = (cell.block for cell in cells)
    assert first == second != third == fourth
    assert len({cell.digest for cell in cells}) == 4
    check_comparable(map(identity, cells))
    assert plan.expand(described(origin), seeds=[1])[0].block == ""


def test_policies_that_began_elsewhere_are_no_pair(origin, tmp_path):
    """A seed whose run was made anew between two methods is refused; a file that all seeds share stays a setting."""
    study, cells = described(str(tmp_path / "run_{seed}")), []
    for method in ("uniform", "p75"):
        moved(origin, tmp_path / "run_1", method.encode())
        cells += plan.expand(study, seeds=[1], methods=[method])
        shutil.rmtree(tmp_path / "run_1")
    with pytest.raises(
        RunError, match="The cells of seed 1 in environment 'after' began with 2 different sets of files"
    ):
        check_comparable(map(identity, cells))
    moved(origin, tmp_path / "other", b"x")
    cells = [*plan.expand(described(origin), seeds=[1]), *plan.expand(described(tmp_path / "other"), seeds=[2])]
    with pytest.raises(RunError, match="run with 2 different settings"):
        check_comparable(map(identity, cells))


def test_a_cell_begins_where_the_run_ended(origin, tmp_path):
    """A worker trains a branch: its policy is the run's while critics learn first, and its row is like any other."""
    study = StudyFolder(tmp_path / "study")
    study.add(plan.expand(described(origin), seeds=[5], methods=["p75"]))
    (cell,) = study.cells()
    assert worker.run(study, cell)
    home = study.cell_path(cell)
    stored = json.loads((home / "run" / "config.json").read_text())
    assert stored["branch_from"] == str(origin)
    ours, theirs = (training.load_checkpoint(RunFolder(path))["ppo"]["actor"] for path in (home / "run", origin))
    assert all(bool((ours[name] == theirs[name]).all()) for name in theirs)  # two rollouts, fewer than WARM_UP
    assert {row["goals"] for row in study.results().rows} == {"naive", "scripted"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"train": {"num_envs": 64}}, "Environment 'after' cannot branch off .*: num_envs must be 32, as in"),
        ({"environment": [{"name": "a", "preset": "particle"}]}, "preset and branch_from cannot be combined"),
        ({"branch_from": 3}, "branch_from must be a text, got 3"),
        ({"branch_from": "nowhere"}, "nowhere"),
    ],
)
def test_what_cannot_branch_off_is_refused(origin, changes, message):
    """A study that would change what a branch shares with its run is refused in one line before anything runs."""
    with pytest.raises(RunError, match=message):
        plan.expand(described(origin, **changes), seeds=[0])


def test_files_of_an_environment_are_part_of_the_hash(tmp_path, monkeypatch):
    """A terrain counts by its content, wherever it lies: another one under the same name makes another cell."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study.toml").write_text(QUAD)
    with pytest.raises(RunError, match=r"hills\.npz"):
        plan.expand(plan.read(tmp_path / "study.toml"))
    found = []
    for name, content in (("hills.npz", b"one"), ("hills.npz", b"two"), ("moved.npz", b"one")):
        (tmp_path / name).write_bytes(content)
        (tmp_path / "study.toml").write_text(QUAD.replace("hills.npz", name))
        found += plan.expand(plan.read(tmp_path / "study.toml"))
    one, two, moved = found
    assert set(one.sources) == {"code", "terrain"}
    assert one.digest == moved.digest
    assert one.digest != two.digest
    assert one.setting != two.setting
