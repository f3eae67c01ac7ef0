"""One block of memory, seen by Warp and by torch."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import warp as wp


@dataclass(frozen=True)
class Shared:
    """A Warp array and a torch tensor over the same memory.

    The pair is frozen because a captured graph and a recorded launch keep the address that they
    were made with: write into the memory (``shared.tensor.copy_(x)``, ``shared.tensor[:] = x``),
    never put another tensor in its place.
    """

    array: wp.array
    tensor: torch.Tensor

    @classmethod
    def zeros(cls, shape: int | tuple[int, ...], dtype: type, device: torch.device) -> "Shared":
        """Allocate zeros of a Warp dtype; where it is a vector, the tensor has one axis more than ``shape``."""
        array = wp.zeros(shape, dtype=dtype, device=warp_device(device))
        return cls(array, wp.to_torch(array))


def warp_device(device: torch.device) -> str:
    """Warp's name of a torch device."""
    return "cpu" if device.type == "cpu" else f"cuda:{device.index or 0}"


@contextmanager
def one_stream(device: torch.device) -> Iterator[None]:
    """Run torch and Warp on one explicit CUDA stream, so that neither has to wait for the other.

    Enter it before anything is built on the device. On the CPU it does nothing. The stream is Warp's: torch's own do
    not wait for the default stream, on which Warp frees memory that may still be in use.
    """
    if device.type == "cpu":
        yield
        return
    stream = wp.Stream(warp_device(device))
    with wp.ScopedStream(stream), torch.cuda.stream(wp.stream_to_torch(stream)):
        yield
