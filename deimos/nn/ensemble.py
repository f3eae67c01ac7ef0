"""Several value functions that differ by initialisation and by data, in one stack of weights."""

from collections.abc import Callable, Iterator

import torch
from torch import Tensor, nn

from deimos.nn.fusion import fused_critics
from deimos.nn.matmul import activate_, multiply_by_slope_, on_threads, onednn
from deimos.nn.networks import rows_in_cache
from deimos.nn.returns import value_gradient


class Stack:
    """K multilayer perceptrons of one shape and one output.

    All weights lie in one vector, those of a member end to end. A layer of all members is one batched product, unless
    there are kernels for the whole.

    Args:
        nets: Made by ``networks.mlp``, on one device. Their parameters become views of the stack.
        kernels: Whether Warp kernels may do the work where there are any for it.
    """

    def __init__(self, nets: list[nn.Sequential], *, kernels: bool = True) -> None:
        self.nets = nets
        linears = [[layer for layer in net if isinstance(layer, nn.Linear)] for net in nets]
        tensors = [[tensor for layer in own for tensor in (layer.weight, layer.bias)] for own in linears]
        sizes = [-(-tensor.numel() // 16) * 16 for tensor in tensors[0]]  # 64 bytes: unaligned weights are slower
        device = tensors[0][0].device
        self.parameters = nn.Parameter(torch.zeros(len(nets) * sum(sizes), device=device))
        self.parameters.grad = torch.zeros_like(self.parameters)
        self._gradient = self.parameters.grad.view(len(nets), -1)
        views = []
        parts = (memory.view(len(nets), -1).split(sizes, dim=1) for memory in (self.parameters.data, self._gradient))
        for members, value, grad in zip(zip(*tensors, strict=True), *parts, strict=True):
            shape, size = members[0].shape, members[0].numel()
            views.append([part[:, :size].view(-1, *shape) for part in (value, grad)])
            for tensor, own, own_grad in zip(members, *views[-1], strict=True):
                own.copy_(tensor.data)
                tensor.data, tensor.grad = own, own_grad
        self.layers = [(*weights, *biases) for weights, biases in zip(views[::2], views[1::2], strict=True)]
        """Weights (K, outputs, inputs), their gradients, biases (K, outputs) and theirs, of every layer: views."""
        self._activation = nets[0][1]
        self._inputs: list[Tensor] = []
        self.threads = torch.get_num_threads()
        """Threads that torch had when the stack was made; it uses them also where its caller keeps to one."""
        widest = max(layer.in_features for layer in linears[0][1:]) * len(nets)
        self._piece = rows_in_cache(widest) if device.type == "cpu" else max(1, 2**26 // widest)
        self.fused = fused_critics(self.layers, self._activation, self.threads) if kernels else None
        """Kernels in the place of batched products, if there are any."""

    @torch.no_grad()
    def values(self, x: Tensor) -> Tensor:
        """Outputs of all members, shape (K, n).

        Args:
            x: Inputs, shape (n, inputs), or (K, n, inputs) for inputs of their own.
        """
        if self.fused is not None:
            return self.fused.values(x)
        with on_threads(self.threads):
            return torch.cat([self.forward(x[..., rows, :]).squeeze(2) for rows in self._pieces(range(x.shape[-2]))], 1)

    @torch.no_grad()
    def gradients(
        self, x: Tensor, before: Tensor, target: Tensor, weight: Tensor, clip: float
    ) -> Callable[[range], Tensor]:
        """The gradient of the clipped value loss of every member on rows of its own; see ``returns.value_gradient``.

        Args:
            x: Inputs, shape (K, n, inputs).
            before: Values before the update, shape (K, n).
            target: What they should be, shape (K, n).
            weight: Weight of every row in the average, 0 or more, shape (K, n).
            clip: How far a value may move, positive; infinite for the plain squared error.

        Returns:
            A function that takes a range of rows, writes ``parameters.grad`` and returns the losses, shape (K,),
            which its next call may overwrite.
        """
        if self.fused is not None:
            return self.fused.gradients(x, before, target, weight, clip)

        def update(rows: range) -> Tensor:
            assert self.parameters.grad is not None
            self.parameters.grad.zero_()
            share = weight[:, rows.start : rows.stop]
            share = share / share.sum(1, keepdim=True).clamp(min=1.0)
            losses = torch.zeros(len(x), device=x.device)
            with on_threads(self.threads):
                for piece in self._pieces(rows):
                    value = self.forward(x[:, piece]).squeeze(2)
                    own = share[:, piece.start - rows.start : piece.stop - rows.start]
                    loss, slope = value_gradient(value, before[:, piece], target[:, piece], own, clip=clip, coef=1.0)
                    self.backward(slope.unsqueeze(2))
                    losses += loss
            return losses

        return update

    def _pieces(self, rows: range) -> Iterator[slice]:
        """Consecutive parts of some rows; on a CPU such as suit its caches, on a GPU such as fit 256 MiB a layer."""
        starts = range(rows.start, max(rows.stop, rows.start + 1), self._piece)
        return (slice(start, min(start + self._piece, rows.stop)) for start in starts)

    @torch.no_grad()
    def forward(self, x: Tensor) -> Tensor:
        """Outputs of all members, shape (K, n, outputs).

        Args:
            x: Inputs, shape (n, inputs), or (K, n, inputs) for inputs of their own. Kept for ``backward``.
        """
        x = x.expand(len(self.nets), -1, -1)
        self._inputs = []
        with onednn(x.device):
            for i, (weight, _, bias, _) in enumerate(self.layers):
                self._inputs.append(x)
                x = torch.baddbmm(bias.unsqueeze(1), x, weight.transpose(1, 2))
                if i < len(self.layers) - 1:
                    x = activate_(x, self._activation)
        return x

    @torch.no_grad()
    def backward(self, delta: Tensor) -> None:
        """Add the gradient of every weight to its ``grad``; ``delta`` is shaped like what ``forward`` gave last."""
        with onednn(delta.device):
            for i in reversed(range(len(self.layers))):
                weight, weight_grad, _, bias_grad = self.layers[i]
                x = self._inputs[i]
                weight_grad.baddbmm_(delta.transpose(1, 2), x)
                bias_grad += delta.sum(1)
                if i:
                    # An outer product is no work for a library.
                    delta = delta * weight if delta.shape[2] == 1 else torch.bmm(delta, weight)
                    multiply_by_slope_(delta, x, self._activation)

    def clip_gradients(self, max_norm: float) -> None:
        """Scale every member's own gradient down to a norm of at most ``max_norm``."""
        norm = torch.linalg.vector_norm(self._gradient, dim=1, keepdim=True)
        self._gradient *= (max_norm / (norm + 1e-6)).clamp(max=1.0)


def deviation(values: Tensor) -> Tensor:
    """Standard deviation over the first axis; ``Tensor.std`` takes ten times as long along a strided axis."""
    return (values - values.mean(0)).square_().mean(0).sqrt_()
