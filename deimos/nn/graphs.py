"""Work on a device that is recorded once and replayed, as a CUDA graph is; and numbers that may change meanwhile.

A graph repeats the calls that Python made while it was recorded, with the arguments that they had: tensors by their
addresses, numbers by their values. So whatever changes from one time to the next must be a tensor that is written in
place, what Python decides by must be in the key of the graph, and what Python counts must be counted without it.
"""

from collections.abc import Callable, Hashable
from typing import Any, Generic, Protocol, TypeVar

from torch import Tensor

T = TypeVar("T")


class Recording(Protocol[T]):
    """Calls that were recorded."""

    result: T
    """What the work returned while it was recorded: tensors that every replay overwrites."""

    def replay(self) -> None:
        """Make the calls again."""


Recorder = Callable[[Callable[[], Any]], Recording[Any]]
"""Runs work once while it records what the device is asked to do; that is done only when it is replayed."""


class Recorded(Generic[T]):
    """Work that is recorded when it is asked for a second time, and replayed from then on.

    The first time it runs as it is, which compiles kernels and allocates what is kept.

    Args:
        record: Who records; ``None`` for nobody, so that it runs as it is every time.
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
            key: What Python decides by within; when it is another one, the work is recorded anew. ``None`` where it
                cannot be recorded.
            replayed: Counts what Python counts in ``work``, which a replay does not run.
        """
        if self._record is None or key is None or key != self._key:
            self._key, self._recording = key, None
            return work()
        if self._recording is None:
            self._recording = self._record(work)  # Python has counted then, and the device has done nothing
            self._recording.replay()
        else:
            self._recording.replay()
            replayed()
        return self._recording.result


class Mirrored:
    """A number of an object's that Python sets, and recorded work reads as a tensor on the device; a descriptor.

    Args:
        tensor: Name of the object's attribute that holds the tensor, of no axes.
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
        tensor.fill_(value)  # on CUDA an argument of a kernel, and no copy
