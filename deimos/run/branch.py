"""Runs that branch off another run: its networks, optimiser and worlds, under another method or another task.

Branches compare methods that start from the same policy in the same worlds. What is random, or belongs to the choice
of goals, is new: seed, draws, pending interactions, selector and budget.
"""

from dataclasses import replace
from typing import Any

from deimos.run.config import to_dict
from deimos.run.trainer import TrainConfig

WARM_UP = 10  # rollouts in which critics learn before the policy does: a selector's has learnt nothing yet
MAY_DIFFER = (
    "method", "selector", "seed", "env_steps", "critic_warmup", "eval", "evaluation", "device", "threads",
    "tf32", "graph", "log", "video_every", "env.crash_penalty", "env.goal_period", "env.engine",
)  # fmt: skip


def branch_config(origin: TrainConfig) -> TrainConfig:
    """The default configuration of a branch of a run: the run's own, except for the method.

    Its seed is the next one, and critics learn for ``WARM_UP`` rollouts before the policy does. Branches that are
    compared must share both.
    """
    return replace(
        origin, method=None, selector=None, seed=(origin.seed + 1) % 2**32, critic_warmup=WARM_UP, device="auto",
        threads=0,
    )  # fmt: skip


def check_branch(config: TrainConfig, origin: TrainConfig) -> None:
    """Raise ``ValueError`` for the first field of a branch that differs from its origin's and must not."""
    ours, theirs = _fields(config), _fields(origin)
    for name in sorted(ours.keys() | theirs.keys(), key=lambda name: (name != "env.kind", name)):
        if ours.get(name) != theirs.get(name):
            raise ValueError(f"{name} must be {theirs.get(name)}, as in the origin, got {ours.get(name)}.")


def _fields(config: TrainConfig) -> dict[str, Any]:
    """All that must be the same, by the names of the command line; for files, a hash of their contents."""
    fields = flat(to_dict(config) | {"env": to_dict(config.env) | config.env.file_hashes()})
    free = tuple(f"{name}." for name in MAY_DIFFER)
    return {name: value for name, value in fields.items() if not f"{name}.".startswith(free)}


def flat(data: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested dictionary with dots between the names."""
    found: dict[str, Any] = {}
    for name, value in data.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return found
