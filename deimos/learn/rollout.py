"""What happened in every world over a few steps, in memory allocated once."""

import torch
from torch import Tensor

from deimos.sim.env import Env, Step


class Rollout:
    """The transitions of ``num_steps`` steps of every world.

    Shapes are (num_steps, num_envs, ...) but for ``obs``, which has one more step: the observation
    that the next rollout starts from. Where an episode ended, ``obs[t + 1]`` is the one after the reset.
    """

    def __init__(
        self, env: Env, num_steps: int, *, discount: float = 0.99, gae_lambda: float = 0.95, reward_scale: float = 1.0
    ) -> None:
        n, device = env.num_envs, env.device
        self.num_steps = num_steps
        self.discount, self.gae_lambda, self.reward_scale = discount, gae_lambda, reward_scale
        # The learner's: whoever estimates values beside it must mean the same by them.
        self.obs = torch.zeros(num_steps + 1, n, env.obs_dim, device=device)
        self.action = torch.zeros(num_steps, n, env.action_dim, device=device)
        self.mean = torch.zeros(num_steps, n, env.action_dim, device=device)
        """Mean of the policy's distribution at the time."""
        self.noise = torch.zeros(num_steps, n, env.action_dim, device=device)
        """Standard normal draws, made for the whole rollout at once."""
        self.reward = torch.zeros(num_steps, n, device=device)
        self.terminated = torch.zeros(num_steps, n, dtype=torch.bool, device=device)
        self.truncated = torch.zeros(num_steps, n, dtype=torch.bool, device=device)
        self.final_obs = torch.zeros(num_steps if env.time_limit else 0, n, env.obs_dim, device=device)
        """Observations that the steps ended in, before any reset; kept only where episodes can be truncated."""
        self.advantage = torch.zeros(num_steps, n, device=device)
        """Advantages in units of scaled rewards, before they are normalised; the learner fills them in."""
        self.invalid = torch.zeros(num_steps, n, dtype=torch.bool, device=device)
        self.weight = torch.ones(num_steps, n, device=device)
        """Weight of the transition in everything learnt: 0 leaves it out."""

    def record(self, t: int, step: Step, weight: Tensor) -> None:
        """Copy what step ``t`` gave back.

        Args:
            t: Index of the step, in [0, num_steps).
            step: Views, not yet reset.
            weight: Weight of every world's transition, shape (num_envs,).
        """
        self.reward[t] = step.reward
        self.terminated[t] = step.terminated
        self.invalid[t] = step.invalid
        self.weight[t] = weight
        if len(self.final_obs):
            self.truncated[t] = step.truncated
            self.final_obs[t] = step.obs

    def exclude_invalid(self) -> None:
        """Give weight 0 to what led to an invalid state: every transition of that world since its last reset."""
        spoilt = torch.zeros_like(self.invalid[0])
        for t in reversed(range(self.num_steps)):
            spoilt &= ~(self.terminated[t] | self.truncated[t])
            spoilt |= self.invalid[t]
            self.weight[t].masked_fill_(spoilt, 0.0)
