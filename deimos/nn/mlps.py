"""K multilayer perceptrons of one shape: forward, gradient, and scores of many candidates per context."""

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from deimos.nn.losses import Loss, Surrogate, ValueLoss, by_outputs
from deimos.nn.networks import ACTIVATIONS
from deimos.nn.normalizer import Normalizer
from deimos.nn.threads import torch_on_one

if TYPE_CHECKING:
    from deimos.nn.cpu import Kernel

_NAMES = {module: name for name, module in ACTIVATIONS.items()}


class MLPs:
    """K networks of one shape in one vector of parameters, each network's contiguous, in its module's order.

    Products are torch's or, on a CPU where Warp is installed, those of ``kernels.mlp``. Both agree up to rounding;
    the kernel's results do not depend on the number of threads.

    Args:
        modules: Linear layers with one kind of activation between them, as ``networks.mlp`` makes them, on one device;
            a module may also have free parameters, which its loss uses (a policy's standard deviation), and a
            ``Normalizer``, whose outputs are then the inputs here. All parameters and their gradients become views of
            ``parameters`` and ``grad``.
        memory: Memory for parameters and gradients, float32, shape (2, K, numbers); ``None`` allocates it.
        workspace: Memory for activations in torch's products [MiB]; what takes more is computed in parts.

    Raises:
        ValueError: If a module has other layers, or the modules' shapes differ.
    """

    def __init__(self, modules: Sequence[nn.Module], memory: Tensor | None = None, workspace: int = 64) -> None:
        self.modules = list(modules)
        first, *others = (_layout(module) for module in self.modules)
        if any(other != first for other in others):
            raise ValueError("modules must all have the same layers.")
        self.units, self.activation, self.weights, self.free = first
        if memory is None:
            parameters = list(self.modules[0].parameters())
            size, device = sum(parameter.numel() for parameter in parameters), parameters[0].device
            memory = torch.zeros(2, len(self.modules), size, device=device, dtype=torch.float32)
        self.parameters, self.grad = memory
        """Shape (K, numbers) each."""
        for module, *rows in zip(self.modules, *memory, strict=True):
            _move(module, *rows)
        self._layers, self._slopes = ([self._layer(k, of) for k in range(len(self.weights))] for of in memory)
        self._workspace = workspace * 2**20
        self._kernel = _kernel(self)

    def __len__(self) -> int:
        return len(self.modules)

    def __getstate__(self) -> dict:
        raise TypeError(
            "Networks whose parameters are views of one vector cannot be copied or pickled, nor can an object that "
            "holds them; make another one and load this one's state_dict()."
        )

    @torch.no_grad()
    def forward(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """Outputs of all networks, shape (K, n, outputs).

        Args:
            x: Inputs, shape (n, inputs), or (K, n, inputs) if each network has its own; rounded to float32.
            out: Memory for the outputs, float32, contiguous; ``None`` allocates it.

        Raises:
            ValueError: If shape or device of the inputs are wrong, or ``out`` does not fit.
        """
        x, shape = self._rounded(x), (len(self), x.shape[-2], self.units[-1])
        if out is not None and (out.shape != shape or out.dtype != torch.float32 or not out.is_contiguous()):
            raise ValueError(
                f"out must be contiguous, float32 and of the shape {shape}, got {out.dtype} and {tuple(out.shape)}."
            )
        if self._kernel is not None:
            return self._kernel.forward(x, out=out)
        x = x.expand(len(self), -1, -1)
        parts = list(self.parts(x.shape[1]))
        if len(parts) == 1:
            return self._outputs(x, out=out)[-1]
        return torch.cat([self._outputs(x[:, rows])[-1] for rows in parts], dim=1, out=out)

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
        weight, bias = self._layers[0]
        with torch_on_one() if self._kernel is not None else nullcontext():
            start = torch.baddbmm(bias, context.expand(len(self), -1, -1), weight[..., :known].mT)
        if self._kernel is not None:
            y = self._kernel.forward(candidates.reshape(rows * count, size), start, count)
            return y.view(len(self), rows, count, self.units[-1])
        parts = []
        for few in self.parts(rows, count):
            hidden = torch.matmul(candidates[few], weight[:, None, :, known:].mT) + start[:, few, None]
            parts.append(self._outputs(hidden.flatten(1, 2), first=1)[-1])
        y = parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)
        return y.view(len(self), rows, count, self.units[-1])

    @torch.no_grad()
    def gradient(self, x: Tensor, loss: Loss) -> Tensor:
        """Write ``grad``, the gradient of a loss.

        Args:
            x: Inputs, as ``forward`` takes them.
            loss: What is minimised; ``losses.ValueLoss`` and ``losses.Surrogate`` are computed within the kernel.

        Returns:
            The loss's sums, shape (K, sums).

        Raises:
            ValueError: If shape or device of the inputs, or of the loss's data, do not fit the networks.
        """
        return gradients((self, x, loss))[0]

    def _gradient(self, x: Tensor, loss: Loss) -> Tensor:
        """``gradient`` with torch's products."""
        activations = self._outputs(x.expand(len(self), -1, -1))
        sums, delta, free = by_outputs(loss, activations.pop(), self.parameters[:, self.free])
        if free.shape[1]:
            self.grad[:, self.free] = free
        for layer in reversed(range(len(self.weights))):
            below = activations.pop()
            weight, bias = self._slopes[layer]
            torch.bmm(delta.mT, below, out=weight)
            torch.sum(delta, 1, keepdim=True, out=bias)
            if layer:
                delta = _times_slope(torch.bmm(delta, self._layers[layer][0]), below, self.activation)
        return sums

    def _outputs(self, x: Tensor, first: int = 0, out: Tensor | None = None) -> list[Tensor]:
        """The inputs and the outputs of layers from ``first`` on; unless that is 0, ``x`` is not activated yet."""
        outputs = [x] if first == 0 else [_activated(x, self.activation)]
        *hidden, (weight, bias) = self._layers[first:]
        for layer in hidden:
            outputs.append(_activated(torch.baddbmm(layer[1], outputs[-1], layer[0].mT), self.activation))
        return [*outputs, torch.baddbmm(bias, outputs[-1], weight.mT, out=out)]

    def _layer(self, layer: int, of: Tensor) -> tuple[Tensor, Tensor]:
        """Views of a layer's weights, shape (K, outputs, inputs), and biases, (K, 1, outputs), in a vector of them."""
        inputs, outputs = self.units[layer : layer + 2]
        numbers = of[:, self.weights[layer] :]
        weight, bias = numbers.split([inputs * outputs, outputs, numbers.shape[1] - (inputs + 1) * outputs], dim=1)[:2]
        return weight.unflatten(1, (outputs, inputs)), bias.unsqueeze(1)

    def parts(self, rows: int, each: int = 1) -> Iterator[slice]:
        """Parts of rows whose activations fit the workspace; each row counts as ``each``."""
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

    def _rounded_loss(self, loss: Loss, rows: int) -> Loss:
        """A loss with its data in float32; these must fit the networks, since the kernel reads them by address."""
        if not isinstance(loss, ValueLoss | Surrogate):
            return loss
        data, device = loss.data, self.parameters.device
        shape = loss.data_shape(len(self), rows, self.units[-1], self.free.stop - self.free.start)
        if data.shape != shape or data.device != device:
            raise ValueError(
                f"data of {type(loss).__name__} must have the shape {shape} on {device}, got {tuple(data.shape)} on "
                f"{data.device}."
            )
        return loss if data.dtype == torch.float32 else replace(loss, data=data.float())


def gradients(*work: tuple[MLPs, Tensor, Loss]) -> list[Tensor]:
    """``MLPs.gradient`` of several, on threads that go from one to the next without waiting for each other."""
    rounded = [(nets, nets._rounded(x), nets._rounded_loss(loss, x.shape[-2:-1].numel())) for nets, x, loss in work]
    prepared = [(nets._kernel, x, loss) for nets, x, loss in rounded if nets._kernel is not None]
    if len(prepared) < len(work):
        return [nets._gradient(x, loss) for nets, x, loss in rounded]
    from deimos.nn import cpu

    return cpu.gradients(prepared)


def _layout(module: nn.Module) -> tuple[tuple[int, ...], str, list[int], slice]:
    """A network's units, its activation, where layers' weights start among its parameters, and which are free."""
    leaves = [part for part in module.modules() if not list(part.children()) and not isinstance(part, Normalizer)]
    linears = [layer for layer in leaves[::2] if isinstance(layer, nn.Linear) and layer.bias is not None]
    between = {type(layer) for layer in leaves[1::2]}
    if len(linears) != len(leaves) // 2 + 1 or len(between) > 1 or not between <= _NAMES.keys():
        names = ", ".join(type(layer).__name__ for layer in leaves)
        raise ValueError(
            f"A network must be linear layers with biases and one of {', '.join(ACTIVATIONS)} between them, "
            f"got {names}."
        )
    offsets: dict[Tensor, int] = {}
    size = 0
    for parameter in module.parameters():
        offsets[parameter] = size
        size += parameter.numel()
    in_layers = {parameter for layer in linears for parameter in layer.parameters()}
    free = [parameter for parameter in offsets if parameter not in in_layers]
    start = offsets[free[0]] if free else size
    free_end = start + sum(parameter.numel() for parameter in free)
    if free and offsets[free[-1]] + free[-1].numel() != free_end:
        raise ValueError("A network's parameters that belong to no layer must follow each other.")
    activation = _NAMES[between.pop()] if between else "relu"  # a single layer has none
    units = linears[0].in_features, *(layer.out_features for layer in linears)
    return units, activation, [offsets[layer.weight] for layer in linears], slice(start, free_end)


def _move(module: nn.Module, parameters: Tensor, grad: Tensor) -> None:
    """Move a module's parameters into a vector, and give them gradients that are views of another."""
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
    """``delta`` times the derivative of an activation, which its output ``y`` determines: autograd's own operator."""
    if activation == "tanh":
        return torch.ops.aten.tanh_backward(delta, y)
    if activation == "elu":
        return torch.ops.aten.elu_backward(delta, 1.0, 1.0, 1.0, True, y)
    return torch.ops.aten.threshold_backward(delta, y, 0.0)


def _kernel(nets: MLPs) -> "Kernel | None":
    """The kernel for networks, on a CPU where Warp is installed."""
    if nets.parameters.device.type != "cpu" or find_spec("warp") is None:
        return None
    from deimos.nn.cpu import Kernel

    return Kernel(nets.units, nets.activation, nets.weights, nets.free, nets.parameters, nets.grad)
