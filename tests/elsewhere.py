"""A GPU made of a CPU's memory: tensors that say they are on another device, and refuse those that are not.

Operations run on the CPU, in the memory that a tensor of that device stands for, so their numbers are right and Warp's
kernels can share it. What CUDA would refuse is refused: operands, results and masks on the CPU, and NumPy's view of a
tensor. Numbers of the host, CPU tensors without axes and CPU indices may take part, as there. Waits are allowed.

It registers a device with torch, whose interface for that is young: use it in a process of its own.
"""

from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch
import warp as wp
from deimos.kernels import lanes
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from deimos.run import oracle

REGISTER = getattr(backend_registration, "_setup_privateuseone_for_python_backend", None)
NAME = "elsewhere"
COPIES = {"copy_", "_to_copy", "_foreach_copy_"}
JOINS = {"cat", "stack"}  # where CUDA takes no number from the CPU either
INDEXED = {"index", "index_put", "index_put_", "_index_put_impl_"}


class Elsewhere(torch.Tensor):
    """A tensor of the device."""

    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, memory):
        """Stand for a tensor of the CPU."""
        tensor = torch.Tensor._make_wrapper_subclass(
            cls, memory.size(), strides=memory.stride(), storage_offset=memory.storage_offset(), dtype=memory.dtype,
            device=torch.device(NAME, 0),
        )  # fmt: skip
        tensor.memory, tensor.gradient = memory, None
        return tensor

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        """Run an operation."""
        return _run(func, args, kwargs or {})

    data = property(lambda self: Elsewhere(self.memory), lambda self, other: setattr(self, "memory", other.memory))
    grad = property(lambda self: self.gradient, lambda self, other: setattr(self, "gradient", other))

    def tolist(self):
        """The numbers, for the host."""
        return self.memory.tolist()

    def new_tensor(self, data, dtype=None):
        """A tensor of the host's numbers beside this one."""
        return torch.tensor(data, dtype=dtype or self.dtype, device=self.device)

    def numpy(self, **options):
        """NumPy cannot see the device."""
        raise TypeError(f"can't convert {self.device} device type tensor to numpy. Use Tensor.cpu() first")

    __array__ = numpy

    def data_ptr(self):
        """Where the numbers are."""
        return self.memory.data_ptr()


class Everywhere(TorchDispatchMode):
    """Makes new tensors where they are asked for."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """Run an operation."""
        return _run(func, args, kwargs or {})


def _is_here(device):
    return device is None or torch.device(device).type != NAME


def _memory(value):
    return value.memory if isinstance(value, Elsewhere) else value


def _refuse_mixtures(func, args, kwargs):
    """Raise ``RuntimeError`` for operands on both devices, and for results that are not with the operands."""
    name, among = func.overloadpacket.__name__, (args, kwargs)
    if name in INDEXED and isinstance(args[0], Elsewhere):
        among = args[0], args[2:3]
    tensors = [value for value in tree_leaves(among) if isinstance(value, torch.Tensor)]
    ours = [value for value in tensors if isinstance(value, Elsewhere)]
    written = [value for value in (kwargs.get("out"), args[0] if args and name.endswith("_") else None)]
    others = [value for value in tensors if not isinstance(value, Elsewhere) and (value.dim() or name in JOINS)]
    others += [value for value in written if isinstance(value, torch.Tensor) and not isinstance(value, Elsewhere)]
    if ours and others and name not in COPIES:
        shapes = ", ".join(str(tuple(value.shape)) for value in others)
        raise RuntimeError(f"Expected all tensors to be on the same device, but {func} got some on the CPU: {shapes}")


def _run(func, args, kwargs):
    """Run an operation on the memory of its operands."""
    _refuse_mixtures(func, args, kwargs)
    ours = {id(value.memory): value for value in tree_leaves((args, kwargs)) if isinstance(value, Elsewhere)}
    there = bool(ours) if kwargs.get("device") is None else not _is_here(kwargs["device"])
    here = tree_map(_memory, kwargs)
    if kwargs.get("device") is not None:
        here["device"] = torch.device("cpu")
    with torch.no_grad():
        result = func(*tree_map(_memory, args), **here)

    def placed(value):
        if not isinstance(value, torch.Tensor):
            return value
        if id(value) not in ours:
            return Elsewhere(value) if there else value
        return ours[id(value)] if there else value.clone()  # a copy to the CPU must not share its memory

    return tree_map(placed, result)


@contextmanager
def device():
    """Make the device known to torch and, as ``cuda:0``, to Warp; once in a process, and not in a fixture's."""
    REGISTER(NAME)
    with pytest.MonkeyPatch.context() as monkeypatch, Everywhere():
        _install(monkeypatch)
        yield torch.device(NAME, 0)


def _install(monkeypatch):
    """Let torch and Warp make tensors of the device, and see one stream."""
    tensor, as_tensor, save = torch.tensor, torch.as_tensor, torch.save
    to_torch, from_torch = wp.to_torch, wp.from_torch

    def made(make):
        def placed(data, *args, device=None, **options):
            there = isinstance(data, Elsewhere) if device is None else not _is_here(device)
            found = make(_memory(data), *args, device="cpu" if there else device, **options)
            return Elsewhere(found) if there else found

        return placed

    class Generator(torch.Generator):
        def __new__(cls, device="cpu"):
            """Numbers are drawn on the CPU, wherever they are wanted."""
            return super().__new__(cls, "cpu")

    monkeypatch.setattr(torch, "Generator", Generator)
    monkeypatch.setattr(torch, "tensor", made(tensor))
    monkeypatch.setattr(torch, "as_tensor", made(as_tensor))
    monkeypatch.setattr(torch, "save", lambda data, *more: save(tree_map(_memory, data), *more))
    monkeypatch.setattr(wp, "to_torch", lambda array: Elsewhere(to_torch(array)))
    monkeypatch.setattr(wp, "from_torch", lambda tensor: from_torch(_memory(tensor)))
    monkeypatch.setattr(lanes, "AS_ON_GPU", True)
    monkeypatch.setitem(oracle.MOST, NAME, oracle.MOST["cuda"])
    stream = SimpleNamespace(cuda_stream=0)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: stream)
    monkeypatch.setattr(wp, "get_stream", lambda device: stream)
    wp.init()
    runtime = wp._src.context.runtime
    monkeypatch.setitem(runtime.device_map, "cuda:0", runtime.cpu_device)
