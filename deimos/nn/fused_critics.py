"""Values and gradients of a stack of critics by Warp kernels, on the threads of a CPU."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import torch
import warp as wp
from torch import Tensor, nn

from deimos.kernels.critics import CriticTables, Layout, gradients, values

LARGE = 2**18  # values that a call may ask for whose memory is kept until the next one
_Copies = list[tuple[Tensor, Tensor]]  # destination and source


_Layers = list[tuple[Tensor, ...]]  # weights, their gradients, biases and theirs; see ``Stack.layers``


def fuse_critics(layers: _Layers, activation: nn.Module, threads: int) -> "FusedCritics | None":
    """Kernels for a stack on a CPU; ``None`` unless it has ReLU between its layers and one output.

    Args:
        layers: See ``Stack.layers``.
        activation: Between the layers.
        threads: Threads to use.
    """
    fits = isinstance(activation, nn.ReLU) and layers[-1][0].shape[1] == 1
    return FusedCritics(layers, threads) if fits else None


class FusedCritics:
    """See ``fuse_critics``. Threads share the members; what a member computes does not depend on their number."""

    def __init__(self, layers: _Layers, threads: int) -> None:
        wp.init()
        count = len(layers[0][0])
        layout = Layout(tuple(weight.shape[2] for weight, *_ in layers))
        self._table = torch.zeros(count, layout.rows, layout.width)
        self._gradient = torch.zeros_like(self._table)
        self._loads, self._stores = _views(layers, layout, self._table, self._gradient)
        self._critics = CriticTables(layout, wp.from_torch(self._table), wp.from_torch(self._gradient))
        self._others = max(1, min(threads, count)) - 1
        """Threads beside the caller's."""
        self._pool = ThreadPoolExecutor(max(1, self._others))
        self._values: list[wp.Launch] = []

    @torch.no_grad()
    def values(self, x: Tensor) -> Tensor:
        """See ``Stack.values``."""
        value = torch.empty(len(self._table), x.shape[-2])
        arrays = {"x": wp.from_torch(x.expand(len(self._table), -1, -1)), "value": wp.from_torch(value)}
        if not self._values:
            self._values = self._record(partial(values, self._critics, **arrays))
        for launch in self._values:
            for name, array in arrays.items():
                launch.set_param_by_name(name, array)
        _copy(self._loads)
        self._run(self._values)
        if value.numel() > LARGE:
            self._values.clear()  # launches keep what they worked on
        return value

    @torch.no_grad()
    def gradients(
        self, x: Tensor, before: Tensor, target: Tensor, weight: Tensor, clip: float
    ) -> Callable[[range], Tensor]:
        """See ``Stack.gradients``."""
        loss = torch.zeros(len(self._table))
        arrays = [wp.from_torch(tensor.contiguous()) for tensor in (x, before, target, weight, loss)]
        # A recorded launch keeps its arguments alive.
        launches = self._record(partial(gradients, self._critics, *arrays, clip=clip, rows=range(1)))

        def update(rows: range) -> Tensor:
            for launch in launches:
                launch.set_param_by_name("start", rows.start)
                launch.set_param_by_name("stop", rows.stop)
            _copy(self._loads)
            self._run(launches)
            _copy(self._stores)
            return loss

        return update

    def _record(self, launcher: Callable[..., wp.Launch | None]) -> list[wp.Launch]:
        """A launch for every member."""
        launches = [launcher(members=range(k, k + 1), record=True) for k in range(len(self._table))]
        return [launch for launch in launches if launch is not None]

    def _run(self, launches: list[wp.Launch]) -> None:
        """Run all launches; each thread takes the next one, as processors that others use too are not equally fast."""
        waiting = iter(launches)

        def work() -> None:
            for launch in waiting:
                launch.launch()  # Python's lock is free meanwhile

        others = [self._pool.submit(work) for _ in range(self._others)]
        work()
        for other in others:
            other.result()


def _copy(views: _Copies) -> None:
    for to, source in views:
        to.copy_(source)


def _views(layers: _Layers, layout: Layout, table: Tensor, gradient: Tensor) -> tuple[_Copies, _Copies]:
    """What fills the tables, and what their gradients go to."""
    loads: _Copies = []
    stores: _Copies = []
    for layer, (weight, weight_grad, bias, bias_grad) in enumerate(layers):
        outputs, inputs = weight.shape[1:]
        loads += zip(_places(layout, layer, inputs, outputs, table), (weight, bias), strict=True)
        stores += zip((weight_grad, bias_grad), _places(layout, layer, inputs, outputs, gradient), strict=True)
        if 0 < layer < len(layout.transposed):
            transposed = layout.transposed[layer]
            loads.append((table[:, transposed : transposed + outputs, :inputs], weight))
    return loads, stores


def _places(layout: Layout, layer: int, inputs: int, outputs: int, table: Tensor) -> tuple[Tensor, Tensor]:
    """A layer's weights, shape (K, outputs, inputs), and biases, shape (K, outputs), in the tables."""
    start = layout.start[layer]
    if layer == len(layout.transposed):  # the output's
        return table[:, start : start + 1, :inputs], table[:, start + 1, :1]
    return table[:, start : start + inputs, :outputs].transpose(1, 2), table[:, start + inputs, :outputs]
