"""The layout of an observation: environments define it, policies carry it with them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor


@dataclass(frozen=True)
class ObsField:
    """Consecutive components of an observation."""

    name: str
    size: int
    unit: str
    scale: float | tuple[float, ...]
    """The policy sees the physical value times this; one number for all components or one for each."""
    seen_by: Literal["both", "actor", "critic"] = "both"
    """Who sees it; what only the critic sees is privileged: only a simulator knows it. Both see the goal."""


Seen = slice | Tensor
"""An index of components of an observation: a slice for all, otherwise their numbers, int64."""
ALL = slice(None)


def seen_by(who: Literal["actor", "critic"], layout: Sequence[ObsField], device: torch.device) -> Seen:
    """The components that the actor, or the critic, sees."""
    shown = [field.seen_by in ("both", who) for field in layout for _ in range(field.size)]
    return ALL if all(shown) else torch.tensor(shown, device=device).nonzero().squeeze(1)


def count(seen: Seen, obs_dim: int) -> int:
    """How many of an observation's ``obs_dim`` components are seen."""
    return len(range(obs_dim)[seen]) if isinstance(seen, slice) else len(seen)


def goal_field(layout: Sequence[ObsField]) -> ObsField:
    """The field named ``goal``.

    Raises:
        ValueError: If no field has that name.
    """
    for field in layout:
        if field.name == "goal":
            return field
    raise ValueError("The layout has no field named 'goal'.")


def goal_slice(layout: tuple[ObsField, ...]) -> slice:
    """The components of the observation that the field named ``goal`` has.

    Raises:
        ValueError: If no field has that name.
    """
    field = goal_field(layout)
    start = sum(other.size for other in layout[: layout.index(field)])
    return slice(start, start + field.size)


@dataclass(frozen=True)
class GoalComponent:
    """One component of the goal."""

    name: str
    """Its group's name; followed by x, y or z in a group of two or three, by a number from 0 in a larger one."""
    unit: str
    """Unit of the physical value; 1 for none."""
    scale: float
    """The policy sees the physical value times this."""

    @property
    def label(self) -> str:
        """The name with the unit."""
        return self.name if self.unit == "1" else f"{self.name} [{self.unit}]"


def goal_components(
    layout: Sequence[ObsField], groups: Sequence[slice], group_names: Sequence[str]
) -> list[GoalComponent]:
    """The components of the goal, in order.

    Args:
        layout: Layout of the observation.
        groups: Components that belong together; every one is in one group.
        group_names: The groups' names.
    """
    field = goal_field(layout)
    names, units = [""] * field.size, field.unit.split(", ")
    if len(units) != field.size:
        units = [field.unit] * field.size
    for group, part in zip(group_names, groups, strict=True):
        members = range(field.size)[part]
        for k, place in enumerate(members):
            names[place] = group if len(members) == 1 else f"{group} {'xyz'[k] if len(members) <= 3 else k}"
    scales = field.scale if isinstance(field.scale, tuple) else (field.scale,) * field.size
    return [GoalComponent(*entry) for entry in zip(names, units, scales, strict=True)]
