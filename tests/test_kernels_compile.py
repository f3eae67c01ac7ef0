"""All kernels compile for the GPUs that we support, on a machine without one."""

import ast
import importlib
import pkgutil
from pathlib import Path

import pytest
import warp as wp

from deimos import kernels

HOME = Path(kernels.__file__).resolve().parent.parent
ARCHITECTURES = (80, 90)  # A100, H100
FOR_CPUS = {"deimos.kernels.mlp"}  # where a GPU has torch's products


def modules_with_kernels():
    """Names of the modules of ``kernels`` that define a kernel."""
    names = [info.name for info in pkgutil.walk_packages(kernels.__path__, prefix="deimos.kernels.")]
    modules = {name: importlib.import_module(name) for name in names}
    return [
        name
        for name, module in modules.items()
        if name not in FOR_CPUS
        and any(isinstance(value, wp.Kernel) and value.func.__module__ == name for value in vars(module).values())
    ]


def test_finds_the_modules():
    """The search finds the modules that are known to define kernels, and not those that define none."""
    found = modules_with_kernels()
    assert {"deimos.kernels.goals", "deimos.kernels.particle", "deimos.kernels.random"} <= set(found)
    assert "deimos.kernels.check" not in found


@pytest.mark.parametrize("name", modules_with_kernels())
def test_compiles_without_a_driver(name, tmp_path):
    """The module gives a binary or PTX for each architecture, and no CUDA driver is needed for it."""
    made = wp.compile_aot_module(name, device=None, arch=list(ARCHITECTURES), module_dir=tmp_path)
    assert len(made) == len(ARCHITECTURES)
    for arch in ARCHITECTURES:
        artefacts = [path for path in made if f".sm{arch}." in path.name]
        assert len(artefacts) == 1
        assert artefacts[0].parent == tmp_path
        assert artefacts[0].stat().st_size > 0


def test_only_one_file_rotates_with_warps_quaternions():
    """MuJoCo stores (w, x, y, z) and Warp expects (x, y, z, w), so wp.quat_rotate stays in kernels/rotations.py."""
    sources = [path for package in ("deimos", "kernels", "terrain") for path in (HOME / package).rglob("*.py")]
    assert len(sources) > 10
    users = {
        path.relative_to(HOME).as_posix()
        for path in [*sources, HOME / "train.py"]
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if {getattr(node, "attr", None), getattr(node, "id", None), getattr(node, "name", None)}
        & {"quat_rotate", "quat_rotate_inv"}
    }
    assert users <= {"kernels/rotations.py"}
