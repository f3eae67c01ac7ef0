"""The kernel for networks on CPUs: it compiles for processors that are not there, and its bits are the same on all."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

HOME = Path(__file__).resolve().parent.parent

COMPILE = """
import sys
import warp as wp
wp.config.quiet, wp.config.cpu_compiler_flags = True, sys.argv[1]
from deimos.kernels import mlp
[path] = wp.compile_aot_module(mlp, device="cpu", module_dir=sys.argv[2])
print(path)
"""

COMPUTE = """
import hashlib, sys
import warp as wp
wp.config.quiet = True
if sys.argv[1]:
    wp.config.cpu_compiler_flags = sys.argv[1]
import torch
torch.set_num_threads(1)
from deimos.nn.losses import Surrogate
from deimos.nn.mlps import MLPs
from deimos.nn.networks import Actor
generator, digest = torch.Generator().manual_seed(0), hashlib.sha256()
for activation in ("relu", "elu", "tanh"):
    nets = MLPs([Actor(11, (65, 33), 3, activation, 0.7, generator)])
    x, data = (torch.randn(*shape, generator=generator) for shape in ((1000, 11), (1, 9, 1000)))
    for tensor in (nets.forward(x), nets.gradient(x, Surrogate(data, 0.2)), nets.grad):
        assert tensor.isfinite().all() and tensor.any()
        digest.update(tensor.numpy().tobytes())
print(digest.hexdigest())
"""


def run(code, *arguments):
    """What a program of its own prints last: flags of the compiler hold for a process."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False, cwd=HOME,
        env=os.environ | {"PYTHONPATH": str(HOME)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def others():
    """Flags for processors with other registers; where none are known, those for this one."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return ["-march=native"]
    return [f"-target-cpu {cpu}" for cpu in ("skylake-avx512", "x86-64")]


def runnable():
    """Flags for the tiles of registers of 128 and 256 bits on any processor, and for a real one with the latter.

    At least one of the first two is not what the processor takes by itself: nothing is compared with itself alone.
    """
    path = Path("/proc/cpuinfo")
    known = path.exists() and {"avx2", "fma"} <= set(path.read_text().split())
    tiles = ["-march=native -U__AVX512F__ -U__AVX__", "-march=native -U__AVX512F__ -D__AVX__=1"]
    return tiles + (["-target-cpu haswell"] if known else [])


@pytest.mark.parametrize("flags", others())
def test_it_compiles_for_other_processors(flags, tmp_path):
    """With registers of 512 and of 128 bits, whatever this processor has."""
    path = Path(run(COMPILE, flags, str(tmp_path)))
    assert path.stat().st_size > 0


def test_registers_change_no_bit():
    """With tiles for registers of 128 and of 256 bits it computes what it computes with this processor's."""
    assert {run(COMPUTE, flags) for flags in runnable()} == {run(COMPUTE, "")}
