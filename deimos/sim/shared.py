"""One block of memory, seen by Warp and by torch."""

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import warp as wp

from deimos.checks import RunError


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
        """Allocate zeros of a Warp dtype; if it is a vector, the tensor has one axis more than ``shape``."""
        array = wp.zeros(shape, dtype=dtype, device=warp_device(device))
        return cls(array, wp.to_torch(array))


def warp_device(device: torch.device) -> str:
    """Warp's name for a torch device."""
    return "cpu" if device.type == "cpu" else f"cuda:{device.index or 0}"


@contextmanager
def one_stream(device: torch.device) -> Iterator[None]:
    """Run torch and Warp on one explicit CUDA stream, so that neither has to wait for the other.

    Enter it before anything is built on the device, and around every step. On the CPU it does nothing. It is the same
    stream every time, since torch keeps freed memory for the stream that has used it; and it is Warp's, since torch's
    own do not wait for the default stream, on which Warp frees memory that may still be in use.
    """
    if device.type == "cpu":
        yield
        return
    stream = _stream(warp_device(device))
    with wp.ScopedStream(stream), torch.cuda.stream(wp.stream_to_torch(stream)):
        yield


@functools.cache
def _stream(device: str) -> wp.Stream:
    wp.init()  # creating a stream does not do it
    return wp.Stream(device)


def check_stream(device: torch.device) -> None:
    """Raise ``RunError`` unless torch and Warp work on the same CUDA stream: they share memory and do not wait."""
    if device.type == "cpu":
        return
    torchs, warps = torch.cuda.current_stream(device).cuda_stream, wp.get_stream(warp_device(device)).cuda_stream
    if torchs != warps:
        raise RunError(
            f"torch works on CUDA stream {torchs:#x} and Warp on {warps:#x}, and neither waits for the other; build "
            f"and step environments within `with deimos.sim.shared.one_stream(torch.device('{device}')):`."
        )


def find_cuda() -> int:
    """The number of CUDA devices, if torch and Warp both see some.

    Raises:
        RunError: If torch sees one but Warp, which simulates, does not.
    """
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count and not wp.get_cuda_device_count():
        raise RunError(
            f"torch {torch.__version__} sees a CUDA device but Warp {wp.config.version} does not: PyPI's Warp needs an "
            f"NVIDIA driver R580 or newer; update the driver, install the +cu12 wheel of Warp from its releases on "
            f"GitHub, or use --device cpu."
        )
    return count
