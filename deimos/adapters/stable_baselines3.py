"""A Director in Stable-Baselines3's training loops."""

from typing import Any, cast

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from deimos.adapters.directed import GoalSlot, Observation, Reward
from deimos.goals.director import GoalDirector


class DirectedVecEnv(VecEnvWrapper):
    """Worlds whose goals a Director chooses: it overwrites the goal in every observation, and the reward follows it.

    A ``Monitor`` inside reports the worlds' own rewards: put a ``VecMonitor`` around it.

    Args:
        venv: The worlds. A termination is a crash; ``TimeLimit.truncated`` in an info is not.
        director: Chooses the goals, on its own clock; it must have a ``goal_box``.
        where: The goal's components of a ``Box``, or its key in a ``Dict``, of a floating-point type.
        reward: Rewards for the goals in force; see ``Reward``. ``None`` asks the worlds' own ``compute_reward``, which
            takes achieved goals, desired goals and infos, as in gymnasium-robotics.

    Raises:
        ValueError: If observations have no such place, or there is no ``reward`` where they have no ``achieved_goal``.
    """

    def __init__(
        self, venv: VecEnv, director: GoalDirector, where: slice | str = "desired_goal", reward: Reward | None = None
    ) -> None:
        super().__init__(venv)
        self.slot = GoalSlot(director, venv.observation_space, self.num_envs, where)
        if reward is None and "achieved_goal" not in getattr(venv.observation_space, "spaces", {}):
            raise ValueError("reward must be a function where observations have no achieved_goal, got None.")
        self._reward = reward

    def reset(self) -> Observation:
        """See ``VecEnv.reset``; every world gets a first goal."""
        return self.slot.begin(self.venv.reset())

    def step_wait(self) -> tuple[Observation, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """See ``VecEnv.step_wait``; the terminal observation of a world that is done holds the goal that was in force.

        The reward is for that goal, too.

        Raises:
            ValueError: If there are not as many rewards as worlds, or as in ``GoalDirector.step``.
        """
        obs, reward, dones, infos = self.venv.step_wait()
        last = {int(world): infos[world]["terminal_observation"] for world in np.flatnonzero(dones)}
        ended = self.slot.ended(obs, last)
        for world, observation in last.items():
            infos[world]["terminal_observation"] = observation
        if self._reward is None:
            goals = cast(dict, ended)
            both = goals["achieved_goal"], goals[self.slot.where]
            (reward,) = self.env_method("compute_reward", *both, np.array(infos), indices=[0])
        else:
            reward = self._reward(ended, reward)
        truncated = np.array([info.get("TimeLimit.truncated", False) for info in infos])
        reward = self.slot.checked(reward)
        return self.slot.advance(obs, dones & ~truncated, truncated), reward, dones, infos
