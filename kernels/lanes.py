"""How many numbers a thread works on: one on a GPU, on a CPU what fills its vector registers.

Warp runs the threads of a CPU one after another, and a thread's own arithmetic is scalar. A kernel that does the same
to many numbers takes them as vectors there: LLVM makes vector instructions of their loops.
"""

import warp as wp

_FLAGS = "-march=native" if wp.config.cpu_compiler_flags is None else wp.config.cpu_compiler_flags

OPTIONS = {
    "enable_backward": False,
    "cpu_compiler_flags": f"{_FLAGS} -ffp-contract=fast -funroll-loops -mllvm=-slp-recursion-max-depth=12",
}
"""Options for modules of such kernels. On a CPU a product and a sum become one instruction, as CUDA has it anyway:
Warp's operators are functions of their own, across which Clang keeps them apart unless told so. Unrolled loops, and
LLVM's own depth of the search for vectors, which Warp cuts to 4 to compile faster, save ``critics`` another 3 %."""

WIDE = 64  # what LLVM makes the best code of; with 16 or 32 some kernels take five times as long (Zen 5, AVX-512)

FLOATS = {lanes: wp.types.vector(length=lanes, dtype=float) for lanes in (1, WIDE)}
"""Vectors of as many float32 as there are lanes."""
WORDS = {lanes: wp.types.vector(length=lanes, dtype=wp.uint32) for lanes in (1, WIDE)}
"""The same of uint32."""


def lanes(count: int, device: wp.Device) -> int:
    """Numbers of a thread, 1 or ``WIDE``, where each row has ``count``."""
    return WIDE if device.is_cpu and count >= WIDE // 4 else 1


def threads(rows: int, count: int, device: wp.Device) -> tuple[int, int]:
    """Threads along each axis for ``count`` numbers in each of ``rows``."""
    return rows, -(-count // lanes(count, device))
