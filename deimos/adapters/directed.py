"""A Director in gymnasium's training loops, and what wrappers for other libraries have in common with it."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Dict, Space
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from deimos.goals.director import GoalDirector

Observation = np.ndarray | dict[str, np.ndarray]
"""Observations of all worlds: shape (num_envs, obs_dim), or arrays by key, worlds along the first axis."""
Reward = Callable[[Observation, np.ndarray], np.ndarray]
"""Gives the rewards, shape (num_envs,), of steps from the observations that they ended in, which hold the goals that
were in force, and the rewards of the environment."""


class GoalSlot:
    """The place of the goal in every observation, and the Director that fills it.

    Args:
        director: Chooses the goals, on its own clock; it must have a ``goal_box``.
        space: Observation space of one world: a ``Box`` of one axis, or a ``Dict``.
        num_envs: Number of worlds.
        where: The goal's components of a ``Box``, or its key in a ``Dict``, of a floating-point type.
        next_step: Whether a world that is done is reset in a separate step.

    Raises:
        ValueError: If the space has no such place, or holds whole numbers there, or has entries that are no arrays.
    """

    def __init__(
        self, director: GoalDirector, space: Space, num_envs: int, where: slice | str, next_step: bool = False
    ) -> None:
        _check_place(space, where)
        self.director, self._next_step = director, next_step
        self.where: Any = where  # a key of dictionaries, else a slice of arrays
        self._space, self._spaces = space, batch_space(space, num_envs)
        self.goal = self.read(create_empty_array(space, num_envs)).copy()
        """The goals in force, shape (num_envs, goal_dim); zeros before the first reset."""

    def begin(self, obs: Observation, where: np.ndarray | None = None) -> Observation:
        """Write first goals into the observations of worlds that begin an episode; what is pending there is dropped.

        Args:
            obs: Observations of all worlds.
            where: Which of them begin an episode, bool, shape (num_envs,); ``None`` for all.
        """
        rows = slice(None) if where is None else where
        self.director.reset(where)
        self.goal = self.goal.copy()  # observations may share it
        # No goal is active: what the worlds have put into its place, such as NaN, does not matter.
        self.goal[rows] = self.director.propose(where, self.state(obs)[rows], np.zeros_like(self.goal[rows]))
        return self.write(obs)

    def ended(self, obs: Observation, last: dict[int, Observation]) -> Observation:
        """Observations that the last step ended in, with the goals that were in force.

        Args:
            obs: Observations after the step: those after the reset where a world has been reset in it.
            last: For each such world, the observation that its episode ended in. Its goal is overwritten.
        """
        if last:
            worlds = [last.get(world, own) for world, own in enumerate(iterate(self._spaces, obs))]
            obs = concatenate(self._space, worlds, create_empty_array(self._space, len(worlds)))
        obs = self.write(obs)
        if last:
            worlds = list(iterate(self._spaces, obs))
            last.update({world: worlds[world] for world in last})
        return obs

    def advance(self, obs: Observation, terminated: np.ndarray, truncated: np.ndarray) -> Observation:
        """Resolve the last step and choose the goals that are due; returns the observations with the goals to pursue.

        Args:
            obs: Observations to act on next.
            terminated: True where the world crashed, bool, shape (num_envs,).
            truncated: True where its episode was cut off without a crash, bool, shape (num_envs,).

        Raises:
            ValueError: If the Director expects resets at another time.
        """
        chosen = self.director.step(self.state(obs), self.goal, terminated, truncated)
        if (chosen.changed[terminated | truncated] == self._next_step).any():
            mode = (AutoresetMode.NEXT_STEP if self._next_step else AutoresetMode.SAME_STEP).value
            raise ValueError(f"director must be made with autoreset='{mode}', as these worlds are reset.")
        self.goal = chosen.goal
        return self.write(obs)

    def checked(self, reward: np.ndarray) -> np.ndarray:
        """The rewards as an array, if there is one for each world: others would be broadcast.

        Raises:
            ValueError: If they have another shape.
        """
        rewards = np.asarray(reward)
        if rewards.shape != (len(self.goal),):
            raise ValueError(f"reward must give the shape {(len(self.goal),)}, got {rewards.shape}.")
        return rewards

    def state(self, obs: Observation) -> np.ndarray:
        """Everything but the goal, float32, shape (num_envs, state_dim)."""
        if isinstance(obs, Mapping):
            parts = [part.reshape(len(part), -1) for key, part in obs.items() if key != self.where]
            return np.concatenate(parts, axis=1, dtype=np.float32)
        return np.delete(obs, self.where, axis=1).astype(np.float32)

    def read(self, obs: Observation) -> np.ndarray:
        """What is in the place of the goal, shape (num_envs, goal_dim)."""
        return obs[self.where] if isinstance(obs, Mapping) else obs[:, self.where]

    def write(self, obs: Observation) -> Observation:
        """A copy of the observations with the goals in force."""
        if isinstance(obs, Mapping):
            return {**obs, self.where: self.goal}
        obs = obs.copy()
        obs[:, self.where] = self.goal
        return obs


def _check_place(space: Space, where: slice | str) -> None:
    """Raise ``ValueError`` unless ``where`` is a place for goals in the space of a world's observations."""
    parts = space.spaces if isinstance(space, Dict) else None
    if not isinstance(where, slice if parts is None else str) or (parts is not None and where not in parts):
        raise ValueError(f"where must be a key of a Dict or a slice of a Box, got {where!r} for {space}.")
    place = space if parts is None else parts[where]
    if place.dtype is None or not np.issubdtype(place.dtype, np.floating):
        raise ValueError(f"where must be a place for fractions, which goals have, got {where!r} of {place.dtype}.")
    if place.shape is None or len(place.shape) != 1:
        raise ValueError(f"where must be a place of one axis, got {where!r} for {place}.")
    components = 0
    for key, part in {"": space}.items() if parts is None else parts.items():
        if part.shape is None:  # the Director sees numbers
            raise ValueError(f"Observations must hold arrays alone, got {part} for {key!r}; flatten it.")
        components += math.prod(part.shape)
    goals = len(range(*where.indices(components))) if isinstance(where, slice) else place.shape[0]
    if not 0 < goals < components:
        raise ValueError(f"where must leave components for the goal and for the state, got {where!r} for {space}.")


class DirectedVectorEnv(gymnasium.vector.VectorWrapper):
    """Worlds whose goals a Director chooses: it overwrites the goal in every observation, and the reward follows it.

    Args:
        env: The worlds, which reset themselves. A termination is a crash.
        director: Chooses the goals, on its own clock; it must have a ``goal_box`` and the worlds' ``autoreset``.
        where: The goal's components of a ``Box``, or its key in a ``Dict``.
        reward: Rewards for the goals in force; see ``Reward``.

    Raises:
        ValueError: If observations have no such place, or ``env`` does not reset worlds that are done or say how.
    """

    def __init__(
        self, env: gymnasium.vector.VectorEnv, director: GoalDirector, where: slice | str, reward: Reward
    ) -> None:
        super().__init__(env)
        known = env.metadata.get("autoreset_mode")
        self._mode = AutoresetMode(known or AutoresetMode.DISABLED)  # some name the mode by its value
        if self._mode is AutoresetMode.DISABLED:
            raise ValueError(
                f"env must reset worlds that are done by itself, got {known} for its metadata['autoreset_mode']."
            )
        next_step = self._mode is AutoresetMode.NEXT_STEP
        self.slot = GoalSlot(director, env.single_observation_space, env.num_envs, where, next_step)
        self._reward, self._over = reward, np.zeros(env.num_envs, dtype=bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """See ``VectorEnv.reset``; every world, or those of a ``reset_mask`` in the options, get a first goal."""
        where = (options or {}).get("reset_mask")  # before the worlds remove it
        obs, infos = self.env.reset(seed=seed, options=options)
        self._over[slice(None) if where is None else where] = False
        return self.slot.begin(obs, where), infos

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """See ``VectorEnv.step``; what an episode ended in, and its reward, are for the goal that was in force.

        Raises:
            ValueError: If there are not as many rewards as worlds, or as in ``GoalDirector.step``.
        """
        obs, reward, terminated, truncated, infos = self.env.step(actions)
        last = {int(world): infos["final_obs"][world] for world in np.flatnonzero(infos.get("_final_obs", False))}
        reward = np.where(self._over, reward, self.slot.checked(self._reward(self.slot.ended(obs, last), reward)))
        for world, observation in last.items():
            infos["final_obs"][world] = observation
        if self._mode is AutoresetMode.NEXT_STEP:  # the next step of these worlds is their reset
            self._over = terminated | truncated
        return self.slot.advance(obs, terminated, truncated), reward, terminated, truncated, infos
