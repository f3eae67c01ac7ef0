"""How many numbers a thread works on: one on a GPU, on a CPU what fills its vector registers.

Warp runs the threads of a CPU one after another, and a thread's own arithmetic is scalar. A kernel that does the same
to many numbers takes them as vectors there: LLVM makes vector instructions of their loops.
"""

import warp as wp

WIDE = 64  # what LLVM makes the best code of; with 16 or 32 some kernels take five times as long (Zen 5, AVX-512)

WORDS = {lanes: wp.types.vector(length=lanes, dtype=wp.uint32) for lanes in (1, WIDE)}
"""Vectors of as many uint32 as there are lanes."""


def lanes(count: int, device: wp.Device) -> int:
    """Numbers of a thread, 1 or ``WIDE``, where each row has ``count``."""
    return WIDE if device.is_cpu and count >= WIDE // 4 else 1


def threads(rows: int, count: int, device: wp.Device) -> tuple[int, int]:
    """Threads along each axis for ``count`` numbers in each of ``rows``."""
    return rows, -(-count // lanes(count, device))
