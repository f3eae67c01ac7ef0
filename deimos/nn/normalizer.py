"""Normalise observations by their running statistics, as rsl_rl's ``EmpiricalNormalization``."""

import torch
from torch import Tensor, nn

from deimos.nn.ranks import sum_over_ranks

EPSILON = 1e-2  # added to the standard deviation, for components that hardly vary; rsl_rl's


class Normalizer(nn.Module):
    """Subtracts the running mean and divides by the running standard deviation, component by component.

    The statistics are buffers, so that they are saved with the network that holds them. Only ``update`` changes them.
    Batches are merged by Chan, Golub and LeVeque's formula [1]_.

    Args:
        size: Components of an observation.

    References:
        .. [1] Chan, Golub and LeVeque, *Updating Formulae and a Pairwise Algorithm for Computing Sample Variances*,
           COMPSTAT 1982, equation 2.1.
    """

    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float32))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float32))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))  # exact up to 2^53

    @torch.no_grad()
    def update(self, obs: Tensor, weight: Tensor) -> None:
        """Add observations to the statistics.

        Args:
            obs: Observations, shape (n, size).
            weight: 1 for those that count and 0 for the others, shape (n,).
        """
        total, mean = weight.sum(), weight @ obs
        sum_over_ranks(total, mean)
        at_least_one = total.clamp(min=1.0)
        mean /= at_least_one
        variance = sum_over_ranks(weight @ (obs - mean).square_()) / at_least_one
        self.count += total
        share = (total / self.count.clamp(min=1.0)).float()
        delta = mean - self.mean
        self.mean += share * delta
        self.variance += share * (variance - self.variance + delta * (mean - self.mean))

    def forward(self, obs: Tensor, out: Tensor | None = None) -> Tensor:
        """Normalised observations, shape (..., size), in ``out`` if it is given."""
        return torch.sub(obs, self.mean, out=out).div_(self.variance.sqrt() + EPSILON)
