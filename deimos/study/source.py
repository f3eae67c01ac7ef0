"""The code that a cell's numbers come from: a commit if one identifies it, else a hash of the sources."""

import hashlib
import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import deimos
from deimos.checks import RunError, one_line

PACKAGES = ("deimos", "deimos.kernels", "deimos.terrain")
DIGITS = 12  # of a commit or a SHA-256

Files = Mapping[str, Callable[[], bytes]]
"""What reads the files that a cell's numbers depend on, by their names."""


@dataclass(frozen=True)
class Code:
    """The code of this process."""

    commit: str
    """The commit that is checked out; empty where this is not a checkout or git is missing."""
    changed: tuple[str, ...]
    """Source files that differ from it, or that it does not have."""
    sources: str
    """A hash of all sources, which a checkout and a wheel of the same sources share."""

    @property
    def name(self) -> str:
        """The commit or, where that is not the whole code, the sources."""
        return self.commit if self.commit and not self.changed else self.sources


def code() -> Code:
    """The code of this process, as it is on the disk now."""
    folders = {name: Path(importlib.import_module(name).__path__[0]) for name in PACKAGES}
    files = {f"{name}/{path.relative_to(folder)}": path for name, folder in folders.items() for path in _files(folder)}
    home = Path(deimos.__file__).resolve().parent.parent
    commit = _git(home, "rev-parse", f"--short={DIGITS}", "HEAD") if (home / ".git").exists() else ""
    changed = _git(home, "status", "--porcelain", "--untracked-files=all", "--", *map(str, folders.values()))
    return Code(commit, tuple(line[3:] for line in changed.splitlines()) if commit else (), f"sources-{_hash(files)}")


def _files(folder: Path) -> list[Path]:
    """The files of a package, except those of packages that a wheel has inside it."""
    inner = {folder / name.rpartition(".")[2] for name in PACKAGES if name != "deimos"}
    return [
        path for path in sorted(folder.rglob("*"))
        if path.is_file() and "__pycache__" not in path.parts and not inner.intersection(path.parents)
    ]  # fmt: skip


def _hash(files: dict[str, Path]) -> str:
    digest = hashlib.sha256()
    for name, path in sorted(files.items()):
        digest.update(f"{name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return digest.hexdigest()[:DIGITS]


def _git(home: Path, *arguments: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(home), *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.rstrip("\n")


def import_plugins(names: Iterable[str]) -> None:
    """Import modules that register selectors, attackers or environments; those of the working directory too.

    Raises:
        RunError: If one is missing or broken.
    """
    if os.getcwd() not in map(os.path.abspath, sys.path):  # ``python -m`` adds it, an installed script does not
        sys.path.append(os.getcwd())
    for name in names:
        try:
            importlib.import_module(name)
        except Exception as error:  # a foreign file may raise anything
            reason = f"{type(error).__name__}: {one_line(error)}"
            raise RunError(f"plugins: the module {name} cannot be imported ({reason}).") from error


def hashes(plugins: Sequence[str], files: Files) -> dict[str, str]:
    """What a cell's numbers depend on besides its configuration and the code: plugins and files by their SHA-256.

    Args:
        plugins: Modules, which must be imported; a package counts with all its modules.
        files: See ``Cell.files``.

    Raises:
        RunError: If a file cannot be read.
    """
    modules: Files = {name: partial(_source, name) for name in plugins}
    try:
        return {name: hashlib.sha256(read()).hexdigest()[:DIGITS] for name, read in {**modules, **files}.items()}
    except OSError as error:
        raise RunError(f"{error.filename} cannot be read ({error.strerror}).") from error


def _source(module: str) -> bytes:
    """The source of an imported module; of a package, that of all its modules."""
    path = Path(str(sys.modules[module].__file__))
    inner = sorted(path.parent.rglob("*.py")) if path.name == "__init__.py" else [path]
    return b"".join(each.read_bytes() for each in inner)


def check_sources(what: str, wanted: dict[str, str], plugins: Sequence[str], files: Files) -> None:
    """Raise ``RunError`` unless the code, the plugins and the files are still those that a cell was made with."""
    found = hashes(plugins, files) | {"code": wanted.get("code", "")}
    here = code()
    if wanted.get("code") not in (here.commit if not here.changed else "", here.sources):
        raise RunError(
            f"{what} was made from {wanted.get('code')}, and this is {here.name}: cells of two versions never mix. "
            f"Continue with that version (a worktree of its commit), or begin a new study."
        )
    for name, value in wanted.items():
        if found.get(name) != value:
            raise RunError(f"{what}: the file of '{name}' is not the one that it was made with; put that one back.")
