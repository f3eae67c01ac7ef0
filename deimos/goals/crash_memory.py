"""Crashes of the past, each with survivals of the same time.

A policy that becomes safe stops crashing, and a network that learns from the last 2 T steps alone stops learning with
it. Old crashes next to recent survivals would teach something else: *when* a state was met. So every crash is kept
together with survivals of the same time, and both fade alike.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from deimos.goals.interactions import Resolved
from deimos.nn.seeds import generator
from deimos.nn.stateful import Stateful

PARTNERS = 16  # survivals that are kept with every crash,
DRAWN = 4  # and those of them that enter a fit: another draw each time, since so few would be memorised
HALF_LIFE = 1.5  # periods of T steps after which a crash and its partners weigh half
PRESENT = 0.1  # share of a class that present rows weigh at most: the AUROC of age stays within PRESENT of 0.5
YOUNGEST = 1024  # survivals of the window that are drawn for a fit


class CrashMemory(Stateful):
    """A bounded number of crashes with their partners; the oldest make way for new ones.

    Args:
        capacity: Crashes that are kept, at least 1.
        period: T, in steps: what was issued that long ago is known to have crashed or survived.
        inputs: Components of a row that the network sees of an interaction.
        device: Where they are kept.
        seed: Seed of which survivals are kept.
        extra: Components of a row after these: whatever else belongs to an interaction, NaN where it is not known.
    """

    saved: ClassVar[tuple[str, ...]] = ("_crash", "_partners", "_issued", "stored", "_upto", "generator")

    def __init__(
        self, capacity: int, period: int, inputs: int, device: torch.device, seed: int, extra: int = 0
    ) -> None:
        self._period, self._inputs = period, inputs
        width = inputs + extra
        self._crash = torch.zeros(capacity, width, dtype=torch.float32, device=device)
        self._partners = torch.zeros(capacity, PARTNERS, width, dtype=torch.float32, device=device)
        self._issued = torch.zeros(capacity, dtype=torch.int64, device=device)
        self.stored = 0
        """Crashes stored so far, including those that have made way."""
        self._upto = -1  # step up to which interactions have been looked at
        self.generator = generator(seed, "crash memory", device)

    def must_be_sound(self) -> Mapping[str, Any]:
        """See ``Stateful``: what the network sees, but not the components after it."""
        inputs = slice(self._inputs)
        return {**super().must_be_sound(), "crash": self._crash[:, inputs], "partners": self._partners[..., inputs]}

    @torch.no_grad()
    def store(self, rows: Tensor, window: Resolved, now: int, kept_since: int = 0) -> None:
        """Take over the new crashes among what was issued at least T steps ago, each with survivals of that time.

        Of what was issued later, only the crashes are known yet. Crashes of a time without survivals wait for some.
        Partners are the survivals that were issued next to a crash, before or after it.

        Where outcomes of goals that were issued later than T steps ago have made way, so that waiting is of no use, it
        takes over what has resolved since the last call instead.

        Args:
            rows: What to keep of every interaction of the window, shape (n, width).
            window: The recently resolved interactions.
            now: Steps so far.
            kept_since: See ``Interactions.kept_since``.
        """
        moment, upto = window.issued, now - self._period
        if kept_since > max(0, upto):
            moment, upto = window.resolved, now
        new = (moment > self._upto) & (moment <= upto)
        crashed, survived = ((new & own).nonzero().squeeze(1) for own in (window.crashed, ~window.crashed))
        if len(crashed) and not len(survived):
            return
        self._upto = max(upto, self._upto)
        if not len(crashed):
            return
        capacity = len(self._issued)
        crashed = crashed[window.issued[crashed].argsort(stable=True)][-capacity:]  # the newest, in their order
        place = (self.stored + torch.arange(len(crashed), device=rows.device)) % capacity
        self._crash[place] = rows[crashed]
        self._partners[place] = rows[self._beside(window.issued, crashed, survived)]
        self._issued[place] = window.issued[crashed]
        self.stored += len(crashed)

    def _beside(self, issued: Tensor, crashed: Tensor, survived: Tensor) -> Tensor:
        """The survivals next to each crash in time, at random among those of its step, int64, shape (n, PARTNERS)."""
        shuffle, draw = (
            torch.rand(len(rows), dtype=torch.float64, generator=self.generator, device=issued.device)
            for rows in (survived, crashed)
        )
        moment, order = (issued[survived] + shuffle).sort()
        begin, end = (torch.searchsorted(moment, (issued[crashed] + later).double()) for later in (0, 1))
        spare = end - begin - PARTNERS  # of its step; where there are too few, as many from before as from after it
        first = begin + (spare.clamp(min=0) * draw + spare.clamp(max=0) * 0.5).floor().long()
        first = first.clamp(0, max(0, len(survived) - PARTNERS))
        place = first.unsqueeze(1) + torch.arange(PARTNERS, device=issued.device)
        return survived[order[place % len(survived)]]  # if there are few, some several times

    def sample(self, rows: Tensor, window: Resolved) -> tuple[Tensor, Tensor, Tensor]:
        """The rows to learn from.

        Args:
            rows: Rows of the window, shape (n, width): the present. The crashes among them that are not stored yet, and
                some of the survivals, join what is remembered.
            window: The recently resolved interactions.

        Returns:
            Rows, shape (m, width); whether each is a crash, bool; and its weight within its class, at least 0, shape
            (m,) each.
        """
        count, device = min(self.stored, len(self._issued)), rows.device
        if not count:
            return rows[:0], window.crashed[:0], rows[:0, 0]
        waiting = (window.crashed & (window.issued > self._upto)).nonzero().squeeze(1)
        youngest = (~window.crashed).nonzero().squeeze(1)
        youngest = youngest[torch.randperm(len(youngest), generator=self.generator, device=device)[:YOUNGEST]]
        drawn = torch.randint(PARTNERS, (count, DRAWN), generator=self.generator, device=device)
        partners = self._partners[torch.arange(count, device=device).unsqueeze(1), drawn].flatten(0, 1)
        age = self._issued[:count].amax() - self._issued[:count]  # only how they compare matters: the newest weighs 1
        weight = torch.exp2(age.float() / (-HALF_LIFE * self._period))
        crashes = _with_present(weight, len(waiting))
        survivals = _with_present(weight.repeat_interleave(DRAWN) / DRAWN, len(youngest))
        inputs = torch.cat([self._crash[:count], rows[waiting], partners, rows[youngest]])
        crashed = torch.arange(len(inputs), device=device) < len(crashes)
        return inputs, crashed, torch.cat([crashes, survivals])


def _with_present(remembered: Tensor, present: int) -> Tensor:
    """Weights of a class, with the same total as the remembered ones: those, and then its ``present`` rows.

    A present row weighs as much as the newest remembered one, but all of them at most ``PRESENT`` of the whole.
    """
    total = remembered.sum()
    share = (present / (present + total)).clamp(max=PRESENT)
    return torch.cat([remembered * (1.0 - share), (total * share / max(1, present)).expand(present)])
