"""Multilayer perceptrons, their gradient without allocations, and the actor-critic."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

from deimos.nn.matmul import activate_, add_product_, fast_linear, multiply_by_slope_

Activation = Literal["relu", "elu", "tanh"]

_MODULES: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "elu": nn.ELU, "tanh": nn.Tanh}


@dataclass(frozen=True)
class Whitening:
    """What a network sees of a candidate: clip((x - mean) * factor, -bound, bound). Tensors may change, not move."""

    mean: Tensor
    """Shape (goal_dim,)."""
    factor: Tensor
    """Shape (goal_dim,)."""
    bound: float
    """Above 0."""


def mlp(
    inputs: int, hidden: Sequence[int], outputs: int, activation: Activation, generator: torch.Generator | None = None
) -> nn.Sequential:
    """Linear layers with ``activation`` between them.

    Args:
        inputs: Inputs.
        hidden: Units of the hidden layers.
        outputs: Outputs.
        activation: Between the layers.
        generator: Where the weights are drawn from, by PyTorch's default initialisation; ``None`` leaves them 0, to
            be loaded. PyTorch itself would draw them from the process's generator, which is somebody else's.
    """
    sizes = [inputs, *hidden]
    layers: list[nn.Module] = []
    for size_in, size_out in pairwise(sizes):
        layers += [_linear(size_in, size_out, generator), _MODULES[activation]()]
    return nn.Sequential(*layers, _linear(sizes[-1], outputs, generator))


def _linear(inputs: int, outputs: int, generator: torch.Generator | None) -> nn.Linear:
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs)
    if generator is None:
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)
    else:  # as ``nn.Linear.reset_parameters`` does it
        nn.init.kaiming_uniform_(layer.weight, a=math.sqrt(5), generator=generator)
        bound = 1 / math.sqrt(inputs)
        nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    return layer


def flatten_parameters(*modules: nn.Module) -> tuple[nn.Parameter, list[Tensor]]:
    """Lay the parameters and the gradients of every module end to end in memory.

    An optimiser or a norm then works on one long vector instead of a dozen short tensors, whose
    overhead per tensor costs more than their arithmetic.

    Args:
        modules: Modules that share no parameter. Their parameters become views of the vectors.

    Returns:
        The parameter vector, with its ``grad`` set, and the slice of the gradient that belongs to
        each module.
    """
    tensors = [list(module.parameters()) for module in modules]
    first = tensors[0][0]
    total = sum(_aligned(p.numel()) for group in tensors for p in group)
    flat = nn.Parameter(torch.zeros(total, dtype=first.dtype, device=first.device))
    flat.grad = torch.zeros_like(flat)
    slices, start = [], 0
    for group in tensors:
        begin = start
        for parameter in group:
            rows = slice(start, start + parameter.numel())
            view = flat.data[rows].view_as(parameter)
            view.copy_(parameter.data)
            parameter.data = view
            parameter.grad = flat.grad[rows].view_as(parameter)
            start += _aligned(parameter.numel())
        slices.append(flat.grad[begin:start])
    return flat, slices


def weights_of(net: nn.Module) -> dict[str, Tensor]:
    """A copy of a network's ``state_dict``: later updates leave it alone, and a file of it holds nothing else.

    Parameters that ``flatten_parameters`` has laid out are views, and a view is saved with all that it is a view of.
    """
    return {name: value.detach().clone() for name, value in net.state_dict().items()}


def _aligned(count: int) -> int:
    """``count`` rounded up to 64 bytes of float32: products of unaligned weights are slower."""
    return -(-count // 16) * 16


def rows_in_cache(widest: int) -> int:
    """Rows whose activations take 3 MiB in a layer of ``widest`` units.

    A CPU works through larger batches in such pieces: they stay in its caches and far below the blocks of memory
    that the C library gives back to the system (see ``matmul.keep_freed_memory``).
    """
    return max(256, 3 * 2**20 // (4 * widest))


class Backprop:
    """Forward and backward pass of an MLP, written out.

    It does the arithmetic of autograd and nothing else: no graph is recorded, activations overwrite
    their inputs, and gradients are added where the optimiser reads them.

    Args:
        net: Made by ``mlp``. For ``backward`` its parameters need a ``grad`` (see ``flatten_parameters``).
    """

    def __init__(self, net: nn.Sequential) -> None:
        self._linears = [layer for layer in net if isinstance(layer, nn.Linear)]
        self._activation = net[1]
        self._inputs: list[Tensor] = []

    @torch.no_grad()
    def forward(self, x: Tensor) -> Tensor:
        """The network's output, shape (n, outputs).

        Args:
            x: Inputs, shape (n, inputs). Kept, with every activation, for ``backward``.
        """
        self._inputs = []
        for layer in self._linears:
            self._inputs.append(x)
            last = layer is self._linears[-1]
            x = fast_linear(x, layer.weight, layer.bias, None if last else self._activation)
        return x

    @torch.no_grad()
    def backward(self, delta: Tensor) -> None:
        """Add the gradient of every parameter to its ``grad``.

        Args:
            delta: Gradient of the loss with respect to the output of the last ``forward``, shape (n, outputs).
        """
        for layer, x in zip(reversed(self._linears), reversed(self._inputs), strict=True):
            assert layer.weight.grad is not None
            assert layer.bias.grad is not None
            add_product_(layer.weight.grad, delta, x)
            layer.bias.grad += delta.sum(0)
            if layer is not self._linears[0]:
                delta = fast_linear(delta, layer.weight.t(), None)
                multiply_by_slope_(delta, x, self._activation)


class ManyCandidates:
    """Evaluates an MLP of (context, candidate) for many candidates per context.

    The first layer is linear, so it is the sum of one product with the context and one with the
    candidate: for N candidates of one context the first is computed once, not N times.

    Args:
        net: Made by ``mlp``; the last ``goal_dim`` inputs are the candidate. Its weights may change, not move.
        goal_dim: Components of a candidate.
        workspace: Memory for activations [MiB]; what takes more is done in parts. A CPU takes parts of 3 MiB,
            which fit its caches. The result is the same for any, up to the rounding of float32 products.
    """

    def __init__(self, net: nn.Sequential, goal_dim: int, workspace: int = 64) -> None:
        self._first, *self._others = [layer for layer in net if isinstance(layer, nn.Linear)]
        self._activation = net[1]
        weight = self._first.weight.data
        self._of_context, self._of_candidate = weight[:, :-goal_dim].t(), weight[:, -goal_dim:].t()
        widest = max(layer.in_features for layer in self._others)
        rows = workspace * 2**20 // (8 * widest)  # a layer's input and output
        self._rows = min(rows, rows_in_cache(widest)) if weight.device.type == "cpu" else rows

    @torch.no_grad()
    def __call__(self, context: Tensor, candidates: Tensor) -> Tensor:
        """The network's output for every candidate, shape (B, N, outputs).

        Args:
            context: The other inputs, shape (B, inputs - goal_dim).
            candidates: Shape (B, N, goal_dim).
        """
        count = candidates.shape[1]
        of_candidate = self._of_candidate.expand(len(candidates), -1, -1)
        of_context = torch.addmm(self._first.bias, context, self._of_context).unsqueeze(1)
        size = max(1, self._rows // count)
        outputs = []
        for known, part in zip(of_context.split(size), candidates.split(size), strict=True):
            x = torch.baddbmm(known, part, of_candidate[: len(part)]).flatten(0, 1)
            activate_(x, self._activation)
            for layer in self._others:
                last = layer is self._others[-1]
                x = fast_linear(x, layer.weight, layer.bias, None if last else self._activation)
            outputs.append(x.view(len(part), count, -1))
        return outputs[0] if len(outputs) == 1 else torch.cat(outputs)


class Actor(nn.Module):
    """A Gaussian policy: its mean is an MLP of the observation, its deviation one number per action; see ``mlp``."""

    def __init__(
        self, obs_dim: int, hidden: Sequence[int], action_dim: int, activation: Activation, init_std: float,
        generator: torch.Generator | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        self.mean = mlp(obs_dim, hidden, action_dim, activation, generator)
        self.std = nn.Parameter(torch.full((action_dim,), init_std))

    def forward(self, obs: Tensor) -> Tensor:
        """Mean action, shape (n, action_dim)."""
        return self.mean(obs)
