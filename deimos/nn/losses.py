"""Losses of networks and their gradients with respect to the outputs, written out in torch: the reference.

``kernels.mlp`` also has ``ValueLoss`` and ``Surrogate``, which a CPU computes while a block of rows is in its caches.
Tests compare these functions with autograd in float64, and the kernel's with these.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor, nn

Loss = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""From outputs, shape (K, n, outputs), and a network's free parameters, which belong to no layer, shape (K, free), to
sums over the rows, shape (K, sums), and the gradients of the first, the loss, with respect to both."""


@dataclass(frozen=True)
class ValueLoss:
    """The squared error of values; clipped, it does not follow a value that has moved too far already.

    Where a value has moved too far and clipping makes the loss larger, the clipped loss counts, and it is flat.
    Inside the clip both are exactly equal, so that rounding cannot decide. It has one sum, the loss.
    """

    data: Tensor
    """Weight of every row, value before the update and target, shape (K, 3, n)."""
    clip: float
    """How far a value may move, positive; infinite for the plain squared error."""

    sums: ClassVar[int] = 1

    def __getitem__(self, rows: slice) -> "ValueLoss":
        return replace(self, data=self.data[..., rows])

    def data_shape(self, networks: int, rows: int, outputs: int, free: int) -> tuple[int, ...]:
        """The shape that ``data`` must have.

        Raises:
            ValueError: If no data fit networks with so many outputs.
        """
        if outputs != 1:
            raise ValueError(f"ValueLoss needs networks with one output, got {outputs}.")
        return networks, 3, rows

    def __call__(self, value: Tensor, free: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See ``Loss``; there is one output."""
        weight, old, target = self.data.unbind(1)
        value = value.squeeze(2)
        error, step = value - target, value - old
        beyond = step - step.clamp(-self.clip, self.clip)  # exactly 0 inside the clip
        plain, clipped = error.square(), (error - beyond).square()
        loss = (weight * torch.maximum(plain, clipped)).sum(1, keepdim=True)
        slope = error * weight * (plain >= clipped) * 2.0  # 0 times NaN is NaN
        return loss, slope.unsqueeze(2), torch.zeros_like(free)


@dataclass(frozen=True)
class Surrogate:
    """PPO's clipped surrogate for a Gaussian policy: outputs are its mean, free parameters its standard deviation.

    Its sums are the loss and, for every action, the squared distance that the mean has moved, for the KL divergence.
    The slope of max(-A r, -A clip(r)) is -A where the first is the larger or both are equal (inside the clip), and 0
    elsewhere; log r has the slopes z / std and (z^2 - 1) / std.
    """

    data: Tensor
    """Actions, means of the policy that acted, log-probability, advantage and weight, shape (1, 2 actions + 3, n)."""
    clip: float
    """How far the ratio of probabilities may move, positive."""

    def __getitem__(self, rows: slice) -> "Surrogate":
        return replace(self, data=self.data[..., rows])

    def data_shape(self, networks: int, rows: int, outputs: int, free: int) -> tuple[int, ...]:
        """The shape that ``data`` must have.

        Raises:
            ValueError: If no data fit so many networks, or networks with so many outputs and free parameters.
        """
        if networks != 1 or outputs != free:
            raise ValueError(
                "Surrogate needs one network with a free parameter for every output, its standard deviation; got "
                f"{networks} with {outputs} outputs and {free} free parameters."
            )
        return 1, 2 * outputs + 3, rows

    @property
    def sums(self) -> int:
        """Number of its sums."""
        return (self.data.shape[1] - 1) // 2

    def __call__(self, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See ``Loss``."""
        size = mean.shape[2]
        action, old_mean, (old_log_prob, advantage, weight) = self.data[0].split([size, size, 3])
        mean, std = mean[0].t(), std[0].unsqueeze(1)  # with actions along the first axis, rows are contiguous
        z = (action - mean) / std
        ratio = (log_prob(z, std) - old_log_prob).exp()
        cost = -advantage
        plain, clipped = cost * ratio, cost * ratio.clamp(1.0 - self.clip, 1.0 + self.clip)
        slope = weight * plain * (plain >= clipped)  # with respect to log r
        loss = weight @ torch.maximum(plain, clipped)
        sums = torch.cat([loss.unsqueeze(0), (mean - old_mean).square() @ weight])
        by_mean, by_std = z / std * slope, (z.square() - 1.0) @ slope / std[:, 0]
        return sums.unsqueeze(0), by_mean.t().unsqueeze(0), by_std.unsqueeze(0)


def by_outputs(loss: Loss, y: Tensor, free: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What a loss returns for outputs; its gradient with respect to them in float32.

    Raises:
        ValueError: If that gradient is not of the outputs' shape and on their device.
    """
    sums, slopes, by_free = loss(y, free)
    if slopes.shape != y.shape or slopes.device != y.device:
        raise ValueError(
            f"A loss must give gradients by its outputs of shape {tuple(y.shape)} on {y.device}, got "
            f"{tuple(slopes.shape)} on {slopes.device}."
        )
    return sums, slopes.float(), by_free


def log_prob(z: Tensor, std: Tensor) -> Tensor:
    """Log of the density of a Gaussian, shape (n,), at standardised z, shape (actions, n); ``std`` is (actions, 1)."""
    return -0.5 * z.square().sum(0) - std.log().sum() - 0.5 * len(std) * math.log(2 * math.pi)


def cross_entropy(target: Tensor, weight: Tensor) -> Loss:
    """The binary cross-entropy of one logit; see ``Loss``.

    Args:
        target: In [0, 1], shape (n,).
        weight: Weight of every row, shape (n,).
    """

    def loss(logit: Tensor, free: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        logit = logit.squeeze(2)
        value = nn.functional.binary_cross_entropy_with_logits(logit[0], target, weight, reduction="sum")
        return value.view(1, 1), ((logit.sigmoid() - target) * weight).unsqueeze(2), free

    return loss


def mean_squared_error(target: Tensor) -> Loss:
    """The mean squared error of outputs; see ``Loss``.

    Args:
        target: Shape (n, outputs).
    """

    def loss(output: Tensor, free: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        error = output - target
        return error.square().mean().view(1, 1), error * (2.0 / error.numel()), free

    return loss
