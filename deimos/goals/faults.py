"""Input that does not fit: refused at once or, on a device that the host would have to wait for, later."""

import torch
from torch import Tensor

from deimos.goals.interactions import Interactions
from deimos.nn.stateful import LARGEST, is_sound

_NEVER = 2**62
_TEXTS = 64  # more than there are


class Faults:
    """Notes on the device where input does not fit, until the host reads from there in any case.

    Args:
        interactions: Their clock tells when.
    """

    def __init__(self, interactions: Interactions) -> None:
        self._interactions = interactions
        self._first = torch.full_like(interactions.issued_at, _NEVER)  # of every world: step and text in one number
        self._texts: list[str] = []

    def note(self, text: str, bad: Tensor, rows: Tensor | None = None) -> None:
        """Note worlds whose input does not fit; the first fault of each is kept.

        Args:
            text: What must hold, with ``{world}`` for the number of the world.
            bad: Where it does not, bool, shape (m,).
            rows: Their worlds, int64, shape (m,); ``None`` for all.
        """
        if text not in self._texts:
            self._texts.append(text)
        code = self._interactions.now * _TEXTS + self._texts.index(text)
        known = self._first if rows is None else self._first[rows]
        found = torch.where(bad, known.clamp(max=code), known)
        if rows is None:
            self._first.copy_(found)
        else:
            self._first[rows] = found

    def refuse(self) -> None:
        """Raise ``ValueError`` that names the first fault that was noted; this waits for the device."""
        first, world = torch.stack(self._first.min(0)).tolist()
        if first == _NEVER:
            return
        step, text = divmod(first, _TEXTS)
        raise ValueError(
            f"{self._texts[text].format(world=world)}; after {step} steps it was not. On {self._first.device}, numbers "
            "are checked when the GoalDirector learns or its state is saved; load an earlier state to continue."
        )

    def clear(self) -> None:
        """Forget all faults."""
        self._first.fill_(_NEVER)


def refuse_not_finite(
    name: str, numbers: Tensor, rows: Tensor | None = None, but: Tensor | None = None, what: str = "world"
) -> None:
    """Raise a ``ValueError`` that names the first row of ``numbers`` with one that is not finite.

    Args:
        name: What they are.
        numbers: Shape (m, ...).
        rows: Worlds of the rows, int64, shape (m,); ``None`` for all worlds in order.
        but: Rows that do not matter, bool, shape (m,).
        what: What a row is.
    """
    if bool(numbers.sum().isfinite()):  # a sum costs a tenth of looking at every number
        return
    bad = ~numbers.flatten(1).isfinite().all(1) if numbers.dim() > 1 else ~numbers.isfinite()
    if but is not None:
        bad &= ~but
    if bool(bad.any()):
        row = int(bad.nonzero()[0])
        world = row if rows is None else int(rows[row])
        raise ValueError(f"{name} of {what} {world} must be finite, got {numbers[row].tolist()}.")


def refuse_unsound(
    name: str, numbers: Tensor, rows: Tensor | None = None, but: Tensor | None = None, faults: Faults | None = None
) -> None:
    """Raise ``ValueError`` where a number is not finite, or so large that what is learnt from it would not be.

    Args:
        name: What they are.
        numbers: Shape (m, n, ...), not empty.
        rows: Worlds of the rows, int64, shape (m,); ``None`` for all worlds in order.
        but: Rows that do not matter, bool, shape (m,).
        faults: Where to note what does not fit; ``None`` to refuse it at once.
    """
    if faults is None:
        if bool(is_sound(torch.stack(numbers.aminmax())).all()):
            return
        refuse_not_finite(name, numbers, rows, but)
    large = ~is_sound(numbers).flatten(1).all(1)
    large = large if but is None else large & ~but
    if faults is not None:
        faults.note(f"{name} of world {{world}} must be finite and at most {LARGEST:g} in size", large, rows)
    elif bool(large.any()):
        row = int(large.nonzero()[0])
        world = row if rows is None else int(rows[row])
        raise ValueError(f"{name} of world {world} must be at most {LARGEST:g} in size, got {numbers[row].tolist()}.")


def refuse_outside_0_and_1(name: str, numbers: Tensor, faults: Faults | None) -> None:
    """Raise a ``ValueError`` that names the first world with a number outside [0, 1] by more than rounding.

    Args:
        name: What they are.
        numbers: Shape (num_envs, ...).
        faults: Where to note what does not fit; ``None`` to refuse it at once.
    """
    inside = (numbers - 0.5).abs() <= 0.5 + 1e-5
    if faults is not None:
        faults.note(f"{name} of world {{world}} must be in [0, 1]", ~inside.view(len(inside), -1).all(1))
        return
    refuse_not_finite(name, numbers)
    outside = ~inside
    if bool(outside.any()):
        world = int(outside.nonzero()[0, 0])
        raise ValueError(f"{name} of world {world} must be in [0, 1], got {numbers[world].tolist()}.")
