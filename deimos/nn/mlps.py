"""K multilayer perceptrons of one shape: forward, gradient, and scores of many candidates per context."""

from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from deimos.nn.losses import Loss

if TYPE_CHECKING:
    from deimos.nn.cpu import Kernel

ACTIVATIONS: dict[type[nn.Module], str] = {nn.ReLU: "relu", nn.ELU: "elu", nn.Tanh: "tanh"}


class MLPs:
    """K networks of one shape in one vector of parameters, those of a network end to end as its module orders them.

    Products are torch's or, on a CPU where Warp is installed, those of ``kernels.mlp``. Both give the same to rounding;
    the kernel's results do not depend on the number of threads.

    Args:
        modules: Linear layers with one kind of activation between them, as ``networks.mlp`` makes them, on one device;
            a module may have free parameters besides, which its loss uses (a policy's standard deviation). All
            parameters and their gradients become views of ``parameters`` and ``grad``.
        memory: Where parameters and gradients shall lie, float32, shape (2, K, numbers); ``None`` allocates it.
        workspace: Memory for activations in torch's products [MiB]; what takes more is computed in parts.
    """

    def __init__(self, modules: Sequence[nn.Module], memory: Tensor | None = None, workspace: int = 64) -> None:
        self.modules = list(modules)
        first = self.modules[0]
        linears = [layer for layer in first.modules() if isinstance(layer, nn.Linear)]
        self.units = (linears[0].in_features, *(layer.out_features for layer in linears))
        """Inputs, and outputs of every layer."""
        self.activation = next(ACTIVATIONS[type(layer)] for layer in first.modules() if type(layer) in ACTIVATIONS)
        offsets: dict[Tensor, int] = {}
        size = 0
        for parameter in first.parameters():
            offsets[parameter] = size
            size += parameter.numel()
        self.weights = [offsets[layer.weight] for layer in linears]
        """Where every layer's weights start, shape (outputs, inputs); its biases follow them."""
        in_layers = {parameter for layer in linears for parameter in layer.parameters()}
        free = [parameter for parameter in offsets if parameter not in in_layers]
        start = offsets[free[0]] if free else size
        self.free = slice(start, start + sum(parameter.numel() for parameter in free))
        """Where the free parameters lie."""
        if memory is None:
            memory = torch.zeros(2, len(self.modules), size, device=linears[0].weight.device, dtype=torch.float32)
        self.parameters, self.grad = memory
        """Shape (K, numbers) each."""
        for module, *rows in zip(self.modules, *memory, strict=True):
            _move(module, *rows)
        self._workspace = workspace * 2**20
        self._kernel = _kernel(self)

    def __len__(self) -> int:
        return len(self.modules)

    @torch.no_grad()
    def forward(self, x: Tensor) -> Tensor:
        """Outputs of all networks, shape (K, n, outputs).

        Args:
            x: Inputs, shape (n, inputs), or (K, n, inputs) for inputs of their own; rounded to float32.

        Raises:
            ValueError: If the shape or the device is another one.
        """
        x = self._rounded(x)
        if self._kernel is not None:
            return self._kernel.forward(x)
        parts = [self._layers(x[..., rows, :].expand(len(self), -1, -1))[-1] for rows in self._parts(x.shape[-2])]
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)

    @torch.no_grad()
    def score(self, context: Tensor, candidates: Tensor) -> Tensor:
        """Outputs for many candidates per context, shape (K, B, N, outputs).

        The first layer is linear: the context's share of it is computed once, not N times.

        Args:
            context: The first inputs, shape (B, inputs - goal_dim); rounded to float32.
            candidates: The other inputs, shape (B, N, goal_dim); rounded to float32.

        Raises:
            ValueError: If the shapes do not fit each other or the networks.
        """
        (rows, count, size), known = candidates.shape, self.units[0] - candidates.shape[-1]
        if context.shape != (rows, known) or not 0 < size < self.units[0]:
            raise ValueError(
                f"context and candidates must have the shapes (B, {known}) and (B, N, {size}), together "
                f"{self.units[0]} inputs, got {tuple(context.shape)} and {tuple(candidates.shape)}."
            )
        context, candidates = context.float(), candidates.float()
        weight, bias = self._layer(0)
        start = torch.baddbmm(bias, context.expand(len(self), -1, -1), weight[..., :known].mT)
        if self._kernel is not None:
            y = self._kernel.forward(candidates.reshape(rows * count, size), start, count)
            return y.view(len(self), rows, count, self.units[-1])
        parts = []
        for few in self._parts(rows, count):
            hidden = torch.matmul(candidates[few], weight[:, None, :, known:].mT) + start[:, few, None]
            parts.append(self._layers(hidden.flatten(1, 2), first=1)[-1])
        return torch.cat(parts, dim=1).view(len(self), rows, count, self.units[-1])

    @torch.no_grad()
    def gradient(self, x: Tensor, loss: Loss) -> Tensor:
        """Write ``grad``, the gradient of a loss.

        Args:
            x: Inputs, as ``forward`` takes them.
            loss: What is minimised; ``losses.ValueLoss`` and ``losses.Surrogate`` are computed within the kernel.

        Returns:
            The loss's sums, shape (K, sums).
        """
        return gradients((self, x, loss))[0]

    def _gradient(self, x: Tensor, loss: Loss) -> Tensor:
        """``gradient`` by torch's products."""
        activations = self._layers(x.expand(len(self), -1, -1))
        sums, delta, free = loss(activations.pop(), self.parameters[:, self.free])
        self.grad[:, self.free] = free
        for layer in reversed(range(len(self.weights))):
            below = activations.pop()
            weight, bias = self._layer(layer, self.grad)
            weight.copy_(torch.bmm(delta.mT, below))
            bias.copy_(delta.sum(1, keepdim=True))
            if layer:
                delta = _times_slope(torch.bmm(delta, self._layer(layer)[0]), below, self.activation)
        return sums

    def _layers(self, x: Tensor, first: int = 0) -> list[Tensor]:
        """The inputs and the outputs of all layers; from ``first`` on, whose inputs are those before the activation."""
        outputs = [x] if first == 0 else [_activated(x, self.activation)]
        for layer in range(first, len(self.weights)):
            weight, bias = self._layer(layer)
            x = torch.baddbmm(bias, outputs[-1], weight.mT)
            outputs.append(x if layer == len(self.weights) - 1 else _activated(x, self.activation))
        return outputs

    def _layer(self, layer: int, of: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Views of a layer's weights, shape (K, outputs, inputs), and biases, (K, 1, outputs), in a vector of them."""
        inputs, outputs = self.units[layer : layer + 2]
        numbers = (self.parameters if of is None else of)[:, self.weights[layer] :]
        weight, bias = numbers.split([inputs * outputs, outputs, numbers.shape[1] - (inputs + 1) * outputs], dim=1)[:2]
        return weight.unflatten(1, (outputs, inputs)), bias.unsqueeze(1)

    def _parts(self, rows: int, each: int = 1) -> Iterator[slice]:
        """Parts of rows whose activations fit the workspace; ``each`` row stands for so many."""
        size = max(1, self._workspace // (8 * len(self) * each * max(self.units)))  # a layer's inputs and outputs
        return (slice(start, start + size) for start in range(0, max(rows, 1), size))

    def clip_gradient(self, max_norm: float) -> None:
        """Scale every network's gradient down to a norm of at most ``max_norm``."""
        norm = torch.linalg.vector_norm(self.grad, dim=1, keepdim=True)
        self.grad *= (max_norm / (norm + 1e-6)).clamp(max=1.0)

    def _rounded(self, x: Tensor) -> Tensor:
        """Inputs as float32, if their shape and device are right."""
        inputs, device = self.units[0], self.parameters.device
        if x.device != device:
            raise ValueError(f"x must be on {device}, got it on {x.device}.")
        if x.dim() not in (2, 3) or x.shape[-1] != inputs or (x.dim() == 3 and len(x) not in (1, len(self))):
            raise ValueError(
                f"x must have the shape (n, {inputs}) or ({len(self)}, n, {inputs}), got {tuple(x.shape)}."
            )
        return x.float()


def gradients(*work: tuple[MLPs, Tensor, Loss]) -> list[Tensor]:
    """``MLPs.gradient`` of several, by threads that pass from one to the next without waiting for each other."""
    rounded = [(nets, nets._rounded(x), loss) for nets, x, loss in work]
    prepared = [(nets._kernel, x, loss) for nets, x, loss in rounded if nets._kernel is not None]
    if len(prepared) < len(work):
        return [nets._gradient(x, loss) for nets, x, loss in rounded]
    from deimos.nn import cpu

    return cpu.gradients(prepared)


def _move(module: nn.Module, parameters: Tensor, grad: Tensor) -> None:
    """Lay a module's parameters into a vector, and give them gradients that are views of another."""
    start = 0
    for parameter in module.parameters():
        rows = slice(start, start + parameter.numel())
        parameters[rows] = parameter.data.flatten()
        parameter.data, parameter.grad = parameters[rows].view_as(parameter), grad[rows].view_as(parameter)
        start = rows.stop


def _activated(x: Tensor, activation: str) -> Tensor:
    """NaN stays NaN."""
    return torch.relu_(x) if activation == "relu" else nn.functional.elu_(x) if activation == "elu" else torch.tanh_(x)


def _times_slope(delta: Tensor, y: Tensor, activation: str) -> Tensor:
    """``delta`` times the derivative of an activation, which its output ``y`` determines."""
    if activation == "tanh":
        return delta * (1.0 - y.square())
    return torch.where(y <= 0.0, delta * (y + 1.0) if activation == "elu" else 0.0, delta)


def _kernel(nets: MLPs) -> "Kernel | None":
    """The kernel for networks, on a CPU where Warp is installed."""
    if nets.parameters.device.type != "cpu" or find_spec("warp") is None:
        return None
    from deimos.nn.cpu import Kernel

    return Kernel(nets.units, nets.activation, nets.weights, nets.free, nets.parameters, nets.grad)
