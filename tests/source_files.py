"""Our source files, for the tests that read them."""

import ast
from pathlib import Path

import deimos

HOME = Path(deimos.__file__).resolve().parent.parent
PACKAGES = ("deimos", "kernels", "terrain")


def sources(*packages):
    """Paths of the source files of packages, with their syntax trees."""
    paths = [path for package in packages for path in sorted((HOME / package).rglob("*.py"))]
    assert len(paths) >= len(packages)
    return {path.relative_to(HOME).as_posix(): ast.parse(path.read_text(encoding="utf-8")) for path in paths}


def module_name(path):
    """The name that a file of the repository is imported under."""
    name = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    return f"deimos.{name}" if name.split(".")[0] in ("kernels", "terrain") else name


def module_names(*packages):
    """Names of all modules of packages."""
    return [module_name(path) for path in sources(*packages)]
