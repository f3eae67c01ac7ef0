"""Check that exactly one package is installed, has everything, and leaves a foreign ``kernels`` alone."""

import base64
import hashlib
import importlib
import importlib.metadata
import pkgutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import deimos
import kernels

SITE = Path(sysconfig.get_paths()["purelib"]).resolve()

ours = importlib.metadata.files("deimos-rl") or []
tops = {file.parts[0] for file in ours if not file.parts[0].endswith(".dist-info")} - {"..", "__pycache__"}
assert tops == {"deimos"}, tops
assert any(file.name == "py.typed" for file in ours)
assert {"LICENSE", "NOTICE"} <= {file.name for file in ours if file.parts[0].endswith(".dist-info")}
assert sum(file.parts[:3] == ("deimos", "terrain", "grids") for file in ours) >= 2  # data files, which no import misses

names = [info.name for info in pkgutil.walk_packages(deimos.__path__, "deimos.")]
assert {"deimos.kernels.particle", "deimos.terrain.shapes.stairs", "deimos.sim.legged.robots.go1"} <= set(names), names
assert not {"deimos.tests", "deimos.benchmarks", "deimos.reproduction"} & set(names), names
for name in names:
    if not name.endswith("__main__"):
        module = importlib.import_module(name)
        assert module.__file__ is None or Path(module.__file__).resolve().is_relative_to(SITE / "deimos"), (
            module.__file__
        )

theirs = importlib.metadata.files("kernels") or []
assert Path(kernels.__file__).resolve() == SITE / "kernels" / "__init__.py", kernels.__file__
assert theirs
assert not {str(file) for file in ours} & {str(file) for file in theirs}
for file in theirs:
    digest = file.hash
    if digest is not None and digest.mode == "sha256":
        found = base64.urlsafe_b64encode(hashlib.sha256(file.locate().read_bytes()).digest()).rstrip(b"=").decode()
        assert found == digest.value, file

for command in (["-m", "deimos", "--version"], ["-m", "deimos.terrain", "--help"]):
    subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
print(f"{len(names)} modules of deimos {deimos.__version__}; {len(theirs)} files of kernels untouched")
