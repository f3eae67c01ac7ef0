"""Multilayer perceptrons as modules, and the policy."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

from deimos.nn.layout import ALL, Seen, count
from deimos.nn.normalizer import Normalizer

Activation = Literal["relu", "elu", "tanh"]

ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "elu": nn.ELU, "tanh": nn.Tanh}


def mlp(
    inputs: int, hidden: Sequence[int], outputs: int, activation: Activation, generator: torch.Generator | None = None
) -> nn.Sequential:
    """Linear layers with ``activation`` between them.

    Args:
        inputs: Inputs.
        hidden: Units of the hidden layers.
        outputs: Outputs.
        activation: Activation between the layers.
        generator: Where the weights are drawn from, by PyTorch's default initialisation; ``None`` leaves them 0, to
            be loaded. PyTorch itself would draw them from the global generator, which belongs to the host program.
    """
    sizes = [inputs, *hidden]
    layers: list[nn.Module] = []
    for size_in, size_out in pairwise(sizes):
        layers += [_linear(size_in, size_out, generator), ACTIVATIONS[activation]()]
    return nn.Sequential(*layers, _linear(sizes[-1], outputs, generator))


def _linear(inputs: int, outputs: int, generator: torch.Generator | None) -> nn.Linear:
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs, dtype=torch.float32)
    if generator is None:
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)
    else:  # as ``nn.Linear.reset_parameters`` does it
        nn.init.kaiming_uniform_(layer.weight, a=math.sqrt(5), generator=generator)
        bound = 1 / math.sqrt(inputs)
        nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    return layer


def weights_of(net: nn.Module) -> dict[str, Tensor]:
    """A copy of a network's ``state_dict``: later updates do not change it, and a file of it holds nothing else.

    Parameters in ``MLPs`` are views, and a view is saved with all the memory that it is a view of.
    """
    return {name: value.detach().clone() for name, value in net.state_dict().items()}


class Actor(nn.Module):
    """A Gaussian policy: its mean is an MLP of the observation, its standard deviation one number per action.

    With ``normalize`` the observation is normalised first, by statistics that are saved with the weights. See
    ``mlp`` for the other arguments.
    """

    def __init__(
        self, obs_dim: int, hidden: Sequence[int], action_dim: int, activation: Activation, init_std: float,
        generator: torch.Generator | None = None, seen: Seen = ALL, *, normalize: bool = False,
    ) -> None:  # fmt: skip
        super().__init__()
        self.seen = seen
        """The components of an observation that it sees."""
        self.normalizer = Normalizer(obs_dim) if normalize else None
        self.mean = mlp(count(seen, obs_dim), hidden, action_dim, activation, generator)
        self.std = nn.Parameter(torch.full((action_dim,), init_std, dtype=torch.float32))

    def forward(self, obs: Tensor) -> Tensor:
        """Mean action, shape (n, action_dim)."""
        obs = obs if self.normalizer is None else self.normalizer(obs)
        return self.mean(obs[..., self.seen])
