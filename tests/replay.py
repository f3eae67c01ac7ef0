"""A stand-in for a CUDA graph on a CPU: the very calls that torch and Warp were asked for, made again.

As from a graph, no Python of ours runs in a replay: every operation reads the tensors and the numbers that it had while
it was recorded, and its results go where they went then. Random numbers are drawn on, as by a generator that a graph
knows. So whatever changes from one time to the next, and is no tensor that is written in place, stays what it was.
"""

from collections import Counter
from contextlib import contextmanager

import torch
import warp as wp
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from deimos.goals import core
from deimos.nn import mlps, random
from deimos.sim import graphs, warp_env

WAITING = {
    "_local_scalar_dense", "nonzero", "masked_select", "_unique", "_unique2", "unique_dim", "unique_consecutive",
    "bincount", "equal", "is_nonzero", "multinomial", "_linalg_check_errors", "histc",
}  # fmt: skip
"""Operations that wait for CUDA: they give the host a number, or a size that depends on numbers."""
READING = {"tolist", "numpy", "cpu", "item", "__array__", "__bool__", "__int__", "__float__", "__index__"}
"""Methods of tensors that hand numbers to the host; on a CPU not all of them come by an operation."""


def waits(func, args):
    """Whether an operation waits for a GPU, or copies something there that the host has."""
    name = func.overloadpacket.__name__
    if name in WAITING or (name == "repeat_interleave" and func._overloadname == "Tensor"):
        return True
    if name == "lift_fresh":  # a tensor of the host's numbers
        return True
    masks = args[1] if name in ("index", "index_put", "index_put_", "_index_put_impl_") else ()
    return any(mask is not None and mask.dtype == torch.bool for mask in masks)


class Calls(TorchDispatchMode):
    """Counts operations by name, those that start work apart from views, and finds those that wait for a GPU."""

    def __init__(self):
        super().__init__()
        self.work, self.views, self.waits = Counter(), Counter(), Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """Take note of an operation, and run it."""
        name = func.overloadpacket.__name__
        (self.views if func.is_view or name == "_unsafe_view" else self.work)[name] += 1
        if waits(func, args):
            self.waits[name] += 1
        return func(*args, **(kwargs or {}))


class Reads(TorchFunctionMode):
    """Finds methods of tensors that hand numbers to the host."""

    def __init__(self):
        super().__init__()
        self.found = Counter()

    def __torch_function__(self, func, types, args=(), kwargs=None):
        """Take note of a call, and make it."""
        if getattr(func, "__name__", "") in READING:
            self.found[func.__name__] += 1
        return func(*args, **(kwargs or {}))


@contextmanager
def counted():
    """Counts calls within; what waits is in ``waits``."""
    with Reads() as reads, Calls() as calls:
        yield calls
    calls.waits += reads.found


class Replay(TorchDispatchMode):
    """Records work as ``graphs.CudaGraph`` does; what the work did meanwhile stands for the first replay."""

    noting = None
    """What is being recorded, if anything is."""

    def __init__(self, work, device):
        super().__init__()
        self._calls, self._done = [], True
        Replay.noting = self._calls
        try:
            with self:
                self.result = work()
        finally:
            Replay.noting = None

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """Take note of an operation, and run it."""
        kwargs = kwargs or {}
        if waits(func, args):
            raise RuntimeError(f"{func} waits for the device, which a graph that is being recorded cannot.")
        result = func(*args, **kwargs)
        if not func.is_view:
            self._calls.append((self._call, (func, args, kwargs, result)))
        return result

    @staticmethod
    def _call(func, args, kwargs, recorded):
        for old, new in zip(tree_leaves(recorded), tree_leaves(func(*args, **kwargs)), strict=True):
            if isinstance(old, torch.Tensor) and old.data_ptr() != new.data_ptr():
                old.copy_(new)

    def replay(self):
        """Make the calls again."""
        if self._done:
            self._done = False
            return
        for call, arguments in self._calls:
            call(*arguments)


def note_launches(monkeypatch):
    """Let whoever records note Warp's launches too, as they are at the time: others may change their sizes."""
    launch, launch_graph = wp.Launch.launch, wp.capture_launch

    def again(command, bounds):
        command.bounds = command.params[0] = bounds
        launch(command)

    def noted(command):
        if Replay.noting is not None:
            Replay.noting.append((again, (command, command.bounds)))
        launch(command)

    def graph_noted(graph):
        if Replay.noting is not None:
            Replay.noting.append((launch_graph, (graph,)))
        launch_graph(graph)

    monkeypatch.setattr(wp.Launch, "launch", noted)
    monkeypatch.setattr(wp, "capture_launch", graph_noted)


def as_on_gpu(monkeypatch):
    """Let torch compute on a CPU what it does on CUDA: products, random numbers, goals of all worlds at once."""
    monkeypatch.setattr(mlps, "_kernel", lambda nets: None)
    monkeypatch.setattr(random, "philox", random._rounds)
    monkeypatch.setattr(core, "AS_ON_GPU", True)
    monkeypatch.setattr(warp_env, "AS_ON_GPU", True)


def replay_on_cpu(monkeypatch):
    """The same, and what a GPU replays as CUDA graphs is replayed by ``Replay``; call it before anything is built."""
    as_on_gpu(monkeypatch)
    note_launches(monkeypatch)
    monkeypatch.setitem(graphs.RECORDERS, "cpu", Replay)
