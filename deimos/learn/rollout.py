"""The transitions of every world over a few steps, in memory allocated once, and their advantages."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from deimos.nn.returns import advantages


class Rollout:
    """The transitions of ``num_steps`` steps of every world.

    Shapes are (num_steps, num_envs, ...) except for ``obs``, which has one more step: the observation
    that the next rollout starts from. Where an episode ended, ``obs[t + 1]`` is the one after the reset.

    Args:
        num_steps: Steps of every world.
        num_envs: Number of worlds.
        obs_dim: Components of an observation.
        action_dim: Components of an action.
        device: Device of all tensors.
        discount: Weight of the next step's reward (gamma), in [0, 1].
        gae_lambda: lambda of the advantages, in [0, 1].
        reward_scale: Factor on rewards in the advantages.
    """

    def __init__(
        self, num_steps: int, num_envs: int, obs_dim: int, action_dim: int, device: torch.device, *,
        discount: float = 0.99, gae_lambda: float = 0.95, reward_scale: float = 1.0,
    ) -> None:  # fmt: skip
        self.num_steps = num_steps
        self.discount, self.gae_lambda, self.reward_scale = discount, gae_lambda, reward_scale
        n = num_envs
        zeros = partial(torch.zeros, dtype=torch.float32, device=device)
        self.obs = zeros(num_steps + 1, n, obs_dim)
        self.action = zeros(num_steps, n, action_dim)
        self.mean = zeros(num_steps, n, action_dim)
        """Mean of the policy's distribution at the time."""
        self.noise = zeros(num_steps, n, action_dim)
        """Standard normal draws, made for the whole rollout at once."""
        self.reward = zeros(num_steps, n)
        self.terminated = torch.zeros(num_steps, n, dtype=torch.bool, device=device)
        self.truncated = torch.zeros(num_steps, n, dtype=torch.bool, device=device)
        self.last_obs = torch.empty(num_steps, n, obs_dim, dtype=torch.float32, device=device)
        """Observations that steps ended in, before any reset; only those of steps that truncated a world are written,
        and on a CPU only those take memory."""
        self.advantage = zeros(num_steps, n)
        """Advantages in units of scaled rewards, before they are normalised; see ``estimate``."""
        self.invalid = torch.zeros(num_steps, n, dtype=torch.bool, device=device)
        self.weight = zeros(num_steps, n).fill_(1.0)
        """Weight of the transition in everything learnt: 0 leaves it out."""
        numbers = self.reward, self.weight, self.last_obs
        flags = self.terminated, self.truncated, self.invalid
        self._numbers, self._flags = (list(zip(*kind, strict=True)) for kind in (numbers, flags))  # of every step

    @torch.no_grad()
    def record(
        self, t: int, *, obs: Tensor, reward: Tensor, terminated: Tensor, truncated: Tensor, invalid: Tensor,
        weight: Tensor, cut_off: Tensor,
    ) -> None:  # fmt: skip
        """Copy what step ``t`` returned.

        Args:
            t: Index of the step, in [0, num_steps).
            obs: Observations that the step ended in, not yet reset, shape (num_envs, obs_dim).
            reward: Rewards, shape (num_envs,).
            terminated: True where the world crashed, bool, shape (num_envs,).
            truncated: True where the episode was cut off without a crash, bool, shape (num_envs,).
            invalid: True where the state is no longer physical, bool, shape (num_envs,).
            weight: Weight of every world's transition, shape (num_envs,).
            cut_off: Worlds, int64, shape (m,), including all in which ``truncated`` is true.
        """
        kinds = 3 if len(cut_off) else 2
        torch._foreach_copy_(self._numbers[t][:kinds], (reward, weight, obs)[:kinds])  # a GPU copies all at once
        torch._foreach_copy_(self._flags[t], (terminated, truncated, invalid))

    def exclude_invalid(self) -> None:
        """Give weight 0 to what led to an invalid state: every transition of that world since its last reset."""
        invalid = torch.zeros_like(self.invalid[0])
        for t in reversed(range(self.num_steps)):
            invalid &= ~(self.terminated[t] | self.truncated[t])
            invalid |= self.invalid[t]
            self.weight[t].masked_fill_(invalid, 0.0)

    def cut_off(self) -> tuple[Tensor, Tensor, Tensor]:
        """Steps and worlds that were truncated, int64, shape (m,) each, and their last observations, (m, obs_dim)."""
        step, world = self.truncated.nonzero(as_tuple=True)
        return step, world, self.last_obs[step, world]

    def estimate(self, critic: Callable[[Tensor], Tensor]) -> Tensor:
        """Fill in ``advantage``.

        Args:
            critic: Values of observations of shape (..., obs_dim), in units of scaled rewards.

        Returns:
            Values of the observations that the steps started from, shape (num_steps, num_envs).
        """
        value = critic(self.obs)
        next_value = value[1:].clone()
        step, world, obs = self.cut_off()
        if len(step):
            next_value[step, world] = critic(obs)
        self.advantage.copy_(advantages(
            self.reward * self.reward_scale, value[:-1], next_value, self.terminated, self.truncated,
            discount=self.discount, gae_lambda=self.gae_lambda,
        ))  # fmt: skip
        return value[:-1]
