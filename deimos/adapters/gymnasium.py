"""Environments as gymnasium's: many worlds as a ``VectorEnv``, one as an ``Env``.

Importing this module registers ``ENVIRONMENTS``: ``gymnasium.make("Deimos/Particle-Directional-v1")``.
"""

from functools import partial
from numbers import Integral
from typing import Any, ClassVar, cast

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from deimos import plugins
from deimos.checks import check_at_least, check_is
from deimos.goals.selector import SelectorConfig
from deimos.goals.selectors import uniform
from deimos.nn.layout import count, seen_by
from deimos.run.loop import GoalLoop, spaces
from deimos.sim import envs
from deimos.sim.env import Env, EnvConfig

Observation = np.ndarray | dict[str, np.ndarray]
"""An array, or one under each of ``observation``, ``achieved_goal`` and ``desired_goal``."""
VERSION = 1  # grows when an episode under the same seed and actions changes
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    **{
        f"Particle-{variant.title()}": {"environment": "particle", "variant": variant, "time_limit": 1000}
        for variant in ("absolute", "directional", "relative")
    },
    **{
        f"{name}-{terrain.title()}": {"environment": environment, "terrain": terrain}
        for name, environment in (("Quad", "quad"), ("QuadArm", "quad_arm")) for terrain in ("flat", "rough")
    },
}  # fmt: skip
"""What gymnasium knows as ``Deimos/NAME-v1``: an environment and its options. Episodes end, as most learners need."""


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv):
    """Many worlds, with NumPy arrays in and copies out; goals are issued within ``step``.

    Observations are what the policy sees. What is privileged is not in them: ``loop.env.obs`` holds all of it.
    ``loop`` leads to the environment, the selector and the interactions; every ``reset`` with a seed makes a new one,
    whose selector has learnt nothing. Weights of losses and crash penalties are left to you, as in ``RslRlVecEnv``.
    On CUDA make it and call it within ``deimos.sim.shared.one_stream(device)``; outside, it is refused.

    Args:
        config: The environment.
        num_envs: Number of worlds, at least 1.
        seed: Seed of every draw, in [0, 2^32); ``None`` for a random one. ``reset`` may set another.
        device: Where they are simulated.
        selector: Chooses their goals; ``None`` for Uniform.
        env_offset: Global number of world 0; see ``EnvConfig.build``.
        autoreset_mode: What becomes of worlds that are done. ``SAME_STEP``: they are reset at once, the observation is
            the new episode's first, and ``infos["final_obs"]`` holds the last one of the old. ``NEXT_STEP``: the
            observation is the last one, and the next step resets such a world, whatever the action, with reward 0.
            ``DISABLED``: ``reset(options={"reset_mask": ...})`` must come before the next step.
        goal_dict: Whether an observation is a dictionary in the shape of gymnasium-robotics' goal environments:
            ``observation`` without the goal, ``achieved_goal`` and ``desired_goal``; see ``compute_reward``.
        learn_every: Steps between two updates of the selector, at least 1. ``None`` leaves it to you: call
            ``loop.learn()`` at least every T steps, or ``loop.learn(rollout)`` for selectors that learn from the
            learner's rollout (``vds``, ``plr``).

    Raises:
        ValueError: If a number is out of range, a selector that needs a rollout is to learn every so many steps, or
            there is a ``goal_dict`` where rewards depend on more than what was achieved and the goal or on a
            ``crash_penalty``, or where what is achieved is privileged.
    """

    def __init__(
        self, config: EnvConfig, num_envs: int, seed: int | None = None, device: torch.device | str = "cpu",
        selector: SelectorConfig | None = None, env_offset: int = 0,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP, goal_dict: bool = False,
        learn_every: int | None = 24,
    ) -> None:  # fmt: skip
        check_is("config", config, EnvConfig)
        if selector is not None:
            check_is("selector", selector, SelectorConfig)
        check_at_least("num_envs", num_envs, 1)
        self.num_envs = num_envs
        self.loop: GoalLoop
        self._fresh: torch.Tensor  # where a world is at the beginning of an episode
        self._over: torch.Tensor  # where an episode has ended and no new one has begun
        self._mode = AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self._mode, "render_modes": []}
        self._build = partial(config.build, num_envs, torch.device(device), env_offset=env_offset)
        self._selector, self._learn_every = selector or uniform.Config(), learn_every
        self._begin(int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed)
        env = self.loop.env
        self._goal_dict = goal_dict
        if goal_dict:
            _check_goals(env)
        parts = [field for field in env.layout if not (goal_dict and field.name == "goal")]
        self._sees = seen_by("actor", parts, env.device)
        seen = count(self._sees, sum(field.size for field in parts))
        sizes = {"observation": seen, "achieved_goal": env.goal_dim, "desired_goal": env.goal_dim}
        boxes = {name: Box(-np.inf, np.inf, (size,), np.float32) for name, size in sizes.items()}
        flat = Box(-np.inf, np.inf, (seen,), np.float32)
        self.single_observation_space = Dict(boxes) if goal_dict else flat
        low, high = env.action_range
        self.single_action_space = Box(low.numpy(), high.numpy(), dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _begin(self, seed: int) -> None:
        if not isinstance(seed, Integral) or not 0 <= seed < 2**32:
            raise ValueError(f"seed must be a whole number in [0, 2^32), one for all worlds, got {seed}.")
        env = self._build(seed=int(seed))
        self.loop = GoalLoop(env, self._selector.build(spaces(env), int(seed)), learn_every=self._learn_every)
        everywhere = torch.ones(self.num_envs, dtype=torch.bool, device=env.device)
        self._fresh, self._over = everywhere, ~everywhere

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Observation, dict]:
        """Begin an episode.

        Args:
            seed: In [0, 2^32), to rebuild the worlds and the selector, so that equal seeds give equal episodes.
            options: Empty, or ``reset_mask``: where to begin, bool, shape (num_envs,), instead of everywhere.

        Returns:
            What to act on first, float32, shape (num_envs, components that the policy sees), and an empty dictionary.

        Raises:
            ValueError: If the seed is out of range, there are other options, or both a seed and a mask.
        """
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        if options:
            raise ValueError(f"options may hold only reset_mask, got {options}.")
        if mask is not None and (np.shape(mask) != (self.num_envs,) or np.asarray(mask).dtype != bool):
            raise ValueError(f"reset_mask must be bool and have shape ({self.num_envs},), got {mask}.")
        if mask is not None and seed is not None:
            raise ValueError(f"seed must be None if there is a reset_mask, got {seed}: it is for all worlds.")
        if seed is not None:
            self._begin(seed)
        super().reset(seed=None if seed is None else int(seed))
        again = ~self._fresh if mask is None else ~self._fresh & torch.as_tensor(mask, device=self._fresh.device)
        if again.any():
            self.loop.start(again)
            self._fresh, self._over = self._fresh | again, self._over & ~again
        return self._seen(), {}

    def step(self, actions: ArrayLike) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Simulate one step of every world, issue the goals that are due and reset the worlds that are done.

        Args:
            actions: Actions, shape (num_envs, action_dim); the environment clips them.

        Returns:
            What to act on next, as ``reset`` gives it; rewards, float64, terminated and truncated, bool, shape
            (num_envs,); and in ``SAME_STEP``, where a world is done, ``final_obs`` and ``final_info`` as gymnasium has
            them.

        Raises:
            ValueError: If the actions have another shape.
            ResetNeeded: If an episode has ended in a world that was not reset, and nothing here does that.
            SimulationError: If an action is not finite, or too many worlds become invalid.
        """
        env = self.loop.env
        action = np.array(actions, dtype=np.float32)
        if action.shape != self.action_space.shape:  # a smaller one would be broadcast
            raise ValueError(f"actions must have shape {self.action_space.shape}, got {action.shape}.")
        if self._mode is AutoresetMode.DISABLED and self._over.any():
            text = f"The episode of world {int(self._over.int().argmax())} has ended; call reset() with a reset_mask."
            raise gymnasium.error.ResetNeeded(text)
        step = env.step(torch.from_numpy(action).to(env.device))
        env.check()
        ended_before = self._over
        if self._mode is AutoresetMode.NEXT_STEP:  # the step of such a world did not happen
            for flag in (step.terminated, step.truncated, step.goal_due):
                flag &= ~ended_before
            step.reward.masked_fill_(ended_before, 0.0)
        changes = self.loop.resolve(step)
        self.loop.choose(changes.due)
        done = step.terminated | step.truncated
        same_step = self._mode is AutoresetMode.SAME_STEP
        begins = done if same_step else ended_before
        final_obs = self._seen()
        reward, terminated, truncated = map(_copy, (step.reward.double(), step.terminated, step.truncated))
        if begins.any():
            self.loop.begin(begins)
        self._fresh, self._over = begins, done & ~begins
        self.loop.learn_if_due()
        infos: dict = {}
        for world in np.flatnonzero(done.cpu()) if same_step else ():
            infos = self._add_info(infos, {"final_obs": _world(final_obs, int(world)), "final_info": {}}, world)
        return self._seen(), reward, terminated, truncated, infos

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None) -> np.ndarray:
        """Rewards of steps that achieved one thing while their goal was another, as in gymnasium-robotics.

        Up to rounding, they are those of ``step`` where the goal of the observation was in force during the step: not
        where a new one was issued after it.

        Args:
            achieved_goal: As observations hold it, shape (..., goal_dim).
            desired_goal: Goals, of the same shape.
            info: Ignored: no reward depends on it.

        Returns:
            Float64, shape (...).

        Raises:
            ValueError: If rewards depend on more than that; see ``goal_dict``.
        """
        env, shape = self.loop.env, np.shape(achieved_goal)[:-1]
        both = (np.asarray(goal, np.float32).reshape(-1, env.goal_dim) for goal in (achieved_goal, desired_goal))
        reward = env.goal_reward(*(torch.from_numpy(goal).to(env.device) for goal in both))
        return _copy(reward.double()).reshape(shape)

    def _seen(self) -> Observation:
        """Copies of the current observations."""
        env = self.loop.env
        if not self._goal_dict:
            return _copy(env.obs[:, self._sees])
        achieved = cast(torch.Tensor, env.achieved(env.obs))  # the constructor has refused environments that give None
        return {
            "observation": _copy(env.state(env.obs)[:, self._sees]), "achieved_goal": _copy(achieved),
            "desired_goal": _copy(env.obs[:, env.goal_slice]),
        }  # fmt: skip


class GymnasiumEnv(gymnasium.Env):
    """World ``env_offset`` of a ``GymnasiumVectorEnv`` alone, without automatic resets; same arguments otherwise."""

    metadata: ClassVar[dict] = {"render_modes": []}

    def __init__(
        self, config: EnvConfig, seed: int | None = None, device: torch.device | str = "cpu",
        selector: SelectorConfig | None = None, env_offset: int = 0, goal_dict: bool = False,
        learn_every: int | None = 24,
    ) -> None:  # fmt: skip
        modes = AutoresetMode.DISABLED, goal_dict, learn_every
        self.worlds = GymnasiumVectorEnv(config, 1, seed, device, selector, env_offset, *modes)
        self.observation_space = self.worlds.single_observation_space
        self.action_space = self.worlds.single_action_space
        self._running = False

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Observation, dict]:
        """See ``GymnasiumVectorEnv.reset``; observations are those of one world."""
        obs, info = self.worlds.reset(seed=seed, options=options)
        super().reset(seed=None if seed is None else int(seed))
        self._running = True
        return _world(obs, 0), info

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict]:
        """See ``GymnasiumVectorEnv.step``; the observation that an episode ends in comes back as such."""
        if not self._running:
            raise gymnasium.error.ResetNeeded("The episode has ended or not begun; call reset().")
        obs, reward, terminated, truncated, _ = self.worlds.step(np.expand_dims(action, 0))
        self._running = not (terminated | truncated).item()
        return _world(obs, 0), reward.item(), terminated.item(), truncated.item(), {}

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None) -> np.ndarray:
        """See ``GymnasiumVectorEnv.compute_reward``."""
        return self.worlds.compute_reward(achieved_goal, desired_goal, info)


def make(environment: str, render_mode: None = None, **options: Any) -> GymnasiumEnv:
    """One world, for ``gymnasium.make``.

    Args:
        environment: Name of the environment.
        render_mode: Must be ``None``: ``deimos play`` draws runs.
        options: Fields of its configuration, and arguments of ``GymnasiumEnv``.

    Raises:
        ValueError: If there is no such environment or a value is not valid.
        TypeError: If there is no such option, or if a ``render_mode`` is given.
    """
    config = _config(environment, render_mode, options)
    return GymnasiumEnv(config, **options)


def make_vec(environment: str, num_envs: int, render_mode: None = None, **options: Any) -> GymnasiumVectorEnv:
    """Many worlds, for ``gymnasium.make_vec``; see ``make`` and ``GymnasiumVectorEnv``."""
    config = _config(environment, render_mode, options)
    return GymnasiumVectorEnv(config, num_envs, **options)


def _config(environment: str, render_mode: None, options: dict[str, Any]) -> EnvConfig:
    """The environment's configuration, whose fields are taken out of ``options``."""
    if render_mode is not None:
        # The error of an unknown option: Stable-Baselines3 asks for 'rgb_array' and continues without it.
        raise TypeError(f"render_mode must be None, got '{render_mode}'; `deimos play` draws runs.")
    kind = plugins.load(envs, environment).Config
    return kind(**{name: options.pop(name) for name in kind.__dataclass_fields__ if name in options})


def _check_goals(env: Env) -> None:
    """Raise ``ValueError`` where goals cannot be handed out in hindsight, or would tell the policy what is privileged.

    What the policy does not see is NaN here, and so is whatever depends on it.
    """
    sees = seen_by("actor", env.layout, env.device)
    shown = torch.full_like(env.obs, torch.nan)
    shown[:, sees] = env.obs[:, sees]
    achieved = env.achieved(shown)
    if achieved is None or env.config.crash_penalty:
        raise ValueError(f"goal_dict must be False, since rewards depend on more than goals here; got {env.config}.")
    if not bool(achieved.isfinite().all()):
        hidden = ", ".join(field.name for field in env.layout if field.seen_by == "critic")
        raise ValueError(f"goal_dict must be False, since achieved_goal would show privileged entries: {hidden}.")


def _world(obs: Observation, world: int) -> Observation:
    """The observation of one world."""
    return {name: part[world] for name, part in obs.items()} if isinstance(obs, dict) else obs[world]


def _copy(tensor: torch.Tensor) -> np.ndarray:
    return tensor.cpu().numpy().copy()


for _name, _options in ENVIRONMENTS.items():
    gymnasium.register(
        f"Deimos/{_name}-v{VERSION}", entry_point=f"{__name__}:make", vector_entry_point=f"{__name__}:make_vec",
        kwargs=dict(_options),
    )  # fmt: skip
