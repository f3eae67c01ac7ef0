"""Input that does not fit, on a device that the host would have to wait for to see it."""

import torch
from torch import Tensor

from deimos.goals.interactions import Interactions

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
