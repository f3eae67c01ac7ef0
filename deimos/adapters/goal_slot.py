"""A Director that writes its goals into somebody else's observations: what wrappers of all libraries have in common."""

from collections.abc import Callable, Mapping

import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from deimos.goals.director import GoalDirector

Observation = np.ndarray | dict[str, np.ndarray]
"""Observations of all worlds: shape (num_envs, obs_dim), or arrays by key, worlds along the first axis."""
Reward = Callable[[Observation, np.ndarray], np.ndarray]
"""Rewards, shape (num_envs,), of steps from the observations that they ended in, which hold the goals that were in
force, and from the rewards of the environment."""


class GoalSlot:
    """The place of the goal in every observation, and the Director that fills it.

    Args:
        director: Who chooses the goals.
        space: Observation space of one world: a ``Box`` of one axis, or a ``Dict`` of such boxes.
        num_envs: Number of worlds.
        where: The goal's components of a ``Box``, or its key in a ``Dict``.
        goals: What goals are drawn from uniformly, a bounded ``Box`` of shape (goal_dim,); ``None`` for the bounds of
            its place in ``space``.
        seed: Seed of the candidates and of the first goals.

    Raises:
        ValueError: If the space has no such place, or the goals no bounds.
    """

    def __init__(
        self, director: GoalDirector, space: Space, num_envs: int, where: slice | str, goals: Box | None = None,
        seed: int = 0,
    ) -> None:  # fmt: skip
        if not isinstance(where, str if isinstance(space, Dict) else slice) or (
            isinstance(space, Dict) and where not in space.spaces
        ):
            raise ValueError(f"where must be a key of a Dict or a slice of a Box, got {where!r} for {space}.")
        if goals is None:
            place = space[where] if isinstance(space, Dict) else Box(space.low[where], space.high[where])
            goals = Box(place.low, place.high)
        if not goals.is_bounded():
            raise ValueError(f"goals must be a bounded Box, got {goals}; say what goals are drawn from.")
        self.director, self.where, self.goals, self.num_envs = director, where, goals, num_envs
        self._space, self._spaces = space, batch_space(space, num_envs)
        self._generator = np.random.default_rng(seed)
        self.goal: np.ndarray
        """The goals in force, float32, shape (num_envs, goal_dim)."""

    def begin(self, obs: Observation) -> Observation:
        """First goals, uniform, for all worlds; returns the observations with them."""
        self.goal = self._draw(1)[:, 0]
        return self.write(obs)

    def ended(self, obs: Observation, last: dict[int, Observation]) -> Observation:
        """Observations that the last step ended in, with the goals that were in force.

        Args:
            obs: Observations after the step: those after the reset where a world is done.
            last: By world that is done, the observation that its episode ended in. Its goal is overwritten.
        """
        if last:
            worlds = [last.get(world, own) for world, own in enumerate(iterate(self._spaces, obs))]
            obs = concatenate(self._space, worlds, create_empty_array(self._space, self.num_envs))
        obs = self.write(obs)
        if last:
            worlds = list(iterate(self._spaces, obs))
            last.update({world: worlds[world] for world in last})
        return obs

    def advance(self, obs: Observation, terminated: np.ndarray, truncated: np.ndarray) -> Observation:
        """What the last step decided, and the goals that are due; returns the observations with the goals to pursue.

        Args:
            obs: Observations to act on next: those after the reset where a world is done.
            terminated: True where the world crashed, bool, shape (num_envs,).
            truncated: True where its episode was cut off without a crash, bool, shape (num_envs,).
        """
        given = self.state(obs), self.goal, terminated, truncated, self._draw(100)
        chosen = self.director.step(*(torch.as_tensor(array) for array in given))
        self.goal = chosen.goal.numpy()
        return self.write(obs)

    def state(self, obs: Observation) -> np.ndarray:
        """Everything but the goal, float32, shape (num_envs, state_dim)."""
        if isinstance(obs, Mapping):
            parts = [array.reshape(len(array), -1) for key, array in obs.items() if key != self.where]
            return np.concatenate(parts, axis=1, dtype=np.float32)
        return np.delete(obs, self.where, axis=1).astype(np.float32)

    def write(self, obs: Observation) -> Observation:
        """A copy of the observations with the goals in force."""
        if isinstance(obs, Mapping):
            return {**obs, self.where: self.goal.astype(obs[self.where].dtype)}
        obs = obs.copy()
        obs[:, self.where] = self.goal
        return obs

    def _draw(self, count: int) -> np.ndarray:
        size = self.num_envs, count, *self.goals.shape
        return self._generator.uniform(self.goals.low, self.goals.high, size).astype(np.float32)
