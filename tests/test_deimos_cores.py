"""CPU cores that a process may use: its affinity, and the quotas of its control groups."""

import os

import pytest

from deimos.run import cores as module
from deimos.run.cores import cores


@pytest.fixture
def groups(tmp_path, monkeypatch):
    """Writes the files of control groups, and what the process says of its own."""
    monkeypatch.setattr(module, "CONTROL_GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(module, "OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)

    def write(own, **files):
        (tmp_path / "own").write_text(own)
        for name, text in files.items():
            path = tmp_path / "cgroup" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    return lambda own, files: write(own, **files)


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {}, 8),
        ("0::/\n", {"cpu.max": "300000 100000\n"}, 3),
        ("0::/\n", {"cpu.max": "max 100000\n"}, 8),
        ("0::/\n", {"cpu.max": "250000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "50000 100000\n"}, 1),
        ("0::/\n", {"cpu.max": "5000000 100000\n"}, 8),
        ("0::/a/b\n", {"a/cpu.max": "400000 100000\n", "a/b/cpu.max": "max 100000\n"}, 4),
        ("0::/docker/elsewhere\n", {"cpu.max": "200000 100000\n"}, 2),
        ("2:cpu,cpuacct:/\n", {"cpu/cpu.cfs_quota_us": "600000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 6),
        ("2:cpu,cpuacct:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
        ("7:cpuset:/\n1:cpu:/d\n0::/\n", {"cpu/d/cpu.cfs_quota_us": "200000", "cpu/d/cpu.cfs_period_us": "50000"}, 4),
        ("0::/\n", {"cpu.max": "nonsense\n"}, 8),
    ],
)
def test_quotas_count(groups, own, files, expected):
    """The whole cores of the smallest quota of any group around the process count, in both versions; one at least."""
    groups(own, files)
    assert cores() == expected


def test_without_control_groups_the_affinity_counts(tmp_path, monkeypatch):
    """Where the system has no control groups, all cores of the affinity are there."""
    monkeypatch.setattr(module, "OWN_GROUPS", tmp_path / "nowhere")
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 3, 5}, raising=False)
    assert cores() == 3
