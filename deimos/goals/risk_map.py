"""Fear over two components of a new goal."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from deimos.goals.given import Array, GoalBox

POINTS = 41  # values of a component by default


@dataclass(frozen=True)
class RiskMap:
    """Fear over two components of a new goal, for a plot such as ``plt.pcolormesh(map.x, map.y, map.probability)``."""

    x: np.ndarray
    """Values of the first component, shape (n,)."""
    y: np.ndarray
    """Values of the second one, shape (m,)."""
    probability: np.ndarray
    """Calibrated probability that the policy crashes, in (0, 1), shape (m, n)."""
    auroc: float
    """See ``FearEstimate``."""
    age: int
    """See ``FearEstimate``."""


def grid(
    goal: Array, axes: Mapping[int, Array] | tuple[int, int], box: GoalBox | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values of the first component, shape (n,), and of the second, (m,), and goals of all pairs, (m n, goal_dim).

    For the arguments and errors see ``GoalDirector.risk_map``.
    """
    known, dims = np.asarray(goal, dtype=np.float32), len(goal)
    if len(axes) != 2 or len({*axes}) != 2 or not all(0 <= axis < dims for axis in axes):
        raise ValueError(f"axes must be two different components in [0, {dims}), got {list(axes)}.")
    if isinstance(axes, Mapping):
        x, y = (np.asarray(values, dtype=np.float32) for values in axes.values())
    elif box is not None:
        x, y = (np.linspace(low, high, POINTS, dtype=np.float32) for low, high in box.ends(axes))
    else:
        raise ValueError(f"axes must come with their values where there is no goal_box, as {{0: [...]}}, got {axes}.")
    if x.ndim != 1 or y.ndim != 1:
        raise ValueError(f"The values of axes must have the shape (n,) each, got {x.shape} and {y.shape}.")
    first, second = axes
    goals = np.tile(known, (len(y), len(x), 1))
    goals[..., first], goals[..., second] = x, y[:, None]
    return x, y, goals.reshape(-1, dims)
