"""Launches that are recorded once and replayed as one graph."""

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
import warp as wp

from deimos.sim.graphs import no_garbage_collected
from deimos.sim.shared import warp_device

PATIENCE = 3.0  # [s] of silence before the wait for the compiler is explained


class Captured:
    """Launches that were recorded once, to be replayed as one graph.

    Args:
        launch: Makes the launches. Run once before it is recorded, which compiles what has to be compiled,
            and once or not at all during recording: whatever it changes must be set again afterwards.
        device: Where they run.
    """

    def __init__(self, launch: Callable[[], None], device: torch.device) -> None:
        self._launch, self._device = launch, wp.get_device(warp_device(device))
        with wp.ScopedDevice(self._device):
            with _say_what_it_waits_for():
                launch()
            with no_garbage_collected(device), wp.ScopedCapture() as capture:
                launch()
        self._graph = capture.graph

    def __call__(self) -> None:
        """Replay the launches; while a larger graph is being recorded, make them.

        CUDA cannot put a graph into another one if it has loops whose end the device decides.
        """
        if self._device.is_cuda and self._device.is_capturing:
            self._launch()
        else:
            wp.capture_launch(self._graph)


@contextmanager
def _say_what_it_waits_for() -> Iterator[None]:
    """Report a compilation of the simulator that takes some seconds; Warp compiles in folders of its cache."""
    done = threading.Event()

    def watch() -> None:
        while not done.wait(PATIENCE):
            if any(Path(wp.config.kernel_cache_dir or "").glob(f"*_p{os.getpid()}_t*")):
                message = "Compiling the simulator for this machine, which takes a minute or two, once."
                print(message, file=sys.stderr, flush=True)
                return

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        done.set()
