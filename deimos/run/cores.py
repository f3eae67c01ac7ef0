"""How many CPU cores a process may use."""

import os
from collections.abc import Iterator
from pathlib import Path

CONTROL_GROUPS = Path("/sys/fs/cgroup")
OWN_GROUPS = Path("/proc/self/cgroup")


def cores() -> int:
    """CPU cores that this process may use: those of its affinity, at most the whole cores of its container's quota."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([count, *map(int, _quotas())]))


def _quotas() -> Iterator[float]:
    """CPU time per second that each control group around this process may use [cores]; only on Linux."""
    for group in _groups():
        try:
            if group.is_relative_to(CONTROL_GROUPS / "cpu"):  # version 1
                names = ("cpu.cfs_quota_us", "cpu.cfs_period_us")
                quota, period = (float((group / name).read_text()) for name in names)
            else:
                quota, period = map(float, (group / "cpu.max").read_text().split())
        except (OSError, ValueError):  # there is none here, or it is "max"
            continue
        if quota > 0 and period > 0:  # version 1 says -1 for none
            yield quota / period


def _groups() -> Iterator[Path]:
    """Folders of the control groups that this process may be in.

    A container sees its own group at the top, whatever path the host knows it by, so the top is always among them.
    """
    try:
        lines = OWN_GROUPS.read_text().splitlines()
    except OSError:
        return
    for line in lines:  # such as 0::/user.slice, or 4:cpu,cpuacct:/docker/1f2e
        _, controllers, path = line.split(":", 2)
        if controllers == "" or "cpu" in controllers.split(","):
            top = CONTROL_GROUPS / "cpu" if controllers else CONTROL_GROUPS
            inner = Path(path.lstrip("/"))
            yield from (top / part for part in (inner, *inner.parents))
