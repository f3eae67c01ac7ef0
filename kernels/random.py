"""Counter-based random numbers: a draw is a pure function of its address.

A sequential generator hands out numbers in the order of the calls, so what one world draws depends on
what the others did before. Here a draw is addressed by *who* draws *what* for *which time*: the key is
(seed, purpose), the counter (world, count, index, block). Two policies that crash at different times
meet the same i-th goal in every world, two halves of a batch equal the whole, and a resumed run continues
with the numbers that it would have had.

The generator is Philox4x32-10 of Salmon et al., *Parallel Random Numbers: As Easy as 1, 2, 3*, SC 2011.
"""

from enum import IntEnum
from typing import Any

import warp as wp

from .check import require
from .lanes import WORDS

wp.set_module_options({"enable_backward": False})

_MULTIPLIER_0 = wp.constant(wp.uint32(0xD2511F53))  # the paper's constants, table 2 and section 3.3
_MULTIPLIER_1 = wp.constant(wp.uint32(0xCD9E8D57))
_WEYL_0 = wp.constant(wp.uint32(0x9E3779B9))  # the golden ratio
_WEYL_1 = wp.constant(wp.uint32(0xBB67AE85))  # sqrt(3) - 1
_SHIFT_32 = wp.constant(wp.uint64(32))
_SHIFT_8 = wp.constant(wp.uint32(8))
_one = WORDS[1]


class Purpose(IntEnum):
    """What a number is drawn for: half of the key, so that no two purposes share a stream."""

    GOAL = 0
    CANDIDATE = 1
    FIRST_GOAL = 2
    RESET = 3
    NOISE = 4
    PUSH = 5
    FRICTION = 6
    LEVEL = 7
    EXPLORATION = 16
    """The learner's noise, which torch draws (``deimos.nn.random``), as it draws ``GOAL`` for a GoalDirector."""
    AUDIT = 17
    AUDIT_CONTEXT = 18
    CANDIDATES = 19


class vec4u(wp.types.vector(length=4, dtype=wp.uint32)):
    """Four 32-bit words: a Philox counter or its output."""


@wp.func
def _round(x0: Any, x1: Any, x2: Any, x3: Any, key_0: wp.uint32, key_1: wp.uint32):
    """One round, of as many counters side by side as there are lanes."""
    y0 = type(x0)()
    y1 = type(x0)()
    y2 = type(x0)()
    y3 = type(x0)()
    for lane in range(len(x0)):
        product_0 = wp.uint64(_MULTIPLIER_0) * wp.uint64(x0[lane])
        product_1 = wp.uint64(_MULTIPLIER_1) * wp.uint64(x2[lane])
        y0[lane] = wp.uint32(product_1 >> _SHIFT_32) ^ x1[lane] ^ key_0
        y1[lane] = wp.uint32(product_1)
        y2[lane] = wp.uint32(product_0 >> _SHIFT_32) ^ x3[lane] ^ key_1
        y3[lane] = wp.uint32(product_0)
    return y0, y1, y2, y3


@wp.func
def philox_lanes(x0: Any, x1: Any, x2: Any, x3: Any, key_0: wp.uint32, key_1: wp.uint32):
    """Ten rounds of Philox4x32: four random words per lane, for one counter (x0, x1, x2, x3) per lane.

    The words of a lane are those of ``philox`` for its counter.
    """
    k0 = key_0
    k1 = key_1
    for _ten in range(10):
        x0, x1, x2, x3 = _round(x0, x1, x2, x3, k0, k1)
        k0 = k0 + _WEYL_0
        k1 = k1 + _WEYL_1
    return x0, x1, x2, x3


@wp.func
def philox(counter: vec4u, key_0: wp.uint32, key_1: wp.uint32) -> vec4u:
    """Ten rounds of Philox4x32: four random 32-bit words for one (counter, key)."""
    x0, x1, x2, x3 = philox_lanes(_one(counter[0]), _one(counter[1]), _one(counter[2]), _one(counter[3]), key_0, key_1)
    return vec4u(x0[0], x1[0], x2[0], x3[0])


@wp.func
def unit(word: wp.uint32) -> float:
    """A random word as a uniform number in [0, 1), a multiple of 2^-24."""
    # The top 24 bits fill a float32 exactly, so 1.0 is never reached.
    return float(word >> _SHIFT_8) * float(5.9604644775390625e-8)


@wp.func
def uniform4(seed: wp.uint32, purpose: int, world: int, count: int, index: int, block: int) -> wp.vec4:
    """Four independent uniform numbers in [0, 1), multiples of 2^-24, for one address."""
    word = philox(
        vec4u(wp.uint32(world), wp.uint32(count), wp.uint32(index), wp.uint32(block)), seed, wp.uint32(purpose)
    )
    return wp.vec4(unit(word[0]), unit(word[1]), unit(word[2]), unit(word[3]))


@wp.func
def symmetric3(seed: wp.uint32, purpose: int, world: int, count: int, index: int) -> wp.vec3:
    """Three independent uniform numbers in [-1, 1) for one address."""
    u = uniform4(seed, purpose, world, count, index, 0)
    return wp.vec3(2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0, 2.0 * u[2] - 1.0)


@wp.kernel
def _draw_words(
    # In
    counter: wp.array[vec4u],
    key: wp.array2d[wp.uint32],
    # Out
    word: wp.array[vec4u],
):
    row = wp.tid()
    word[row] = philox(counter[row], key[row, 0], key[row, 1])


def draw_words(counter: wp.array, key: wp.array, word: wp.array) -> None:
    """Write the Philox4x32-10 output of every (counter, key) pair.

    For other programs that must reproduce a run's draws, and for the known-answer test.

    Args:
        counter: Counters, vec4u, shape (n,).
        key: Keys, uint32, shape (n, 2).
        word: Random words, vec4u, shape (n,). Written.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("counter", counter, dtype=vec4u)
    require("key", key, dtype=wp.uint32, shape=(*counter.shape, 2), like=counter)
    require("word", word, like=counter)
    wp.launch(_draw_words, dim=counter.shape[0], inputs=[counter, key], outputs=[word], device=counter.device)


@wp.kernel
def _draw_uniforms(
    # In
    seed: wp.uint32,
    purpose: int,
    world_offset: int,
    row: wp.array[int],
    count: wp.array[int],
    # Out
    draw: wp.array[wp.vec4],
):
    i = wp.tid()
    env = row[i]
    draw[i] = uniform4(seed, purpose, world_offset + env, count[env], 0, 0)


def draw_uniforms(
    row: wp.array,
    count: wp.array,
    draw: wp.array,
    *,
    seed: int,
    purpose: Purpose,
    world_offset: int,
    record: bool = False,
) -> wp.Launch | None:
    """Draw four uniform numbers in [0, 1) for every listed world, addressed by that world's own count.

    Args:
        row: Worlds to draw for, int32, shape (n,), each in [0, num_envs).
        count: Number of earlier draws of each world for this purpose, int32, shape (num_envs,).
        draw: The numbers, vec4, shape (n,). Written.
        seed: Seed of the run, in [0, 2^32).
        purpose: What the numbers are for.
        world_offset: Global number of world 0, at least 0.
        record: Return the launch, to be replayed with ``launch()``, instead of making it.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("row", row, dtype=wp.int32)
    require("count", count, dtype=wp.int32, shape=count.shape, like=row)
    require("draw", draw, dtype=wp.vec4, like=row)
    return wp.launch(
        _draw_uniforms,
        dim=row.shape[0],
        inputs=[wp.uint32(seed), int(purpose), world_offset, row, count],
        outputs=[draw],
        device=row.device,
        record_cmd=record,
    )
