"""Several value functions that differ by initialisation and by data, in one stack of weights."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from deimos.networks import ManyCandidates, rows_in_cache
from deimos.products import activate_, multiply_by_slope_, onednn


class Stack:
    """K multilayer perceptrons of one shape; a layer of all members is one batched product.

    The weights of a layer lie in one tensor, those of all layers in one vector.

    Args:
        nets: Made by ``networks.mlp``, on one device. Their parameters become views of the stack.
    """

    def __init__(self, nets: list[nn.Sequential]) -> None:
        self.nets = nets
        self._linears = [[layer for layer in net if isinstance(layer, nn.Linear)] for net in nets]
        first = self._linears[0][0].weight
        self.parameters = nn.Parameter(torch.zeros(self._pack(), device=first.device))
        self.parameters.grad = torch.zeros_like(self.parameters)
        self._pack(move=True)
        self._activation = nets[0][1]
        self._inputs: list[Tensor] = []
        self._threads = torch.get_num_threads()
        widest = max(layer.in_features for layer in self._linears[0][1:])
        self._piece = rows_in_cache(widest * len(nets)) if first.device.type == "cpu" else sys.maxsize

    def _pack(self, move: bool = False) -> int:
        """Lay every layer's weights, then its biases, of all members end to end; returns their number."""
        start, count = 0, len(self._linears)
        self._layers: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        for members in zip(*self._linears, strict=True):
            views: list[Tensor] = []
            for name in ("weight", "bias"):
                tensors = [getattr(layer, name) for layer in members]
                stop = start + count * tensors[0].numel()
                if move:
                    assert self.parameters.grad is not None
                    shape = (count, *tensors[0].shape)
                    value = self.parameters.data[start:stop].view(shape)
                    grad = self.parameters.grad[start:stop].view(shape)
                    for k, tensor in enumerate(tensors):
                        value[k] = tensor.data
                        tensor.data, tensor.grad = value[k], grad[k]
                    views += [value, grad]
                start = -(-stop // 16) * 16  # 64 bytes: products of unaligned weights are slower
            if move:
                weight, weight_grad, bias, bias_grad = views
                self._layers.append((weight, bias, weight_grad, bias_grad))
        return start

    @contextmanager
    def all_threads(self) -> Iterator[None]:
        """Run on as many threads as torch had when the stack was made, also where the caller keeps to one."""
        threads = torch.get_num_threads()
        torch.set_num_threads(self._threads)
        try:
            yield
        finally:
            torch.set_num_threads(threads)

    def pieces(self, rows: int) -> Iterator[slice]:
        """Consecutive parts of ``rows`` rows per member; on a CPU such as suit its caches, on a GPU all of them."""
        return (slice(start, start + self._piece) for start in range(0, max(1, rows), self._piece))

    @torch.no_grad()
    def forward(self, x: Tensor) -> Tensor:
        """Outputs of all members, shape (K, n, outputs).

        Args:
            x: Inputs, shape (n, inputs), or (K, n, inputs) for inputs of their own. Kept for ``backward``.
        """
        x = x.expand(len(self.nets), -1, -1)
        self._inputs = []
        with onednn(x.device):
            for i, (weight, bias, _, _) in enumerate(self._layers):
                self._inputs.append(x)
                x = torch.baddbmm(bias.unsqueeze(1), x, weight.transpose(1, 2))
                if i < len(self._layers) - 1:
                    x = activate_(x, self._activation)
        return x

    @torch.no_grad()
    def backward(self, delta: Tensor) -> None:
        """Add the gradient of every weight to its ``grad``; ``delta`` is shaped like what ``forward`` gave last."""
        with onednn(delta.device):
            for i in reversed(range(len(self._layers))):
                weight, _, weight_grad, bias_grad = self._layers[i]
                x = self._inputs[i]
                weight_grad.baddbmm_(delta.transpose(1, 2), x)
                bias_grad += delta.sum(1)
                if i:
                    # An outer product is no work for a library.
                    delta = delta * weight if delta.shape[2] == 1 else torch.bmm(delta, weight)
                    multiply_by_slope_(delta, x, self._activation)

    def clip_gradients(self, max_norm: float) -> None:
        """Scale every member's own gradient down to a norm of at most ``max_norm``."""
        squares = torch.zeros(len(self.nets), device=self.parameters.device)
        for _, _, weight_grad, bias_grad in self._layers:
            squares += weight_grad.flatten(1).square().sum(1) + bias_grad.square().sum(1)
        factor = (max_norm / (squares.sqrt() + 1e-6)).clamp(max=1.0)
        for _, _, weight_grad, bias_grad in self._layers:
            weight_grad *= factor.view(-1, 1, 1)
            bias_grad *= factor.view(-1, 1)

    @torch.no_grad()
    def values(self, x: Tensor) -> Tensor:
        """Outputs of members with one output, shape (K, n).

        Args:
            x: Inputs, shape (n, inputs), or (K, n, inputs) for inputs of their own.
        """
        return torch.cat([self.forward(x[..., rows, :]).squeeze(2) for rows in self.pieces(x.shape[-2])], dim=1)


class CandidateValues:
    """Outputs of every member of a stack for many candidates per context; see ``ManyCandidates``."""

    def __init__(self, stack: Stack, goal_dim: int, workspace: int = 64) -> None:
        self._stack = stack
        self._members = [ManyCandidates(net, goal_dim, max(1, workspace // len(stack.nets))) for net in stack.nets]

    def operations(self, contexts: float, count: int) -> float:
        """Multiplications and additions of the products; see ``ManyCandidates.operations``."""
        return sum(member.operations(contexts, count) for member in self._members)

    def __call__(self, context: Tensor, candidates: Tensor) -> Tensor:
        """Shape (K, B, N) for members with one output; the arguments are those of ``ManyCandidates``."""
        with self._stack.all_threads():
            return torch.stack([member(context, candidates).squeeze(2) for member in self._members])


def deviation(values: Tensor) -> Tensor:
    """Standard deviation over the first axis; ``Tensor.std`` takes ten times as long along a strided axis."""
    return (values - values.mean(0)).square_().mean(0).sqrt_()
