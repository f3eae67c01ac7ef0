"""Fear over two components of a new goal."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from numbers import Integral

import numpy as np
from torch import Tensor

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
    known, dims, named = _plain(goal), len(goal), [*axes] if isinstance(axes, Iterable) else [axes]
    there = all(isinstance(axis, Integral) and 0 <= int(axis) < dims for axis in named)
    if len(named) != 2 or len({*named}) != 2 or not there:
        raise ValueError(f"axes must be two different components in [0, {dims}), got {named}.")
    if isinstance(axes, Mapping):
        x, y = map(_plain, axes.values())
    elif box is not None:
        x, y = (np.linspace(low, high, POINTS, dtype=np.float32) for low, high in box.ends(axes))
    else:
        raise ValueError(f"axes must come with their values where there is no goal_box, as {{0: [...]}}, got {axes}.")
    if x.ndim != 1 or y.ndim != 1:
        raise ValueError(f"The values of axes must have the shape (n,) each, got {x.shape} and {y.shape}.")
    first, second = named
    goals = np.tile(known, (len(y), len(x), 1))
    goals[..., first], goals[..., second] = x, y[:, None]
    return x, y, goals.reshape(-1, dims)


def _plain(values: Array) -> np.ndarray:
    """Numbers of any kind, float32; NumPy does not read tensors of another device, of bfloat16 or with gradients."""
    values = values.detach().float().cpu() if isinstance(values, Tensor) else values
    return np.asarray(values, dtype=np.float32)
