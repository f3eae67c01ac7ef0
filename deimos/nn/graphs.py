"""Work on a device that is recorded once and replayed, as a CUDA graph is, and numbers that may change in between.

A graph repeats the calls that Python made while it was recorded, with the same arguments: tensors by address, numbers
by value. So whatever changes from one replay to the next must be a tensor that is written in place, whatever Python
branches on must be in the graph's key, and whatever Python counts must be counted outside the graph.
"""

from collections.abc import Callable, Hashable
from typing import Any, Generic, Protocol, TypeVar

from torch import Tensor

T = TypeVar("T")


class Recording(Protocol[T]):
    """Recorded calls."""

    result: T
    """What the work returned while it was recorded: tensors that every replay overwrites."""

    def replay(self) -> None:
        """Make the calls again."""


Recorder = Callable[[Callable[[], Any]], Recording[Any]]
"""Runs work once and records what it asks the device to do; the device does it only when it is replayed."""


class Recorded(Generic[T]):
    """Work that is recorded when it is asked for a second time, and replayed from then on.

    The first time it runs directly, which compiles kernels and allocates what is kept.

    Args:
        record: The recorder; with ``None`` the work runs directly every time.
    """

    def __init__(self, record: Recorder | None) -> None:
        self._record = record
        self._key: Hashable = None
        self._recording: Recording[T] | None = None

    def __call__(self, work: Callable[[], T], key: Hashable, replayed: Callable[[], None] = lambda: None) -> T:
        """Do the work.

        Args:
            work: The same every time. It reads and writes tensors that stay where they are, and does not wait for the
                device.
            key: What Python branches on in ``work``; when it changes, the work is recorded again. ``None`` where it
                cannot be recorded.
            replayed: Called after every replay but the first, to count what Python counts in ``work``.
        """
        if self._record is None or key is None or key != self._key:
            self._key, self._recording = key, None
            return work()
        if self._recording is None:
            self._recording = self._record(work)  # now Python has counted, but the device has done nothing
            self._recording.replay()
        else:
            self._recording.replay()
            replayed()
        return self._recording.result


class Mirrored:
    """Descriptor of a number that Python sets and recorded work reads as a tensor on the device.

    Args:
        tensor: Name of the attribute that holds the zero-dimensional tensor.
    """

    def __init__(self, tensor: str) -> None:
        self._tensor = tensor

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: Any, owner: type | None = None) -> float:
        return vars(instance)[self._name]

    def __set__(self, instance: Any, value: float) -> None:
        vars(instance)[self._name] = value
        tensor: Tensor = getattr(instance, self._tensor)
        tensor.fill_(value)  # on CUDA an argument of a kernel, not a copy
