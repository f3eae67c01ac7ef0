"""Our source files, for the tests that read them."""

import ast
import functools
from pathlib import Path

import deimos

HOME = Path(deimos.__file__).resolve().parent.parent
PACKAGES = ("deimos", "kernels", "terrain")


@functools.cache
def syntax(path):
    """The syntax tree of a file, read once for all tests, which leave it as it is."""
    return ast.parse(path.read_text(encoding="utf-8"))


def sources(*packages):
    """Paths of the source files of packages, with their syntax trees."""
    paths = [path for package in packages for path in sorted((HOME / package).rglob("*.py"))]
    assert len(paths) >= len(packages)
    return {path.relative_to(HOME).as_posix(): syntax(path) for path in paths}


def module_name(path):
    """The name that a file of the repository is imported under."""
    name = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    return f"deimos.{name}" if name.split(".")[0] in ("kernels", "terrain") else name


def module_names(*packages):
    """Names of all modules of packages."""
    return [module_name(path) for path in sources(*packages)]
