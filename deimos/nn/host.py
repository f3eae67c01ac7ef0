"""Settings of torch that belong to the program around us, and change neither our numbers nor where they lie."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch

DEVICES = ("cpu", "cuda")  # whose autocast may be on


@contextmanager
def own_settings() -> Iterator[None]:
    """Compute in the precision and on the devices that the code names, whatever the host prefers; also a decorator.

    Whatever a host's loop calls runs under it. Autocast is off, and what names no device lies on the CPU, in this
    thread and until the context ends. The default dtype is no thread's own, so nobody changes it here: whoever makes a
    tensor names its dtype.
    """
    with ExitStack() as stack:  # nothing is entered, and nothing is slower, where the host has no such preference
        for device in DEVICES:
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        if torch.empty(0, dtype=torch.float32).device.type != "cpu":  # get_default_device misses contexts in 2.7
            stack.enter_context(torch.device("cpu"))
        yield
