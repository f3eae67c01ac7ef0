"""Threads that share work: how many, and what an interrupt or an error does to them."""

import os
import signal
import time

import pytest
import torch

from deimos.nn.threads import ThreadPool, available, on_threads, torch_on_one


def test_torch_alone_keeps_to_one_thread():
    """``torch_on_one`` leaves shared work its threads, whatever is nested, and gives torch its own back."""
    with on_threads(3):
        with torch_on_one():
            assert (torch.get_num_threads(), available()) == (1, 3)
            with on_threads(2):
                assert (torch.get_num_threads(), available()) == (2, 2)
            with torch_on_one():
                assert (torch.get_num_threads(), available()) == (1, 3)
        assert (torch.get_num_threads(), available()) == (3, 3)


@pytest.mark.parametrize("where", ["working", "waiting"])
def test_an_interrupt_leaves_no_thread_behind(where):
    """Ctrl-C while it works or waits is raised once all threads are done, and they work again afterwards."""
    pool, finished = ThreadPool(), []

    def work(i):
        if i == (0 if where == "working" else 1):
            os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.05 * (i > 0))
        finished.append(i)

    with pytest.raises(KeyboardInterrupt):
        pool.run(work, 4)
    assert {1, 2, 3} <= set(finished)
    for count in (4, 2, 4):
        done = []
        pool.run(done.append, count)
        assert sorted(done) == list(range(count))


@pytest.mark.parametrize("thread", [0, 1, 2])
def test_an_error_on_a_thread_is_raised(thread):
    """What the work raises on any thread reaches the caller once all are done, and the threads work on."""
    pool, finished = ThreadPool(), []

    def work(i):
        if i == thread:
            raise MemoryError(f"on thread {i}")
        finished.append(i)

    for _ in range(2):
        with pytest.raises(MemoryError, match=f"on thread {thread}"):
            pool.run(work, 3)
    assert sorted(finished) == sorted(2 * [i for i in range(3) if i != thread])
    done = []
    pool.run(done.append, 3)
    assert sorted(done) == [0, 1, 2]
