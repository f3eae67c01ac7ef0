"""What other people's loops hand over, as tensors: checked, without gradients, floats as float32; and what they get."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from deimos.goals.faults import Faults, refuse_outside_0_and_1, refuse_unsound
from deimos.goals.interactions import assign
from deimos.goals.selector import Delegate, GoalSelector, with_parts
from deimos.nn.random import Purpose, uniforms

Array = Tensor | np.ndarray
A = TypeVar("A", Tensor, np.ndarray)  # what comes back is of the kind of what came in
Bound = Array | Sequence[float]
Rows = Array | slice | Sequence[int] | None
Candidates = Array | Callable[[Array], Array] | None


@dataclass(frozen=True)
class Assignment(Generic[A]):
    """What every world pursues next; arrays or tensors, as the goals given to the step."""

    goal: A
    """Goals, shape (num_envs, goal_dim): the given ones except where ``changed``."""
    changed: A
    """True where the goal is a new one, bool, shape (num_envs,)."""
    weight: A
    """Weight of the transitions under the goal in everything that the learner learns, at least 0, shape (num_envs,);
    1 under most selectors."""


def matrix(name: str, value: Array, components: str) -> tuple[int, int]:
    """Rows and ``components`` of an array.

    Raises:
        ValueError: If it does not have two axes.
    """
    shape = tuple(np.shape(value))
    if len(shape) != 2:
        raise ValueError(f"{name} must have the shape (num_envs, {components}), got {shape}.")
    return shape


def tensor(name: str, value: Bound | int, device: torch.device) -> Tensor:
    """An array or a tensor as a tensor on ``device``, without gradients.

    Raises:
        ValueError: If it is a tensor on another device, or does not hold numbers.
    """
    if isinstance(value, Tensor):
        if value.device != device:
            raise ValueError(
                f"{name} must be on {device}, got it on {value.device}; GoalDirector(device=...) names another one."
            )
        return value.detach()
    try:
        return torch.from_numpy(np.array(value)).to(device)  # a copy, since an array may refuse to be written to
    except (TypeError, ValueError, RuntimeError) as error:
        kind = f"{type(value).__module__}.{type(value).__qualname__}"
        kind += f" of {value.dtype}" if isinstance(value, np.ndarray) else ""  # not all of NumPy's types are torch's
        raise ValueError(f"{name} must be an array or a tensor of numbers, got {kind}.") from error


def floats(name: str, value: Bound, shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Numbers of exactly this shape, float32.

    Raises:
        ValueError: If they have another shape.
    """
    numbers = tensor(name, value, device)
    if numbers.shape != shape:
        raise ValueError(f"{name} must have the shape {shape}, got {tuple(numbers.shape)}.")
    return numbers.float()


def flags(name: str, value: Array, num_envs: int, device: torch.device, faults: Faults | None = None) -> Tensor:
    """Flags of all worlds, bool, shape (num_envs,), from bool or from whole or real numbers 0 and 1.

    Raises:
        ValueError: If they have another shape or are other numbers.
    """
    marks = tensor(name, value, device)
    if marks.shape != (num_envs,):
        raise ValueError(f"{name} must have the shape {(num_envs,)}, got {tuple(marks.shape)}.")
    if marks.dtype == torch.bool:
        return marks
    other = (marks != 0) & (marks != 1)
    if faults is not None:
        faults.note(f"{name} of world {{world}} must be bool, or 0 and 1", other)
    elif bool(other.any()):
        world = int(other.nonzero()[0])
        raise ValueError(f"{name} must be bool, or 0 and 1, got {marks[world].item()} in world {world}.")
    return marks == 1


def worlds(
    rows: Rows, num_envs: int, device: torch.device, count: int | None = None, faults: Faults | None = None
) -> Tensor:
    """The listed worlds, int64, shape (m,), from indices, a mask, a slice, or ``None`` for all.

    Args:
        rows: Which.
        num_envs: Worlds.
        device: Where.
        count: How many a mask must have, where they are not to be counted at once.
        faults: Where to note what does not fit; ``None`` to refuse it at once.

    Raises:
        ValueError: If a world does not exist or is listed twice, or a mask has another length.
    """
    every = torch.arange(num_envs, dtype=torch.int64, device=device)
    if rows is None or isinstance(rows, slice):
        return every if rows is None else every[rows]
    listed = tensor("rows", rows, device)
    if listed.dtype == torch.bool:
        _check_mask(listed, num_envs)
        if faults is None or count is None:
            return every[listed]
        faults.note("rows must be as many worlds as state has rows", (listed.sum() != count).expand(num_envs))
        return torch.nonzero_static(listed, size=count).squeeze(1).clamp(min=0)
    if listed.dim() != 1 or (len(listed) and (listed.is_floating_point() or listed.is_complex())):
        raise ValueError(f"rows must be indices of worlds, a mask or a slice, got {rows!r}.")
    listed = listed.long()
    if faults is not None:
        there = listed.clamp(0, num_envs - 1)
        times = torch.zeros_like(every).index_add_(0, there, 1 + (there != listed).long())
        faults.note(f"rows must be worlds in [0, {num_envs}), each once", times > 1)
        return there
    if not bool(((listed >= 0) & (listed < num_envs)).all()) or len(listed.unique()) < len(listed):
        raise ValueError(f"rows must be worlds in [0, {num_envs}), each once, got {listed.tolist()}.")
    return listed


def marked(rows: Rows, num_envs: int, device: torch.device, faults: Faults | None = None) -> Tensor:
    """True in the listed worlds, bool, shape (num_envs,); for the arguments and errors see ``worlds``."""
    if not (rows is None or isinstance(rows, slice)):
        rows = tensor("rows", rows, device)
        if rows.dtype == torch.bool:
            _check_mask(rows, num_envs)
            return rows
    listed = worlds(rows, num_envs, device, faults=faults)
    return torch.zeros(num_envs, dtype=torch.bool, device=device).index_fill_(0, listed, True)


def _check_mask(rows: Tensor, num_envs: int) -> None:
    if rows.shape != (num_envs,):
        raise ValueError(f"rows must be a mask of the shape {(num_envs,)}, got {tuple(rows.shape)}.")


def like(values: Tensor, model: A) -> A:
    """Values as an array if ``model`` is one, else as a tensor; floats in its dtype, if it has floats."""
    if isinstance(model, Tensor):
        return values.to(model.dtype) if values.is_floating_point() and model.is_floating_point() else values
    array, dtype = values.cpu().numpy(), np.asarray(model).dtype
    return array.astype(dtype) if values.is_floating_point() and np.issubdtype(dtype, np.floating) else array


def taken(values: Candidates, rows: Tensor, where: Tensor | None) -> Candidates:
    """The candidates of some worlds, int64, shape (m,), if they exist already; with ``where``, these are all worlds."""
    if values is None or callable(values) or where is not None:
        return values
    return values[rows] if isinstance(values, Tensor) else np.asarray(values)[rows.cpu().numpy()]


def replaced(values: A, rows: Tensor, new: Tensor, where: Tensor | None = None) -> A:
    """A copy of ``values``, shape (num_envs, ...), with new rows, int64, shape (m,); whole numbers become float32.

    For ``where`` see ``deimos.goals.interactions.assign``.
    """
    if isinstance(values, Tensor):
        copy = values.detach().clone() if values.is_floating_point() else values.float()
        assign(copy, rows, new.to(copy.dtype), where)
        return copy
    array = np.array(values)
    array = array if np.issubdtype(array.dtype, np.floating) else array.astype(np.float32)
    places = (rows if where is None else where).cpu().numpy()
    array[places] = (new if where is None else new[where]).cpu().numpy()
    return array


@dataclass(frozen=True)
class Inputs:
    """Sizes and device that arguments must have."""

    num_envs: int
    """Worlds."""
    state_dim: int
    """Components of a state."""
    goal_dim: int
    """Components of a goal."""
    device: torch.device
    """Device of tensors."""
    columns: tuple[int, ...]
    """Shape of the tracking of a world: () for the whole goal, (groups,) for each group of its components."""
    faults: Faults | None = None
    """Where to note what does not fit; ``None`` to refuse it at once."""

    def states(self, value: Array, count: int) -> Tensor:
        """States of ``count`` worlds."""
        return floats("state", value, (count, self.state_dim), self.device)

    def goals(self, value: Array, count: int, name: str = "goal") -> Tensor:
        """Goals of ``count`` worlds, called ``name``."""
        return floats(name, value, (count, self.goal_dim), self.device)

    def ends(
        self, terminated: Array, truncated: Array, tracking: Array | None, executed: Array | None
    ) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
        """What a step of all worlds ended in; see ``GoalDirector.step``."""
        crashed, cut_off = (
            flags(name, value, self.num_envs, self.device, self.faults)
            for name, value in (("terminated", terminated), ("truncated", truncated))
        )
        met = pursued = None
        if tracking is not None:
            met = floats("tracking", tracking, (self.num_envs, *self.columns), self.device)
            refuse_outside_0_and_1("tracking", met, self.faults)
        if executed is not None:
            pursued = self.goals(executed, self.num_envs, "executed")
            refuse_unsound("executed", pursued, faults=self.faults)
        return crashed, cut_off, met, pursued

    def check_candidates(self, value: Candidates, count: int) -> None:
        """Raise ``ValueError`` if candidates are given, but not of ``count`` worlds, shape (count, N, goal_dim)."""
        if value is None or callable(value):
            return
        shape = tuple(np.shape(value))
        if len(shape) != 3 or shape[::2] != (count, self.goal_dim) or shape[1] < 1:
            expected = f"({count}, N, {self.goal_dim}) with N at least 1"
            raise ValueError(f"candidates must have the shape {expected}, got {shape}.")

    def candidates(self, value: Array, count: int) -> Tensor:
        """Candidates of ``count`` worlds, shape (count, N, goal_dim)."""
        self.check_candidates(value, count)
        return tensor("candidates", value, self.device).float()

    def horizons(self, value: Array | int, most: int, rows: Tensor) -> Tensor:
        """Steps that the goals of some worlds, int64, shape (m,), are to last, in [1, most], int64, shape (m,)."""
        count = len(rows)
        if isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= most:  # nothing to copy
            return torch.full((count,), value, dtype=torch.int64, device=self.device)
        steps = tensor("horizon", value, self.device)
        if steps.dtype == torch.bool or steps.is_floating_point() or steps.shape not in ((), (count,)):
            raise ValueError(f"horizon must be a whole number or {count} of them, got {value!r}.")
        fits = (steps >= 1) & (steps <= most)
        if self.faults is not None:
            self.faults.note(f"horizon of world {{world}} must be in [1, {most}]", ~fits, rows)
        elif not bool(fits.all()):
            raise ValueError(f"horizon must be in [1, {most}], got {steps.tolist()}.")
        return steps.long().expand(count)


def lacking(selector: GoalSelector, taught: bool, tracked: bool) -> Iterator[str]:
    """What a selector needs and has not been given, a sentence each.

    Args:
        selector: The selector; what it is made of counts too.
        taught: Whether it has learnt yet.
        tracked: Whether tracking has ever been given.
    """
    for part in with_parts(selector):
        who = type(part).__module__
        if part.needs_rollout and not taught and not isinstance(part, Delegate):
            yield f"{who} learns from the learner's transitions: call learn(rollout)."
        if part.needs_tracking and not tracked:
            yield f"{who} follows how well goals are met, and stays as it is until you give tracking."


class GoalBox:
    """The range of goals, a box: candidates are drawn from it, or must be inside it.

    Args:
        low: Lowest goal, shape (goal_dim,).
        high: Highest goal, above ``low`` in every component, shape (goal_dim,).
        goal_dim: Components of a goal.
        device: Device of goals.

    Raises:
        ValueError: If they are not a box, or not finite.
    """

    def __init__(self, low: Bound, high: Bound, goal_dim: int, device: torch.device) -> None:
        below, above = (floats("goal_box", end, (goal_dim,), device) for end in (low, high))
        self._middle, self._half = (below + above) / 2, (above - below) / 2
        self.middle: tuple[float, ...] = tuple(self._middle.tolist())
        """Middle of every component."""
        if not bool(((self._half > 0) & self._half.isfinite()).all()):
            raise ValueError(
                f"goal_box must be the lowest and the highest goal, finite, got {below.tolist()} and {above.tolist()}."
            )

    def __len__(self) -> int:
        return len(self._middle)

    def ends(self, axes: Iterable[int]) -> list[tuple[float, float]]:
        """Lowest and highest values of some components."""
        low, high = (self._middle - self._half).tolist(), (self._middle + self._half).tolist()
        return [(low[axis], high[axis]) for axis in axes]

    def draw(self, seed: int, rows: Tensor, asked: Tensor, count: int, share: Tensor | None) -> Tensor:
        """Uniform goals, shape (m, count, goal_dim).

        Args:
            seed: Seed of the draws.
            rows: Worlds, int64, shape (m,).
            asked: How often each has drawn, int64, shape (m,).
            count: Goals for each.
            share: Share of the range to draw from, around its middle, shape (goal_dim,); ``None`` for all of it.
        """
        numbers = count * len(self)
        blocks = torch.arange(-(-numbers // 4), dtype=torch.int64, device=rows.device)
        address = asked.unsqueeze(1) * len(blocks) + blocks
        drawn = uniforms(seed, Purpose.CANDIDATES, rows.unsqueeze(1).expand_as(address), address)
        unit = drawn.flatten(1)[:, :numbers].unflatten(1, (count, len(self))) * 2.0 - 1.0
        return self._middle + self._half * (unit if share is None else unit * share)

    def check(
        self, candidates: Tensor, rows: Tensor, share: Tensor | None, but: Tensor | None, faults: Faults | None
    ) -> None:
        """Raise ``ValueError`` if a candidate, shape (m, N, goal_dim), is outside by more than rounding.

        For ``but`` and ``faults`` see ``refuse_not_finite``.
        """
        reach = self._half if share is None else self._half * share
        outside = ((candidates - self._middle).abs() > reach * 1.001).any(2)
        if faults is not None:
            bad = outside.any(1)
            text = "candidates of world {world} must be in the goal_box, within GoalDirector.goal_range"
            faults.note(text, bad if but is None else bad & ~but, rows)
        elif bool(outside.any()):
            row, candidate = outside.nonzero()[0].tolist()
            low, high = (self._middle - reach).tolist(), (self._middle + reach).tolist()
            raise ValueError(
                f"candidates must be between {low} and {high}, got {candidates[row, candidate].tolist()} for world "
                f"{int(rows[row])}; see GoalDirector.goal_range."
            )
