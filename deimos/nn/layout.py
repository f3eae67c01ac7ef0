"""What stands where in an observation: environments lay it out, policies carry it with them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor


@dataclass(frozen=True)
class ObsField:
    """A run of components of the observation."""

    name: str
    size: int
    unit: str
    scale: float | tuple[float, ...]
    """The policy sees the physical value times this; one number for all components or one for each."""
    seen_by: Literal["both", "actor", "critic"] = "both"
    """Who sees it; what only the critic sees is privileged, for a simulator alone. The goal is seen by both."""


Seen = slice | Tensor
"""Components of an observation, as what indexes them: all as a slice, else their numbers, int64."""
ALL = slice(None)


def seen_by(who: Literal["actor", "critic"], layout: Sequence[ObsField], device: torch.device) -> Seen:
    """The components that the actor, or the critic, sees."""
    shown = [field.seen_by in ("both", who) for field in layout for _ in range(field.size)]
    return ALL if all(shown) else torch.tensor(shown, device=device).nonzero().squeeze(1)


def count(seen: Seen, obs_dim: int) -> int:
    """How many components of an observation of ``obs_dim`` are seen."""
    return len(range(obs_dim)[seen]) if isinstance(seen, slice) else len(seen)


def goal_slice(layout: tuple[ObsField, ...]) -> slice:
    """Where the field named ``goal`` stands in the observation.

    Raises:
        ValueError: If there is none.
    """
    start = 0
    for field in layout:
        if field.name == "goal":
            return slice(start, start + field.size)
        start += field.size
    raise ValueError("The layout has no field named 'goal'.")
