"""What stands where in an observation: environments lay it out, policies carry it with them."""

from dataclasses import dataclass
from typing import Literal


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
