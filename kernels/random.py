"""Counter-based random numbers: a draw is a pure function of its address.

A sequential generator hands out numbers in the order of the calls, so what one world draws depends on
what the others did before. Here a draw is addressed by *who* draws *what* for *which time*: the key is
(seed, purpose), the counter (world, count, index, block). Two policies that crash at different times
meet the same i-th goal in every world, two halves of a batch equal the whole, and a resumed run goes on
with the very numbers that it would have had.

The generator is Philox4x32-10 of Salmon et al., *Parallel Random Numbers: As Easy as 1, 2, 3*, SC 2011.
"""

from enum import IntEnum

import warp as wp

from kernels.check import require

wp.set_module_options({"enable_backward": False})

_MULTIPLIER_0 = wp.constant(wp.uint32(0xD2511F53))  # the paper's constants, table 2 and section 3.3
_MULTIPLIER_1 = wp.constant(wp.uint32(0xCD9E8D57))
_WEYL_0 = wp.constant(wp.uint32(0x9E3779B9))  # the golden ratio
_WEYL_1 = wp.constant(wp.uint32(0xBB67AE85))  # sqrt(3) - 1
_SHIFT_32 = wp.constant(wp.uint64(32))
_SHIFT_8 = wp.constant(wp.uint32(8))


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


class vec4u(wp.types.vector(length=4, dtype=wp.uint32)):
    """Four 32-bit words: a Philox counter or its output."""


@wp.func
def philox(counter: vec4u, key_0: wp.uint32, key_1: wp.uint32) -> vec4u:
    """Ten rounds of Philox4x32: four random 32-bit words for one (counter, key)."""
    x0 = counter[0]
    x1 = counter[1]
    x2 = counter[2]
    x3 = counter[3]
    k0 = key_0
    k1 = key_1
    for _round in range(10):
        product_0 = wp.uint64(_MULTIPLIER_0) * wp.uint64(x0)
        product_1 = wp.uint64(_MULTIPLIER_1) * wp.uint64(x2)
        x0 = wp.uint32(product_1 >> _SHIFT_32) ^ x1 ^ k0
        x1 = wp.uint32(product_1)
        x2 = wp.uint32(product_0 >> _SHIFT_32) ^ x3 ^ k1
        x3 = wp.uint32(product_0)
        k0 = k0 + _WEYL_0
        k1 = k1 + _WEYL_1
    return vec4u(x0, x1, x2, x3)


@wp.func
def uniform4(seed: wp.uint32, purpose: int, world: int, count: int, index: int, block: int) -> wp.vec4:
    """Four independent uniform numbers in [0, 1), multiples of 2^-24, for one address."""
    word = philox(
        vec4u(wp.uint32(world), wp.uint32(count), wp.uint32(index), wp.uint32(block)), seed, wp.uint32(purpose)
    )
    ulp = float(5.9604644775390625e-8)  # 2^-24: the top 24 bits fill a float32 exactly, so 1.0 is never reached
    return wp.vec4(
        float(word[0] >> _SHIFT_8) * ulp,
        float(word[1] >> _SHIFT_8) * ulp,
        float(word[2] >> _SHIFT_8) * ulp,
        float(word[3] >> _SHIFT_8) * ulp,
    )


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
        count: How often each world has drawn for this purpose, int32, shape (num_envs,).
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
