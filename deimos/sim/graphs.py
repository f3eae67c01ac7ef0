"""CUDA graphs of torch's and Warp's work together: many small calls for the price of one."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal, get_args

import torch
import warp as wp

from deimos.checks import RunError, one_line
from deimos.nn.graphs import Recorder, Recording
from deimos.sim.shared import warp_device

Mode = Literal["auto", "on", "off"]
MODES: tuple[Mode, ...] = get_args(Mode)
CAPTURE_MODE = "thread_local"  # torch's name for Warp's default: threads that log may use the device meanwhile


class CudaGraph:
    """What torch and Warp launch on the current stream, recorded as one CUDA graph.

    torch begins the capture, so that its allocator reserves the memory for the graph, and Warp is told of it, as both
    document. A Warp loop whose end the device decides (``wp.capture_while``, in mujoco-warp's solver) ends that capture
    and begins another one into the same graph, whose number torch's allocator does not recognise; so everything that
    this thread allocates comes from a separate pool.

    Args:
        work: What is recorded; called once, without any effect on the device yet.
        device: Where; enter ``one_stream`` first.
    """

    def __init__(self, work: Callable[[], Any], device: torch.device) -> None:
        self._graph, self._pool = torch.cuda.CUDAGraph(), torch.cuda.MemPool()
        streams = torch.cuda.current_stream(device), wp.get_stream(warp_device(device))
        recording = torch.cuda.graph(self._graph, stream=streams[0], capture_error_mode=CAPTURE_MODE)
        with no_garbage_collected(device), recording, torch.cuda.use_mem_pool(self._pool, device):
            with wp.ScopedCapture(stream=streams[1], external=True) as capture:
                self.result = work()
        self._modules = capture.graph  # keeps the kernels loaded

    def replay(self) -> None:
        """Do the work."""
        self._graph.replay()


RECORDERS: dict[str, Callable[[Callable[[], Any], torch.device], Recording[Any]]] = {"cuda": CudaGraph}
"""Recorders, by the type of the device."""


def recorder(mode: Mode, device: torch.device) -> Recorder | None:
    """The recorder for a device, which raises ``RunError`` if recording fails; ``None`` for no recording.

    Raises:
        RunError: If the mode is on and the device cannot record.
    """
    found = RECORDERS.get(device.type)
    if mode == "on" and found is None:
        raise RunError(f"graph must be auto or off on {device}, where there are no CUDA graphs, got on.")
    if mode == "off" or found is None:
        return None

    def record(work: Callable[[], Any]) -> Recording[Any]:
        try:
            return found(work, device)
        except RuntimeError as error:
            raise RunError(f"No CUDA graph can be recorded on {device}; use --graph off: {one_line(error)}") from error

    return record


@contextmanager
def no_garbage_collected(device: torch.device) -> Iterator[None]:
    """Keep Python from finalising remains of earlier graphs: on CUDA, freeing their memory would be recorded."""
    if device.type == "cuda":
        gc.collect()  # takes a tenth of a second
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
