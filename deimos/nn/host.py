"""Torch settings of the host program, which must change neither our numbers nor their device."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch

DEVICES = ("cpu", "cuda")  # whose autocast may be on


@contextmanager
def own_settings() -> Iterator[None]:
    """Compute in the precision and on the devices that the code names, whatever the host prefers; also a decorator.

    Everything that a host's loop calls runs under it. In this thread, until the context ends, autocast is off and
    tensors for which no device is named are on the CPU. The default dtype is shared by all threads, so it is not
    changed here: code that makes a tensor names its dtype.
    """
    with ExitStack() as stack:  # where the host has no such settings, nothing is entered and nothing costs time
        for device in DEVICES:
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        if torch.empty(0, dtype=torch.float32).device.type != "cpu":  # get_default_device misses contexts in 2.7
            stack.enter_context(torch.device("cpu"))
        yield
