"""Several value functions that differ by initialisation and by data, in one stack of weights."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor, nn

from deimos.networks import Backprop, ManyCandidates, activate_, rows_in_cache

LARGE = 4096  # rows from which on members are spread over threads


class Stack:
    """K multilayer perceptrons of one shape; the weights of a layer lie in one tensor, all of them in one vector.

    On a GPU a layer of all members is one batched product. On a CPU batched products are the slower
    ones; there every member is computed by itself, and the members are spread over as many threads as
    torch has when the stack is made. Both give the same numbers up to float32 rounding, and the latter
    the same for any number of threads.

    Args:
        nets: Made by ``networks.mlp``, on one device. Their parameters become views of the stack.
        batched: Whether to use batched products; ``None`` for where they are faster.
    """

    def __init__(self, nets: list[nn.Sequential], batched: bool | None = None) -> None:
        self._linears = [[layer for layer in net if isinstance(layer, nn.Linear)] for net in nets]
        first = self._linears[0][0].weight
        self.parameters = nn.Parameter(torch.zeros(self._pack(), device=first.device))
        self.parameters.grad = torch.zeros_like(self.parameters)
        self._pack(move=True)
        self._activation = nets[0][1]
        self._inputs: list[Tensor] = []
        self.batched = first.device.type != "cpu" if batched is None else batched
        self.members = [Backprop(net) for net in nets]
        self.nets = nets
        self._threads = torch.get_num_threads()
        workers = min(self._threads, len(nets))
        self._pool = None if self.batched or workers == 1 else ThreadPoolExecutor(workers, initializer=_alone)

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

    def each(self, work: Callable[[int], Any], rows: int) -> list:
        """``work(k)`` on ``rows`` rows for every member k, in the order of the members.

        Side by side where the work is large. Threads that call small operations wait for each other more than they
        save, so these run one after another, each on all threads (1200 rows of 64 units, ten members, two cores:
        5.3 against 6.1 ms).
        """
        every: Iterable[int] = range(len(self.nets))
        if self._pool is not None and rows >= LARGE:
            return list(self._pool.map(work, every))
        threads = torch.get_num_threads()
        torch.set_num_threads(self._threads)
        try:
            return [work(k) for k in every]
        finally:
            torch.set_num_threads(threads)

    @torch.no_grad()
    def forward(self, x: Tensor) -> Tensor:
        """Outputs of all members by batched products, shape (K, n, outputs).

        Args:
            x: Inputs, shape (n, inputs), or (K, n, inputs) for inputs of their own. Kept for ``backward``.
        """
        x = x.expand(len(self.nets), -1, -1)
        self._inputs = []
        for i, (weight, bias, _, _) in enumerate(self._layers):
            self._inputs.append(x)
            x = torch.baddbmm(bias.unsqueeze(1), x, weight.transpose(1, 2))
            if i < len(self._layers) - 1:
                x = activate_(x, self._activation)
        return x

    @torch.no_grad()
    def backward(self, delta: Tensor) -> None:
        """Add the gradient of every weight to its ``grad``; ``delta`` is shaped like what ``forward`` gave last."""
        for i in reversed(range(len(self._layers))):
            weight, _, weight_grad, bias_grad = self._layers[i]
            x = self._inputs[i]
            weight_grad.baddbmm_(delta.transpose(1, 2), x)
            bias_grad += delta.sum(1)
            if i:
                delta = torch.bmm(delta, weight)
                self.members[0].multiply_by_slope(delta, x)

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
        """Outputs of members with one output, shape (K, n); a CPU works in pieces that suit its caches.

        Args:
            x: Inputs, shape (n, inputs).
        """
        if self.batched:
            return self.forward(x).squeeze(2)
        value = torch.empty(len(self.nets), len(x), device=x.device)
        size = rows_in_cache(max(layer.in_features for layer in self._linears[0][1:]))

        def work(k: int) -> None:
            for start in range(0, len(x), size):
                rows = slice(start, start + size)
                value[k, rows] = self.members[k].forward(x[rows]).squeeze(1)

        self.each(work, len(x))
        return value


class CandidateValues:
    """Outputs of every member of a stack for many candidates per context; see ``ManyCandidates``."""

    def __init__(self, stack: Stack, goal_dim: int, workspace: int = 64) -> None:
        self._stack = stack
        # On a GPU the members' activations lie in memory together, so each gets its part of the workspace.
        share = max(1, workspace // len(stack.nets)) if stack.batched else workspace
        self._members = [ManyCandidates(net, goal_dim, share) for net in stack.nets]

    def operations(self, contexts: float, count: int) -> float:
        """Multiplications and additions of the products; see ``ManyCandidates.operations``."""
        return sum(member.operations(contexts, count) for member in self._members)

    def __call__(self, context: Tensor, candidates: Tensor) -> Tensor:
        """Shape (K, B, N) for members with one output; the arguments are those of ``ManyCandidates``."""
        # One after another: products this small take less time than handing them to threads (1.7 against 2.1 ms).
        return torch.stack([member(context, candidates).squeeze(2) for member in self._members])


def deviation(values: Tensor) -> Tensor:
    """Standard deviation over the first axis; ``Tensor.std`` takes ten times as long along a strided axis."""
    return (values - values.mean(0)).square_().mean(0).sqrt_()


def _alone() -> None:
    """What a thread of the pool does first: it takes one core, since every core has such a thread."""
    torch.set_num_threads(1)
