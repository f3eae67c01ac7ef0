"""Threads that share work, and how many torch uses beside them."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch


@contextmanager
def on_threads(count: int) -> Iterator[None]:
    """Run torch's CPU operations on so many threads; afterwards on as many as before.

    A thread of torch's that has had work waits for more in a loop, and takes the processor from everybody else.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Crew:
    """Threads of Python that sleep while there is nothing to do; made when they are first needed.

    Work must release Python's lock to gain by them, and find its own share of what there is to do.
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        """Held by whoever prepares and runs work: of two threads of the host, one waits."""
        self._gates: list[tuple[threading.Lock, threading.Lock]] = []
        self._work: Callable[[int], object] = int

    def run(self, work: Callable[[int], object], count: int) -> None:
        """Call ``work(i)`` on ``count`` threads, i from 0, the first of them the caller's; returns when all have."""
        self._work = work
        while len(self._gates) < count - 1:
            self._hire()
        gates = self._gates[: count - 1]
        for start, _ in gates:
            start.release()
        try:
            work(0)
        finally:
            for _, done in gates:
                done.acquire()

    def _hire(self) -> None:
        start, done = threading.Lock(), threading.Lock()
        start.acquire()
        done.acquire()
        self._gates.append((start, done))
        threading.Thread(target=self._wait, args=(len(self._gates), start, done), daemon=True).start()

    def _wait(self, i: int, start: threading.Lock, done: threading.Lock) -> None:
        while start.acquire():
            try:
                self._work(i)
            finally:
                done.release()


CREW = Crew()
"""The process's."""

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=CREW.__init__)  # type: ignore[misc]  # threads do not survive a fork
