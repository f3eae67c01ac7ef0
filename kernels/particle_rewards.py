"""The particle's reward, which maps a distance to the goal to a number in (0, 1].

To add a shape, write one ``@wp.func`` here, name it in ``RewardName`` and ``RewardShape``, and give it a branch in
``shape_reward``; the configuration, the command line and the tests find it by its name.
"""

from enum import IntEnum
from typing import Literal

import warp as wp

from .check import require

wp.set_module_options({"enable_backward": False})


RewardName = Literal["linear", "reciprocal", "exponential"]
"""Names of the shapes in a configuration."""


class RewardShape(IntEnum):
    """The shapes that ``shape_reward`` knows, by their names in upper case."""

    LINEAR = 0
    RECIPROCAL = 1
    EXPONENTIAL = 2


@wp.func
def linear(distance: float, largest: float) -> float:
    """1 at the goal, falling evenly; the 1 % of slack keeps it positive at the largest distance."""
    return 1.0 - distance / (1.01 * largest)


@wp.func
def reciprocal(distance: float, length: float) -> float:
    """1 at the goal, 1/2 at ``length``; its gradient never quite vanishes."""
    return length / (length + distance)


@wp.func
def exponential(distance: float, length: float) -> float:
    """1 at the goal, 1/e at ``length``; flat, and at last 0 in float32, far away."""
    return wp.exp(-distance / length)


@wp.func
def shape_reward(shape: int, distance: float, largest: float, length: float) -> float:
    """Reward of a distance; every thread takes the same branch.

    Args:
        shape: One of ``RewardShape``.
        distance: Distance to the goal, at least 0.
        largest: The largest distance that can occur (``LINEAR``).
        length: The distance of 1/2 (``RECIPROCAL``) or of 1/e (``EXPONENTIAL``).
    """
    if shape == wp.static(int(RewardShape.LINEAR)):
        return linear(distance, largest)
    if shape == wp.static(int(RewardShape.RECIPROCAL)):
        return reciprocal(distance, length)
    return exponential(distance, length)


@wp.kernel
def _reward_distances(
    # In
    distance: wp.array[float],
    shape: int,
    largest: float,
    length: float,
    # Out
    reward: wp.array[float],
):
    i = wp.tid()
    reward[i] = shape_reward(shape, distance[i], largest, length)


def reward_distances(
    distance: wp.array, reward: wp.array, *, shape: RewardShape, largest: float, length: float
) -> None:
    """Compute rewards for distances that no step has measured, such as those to goals that were not pursued.

    Args:
        distance: Distances to the goal, at least 0, shape (n,).
        reward: Their rewards, shape (n,). Overwritten.
        shape: How a distance becomes a reward.
        largest: The largest distance that can occur, positive, in the unit of ``distance`` (``LINEAR``).
        length: The distance of 1/2 (``RECIPROCAL``) or of 1/e (``EXPONENTIAL``), positive.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("distance", distance, dtype=wp.float32)
    require("reward", reward, like=distance)
    wp.launch(
        _reward_distances, dim=len(distance), inputs=[distance, int(shape), largest, length], outputs=[reward],
        device=distance.device,
    )  # fmt: skip
