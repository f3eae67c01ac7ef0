"""Counter-based random numbers, on any device: the same that ``kernels.random`` draws.

A draw is a pure function of its address: *who* draws *what* for *which time*. So two halves of the worlds draw what
the whole draws, and a resumed run continues with the numbers that it would have had. The generator is
Philox4x32-10 of Salmon et al., *Parallel Random Numbers: As Easy as 1, 2, 3*, SC 2011.
"""

import math
from enum import IntEnum
from typing import Any

import numpy as np
import torch
from torch import Tensor

_MULTIPLIERS = 0xD2511F53, 0xCD9E8D57  # the paper's constants, table 2 and section 3.3
_WEYL = 0x9E3779B9, 0xBB67AE85
_WORD = 0xFFFFFFFF


class Purpose(IntEnum):
    """What a number is drawn for: half of the key. Those below 16 are ``kernels.random``'s."""

    GOAL = 0  # the choice of a goal: a GoalDirector draws what an environment draws for it
    EXPLORATION = 16
    AUDIT = 17  # exploration in the audits of a fear network
    AUDIT_CONTEXT = 18  # which of the contexts are audited
    CANDIDATES = 19  # the candidates that a GoalDirector draws itself


def philox(counter: tuple[Tensor, Tensor, Tensor, Tensor], key: tuple[int, int]) -> tuple[Tensor, ...]:
    """Ten rounds of Philox4x32: four random 32-bit words for every counter.

    Args:
        counter: The four words of the counters, int64 in [0, 2^32), of shapes that broadcast.
        key: The two words of the key, in [0, 2^32).
    """
    if counter[0].device.type != "cpu":
        return _rounds(counter, key)
    with np.errstate(over="ignore"):  # NumPy takes a third to a half of torch's time here, for any size
        return tuple(torch.from_numpy(np.asarray(word)) for word in _rounds([word.numpy() for word in counter], key))


def _rounds(counter: Any, key: tuple[int, int]) -> Any:
    """The rounds of ``philox``, on torch tensors or NumPy arrays."""
    x0, x1, x2, x3 = counter
    k0, k1 = key
    for _ in range(10):
        # An int64 keeps the low 64 bits of a product; bits above a word are masked off where they would matter.
        p0, p1 = x0 * _MULTIPLIERS[0], x2 * _MULTIPLIERS[1]
        x0, x2 = ((p1 >> 32) ^ x1 ^ k0) & _WORD, ((p0 >> 32) ^ x3 ^ k1) & _WORD
        x1, x3 = p1, p0
        k0, k1 = (k0 + _WEYL[0]) & _WORD, (k1 + _WEYL[1]) & _WORD
    return x0, x1 & _WORD, x2, x3 & _WORD


def uniforms(seed: int, purpose: int, world: Tensor, count: Tensor) -> Tensor:
    """Four independent uniform numbers in [0, 1), multiples of 2^-24, for every address, shape (..., 4).

    Args:
        seed: Seed of the run, in [0, 2^32).
        purpose: What they are for.
        world: Global numbers of the worlds, int64 in [0, 2^32), shape (...,).
        count: How often each has drawn for this purpose, int64 in [0, 2^32), of a shape that broadcasts.
    """
    return torch.stack(_uniforms(seed, purpose, world, count, 0), dim=-1)


def _uniforms(seed: int, purpose: int, world: Tensor, count: Tensor, block: int) -> list[Tensor]:
    zero = torch.zeros((), dtype=torch.int64, device=world.device)
    words = philox((world, count, zero, zero + block), (seed, purpose))
    # The top 24 bits fill a float32 exactly, so 1.0 is never reached.
    return [(word >> 8).float().mul_(2.0**-24) for word in words]


def normals(seed: int, purpose: int, world: Tensor, count: Tensor, size: int) -> Tensor:
    """Independent standard normal numbers for every address, shape (..., size); for the arguments see ``uniforms``.

    By Box and Muller: two uniform numbers make two normal ones, none beyond sqrt(48 ln 2) = 5.77.
    """
    numbers: list[Tensor] = []
    for block in range(-(-size // 4)):
        u0, u1, u2, u3 = _uniforms(seed, purpose, world, count, block)
        for first, second in ((u0, u1), (u2, u3)):
            radius = torch.log1p(-first).mul_(-2.0).sqrt_()  # 1 - u is never 0
            angle = second.mul_(2.0 * math.pi)
            wanted = (torch.cos, torch.sin)[: max(0, size - len(numbers))]
            numbers += [turn(angle).mul_(radius) for turn in wanted]
    return torch.stack(numbers, dim=-1)
