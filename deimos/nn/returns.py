"""Advantages of a rollout."""

import torch
from torch import Tensor


def advantages(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    *,
    discount: float,
    gae_lambda: float,
) -> Tensor:
    """Generalized advantage estimates [1]_, exact at time limits [2]_.

    An episode that terminated has no future, so its last target is the reward alone. One that was
    only truncated has a future that was cut off, so its last target still counts ``next_value``.
    Neither passes advantage across the reset.

    Args:
        reward: Rewards, shape (num_steps, ...).
        value: V of the observation that each step started from, same shape.
        next_value: V of the observation that each step ended in, *before* any reset, same shape.
        terminated: True where the task itself ended the episode, bool, same shape.
        truncated: True where only the time limit ended it, bool, same shape.
        discount: gamma, in [0, 1].
        gae_lambda: lambda, in [0, 1].

    Returns:
        Advantages, same shape. Add ``value`` for the value targets.

    Raises:
        ValueError: If the shapes differ.

    References:
        .. [1] Schulman et al., *High-Dimensional Continuous Control Using Generalized Advantage
           Estimation*, ICLR 2016, equation 16. arXiv:1506.02438
        .. [2] Pardo et al., *Time Limits in Reinforcement Learning*, ICML 2018. arXiv:1712.00378
    """
    for name, array in (
        ("value", value), ("next_value", next_value), ("terminated", terminated), ("truncated", truncated),
    ):  # fmt: skip
        if array.shape != reward.shape:
            raise ValueError(f"{name} must have the shape of reward, {tuple(reward.shape)}, got {tuple(array.shape)}.")
    has_future = (~terminated).float()
    continues = (~(terminated | truncated)).float().mul_(discount * gae_lambda)
    advantage = torch.addcmul(reward, has_future, next_value, value=discount).sub_(value)
    for t in reversed(range(len(reward) - 1)):
        advantage[t].addcmul_(continues[t], advantage[t + 1])
    return advantage
