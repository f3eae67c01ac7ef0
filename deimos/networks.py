"""Multilayer perceptrons, their gradient without allocations, and the actor-critic."""

import sys
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

Activation = Literal["relu", "elu", "tanh"]

_MODULES: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "elu": nn.ELU, "tanh": nn.Tanh}


def mlp(inputs: int, hidden: Sequence[int], outputs: int, activation: Activation) -> nn.Sequential:
    """Linear layers with ``activation`` between them, in PyTorch's default initialisation."""
    sizes = [inputs, *hidden]
    layers: list[nn.Module] = []
    for size_in, size_out in zip(sizes[:-1], sizes[1:], strict=True):
        layers += [nn.Linear(size_in, size_out), _MODULES[activation]()]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


def flatten_parameters(*modules: nn.Module) -> tuple[list[nn.Parameter], list[Tensor]]:
    """Lay the parameters and the gradients of every module end to end in memory.

    An optimiser or a norm then works on one long vector instead of a dozen short tensors, whose
    overhead per tensor costs more than their arithmetic.

    Args:
        modules: Modules that share no parameter. Their parameters become views of the vectors.

    Returns:
        One parameter vector whose ``grad`` is set, in a list for an optimiser, and the slice of
        the gradient that belongs to each module.
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
    return [flat], slices


def _aligned(count: int) -> int:
    """``count`` rounded up to 64 bytes of float32: products of unaligned weights are slower."""
    return -(-count // 16) * 16


class Backprop:
    """Forward and backward pass of an MLP, written out.

    It does the arithmetic of autograd and nothing else: activations overwrite their inputs, no
    graph is recorded, and gradients are added where the optimiser reads them. Parameters need a
    ``grad`` (see ``flatten_parameters``), which the caller sets to zero.

    On a CPU the hidden layers run as 1x1 convolutions, which are the same products: PyTorch hands
    float32 convolutions to oneDNN, and float32 matrix products to MKL, which takes twice as long
    where the processor is not Intel's (64 x 64 units, 12 000 rows, Zen 5, two cores: 0.32 against
    0.56 ms forward, 0.69 against 1.22 ms backward). Batches above ``best_rows`` lose that again.

    Args:
        net: Made by ``mlp``.
    """

    def __init__(self, net: nn.Sequential) -> None:
        self._linears = [layer for layer in net if isinstance(layer, nn.Linear)]
        self._activation = net[1]
        self._convolve = self._linears[0].weight.device.type == "cpu" and torch.backends.mkldnn.is_available()
        self._inputs: list[Tensor] = []

    @property
    def best_rows(self) -> int:
        """Rows per call above which a CPU slows down.

        The limit keeps each layer's activations within 1.5 MiB: above about 2 MiB the C library
        returns freed memory to the system, and touching fresh pages costs more than the products.
        """
        if self._linears[0].weight.device.type != "cpu":
            return sys.maxsize
        widest = max(layer.out_features for layer in self._linears)
        return max(256, 3 * 2**19 // (4 * widest))

    @torch.no_grad()
    def forward(self, x: Tensor) -> Tensor:
        """The network's output, shape (n, outputs).

        Args:
            x: Inputs, shape (n, inputs). Kept, with every activation, for ``backward``.
        """
        self._inputs = [x]
        for layer in self._linears[:-1]:
            x = _convolution(x, layer) if self._convolve else nn.functional.linear(x, layer.weight, layer.bias)
            self._activate(x)
            self._inputs.append(x)
        head = self._linears[-1]
        return nn.functional.linear(x, head.weight, head.bias)

    @torch.no_grad()
    def backward(self, delta: Tensor) -> None:
        """Add the gradient of every parameter to its ``grad``.

        Args:
            delta: Gradient of the loss by the output of the last ``forward``, shape (n, outputs).
        """
        for layer, x in zip(reversed(self._linears), reversed(self._inputs), strict=True):
            is_first, is_head = layer is self._linears[0], layer is self._linears[-1]
            if self._convolve and not is_head:
                below = _convolution_backward(delta, x, layer, not is_first)
            else:
                assert layer.weight.grad is not None and layer.bias.grad is not None
                layer.weight.grad.addmm_(delta.t(), x)
                layer.bias.grad += delta.sum(0)
                below = None if is_first else delta @ layer.weight
            if below is not None:
                delta = below
                self._multiply_by_slope(delta, x)

    def _activate(self, x: Tensor) -> None:
        if isinstance(self._activation, nn.ReLU):
            torch.relu_(x)
        elif isinstance(self._activation, nn.ELU):
            nn.functional.elu_(x)
        else:
            torch.tanh_(x)

    def _multiply_by_slope(self, delta: Tensor, y: Tensor) -> None:
        """Multiply ``delta`` in place by the activation's slope, which its output ``y`` determines."""
        aten = torch.ops.aten
        if isinstance(self._activation, nn.ReLU):
            aten.threshold_backward(delta, y, 0, grad_input=delta)
        elif isinstance(self._activation, nn.ELU):
            aten.elu_backward(delta, 1, 1, 1, True, y, grad_input=delta)
        else:
            aten.tanh_backward(delta, y, grad_input=delta)


def _convolution(x: Tensor, layer: nn.Linear) -> Tensor:
    """``layer(x)`` as a 1x1 convolution over an image of n x 1 pixels, channels last: no data moves."""
    out = nn.functional.conv2d(_as_image(x), layer.weight[:, :, None, None], layer.bias)
    return out.permute(0, 2, 3, 1).reshape(len(x), -1)


def _convolution_backward(delta: Tensor, x: Tensor, layer: nn.Linear, with_input: bool) -> Tensor | None:
    """Add the gradients of ``layer`` to its ``grad``; return that of its input if asked for."""
    below, weight, bias = torch.ops.aten.convolution_backward(
        _as_image(delta), _as_image(x), layer.weight[:, :, None, None], [layer.out_features],
        [1, 1], [0, 0], [1, 1], False, [0, 0], 1, [with_input, True, True],
    )  # fmt: skip
    assert layer.weight.grad is not None and layer.bias.grad is not None
    layer.weight.grad += weight[:, :, 0, 0]
    layer.bias.grad += bias
    return below.permute(0, 2, 3, 1).reshape(len(x), -1) if with_input else None


def _as_image(x: Tensor) -> Tensor:
    return x.view(1, len(x), 1, -1).permute(0, 3, 1, 2)


class Actor(nn.Module):
    """A Gaussian policy: its mean is an MLP of the observation, its deviation one number per action."""

    def __init__(
        self, obs_dim: int, hidden: Sequence[int], action_dim: int, activation: Activation, init_std: float
    ) -> None:
        super().__init__()
        self.mean = mlp(obs_dim, hidden, action_dim, activation)
        self.std = nn.Parameter(torch.full((action_dim,), init_std))

    def forward(self, obs: Tensor) -> Tensor:
        """Mean action, shape (n, action_dim)."""
        return self.mean(obs)
