"""The memory that a run needs, estimated before it starts.

Systems promise more memory than they have, and would kill the process halfway. Each estimate counts only what is
certain, so that nothing that would fit is refused.
"""

import math
import os
import re

import torch

from deimos.checks import RunError

LEAST_BYTES = 100  # of any transition, of any world, and of any interaction that is kept
NUMBER_BYTES = 4  # float32
_SHORTAGE = re.compile(
    "out of memory|allocate|alloc_failed|allowed dimension|too big|storage size|representable|overflow", re.IGNORECASE
)
"""Words by which Warp, torch and NumPy report that an array does not fit."""


def is_shortage(error: BaseException) -> bool:
    """Whether an error reports a lack of memory."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError | ValueError) and bool(
        _SHORTAGE.search(str(error))
    ))  # fmt: skip


def total(device: torch.device) -> float:
    """Memory of a device [B]; infinite where the system does not say."""
    if device.type == "cuda":
        return float(torch.cuda.get_device_properties(device).total_memory)
    return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")) if hasattr(os, "sysconf") else math.inf


def require(what: str, need: float, device: torch.device, way_out: str) -> None:
    """Raise ``RunError`` if something needs more memory [B] than a device has.

    Args:
        what: What needs it: the first words of the message.
        need: How much it needs at least [B].
        device: Where it is allocated.
        way_out: What to do about it: the last words of the message.
    """
    has = total(device)
    if need > has:
        here, need_gib, has_gib = "this machine" if device.type == "cpu" else "this GPU", need / 2**30, has / 2**30
        raise RunError(
            f"{what} need more than {need_gib:,.0f} GiB of memory, and {here} has {has_gib:,.0f} GiB; {way_out}."
        )


def require_worlds(num_envs: int, num_steps: int, device: torch.device) -> None:
    """``require`` for worlds, shape (num_envs,), and their rollout of ``num_steps`` steps."""
    each = (num_steps + 1) * LEAST_BYTES
    what = f"{num_envs} worlds, each at least {each / 2**10:.0f} KiB,"
    require(what, num_envs * each, device, "use fewer (num_envs)")


def require_candidates(num_envs: int, num_candidates: int, goal_dim: int, device: torch.device) -> None:
    """``require`` for the candidates of all worlds at once, each a goal of ``goal_dim`` numbers."""
    need = num_envs * num_candidates * goal_dim * NUMBER_BYTES
    require(f"{num_candidates} candidates in each of {num_envs} worlds", need, device, "use fewer (candidates)")


def require_interactions(what: str, worlds: int, steps: int, period: int, device: torch.device, way_out: str) -> None:
    """``require`` for all interactions of ``steps`` steps, one every ``period``; for the other arguments see there."""
    need = worlds * (steps / period + 1) * LEAST_BYTES
    require(f"{what}, {steps} steps of {worlds} worlds,", need, device, way_out)
