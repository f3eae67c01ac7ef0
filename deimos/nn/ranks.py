"""All communication between the processes of one training run.

``torchrun`` starts several processes, the *ranks*, one per GPU. Each simulates its share of the worlds; what networks
learn from is added up, or gathered, over all of them here, so that every rank ends up with the same networks. Within
``joined`` every rank must make the same calls in the same order. Without it, or with one process, nothing is sent:
every function returns what it was given.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor

from deimos.checks import RunError, SimulationError, one_line

PATIENCE = timedelta(minutes=10)  # for a rank that does not answer; robots' kernels take minutes to compile
T = TypeVar("T")


@dataclass(frozen=True)
class Place:
    """The place of a process among those of its run."""

    rank: int = 0
    """Its number, in [0, size)."""
    size: int = 1
    """Number of processes."""
    local_rank: int = 0
    """Its number among those of its machine, which is also the number of its GPU."""
    local_size: int = 1
    """Number of processes on its machine."""

    @property
    def first(self) -> bool:
        """Whether it is the one that writes files and messages for all."""
        return self.rank == 0


_ALONE = Place()
_place = _ALONE
_apart = False  # within ``together``


def place() -> Place:
    """The place of this process: the first of one, except within ``joined``."""
    return _place


@contextmanager
def joined() -> Iterator[None]:
    """Join the processes that torchrun has started, as its environment variables describe them, within the context.

    Tensors on a CPU are sent by gloo, those on a GPU by NCCL.

    Raises:
        RunError: If the others cannot be reached.
    """
    global _place
    found = _launched()
    if found.size == 1:
        yield
        return
    import torch.distributed as dist

    gpus = torch.cuda.is_available() and dist.is_nccl_available()
    try:
        dist.init_process_group("cpu:gloo,cuda:nccl" if gpus else "gloo", timeout=PATIENCE)
    except (RuntimeError, ValueError) as error:
        raise RunError(f"Rank {found.rank} of {found.size} cannot join the others: {one_line(error)}") from error
    _place = found
    try:
        yield
    finally:
        _place = _ALONE
        dist.destroy_process_group()  # ends threads that would abort an exiting process


def _launched() -> Place:
    """The place that the environment variables give; torchrun sets all of them."""
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    if not all(name in os.environ for name in (*names, "MASTER_ADDR", "MASTER_PORT")):
        return _ALONE
    return Place(*(int(os.environ[name]) for name in names))


def share(name: str, count: int) -> int:
    """How many of ``count`` things, such as worlds, each rank has.

    Raises:
        ValueError: If they cannot be shared evenly; the message calls them ``name``.
    """
    if count % _place.size:
        raise ValueError(f"{name} must be divisible by the {_place.size} ranks that share them, got {count}.")
    return count // _place.size


def sum_over_ranks(value: Tensor, *more: Tensor) -> Tensor:
    """Add up ``value`` over all ranks, in place, and return it; ``more`` of the same dtype go in the same message."""
    if more and _communicates():
        sums = _reduced(torch.cat([part.flatten() for part in (value, *more)]), "SUM")
        for part, sum_ in zip((value, *more), sums.split([part.numel() for part in (value, *more)]), strict=True):
            part.copy_(sum_.view_as(part))
        return value
    return _reduced(value, "SUM")


def max_over_ranks(value: Tensor) -> Tensor:
    """The largest ``value`` of all ranks, component by component, in place; returns it."""
    return _reduced(value, "MAX")


def largest(*numbers: int) -> tuple[int, ...]:
    """The maximum of each number over all ranks; for a flag, whether any rank sets it."""
    if not _communicates():
        return numbers
    return tuple(max_over_ranks(torch.tensor([*map(int, numbers)], device="cpu")).tolist())


def mean_over_ranks(value: Tensor) -> Tensor:
    """Average ``value`` over all ranks, in place, and return it; a mean over its worlds becomes one over all."""
    return sum_over_ranks(value).div_(_place.size) if _communicates() else value


def _reduced(value: Tensor, operation: str) -> Tensor:
    if _communicates():
        import torch.distributed as dist

        _communicate(dist.all_reduce, value, getattr(dist.ReduceOp, operation))
    return value


def gather_rows(value: Tensor, dim: int = 0) -> Tensor:
    """Join tensors with one row per world, of all ranks, along ``dim``, in the order of the worlds' global numbers."""
    if not _communicates():
        return value
    import torch.distributed as dist

    value = value.contiguous()
    parts = [torch.empty_like(value) for _ in range(_place.size)]
    _communicate(dist.all_gather, parts, value)
    return torch.cat(parts, dim)


def own_rows(value: Tensor) -> Tensor:
    """The inverse of ``gather_rows``: this rank's part of a tensor with one row per world, a view."""
    size = len(value) // _place.size
    return value[_place.rank * size : (_place.rank + 1) * size]


def own_transitions(order: Tensor, num_envs: int) -> tuple[Tensor, Tensor | None]:
    """This rank's share of minibatches that are drawn from the transitions of all ranks.

    Args:
        order: Transitions of each minibatch, numbered step * all worlds + global number of the world, int64, shape
            (minibatches, size).
        num_envs: Worlds of each rank.

    Returns:
        This rank's transitions of each minibatch, numbered step * ``num_envs`` + world, padded with others to the n of
        its largest share, shape (minibatches, n); and which are its own, bool, same shape, or ``None`` for all.
    """
    if _place.size == 1:
        return order, None
    step, world = order // (num_envs * _place.size), order % (num_envs * _place.size)
    own, place = (world // num_envs == _place.rank).sort(dim=1, descending=True, stable=True)
    most = max(1, int(own.sum(1).max()))
    return (step * num_envs + world % num_envs).gather(1, place[:, :most]), own[:, :most]


def from_first(make: Callable[[], T]) -> T:
    """The result of ``make`` on the first rank, for every rank; its error is raised on all."""
    with together():
        found = [make() if _place.first else None]
    if _communicates():
        import torch.distributed as dist

        _communicate(dist.broadcast_object_list, found)
    return found[0]  # type: ignore[return-value]


@contextmanager
def together() -> Iterator[None]:
    """Raise on every rank what one of them raises within, with its number; where several fail, what the first raises.

    Within, each rank is alone and nothing is sent: sums are over its own worlds, and a state holds only these.

    Raises:
        RunError, SimulationError: If another rank has failed.
    """
    global _apart
    if not _communicates():
        yield
        return
    fault, _apart = None, True
    try:
        yield
    except Exception as error:  # whatever it is: the others wait for a message, and it is raised again below
        fault = error
    finally:
        _apart = False
    if not any(largest(fault is not None)):
        return
    import torch.distributed as dist

    said: list[Any] = [None] * _place.size
    known = isinstance(fault, RunError | SimulationError)
    text = str(fault) if known else repr(fault)
    _communicate(dist.all_gather_object, said, fault and (text, isinstance(fault, SimulationError)))
    rank, (text, numbers) = next((rank, heard) for rank, heard in enumerate(said) if heard)
    if fault is not None and not known:
        raise fault
    if not numbers:
        raise RunError(f"Rank {rank}: {text}") from fault
    raise SimulationError(f"Rank {rank}: {text}", rank) from fault


def _communicates() -> bool:
    """Whether there are other ranks to communicate with."""
    return _place.size > 1 and not _apart


def _communicate(collective: Callable, *arguments: Any) -> None:
    """Communicate with the other ranks.

    Raises:
        RunError: If one of them has ended or does not answer.
    """
    try:
        collective(*arguments)
    except RuntimeError as error:
        raise RunError(
            f"Rank {_place.rank} has lost another rank, which has ended or has not answered for "
            f"{PATIENCE.total_seconds() / 60:g} minutes; see its own message ({one_line(error).partition('. ')[0]})."
        ) from error
