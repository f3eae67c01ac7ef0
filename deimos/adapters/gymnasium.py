"""Environments as gymnasium's: many worlds as a ``VectorEnv``, one as an ``Env``."""

from functools import partial
from typing import ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from deimos.checks import check_at_least
from deimos.goals.selector import SelectorConfig
from deimos.goals.selectors import uniform
from deimos.run.loop import GoalLoop, spaces
from deimos.sim.env import EnvConfig


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv):
    """Many worlds, with NumPy arrays in and copies out; goals are issued within ``step``.

    Worlds that are done begin anew in the same step (``AutoresetMode.SAME_STEP``): what comes back is the first
    observation of the new episode, and ``infos["final_obs"]`` holds the last one of the old. ``loop`` leads to the
    environment, the selector and the interactions; every ``reset`` with a seed makes another one.

    Args:
        config: The environment.
        num_envs: Number of worlds, at least 1.
        seed: Seed of every draw, in [0, 2^32); ``reset`` may set another.
        device: Where they are simulated.
        selector: Who chooses their goals; ``None`` for Uniform. Nothing here lets it learn.
        env_offset: Global number of world 0; see ``EnvConfig.build``.
    """

    metadata: ClassVar[dict] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    def __init__(
        self, config: EnvConfig, num_envs: int, seed: int = 0, device: torch.device | str = "cpu",
        selector: SelectorConfig | None = None, env_offset: int = 0,
    ) -> None:  # fmt: skip
        check_at_least("num_envs", num_envs, 1)
        self.num_envs = num_envs
        self._build = partial(config.build, num_envs, torch.device(device), env_offset=env_offset)
        self._selector = selector or uniform.Config()
        self._begin(seed)
        env = self.loop.env
        self.single_observation_space = Box(-np.inf, np.inf, (env.obs_dim,), np.float32)
        low, high = env.action_range
        self.single_action_space = Box(low.numpy(), high.numpy(), dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _begin(self, seed: int) -> None:
        if not 0 <= seed < 2**32:
            raise ValueError(f"seed must be in [0, 2^32), got {seed}.")
        env = self._build(seed=seed)
        self.loop = GoalLoop(env, self._selector.build(spaces(env), seed))
        self._untouched = True  # all worlds stand where an episode begins

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode in every world.

        Args:
            seed: In [0, 2^32), to build the worlds and the selector anew, so that equal seeds give equal episodes.
            options: Must be empty; worlds that are done need no ``reset_mask``.

        Returns:
            What to act on first, float32, shape (num_envs, obs_dim), and an empty dictionary.

        Raises:
            ValueError: If the seed is out of range or there are options.
        """
        if options:
            raise ValueError(f"options must be empty, got {options}.")
        super().reset(seed=seed)
        if seed is not None:
            self._begin(seed)
        elif not self._untouched:
            self.loop.start()
            self._untouched = True
        return _copy(self.loop.env.obs), {}

    def step(self, actions: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Simulate one step of every world, issue the goals that are due and reset the worlds that are done.

        Args:
            actions: Actions, shape (num_envs, action_dim); the environment clips them.

        Returns:
            What to act on next, float32, shape (num_envs, obs_dim); rewards, float64, terminated and truncated,
            bool, shape (num_envs,); and where a world is done, ``final_obs`` and ``final_info`` as gymnasium has them.

        Raises:
            ValueError: If the actions have another shape.
            SimulationError: If an action is not finite, or more worlds become invalid than may.
        """
        env = self.loop.env
        action = np.array(actions, dtype=np.float32)
        if action.shape != self.action_space.shape:  # a smaller one would be broadcast
            raise ValueError(f"actions must have shape {self.action_space.shape}, got {action.shape}.")
        self._untouched = False
        step = env.step(torch.from_numpy(action).to(env.device))
        env.check()
        ended = (step.obs, step.reward.double(), step.terminated, step.truncated)
        final_obs, reward, terminated, truncated = map(_copy, ended)
        self.loop.advance(step)
        done = terminated | truncated
        self._untouched = done.all()
        infos: dict = {}
        for world in np.flatnonzero(done):
            infos = self._add_info(infos, {"final_obs": final_obs[world], "final_info": {}}, world)
        return _copy(env.obs), reward, terminated, truncated, infos


class GymnasiumEnv(gymnasium.Env):
    """World ``env_offset`` of a ``GymnasiumVectorEnv`` alone, without automatic resets; same arguments otherwise."""

    metadata: ClassVar[dict] = {"render_modes": []}

    def __init__(
        self, config: EnvConfig, seed: int = 0, device: torch.device | str = "cpu",
        selector: SelectorConfig | None = None, env_offset: int = 0,
    ) -> None:  # fmt: skip
        self.worlds = GymnasiumVectorEnv(config, 1, seed, device, selector, env_offset)
        self.observation_space = self.worlds.single_observation_space
        self.action_space = self.worlds.single_action_space
        self._running = False

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """See ``GymnasiumVectorEnv.reset``; observations have the shape (obs_dim,)."""
        super().reset(seed=seed)
        obs, info = self.worlds.reset(seed=seed, options=options)
        self._running = True
        return obs[0], info

    def step(self, action: ArrayLike) -> tuple[np.ndarray, float, bool, bool, dict]:
        """See ``GymnasiumVectorEnv.step``; the observation that an episode ends in comes back as such."""
        if not self._running:
            raise gymnasium.error.ResetNeeded("The episode has ended or not begun; call reset().")
        obs, reward, terminated, truncated, infos = self.worlds.step(np.expand_dims(action, 0))
        self._running = "final_obs" not in infos
        return (obs if self._running else infos["final_obs"])[0], reward.item(), terminated.item(), truncated.item(), {}


def _copy(tensor: torch.Tensor) -> np.ndarray:
    return tensor.cpu().numpy().copy()
