"""The bases of the legged studies: trained flat, then rough, kept once, and attacked by what the others taught."""

from dataclasses import replace
from pathlib import Path

import pytest

from deimos.run import presets, training
from deimos.run.folder import RunFolder
from reproduction import legged_bases


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Two bases of eight robots and one rollout on each ground, kept in a folder of the test's."""

    def preset(name: str):
        config = presets.preset(name)
        return replace(config, num_envs=8, ppo=replace(config.ppo, hidden=(8,)))

    values = {
        "BASES": tmp_path / "kept", "POOL": tmp_path / "pool", "SEEDS": (7001, 7002), "FLAT": 100, "ROUGH": 100,
        "preset": preset,
    }  # fmt: skip
    for name, value in values.items():
        monkeypatch.setattr(legged_bases, name, value)
    return tmp_path


def test_a_base_walks_flat_first_and_is_kept_once(small: Path):
    """The rough run has the flat one's networks and seed, its folder can be branched off, and it is not made again."""
    kept = legged_bases.base(0, small / "runs")
    config = training.read_config(RunFolder.open(kept))
    assert (config.seed, config.env.terrain, config.env.goal_period, config.method) == (7001, "rough", 500, "uniform")
    assert RunFolder.open(kept).read_json("config.json")["init_from"] == str(small / "runs/base_1/flat")
    before = (kept / "checkpoint.pt").read_bytes()
    assert legged_bases.base(0, small / "other") == kept
    assert (kept / "checkpoint.pt").read_bytes() == before
    assert not (small / "other").exists()
    branch = replace(config, env=replace(config.env, goal_period=100), seed=0)
    trainer, _ = training.start(branch, small / "branch", branch_from=kept)
    assert trainer.config.env.goal_period == 100


def test_no_policy_teaches_its_own_attacker(small: Path, monkeypatch: pytest.MonkeyPatch):
    """The pool of a base is made of the other bases."""
    made = {}
    monkeypatch.setattr(legged_bases, "base", lambda index, root: root / f"base_{index + 1}")
    monkeypatch.setattr(legged_bases, "pool", lambda folders, path: made.update({path.stem: [f.name for f in folders]}))
    monkeypatch.setattr(legged_bases, "note_checksums", lambda: None)
    monkeypatch.setattr("sys.argv", ["legged_bases", str(small)])
    legged_bases.main()
    assert made == {"quad_base_1": ["base_2"], "quad_base_2": ["base_1"]}
