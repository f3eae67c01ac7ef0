"""Where commands run: other people's environments, streams and folders."""

import dataclasses
import logging
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

import deimos
from deimos.app import cli, console
from deimos.run import training
from deimos.run.config import kind
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig

HOME = Path(deimos.__file__).resolve().parent.parent
DEIMOS = [sys.executable, "-m", "deimos"]
TINY = "train --no-evaluation --num-envs 4 --env-steps 24 --threads 1 --device cpu".split()


def run(*arguments, cwd, shell="", **environment):
    """A command in a process of its own; ``shell`` is what a shell would redirect."""
    command = ["/bin/bash", "-c", f'"$@" {shell}', "bash", *DEIMOS, *map(str, arguments)]
    known = os.environ | {"PYTHONPATH": str(HOME), "OMP_NUM_THREADS": "1"} | environment
    done = subprocess.run(command, cwd=cwd, env=known, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    assert "Exception ignored" not in done.stderr, done.stderr
    return done


@pytest.mark.parametrize("arguments", [[], ["--help"], ["--version"]])
def test_what_deimos_is_needs_no_torch(tmp_path, arguments):
    """The list of commands and the version come without torch, Warp, tyro and NumPy."""
    code = f"""
import sys
from deimos.app.cli import main
assert main({arguments}) == 0
heavy = {{"torch", "warp", "tyro", "numpy", "rich", "matplotlib"}} & set(sys.modules)
assert not heavy, heavy
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(HOME)}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout


WAITING = """
import os, sys
from deimos.app import cli
assert "torch" not in sys.modules
cli.COMMANDS["train"] = ("waiting", "")
class Waiting:
    def main(arguments, program):
        print(os.environ["OMP_WAIT_POLICY"], "torch" in sys.modules, os.environ["MPLBACKEND"])
sys.modules["waiting"] = Waiting
sys.exit(cli.main(["train"]))
"""


@pytest.mark.parametrize(("given", "found"), [({}, "passive"), ({"OMP_WAIT_POLICY": "active"}, "active")])
def test_threads_that_wait_sleep(tmp_path, given, found):
    """A command sets the policy before torch is loaded; a user's value wins."""
    known = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run(
        [sys.executable, "-c", WAITING], cwd=tmp_path, env=known | {"PYTHONPATH": str(HOME)} | given,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.split() == [found, "False", "agg"], done.stderr


def test_the_library_leaves_the_environment_alone(tmp_path):
    """Importing everything that deimos offers and its command line changes no environment variable."""
    code = """
import os
before = dict(os.environ)
import deimos
for name in deimos.__all__:
    getattr(deimos, name)
import deimos.app.cli, deimos.app.train, deimos.app.playback, deimos.study.cli
changed = {name for name in before.keys() | os.environ.keys() if before.get(name) != os.environ.get(name)}
assert not {name for name in changed if name.startswith(("OMP", "MPL", "MKL", "MUJOCO", "COLUMNS"))}, changed
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(HOME)}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_a_run_needs_neither_git_nor_streams_nor_a_notebooks_back_end(tmp_path):
    """A run is whole without git, with all streams closed and with the back end of a notebook that is not here."""
    done = run(
        *TINY, "--out", "here", cwd=tmp_path, shell="<&- >&- 2>&-", PATH=str(tmp_path),
        MPLBACKEND="module://matplotlib_inline_of_nowhere.backend_inline",
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "here" / "summary.png").read_bytes().startswith(b"\x89PNG")


def test_provenance_without_git(monkeypatch, tmp_path):
    """Where there is no git, or the package lies in somebody else's repository, the commit is unknown."""
    assert training.provenance()["commit"] != ""
    monkeypatch.setenv("PATH", str(tmp_path))
    assert training.provenance()["commit"] == "unknown"


def test_the_repository_around_an_installed_package_is_not_ours(tmp_path, monkeypatch):
    """A package in somebody's environment, in somebody's repository, does not take that repository's commit."""
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    place = tmp_path / "venv" / "site-packages" / "deimos" / "run" / "training.py"
    place.parent.mkdir(parents=True)
    monkeypatch.setattr(training, "__file__", str(place))
    assert training.provenance()["commit"] == "unknown"


@pytest.mark.parametrize("arguments", [["--help"], ["terrain", "list"], ["train", "--help"]])
def test_a_pipe_that_closes_ends_quietly(tmp_path, arguments):
    """Whoever has read enough of a command's output hears nothing more of it."""
    done = run(*arguments, cwd=tmp_path, shell="| head -1; exit ${PIPESTATUS[0]}")
    assert done.returncode in (0, cli.BROKEN_PIPE)
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("shell", "code", "said"),
    [
        (">/dev/full", 2, "deimos: A file or the output could not be read or written (No space left on device).\n"),
        (">&-", 0, ""),
        ("2>&-", 0, ""),
        ("<&- >&- 2>&-", 0, ""),
        ("2>/dev/full", 0, ""),
    ],
)
def test_streams_may_be_closed_or_full(tmp_path, shell, code, said):
    """A full disk is said in one line; what is closed is written to nowhere."""
    done = run("--help", cwd=tmp_path, shell=shell)
    assert (done.returncode, done.stderr) == (code, said)


def test_an_error_that_nobody_hears_is_an_error(tmp_path):
    """With stderr closed or full, the exit code stays."""
    for shell in ("2>&-", "2>/dev/full"):
        assert run("frobnicate", cwd=tmp_path, shell=shell).returncode == 2


def test_a_closed_stream_is_not_the_next_file(tmp_path):
    """What is said to a closed stderr does not end up in the file that was opened next."""
    run("terrain", "shape", "flat", "--cell", "0.5", "--out", "flat.npz", cwd=tmp_path, shell="2>&- >&-")
    assert (tmp_path / "flat.npz").read_bytes().startswith(b"PK")
    assert run("terrain", "import", "flat.npz", "--out", "same.npz", cwd=tmp_path).returncode == 0


def test_a_path_that_the_terminal_cannot_spell(tmp_path):
    """A folder's name is printed as well as the terminal's encoding can."""
    done = run("evaluate", "ä", cwd=tmp_path, PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert done.returncode == 2
    assert done.stderr == "deimos: \\xe4 is not a run folder: it holds no config.json.\n"


def test_a_folder_for_kernels_that_cannot_be_made(tmp_path):
    """Where Warp cannot keep what it compiles, one line says how to give it another folder."""
    (tmp_path / "file").touch()
    done = run(*TINY, cwd=tmp_path, WARP_CACHE_PATH=str(tmp_path / "file" / "cache"))
    assert done.returncode == 2
    assert re.fullmatch(r"deimos: Compiled kernels cannot be kept in .*; set WARP_CACHE_PATH to .*\n", done.stderr)


def test_a_working_folder_that_is_gone(tmp_path):
    """A command in a folder that was deleted says so."""
    command = f'mkdir gone; cd gone; rmdir ../gone; exec "{sys.executable}" -m deimos train'
    done = subprocess.run(
        ["bash", "-c", command], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(HOME)}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "deimos: The working folder does not exist any more; change to one that does.\n"


def test_two_runs_of_one_second_have_two_folders(tmp_path, monkeypatch):
    """Runs that begin in the same second with the same configuration do not meet."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda form: "now")
    config = TrainConfig(num_envs=4, env_steps=24, device="cpu", threads=1, evaluation=False)
    paths = [training.start(config, None, None)[1].path for _ in range(3)]
    stem = f"{kind(config.env)}-p25-s0-now"
    assert [path.name for path in paths] == [stem, f"{stem}-2", f"{stem}-3"]
    assert all(RunFolder.open(path) for path in paths)


@pytest.mark.parametrize("place", ["~/run", "--out=~/run"])
def test_a_tilde_is_the_home_folder(monkeypatch, tmp_path, place):
    """A path from ``~`` is below the home folder, however it is given."""
    parsed = []
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr("deimos.app.train._train", parsed.append)
    assert cli.main(["train", *(["--out", place] if place.startswith("~") else [place])]) == 0
    assert parsed[0].out == tmp_path / "run"


def test_progress_without_a_terminal_is_a_plain_line(monkeypatch, capfd):
    """Where there is no terminal, now and then a whole line says how far it is, and more seldom in a long job."""
    clock = iter([0.0, 1.0, 25.0, 30.0, 50.0, 10_000.0, 10_400.0, 10_600.0])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    with console.progress("training") as report:
        for i in range(1, 8):
            report(f"iteration {i}", i / 8)
    said = capfd.readouterr().err.splitlines()
    assert said == [
        f"training: iteration {i}, {share}" for i, share in ((2, "25%"), (4, "50%"), (5, "62%"), (7, "88%"))
    ]


def test_progress_of_a_short_run_is_silent(tmp_path, capfd):
    """A run of a second says nothing on stderr where there is no terminal."""
    assert cli.main([*TINY, "--method", "uniform", "--out", str(tmp_path / "run")]) == 0
    assert capfd.readouterr().err == ""


def test_a_director_without_fear_yet_says_so(tmp_path, capfd):
    """Why its goals are uniform at first is a line on stderr; afterwards Deimos logs as little as before."""
    for number in range(2):
        assert cli.main([*TINY, "--method", "p75", "--out", str(tmp_path / f"run{number}")]) == 0
        (line,) = capfd.readouterr().err.splitlines()
        assert line.startswith("Goals are uniform until the fear network has seen crashes (1) and as many survivals;")
    assert not logging.getLogger("deimos").handlers
    assert not logging.getLogger("deimos").isEnabledFor(logging.INFO)


@pytest.mark.parametrize("columns", [20, 60, 80, 100, 200])
@pytest.mark.parametrize("command", ["", "train", "play", "terrain", "terrain grid", "study", "evaluate"])
def test_help_fits_the_terminal(monkeypatch, capsys, columns, command):
    """No line of any help is wider than the terminal, or than the least that help is written for."""
    monkeypatch.setenv("COLUMNS", str(columns))
    assert cli.main([*command.split(), "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= max(columns, console.LEAST_WIDTH)
    assert all(line == line.rstrip() for line in lines)


def test_first_options_come_first(capsys, monkeypatch):
    """What people ask for first is at the top of the help of train, the presets among it, and options are in groups."""
    monkeypatch.setenv("COLUMNS", "100")
    assert cli.main(["train", "--help"]) == 0
    out = capsys.readouterr().out
    flags = re.findall(r"^  (--[\w.-]+)", out, re.MULTILINE)
    first = {"--preset", "--resume", "--method", "--evaluation", "--seed", "--num-envs", "--env-steps", "--device",
             "--threads", "--out"}  # fmt: skip
    assert first < set(flags[:12])
    assert flags[0] == "--preset"
    groups = re.findall(r"^ (\w[\w. ]*)$", out, re.MULTILINE)
    assert groups == ["options", "ppo options", "eval options", "eval.fear options", "env options", "subcommands"]


def test_a_broken_plugin_is_named_and_breaks_nothing(tmp_path):
    """One file that cannot be imported is named in one line; help, training and the list of shapes work without it."""
    (tmp_path / "broken_module.py").write_text("raise KeyError('it is broken')")
    information = tmp_path / "other-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    groups = ("envs", "selectors", "shapes")
    entries = "".join(f"[deimos.{group}]\nbroken = broken_module\n" for group in groups)
    (information / "entry_points.txt").write_text(entries)
    for arguments, known in (
        (["train", "--help"], "selector:director"),
        ([*TINY, "--method", "uniform", "--out", "run"], "run"),
        (["terrain", "list"], "stairs-up: "),
    ):
        done = run(*arguments, cwd=tmp_path, PYTHONPATH=f"{tmp_path}:{HOME}")
        assert done.returncode == 0, done.stderr
        assert known in done.stdout
        lines = done.stderr.splitlines()
        assert lines
        assert all(re.match("deimos: The plug-in 'broken' of deimos.*broken_module, is broken", line) for line in lines)


@dataclasses.dataclass(frozen=True)
class Described:
    """What a stranger's plug-in holds."""

    plain: int = 3
    long: int = 4
    """A text that goes on
    over two lines, with ``code``."""
    other: int = 5
    ...


def test_help_takes_plugins_as_they_are(monkeypatch, capsys):
    """A field without a docstring is listed without one, and a docstring of several lines is one text."""
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        console.parse(Described, ["--help"], "program")
    out = capsys.readouterr().out
    assert "A text that goes on over two lines, with code. (default: 4)" in out
    assert all(flag in out for flag in ("--plain", "--other"))
