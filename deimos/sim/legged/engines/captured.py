"""Launches that are recorded once and replayed as one graph."""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
import warp as wp

from deimos.sim.shared import warp_device

PATIENCE = 3.0  # [s] of silence before the first step says what it waits for


class Captured:
    """Launches that were recorded once, to be replayed as one graph.

    Args:
        launch: Makes the launches. Run once before it is recorded, which compiles what has to be compiled,
            and once or not at all while it is: whatever it changes has to be set anew afterwards.
        device: Where they run.
    """

    def __init__(self, launch: Callable[[], None], device: torch.device) -> None:
        with wp.ScopedDevice(warp_device(device)):
            with _say_what_it_waits_for():
                launch()
            with wp.ScopedCapture() as capture:
                launch()
        self._graph = capture.graph

    def __call__(self) -> None:
        """Replay the launches."""
        wp.capture_launch(self._graph)


@contextmanager
def _say_what_it_waits_for() -> Iterator[None]:
    """After some seconds of silence, say that the simulator is being compiled."""
    message = "Compiling the simulator for this machine, which takes a minute or two, once."
    timer = threading.Timer(PATIENCE, lambda: print(message, file=sys.stderr, flush=True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
