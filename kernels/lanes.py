"""How work is divided into threads: one number for each on a GPU, many on a CPU.

Warp runs the threads of a CPU one after another and copies the arguments again for each, so one thread does all there.
A thread's own arithmetic is scalar; a kernel that does the same to many numbers takes them as vectors on a CPU, and
LLVM vectorises their loops.
"""

import warp as wp

WIDE = 64  # LLVM's best code; with 16 or 32 some kernels take five times as long (Zen 5, AVX-512)

AS_ON_GPU = False
"""Whether CPUs divide their work as a GPU does: for tests, in which a GPU's division would otherwise never run."""

WORDS = {lanes: wp.types.vector(length=lanes, dtype=wp.uint32) for lanes in (1, WIDE)}
"""Vectors of as many uint32 as there are lanes."""


def is_serial(device: wp.Device) -> bool:
    """Whether the threads of a device run one after another, so that one should do all."""
    return device.is_cpu and not AS_ON_GPU


def split(count: int, device: wp.Device) -> int:
    """Threads that share ``count`` pieces of work: one on a CPU, on a GPU as many as there are pieces."""
    return 1 if is_serial(device) else count


def lanes(count: int, device: wp.Device) -> int:
    """Numbers per thread, 1 or ``WIDE``, if each row has ``count``."""
    return WIDE if is_serial(device) and count >= WIDE // 4 else 1


def threads(rows: int, count: int, device: wp.Device) -> tuple[int, int]:
    """Threads along each axis for ``count`` numbers in each of ``rows``."""
    return rows, -(-count // lanes(count, device))
