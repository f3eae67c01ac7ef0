"""What code a cell was made by: commits, changed checkouts, installations without git."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import deimos
from deimos.checks import RunError
from deimos.study import source

HOME = Path(deimos.__file__).resolve().parent.parent
ASK = "from deimos.study.source import code; here = code(); print(here.commit, here.name, *here.changed)"


def git(folder, *arguments):
    """What git says in a folder."""
    who = ("-c", "user.name=x", "-c", "user.email=x@example.org")
    done = subprocess.run(["git", "-C", str(folder), *who, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def ask(folder, where=None):
    """Commit, name and changed files of the code in a folder, as a process there sees it."""
    done = subprocess.run(
        [sys.executable, "-c", ASK], cwd=where or folder, capture_output=True, text=True, check=True,
        env={"PYTHONPATH": str(folder), "PATH": "/usr/bin:/bin", "HOME": str(folder)},
    )  # fmt: skip
    return done.stdout.rstrip("\n").split(" ")


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A repository with our packages, at its first commit."""
    folder = tmp_path_factory.mktemp("checkout")
    for package in ("deimos", "kernels", "terrain"):
        shutil.copytree(HOME / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / ".gitignore").write_text("__pycache__/\n")
    git(folder, "init", "-q")
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "x")
    return folder


def test_clean_checkout_is_its_commit(checkout):
    """Where sources are as committed the commit is the code's name, whatever else lies around."""
    (checkout / "notes.md").write_text("not a source")
    commit = git(checkout, "rev-parse", "HEAD")[:12]
    assert ask(checkout) == [commit, commit]


def test_changed_checkout_is_its_sources(checkout, tmp_path):
    """A source that differs, or that the commit does not have, makes it a hash of the sources; so does no git."""
    before = ask(checkout)
    (checkout / "deimos" / "goals" / "selectors" / "mine.py").write_text('"""Mine."""\n')
    commit, name, *changed = ask(checkout)
    assert (commit, changed) == (before[0], ["deimos/goals/selectors/mine.py"])
    assert name.startswith("sources-")
    other = tmp_path / "copied"
    shutil.copytree(checkout, other, ignore=shutil.ignore_patterns(".git"))
    assert ask(other) == ["", name]
    with (other / "kernels" / "particle.py").open("a") as file:
        file.write("# changed\n")
    assert ask(other)[1] not in (name, "")
    (checkout / "deimos" / "goals" / "selectors" / "mine.py").unlink()
    assert ask(checkout) == before


def test_wheel_and_checkout_of_the_same_sources_agree(checkout, tmp_path):
    """Installed, where kernels and terrain lie inside, the sources have the hash that they have in a checkout."""
    plain, wheel = tmp_path / "plain", tmp_path / "wheel"
    for package in ("deimos", "kernels", "terrain"):
        shutil.copytree(checkout / package, plain / package, ignore=shutil.ignore_patterns("__pycache__"))
        inside = wheel / "deimos" if package == "deimos" else wheel / "deimos" / package
        shutil.copytree(checkout / package, inside, ignore=shutil.ignore_patterns("__pycache__"))
    assert ask(plain) == ask(wheel, where=tmp_path)


def test_repository_around_an_installation_is_not_its_own(checkout, tmp_path):
    """An environment inside of somebody's repository has no commit: that one says nothing about our sources."""
    git(tmp_path, "init", "-q")
    inner = tmp_path / "env"
    inner.mkdir()
    for package in ("deimos", "kernels", "terrain"):
        shutil.copytree(checkout / package, inner / package, ignore=shutil.ignore_patterns("__pycache__"))
    commit, name = ask(inner)
    assert (commit, name[:8]) == ("", "sources-")


def test_pool_is_part_of_what_a_cell_is_made_from(tmp_path):
    """The file of a pool counts by its content, and one that is missing or has changed is refused in one line."""
    pool = tmp_path / "pool.pt"
    with pytest.raises(RunError, match=r"pool\.pt cannot be read \(No such file"):
        source.hashes((), {"pool": pool.read_bytes})
    pool.write_bytes(b"one")
    made = source.hashes((), {"pool": pool.read_bytes}) | {"code": source.code().name}
    assert set(made) == {"code", "pool"}
    source.check_sources("Cell x", made, (), {"pool": pool.read_bytes})
    pool.write_bytes(b"two")
    with pytest.raises(RunError, match="Cell x: the file of 'pool' is not the one that it was made with"):
        source.check_sources("Cell x", made, (), {"pool": pool.read_bytes})


def test_package_counts_with_all_its_modules(tmp_path, monkeypatch):
    """A plug-in that is a package is another one where a module inside it has changed."""
    (tmp_path / "my_plugins").mkdir()
    for name in ("__init__", "inner"):
        (tmp_path / "my_plugins" / f"{name}.py").write_text('"""A module."""\n')
    monkeypatch.syspath_prepend(str(tmp_path))
    source.import_plugins(["my_plugins", "my_plugins.inner"])
    before = source.hashes(["my_plugins", "my_plugins.inner"], {})
    (tmp_path / "my_plugins" / "__init__.py").write_text('"""A package."""\n')
    package = source.hashes(["my_plugins", "my_plugins.inner"], {})
    (tmp_path / "my_plugins" / "inner.py").write_text('"""Another one."""\n')
    both = source.hashes(["my_plugins", "my_plugins.inner"], {})
    assert len({each["my_plugins"] for each in (before, package, both)}) == 3
    assert before["my_plugins.inner"] == package["my_plugins.inner"] != both["my_plugins.inner"]
