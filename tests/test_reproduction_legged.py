"""The bases of the legged studies: trained in two stages, kept once, judged, attacked by what the others taught."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from deimos.checks import RunError
from deimos.run import presets, training
from deimos.run.evaluation import EvalConfig
from deimos.run.folder import RunFolder
from deimos.study import archive, cli, plan
from deimos.study import cell as worker
from deimos.study.folder import StudyFolder
from deimos.study.results import TABLES, Results, merge
from reproduction import legged_bases, legged_on_warp

SETTINGS = {"quad": ("rough", 500), "quad_arm": ("flat", 100)}
"""Ground and T of every robot's bases."""


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Two bases of each robot, of eight robots and one rollout in each stage, kept in a folder of the test's."""

    def preset(name: str):
        config = presets.preset(name)
        return replace(config, num_envs=8, ppo=replace(config.ppo, hidden=(8,)))

    robots = {
        name: replace(own, seeds=own.seeds[:2], stages=tuple((stage, 100) for stage, _ in own.stages), judged=(50,))
        for name, own in legged_bases.ROBOTS.items()
    }
    values = {
        "KEPT_IN": tmp_path / "kept", "POOL": tmp_path / "pool", "ROBOTS": robots, "preset": preset,
        "ATTACKS": EvalConfig(worlds=4, steps=100),
    }  # fmt: skip
    for name, value in values.items():
        monkeypatch.setattr(legged_bases, name, value)
    return tmp_path


@pytest.mark.parametrize("robot", SETTINGS)
def test_a_base_learns_in_two_stages_and_is_kept_once(robot: str, small: Path):
    """The second stage has the first one's networks; it is judged, can be branched off, and is not made again."""
    kept = legged_bases.base(robot, 0, small / "runs")
    own = legged_bases.ROBOTS[robot]
    config = training.read_config(RunFolder.open(kept))
    assert (config.env.terrain, config.env.goal_period) == SETTINGS[robot]
    assert (config.seed, config.method, kept.name) == (own.seeds[0], "uniform", f"{robot}_base_1")
    assert config.env.episode_steps >= 2 * config.env.goal_period
    first = small / "runs" / kept.name / own.stages[0][0]
    assert RunFolder.open(kept).read_json("config.json")["init_from"] == str(first)
    before = (kept / "checkpoint.pt").read_bytes()
    assert legged_bases.base(robot, 0, small / "other") == kept
    assert (kept / "checkpoint.pt").read_bytes() == before
    assert not (small / "other").exists()
    assert [(row["goals"], row["goal_period"]) for row in legged_bases.judge(kept, own.judged)] == [("naive", 50)]
    assert len(RunFolder.open(kept).read_rows("evaluation.json")) == 1  # judged once, before anything branches off
    branch = replace(config, env=replace(config.env, goal_period=100), seed=0)
    trainer, _ = training.start(branch, small / "branch", branch_from=kept)
    assert trainer.config.env.goal_period == 100


def test_no_policy_teaches_its_own_attacker(small: Path, monkeypatch: pytest.MonkeyPatch):
    """The pool of a base is made of the other bases of its robot."""
    made = {}
    monkeypatch.setattr(
        legged_bases, "base", lambda robot, index, root: root / legged_bases.base_name(robot, index)
    )  # fmt: skip
    monkeypatch.setattr(legged_bases, "pool", lambda folders, path: made.update({path.stem: [f.name for f in folders]}))
    monkeypatch.setattr(legged_bases, "note_checksums", lambda: None)
    monkeypatch.setattr("sys.argv", ["legged_bases", str(small)])
    legged_bases.main()
    assert made == {
        f"{robot}_base_{i}": [f"{robot}_base_{3 - i}"] for robot in ("quad", "quad_arm") for i in (1, 2)
    }  # fmt: skip


def test_no_seed_is_used_twice():
    """Every base has a seed of its own."""
    seeds = [seed for own in legged_bases.ROBOTS.values() for seed in own.seeds]
    assert len(set(seeds)) == len(seeds)


def test_policies_are_judged_on_the_other_engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A finished policy has a row on mujoco-warp, of an environment of its own that merges with the study's tables.

    Where the study's folder was lost, its archive and tables give the same row; where the row is in tables, they do.
    """
    monkeypatch.setattr(legged_on_warp, "EVALUATION", EvalConfig(worlds=4, steps=200, attackers=()))
    table = {"name": "quad", "env": {"kind": "quad", "goal_period": 100, "engine": "native"}}
    train = {"num_envs": 4, "env_steps": 24, "ppo": {"hidden": [8]}, "device": "cpu",
             "eval": {"worlds": 4, "steps": 200, "attackers": []}}  # fmt: skip
    described = {"methods": ["uniform", "p75"], "audit_worlds": 0, "train": train, "environment": [table]}
    study = StudyFolder(tmp_path / "study")
    study.add(plan.expand(described, seeds=[1, 2]))
    (cell,) = [cell for cell in study.cells() if (cell.config.method, cell.config.seed) == ("p75", 2)]
    assert worker.run(study, cell)
    monkeypatch.setattr("sys.argv", ["legged_on_warp", str(study.path), str(tmp_path / "warp"), "--seeds", "2-2"])
    legged_on_warp.main()
    merge(tmp_path / "all", [study.path, tmp_path / "warp"])
    native, warp = Results.read(tmp_path / "all").rows
    assert (native["environment"], warp["environment"]) == ("quad", "quad_on_warp")
    assert (warp["method"], warp["seed"], warp["goals"], warp["goal_period"]) == ("p75", 2, "naive", 100)
    assert warp["hash"] != native["hash"]
    assert {row["engine"] for row in RunFolder(study.cell_path(cell) / "run").read_rows("evaluation.json")} == {
        "native", "warp",
    }  # fmt: skip
    curves = Results.read(tmp_path / "all").curves
    assert curves[0]["crashes_per_1000"] == curves[1]["crashes_per_1000"] != ()  # one training
    with pytest.raises(RunError, match="no finished policies of these methods and seeds"):
        legged_on_warp.judge(study, StudyFolder(tmp_path / "other"), ["uniform"], [])

    lost = StudyFolder(tmp_path / "lost")
    cli.PackOptions(folder=study.path).run()
    merge(lost.path, [study.path])
    shutil.copy2(study.path / archive.FILE, lost.path)
    archive.unpack(lost)
    legged_on_warp.judge(lost, StudyFolder(tmp_path / "from_archive"), [], [])
    for name in ("from_archive", "warp"):
        merge(tmp_path / f"{name}_tables", [tmp_path / name])
    kept = StudyFolder(tmp_path / "warp_tables")
    for name in TABLES:
        assert (tmp_path / "from_archive_tables" / name).read_bytes() == (kept.path / name).read_bytes()
    monkeypatch.setattr(legged_on_warp, "evaluate_run", None)
    legged_on_warp.judge(lost, kept, [], [])
