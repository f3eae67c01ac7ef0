"""Threads that share work, the number of torch's own threads, and the precision of its products."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch

_shared: ContextVar[int | None] = ContextVar("threads that share work", default=None)


def available() -> int:
    """Threads that may share work: as many as torch has, or would have without ``torch_on_one``."""
    return _shared.get() or torch.get_num_threads()


@contextmanager
def on_threads(count: int) -> Iterator[None]:
    """Run torch's CPU operations, and shared work, on ``count`` threads; afterwards on as many as before."""
    before, token = torch.get_num_threads(), _shared.set(None)
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _shared.reset(token)


@contextmanager
def torch_on_one() -> Iterator[None]:
    """Run torch's CPU operations on one thread, and shared work on as many as before.

    Torch's sums depend on its number of threads; and a thread that has had work spins while it waits for more, which
    takes the processor from everything else.
    """
    if torch.get_num_threads() == 1:  # as within a run; setting it takes as long as a small product
        yield
        return
    share = available()
    with on_threads(1):
        _shared.set(share)
        yield


@contextmanager
def tf32_products(allowed: bool) -> Iterator[None]:
    """Let torch's float32 matrix products round their factors to TF32, or not, whatever the host has chosen."""
    # Torch 2.9 has a setting for each kind of device as well. The one for all overwrites them, but they do not change
    # it, and where they contradict it, it cannot be read: it is then taken to be torch's default.
    devices: list[Any] = [getattr(own, "matmul", None) for own in (torch.backends.cuda, torch.backends.mkldnn)]
    each = [(own, own.fp32_precision) for own in devices if hasattr(own, "fp32_precision")]
    try:
        before = torch.get_float32_matmul_precision()
    except RuntimeError:
        before = "highest"
    torch.set_float32_matmul_precision("high" if allowed else "highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
        for own, precision in each:
            own.fp32_precision = precision


class _Worker(threading.Thread):
    """A thread that sleeps until it is given work; two locks cost half as much as an executor."""

    def __init__(self, number: int) -> None:
        super().__init__(daemon=True)
        self.work: Callable[[int], object] | None = None
        """Its work; ``None`` once it is done."""
        self.error: BaseException | None = None
        """What its last work raised."""
        self._number = number
        self._gate, self._done = threading.Lock(), threading.Lock()
        self._gate.acquire()
        self._done.acquire()
        self.start()

    def run(self) -> None:
        """Work whenever there is some."""
        while self._gate.acquire():
            work = self.work
            if work is None:  # it was woken once too often
                continue
            try:
                work(self._number)
            except BaseException as error:
                self.error = error
            self.work = None
            if self._done.locked():
                self._done.release()

    def wake(self) -> None:
        """Let it look for work; one call too many does no harm."""
        if self._gate.locked():
            self._gate.release()

    def wait(self) -> None:
        """Sleep until it may have done its work."""
        self.wake()
        self._done.acquire()


class ThreadPool:
    """Python threads that sleep while there is nothing to do; made when they are first needed.

    To gain from them, work must release Python's lock; each call must find its own share of it.
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        """Held while work is prepared and run: of two threads of the host, one waits."""
        self._workers: list[_Worker] = []

    def run(self, work: Callable[[int], object], count: int) -> None:
        """Call ``work(i)`` on ``count`` threads, i from 0, the first of them the caller's.

        Ends only when all of them are done, so that none still touches the work's memory. Then raises the first error,
        if any: what interrupted the caller, or what the work raised on a thread.
        """
        while len(self._workers) < count - 1:
            self._workers.append(_Worker(len(self._workers) + 1))
        workers, errors = self._workers[: count - 1], []
        try:
            for worker in workers:
                worker.work, worker.error = work, None
                worker.wake()
            work(0)
        except BaseException as error:  # Ctrl-C may come at any time
            errors.append(error)
        while busy := [worker for worker in workers if worker.work is not None]:
            try:
                busy[0].wait()
            except BaseException as error:
                errors.append(error)
        errors += [worker.error for worker in workers if worker.error is not None]
        if errors:
            raise errors[0]


POOL = ThreadPool()
"""The pool of this process."""

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=POOL.__init__)  # type: ignore[misc]  # threads do not survive a fork
