"""Run ``kernels.mlp`` for ``MLPs``: memory, jobs, and threads that share them."""

import ctypes
import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np
import torch
import warp as wp
from torch import Tensor

from deimos.kernels.mlp import ACTIVATIONS, STEP, Job, Mode, Shape, record
from deimos.nn.losses import Loss, Surrogate, ValueLoss, by_outputs
from deimos.nn.threads import POOL, available

BLOCK_ROWS = 384  # rows of a block: with more, summing a gradient over the lanes of a register costs less
BLOCK_SIZE = 3 * 2**17  # numbers in a block, 1.5 MiB: what a core's caches hold
PARTS = 16  # of the rows of all networks together, each with its own gradient
MIN_OPERATIONS = 1e7  # operations that are worth waking a thread for, about 100 us


@contextmanager
def _quietly() -> Iterator[None]:
    """Keep Warp's messages about its start and the modules it loads off the terminal: the host may not know of it."""
    level = wp.config.log_level
    wp.config.log_level = max(level, wp.LOG_WARNING)
    try:
        yield
    finally:
        wp.config.log_level = level


class Kernel:
    """The kernel for some networks. What it computes depends on their shape and the rows, never on the threads.

    Args:
        units: Inputs, and outputs of every layer.
        activation: One of ``ACTIVATIONS``.
        weights: Where every layer's weights start among a network's parameters.
        free: Which parameters belong to no layer.
        parameters: Shape (K, numbers), float32.
        grad: The gradient, of the same shape, which ``gradients`` writes.
    """

    @_quietly()
    @torch.inference_mode(False)  # what is made in inference mode must also be usable outside it
    def __init__(
        self, units: Sequence[int], activation: str, weights: Sequence[int], free: slice,
        parameters: Tensor, grad: Tensor,
    ) -> None:  # fmt: skip
        wp.init()
        self._parameters, self._grad, self._free, self._outputs = parameters, grad, free, units[-1]
        self._threads = available()
        count, self._size = parameters.shape
        shape = Shape()
        shape.layers, shape.activation = len(units) - 1, ACTIVATIONS.index(activation)
        shape.parameters, shape.free = self._size, free.start
        places = {"units": units, "weight": weights, "unit": [0, *itertools.accumulate(units)]}
        for name, values in places.items():
            setattr(shape, name, wp.array(values, dtype=int, device="cpu"))
        self._operations = 2 * count * sum(a * b for a, b in itertools.pairwise(units))
        columns = 2 * units[-1] + 3  # of the largest loss
        self._block_rows = max(STEP, min(BLOCK_ROWS, BLOCK_SIZE // (sum(units) + columns)) // STEP * STEP)
        stride = 16 * (self._block_rows // 16 | 1)  # an odd number of cache lines: units then use all sets of a cache
        self._memory = torch.zeros(self._threads, (sum(units) + columns) * stride, dtype=torch.float32)
        self._gradient = torch.zeros(0, dtype=torch.float32)
        self._counter = ctypes.c_int32()
        self._jobs = jobs = wp.zeros(1, dtype=Job, device="cpu")
        # A view of that memory; ctypes is cheapest, and every minibatch fills in 30 fields.
        self._job = np.ctypeslib.as_ctypes_type(jobs.numpy().dtype).from_address(jobs.ptr)
        self._fill(
            count=count, block_rows=self._block_rows, stride=stride, counter=ctypes.addressof(self._counter),
            memory=self._memory.data_ptr(), memory_size=self._memory.shape[1], parameters=parameters.data_ptr(),
        )  # fmt: skip
        self._launches = [record(shape, jobs, thread) for thread in range(self._threads)]

    def _fill(self, **fields: float) -> None:
        for name, value in fields.items():
            setattr(self._job, name, value)

    def forward(self, x: Tensor, start: Tensor | None = None, shared: int = 1, out: Tensor | None = None) -> Tensor:
        """Outputs of all networks, shape (K, n, outputs).

        Args:
            x: Inputs, shape (n, inputs) or (K, n, inputs); only the last ones if ``start`` has the others' share.
            start: What the first layer's sums start from instead of its biases, shape (K, n / shared, units).
            shared: Consecutive rows that share a start.
            out: Memory for the outputs, contiguous; ``None`` allocates it.
        """
        rows = x.shape[-2]
        y = torch.empty(len(self._parameters), rows, self._outputs, dtype=torch.float32) if out is None else out
        start = None if start is None else start.contiguous()
        with POOL.lock:
            self._prepare(Mode.FORWARD, x, -(-rows // self._block_rows))
            self._fill(y=y.data_ptr(), start=0 if start is None else start.data_ptr(), shared=shared)
            _run([self], rows * self._operations)
        return y

    def _prepare(self, mode: Mode, x: Tensor, parts: int) -> None:
        """Fill in what every job needs."""
        self._counter.value = 0
        net = x.stride(0) if x.dim() == 3 and len(x) > 1 else 0
        self._fill(
            mode=mode, rows=x.shape[-2], parts=parts, x=x.data_ptr(), x_net=net, x_row=x.stride(-2),
            x_unit=x.stride(-1), inputs=x.shape[-1],
        )  # fmt: skip

    def prepare_gradient(self, mode: Mode, x: Tensor, data: Tensor, sums: int = 0, clip: float = 0.0) -> float:
        """Fill in a job that adds up gradients; return the number of its operations.

        ``data`` is the loss's, or gradients with respect to outputs, shape (K, columns, n); ``sums`` is how many sums
        the loss has.
        """
        rows, count = x.shape[-2], len(self._parameters)
        parts = max(1, min(-(-rows // self._block_rows), max(4, PARTS // count)))
        shape = count, parts, self._size + sums
        if self._gradient.shape != shape:
            with torch.inference_mode(False):
                self._gradient = torch.zeros(shape, dtype=torch.float32)
        self._prepare(mode, x, parts)
        self._fill(
            start=0, gradient=self._gradient.data_ptr(), sums=sums, data=data.data_ptr(), data_net=data.stride(0),
            data_column=data.stride(1), data_row=data.stride(2), columns=data.shape[1], clip=clip,
        )  # fmt: skip
        return 3.0 * rows * self._operations

    def collect(self) -> Tensor:
        """Write the gradient of what has been run, added up in the order of the parts; return the loss's sums."""
        total = self._gradient.sum(1)
        self._grad.copy_(total[:, : self._size])
        return total[:, self._size :]


def gradients(work: list[tuple[Kernel, Tensor, Loss]]) -> list[Tensor]:
    """See ``mlps.gradients``."""
    kernels, jobs = [kernel for kernel, _, _ in work], []
    known: dict[Kernel, tuple[Tensor, Tensor]] = {}
    for kernel, x, loss in work:
        if isinstance(loss, ValueLoss | Surrogate):
            mode = Mode.VALUE if isinstance(loss, ValueLoss) else Mode.SURROGATE
            jobs.append(partial(kernel.prepare_gradient, mode, x, loss.data, loss.sums, loss.clip))
        else:  # torch computes it between two passes
            sums, slopes, free = by_outputs(loss, kernel.forward(x), kernel._parameters[:, kernel._free])
            jobs.append(partial(kernel.prepare_gradient, Mode.BACKWARD, x, slopes.mT))
            known[kernel] = sums, free
    with POOL.lock:
        _run(kernels, sum(prepare() for prepare in jobs))
        found = {kernel: kernel.collect() for kernel in kernels}
    for kernel, (sums, free) in known.items():
        found[kernel], kernel._grad[:, kernel._free] = sums, free
    return list(found.values())


def _run(kernels: list[Kernel], operations: float) -> None:
    """Run the prepared jobs on as many threads as are worth waking."""

    def work(thread: int) -> None:
        for kernel in kernels:
            kernel._launches[thread].launch()  # without Python's lock

    POOL.run(work, max(1, min(min(kernel._threads for kernel in kernels), int(operations / MIN_OPERATIONS))))
