"""Matrix products of float32 on a CPU by the faster of the two libraries that PyTorch has for them.

PyTorch hands them to MKL, which takes twice as long as oneDNN and longer where the processor is not Intel's.
A GPU has one library; there everything here is the plain operation.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

_MATMUL: Any = getattr(torch.backends.mkldnn, "matmul", None)  # not in every version of PyTorch


def fast_linear(x: Tensor, weight: Tensor, bias: Tensor | None, activation: nn.Module | None = None) -> Tensor:
    """``activation(x @ weight.t() + bias)``.

    The operator of oneDNN is the one that ``torch.compile`` emits for a linear layer (64 x 64 units, 12 000
    rows, Zen 5, two cores: 0.30 ms, MKL 0.57). Its call alone takes 15 us, MKL's 2 us: below a million
    multiplications MKL is the faster one. It applies ReLU and tanh while it writes the product, which makes
    them nearly free; ELU it does not know.
    """
    if x.shape[1] == 1 and bias is None:
        y = x * weight.t()  # an outer product: MKL takes ten times as long
    elif len(x) * weight.numel() >= 2**20 and x.device.type == "cpu" and (linear := _onednn_linear()) is not None:
        fused = "relu" if isinstance(activation, nn.ReLU) else "tanh" if isinstance(activation, nn.Tanh) else "none"
        y = linear(x, weight, bias, fused, [], "")
        activation = activation if fused == "none" else None
    else:
        y = nn.functional.linear(x, weight, bias)
    return y if activation is None else activate_(y, activation)


@cache
def _onednn_linear() -> Callable[..., Tensor] | None:
    """The operator of oneDNN, which is private to PyTorch; ``None`` where it is missing or takes something else."""
    if not torch.backends.mkldnn.is_available():
        return None
    x = torch.tensor([[-1.0, 3.0]])
    try:
        linear = torch.ops.mkldnn._linear_pointwise
        right = torch.equal(linear(x, x, x[0, :1], "relu", [], ""), torch.tensor([[9.0]]))
    except (AttributeError, RuntimeError, TypeError):
        return None
    return linear if right else None


def add_product_(total: Tensor, delta: Tensor, x: Tensor) -> None:
    """Add ``delta.t() @ x``, the gradient of a layer's weights, shape (outputs, inputs).

    Small products of long sums gain most by ``onednn`` (6144 rows, Zen 5, two cores: 64 x 64 units 0.30 against
    0.14 ms, 11 x 64 units 0.28 against 0.06 ms). It compiles code for every shape it has not seen, so small
    ones, of data whose number varies, are left to MKL.

    Args:
        total: Added to.
        delta: Shape (n, outputs).
        x: Shape (n, inputs).
    """
    if len(x) * total.numel() >= 2**21:
        with onednn(x.device):
            total.addmm_(delta.t(), x)
    else:
        total.addmm_(delta.t(), x)


def activate_(x: Tensor, activation: nn.Module) -> Tensor:
    """Apply an activation that ``networks.mlp`` knows, in place."""
    if isinstance(activation, nn.ReLU):
        return torch.relu_(x)
    if isinstance(activation, nn.ELU):
        return nn.functional.elu_(x)
    return torch.tanh_(x)


def multiply_by_slope_(delta: Tensor, y: Tensor, activation: nn.Module) -> None:
    """Multiply ``delta`` by the derivative of an activation, which its output ``y`` determines, in place."""
    aten = torch.ops.aten
    if isinstance(activation, nn.ReLU):
        aten.threshold_backward(delta, y, 0, grad_input=delta)
    elif isinstance(activation, nn.ELU):
        aten.elu_backward(delta, 1, 1, 1, True, y, grad_input=delta)
    else:
        aten.tanh_backward(delta, y, grad_input=delta)


@contextmanager
def onednn(device: torch.device) -> Iterator[None]:
    """Within it, larger products of float32 on a CPU go to oneDNN where that leaves them float32; else nothing changes.

    The switch (``torch.backends.mkldnn.matmul.fp32_precision``) is the process's: use it around products alone, and
    not from several threads. Afterwards it is what it was, and no longer follows ``torch.backends.fp32_precision``.
    """
    if device.type != "cpu" or not _exact_through_onednn():
        yield
        return
    before = _MATMUL.fp32_precision
    _MATMUL.fp32_precision = "bf16"
    try:
        yield
    finally:
        _MATMUL.fp32_precision = before


@cache
def _exact_through_onednn() -> bool:
    """Whether oneDNN multiplies float32 exactly also where it is allowed bfloat16.

    PyTorch passes float32 on to oneDNN only with that permission. oneDNN uses it on processors with units for
    tiles of bfloat16 (AMX), whose own library is fast in float32, and not on the others.
    """
    if not torch.backends.mkldnn.is_available() or not hasattr(_MATMUL, "fp32_precision"):
        return False
    before = _MATMUL.fp32_precision
    _MATMUL.fp32_precision = "bf16"
    try:
        rows = torch.full((4096, 64), 1 + 2.0**-12)  # bfloat16 would take 1 for it
        sums = rows.t() @ torch.ones(4096, 64)
    finally:
        _MATMUL.fp32_precision = before
    return bool((sums == 4097.0).all())


def keep_freed_memory() -> None:
    """Let the process keep the memory that it frees, up to 62 MiB, instead of giving it back to the system.

    Every activation of an update would otherwise lie in fresh pages, which the system has to find and to clear:
    24 000 faults and a third of the time. The GNU C library raises its thresholds to the largest block that was
    ever freed, up to 32 MiB (``mallopt(3)``, M_MMAP_THRESHOLD); other libraries keep what is freed anyway.
    """
    torch.empty(31 * 2**20, dtype=torch.uint8)


@contextmanager
def on_threads(count: int) -> Iterator[None]:
    """Run torch's CPU operations on so many threads; waking another for small ones costs more than it saves."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
