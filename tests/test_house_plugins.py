"""How a plug-in is found: by its file's name, or by an entry point of another distribution."""

import importlib
import re
import sys
from pathlib import Path

import pytest

from deimos import plugins
from deimos.app import cli
from deimos.goals import selectors
from deimos.run import config
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim import envs
from deimos.sim.envs import particle, quad
from deimos.sim.legged import robots

SELECTOR = '''
"""The longest goal."""

from dataclasses import dataclass

import torch

from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """The longest of some goals."""

    candidates: int = 5
    """Goals to pick from."""

    def build(self, spaces, seed):
        """See ``SelectorConfig.build``."""
        return Longest(self)


class Longest(GoalSelector):
    """See ``Config``."""

    def __init__(self, config):
        self.num_candidates = config.candidates

    def propose(self, rows, state, goal, candidates, draws):
        """See ``GoalSelector.propose``."""
        score = candidates.norm(dim=2)
        best = score.argmax(dim=1)
        every = torch.arange(len(rows), device=rows.device)
        return Proposal(candidates[every, best], score[every, best])
'''


ENVIRONMENT = '''
"""Particle Gym under another name."""

from dataclasses import dataclass

from deimos.sim.envs import particle


@dataclass(frozen=True, kw_only=True)
class Config(particle.Config):
    """See ``particle.Config``."""
'''


ROBOT = '''
"""A stiff Go1."""

from deimos.sim.legged.robots import go1


def build(stiffness=77.0, **gains):
    """A Go1 whose joints are stiff unless they are told otherwise."""
    return go1.build(stiffness=stiffness, **gains)
'''


@pytest.mark.parametrize("package", [envs, selectors])
def test_file_name_is_the_registration(package):
    """The plugins of a package are its public modules, and each holds a Config that knows its own name."""
    names = plugins.names(package)
    files = {path.stem for path in Path(package.__file__).parent.glob("*.py")}
    assert set(names) == {name for name in files if not name.startswith("_")}
    for name in names:
        assert config.kind(plugins.load(package, name).Config()) == name


def test_unknown_plugin_is_refused():
    """Asking for a plugin that is not there lists those that are."""
    with pytest.raises(
        ValueError,
        match=r"deimos\.goals\.selectors has no 'nope'; it has: boltzmann, cl, director, .*, uniform, vds, weighted\.",
    ):
        plugins.load(selectors, "nope")


FLAGS = "--num-envs 4 --env-steps 24 --threads 1 --device cpu --no-evaluation --env.goal-period 8".split()


def assert_selector_works(tmp_path, name, capsys):
    """A run with a selector of this name can be started, read back and resumed."""
    path = tmp_path / "run"
    assert cli.main(["train", *FLAGS, f"selector:{name}", "--selector.candidates", "7", "--out", str(path)]) == 0
    stored = RunFolder(path).read_json("config.json")["config"]["selector"]
    assert stored == {"kind": name, "candidates": 7}
    assert cli.main(["train", "--resume", str(path), "--env-steps", "48"]) == 0
    assert len(RunFolder(path).read_csv("progress.csv")) == 2
    capsys.readouterr()
    assert cli.main(["train", "selector:nope"]) == 2
    assert f"selector:{name}" in capsys.readouterr().err


def test_dropped_in_file_is_a_selector(tmp_path, monkeypatch, capsys):
    """One file in the package's folder, and nothing else, makes ``selector:NAME`` work from the command line."""
    folder = tmp_path / "selectors"
    folder.mkdir()
    (folder / "longest.py").write_text(SELECTOR)
    (folder / "_helper.py").write_text("")
    before = plugins.names(selectors)
    monkeypatch.setattr(selectors, "__path__", [*selectors.__path__, str(folder)])
    importlib.invalidate_caches()
    try:
        assert plugins.names(selectors) == sorted([*before, "longest"])
        assert_selector_works(tmp_path, "longest", capsys)
    finally:
        sys.modules.pop("deimos.goals.selectors.longest", None)


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Installs another distribution, of one module that is registered under an entry-point group."""

    def write(group, name, source):
        (tmp_path / "other_module.py").write_text(source)
        information = tmp_path / "other-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(f"[{group}]\n{name} = other_module\n")
        monkeypatch.syspath_prepend(str(tmp_path))

    yield write
    sys.modules.pop("other_module", None)


def test_entry_point_is_a_selector(install, tmp_path, capsys):
    """A module of another distribution that is registered under ``deimos.selectors`` is a selector too."""
    before = plugins.names(selectors)
    install("deimos.selectors", "furthest", SELECTOR)
    assert plugins.names(selectors) == sorted([*before, "furthest"])
    assert_selector_works(tmp_path, "furthest", capsys)


def test_entry_point_with_a_hyphen_is_an_environment(install, tmp_path):
    """An environment of another distribution trains under its own name, hyphens and all."""
    install("deimos.envs", "my-particle", ENVIRONMENT)
    path = tmp_path / "run"
    assert cli.main(["train", "env:my-particle", *FLAGS, "--out", str(path)]) == 0
    assert RunFolder(path).read_json("config.json")["config"]["env"]["kind"] == "my-particle"
    assert cli.main(["train", "--resume", str(path), "--env-steps", "48"]) == 0


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("raise ImportError('it needs what is not there')", "ImportError: it needs what is not there"),
        ("def", "SyntaxError: invalid syntax (other_module.py, line 1)"),
        ("class Config: ...", "TypeError: it holds no dataclass Config"),
    ],
)
@pytest.mark.parametrize(("group", "kind"), [("deimos.envs", "env"), ("deimos.selectors", "selector")])
def test_a_broken_plugin_stops_no_other(install, tmp_path, capsys, group, kind, source, reason):
    """It is reported by name wherever all are listed; who asks for it is told why, and all else works."""
    install(group, "broken", source)
    assert config.kind(particle.Config()) == "particle"
    assert config.to_dict(TrainConfig())["env"]["kind"] == "particle"
    message = f"The plug-in 'broken' of {group}, other_module, is broken ({reason})."
    with pytest.warns(UserWarning, match=re.escape(message)):
        assert cli.main(["train", "env:particle", *FLAGS, "--out", str(tmp_path / "run")]) == 0
    with pytest.warns(UserWarning, match=re.escape(message)):
        assert cli.main(["train", "--help"]) == 0
    capsys.readouterr()
    assert cli.main(["train", f"{kind}:broken"]) == 2
    assert capsys.readouterr().err == f"deimos: {message}\n"


def test_a_plugin_is_registered_once(new_plugins, tmp_path, monkeypatch):
    """A name that is taken, by a file or by another registration, and a module that is not there are refused."""
    (tmp_path / "my_selector.py").write_text(SELECTOR)
    monkeypatch.syspath_prepend(str(tmp_path))
    before = plugins.names(selectors)
    plugins.register(selectors, "longest", "my_selector")
    plugins.register(selectors, "longest", "my_selector")  # a module that is imported anew
    assert plugins.names(selectors) == sorted([*before, "longest"])
    for name, owner in (("director", "deimos.goals.selectors.director"), ("longest", "my_selector")):
        with pytest.raises(ValueError, match=f"name must be free in .*, got '{name}', which is {re.escape(owner)}"):
            plugins.register(selectors, name, "deimos.goals.selectors.uniform")
    for module in ("no_such_module", "no_such_package.module", "json.no_such_module", ""):
        with pytest.raises(ValueError, match=f"module must be .* that can be imported, got '{module}'"):
            plugins.register(selectors, "other", module)
    assert not plugins.has(selectors, "other")


def test_every_lookup_finds_the_same_plugin(new_plugins, install, tmp_path):
    """A registered module precedes an entry point of its name: when it is listed, loaded, and named again."""
    (tmp_path / "my_selector.py").write_text(SELECTOR)
    install("deimos.selectors", "longest", SELECTOR)
    with pytest.raises(ValueError, match=r"name must be free in .*, got 'longest', which is other_module"):
        plugins.register(selectors, "longest", "my_selector")
    assert plugins.name_of(selectors, "other_module") == "longest"
    plugins._registered["deimos.selectors"] = {"longest": "my_selector"}  # by a module that came before the package
    assert plugins.names(selectors).count("longest") == 1
    assert plugins.load(selectors, "longest").__name__ == "my_selector"
    assert plugins.name_of(selectors, "my_selector") == "longest"
    assert plugins.name_of(selectors, "other_module") is None


def test_entry_point_is_a_robot(install):
    """A module of another distribution that is registered under ``deimos.robots`` can be asked for by its name."""
    before = plugins.names(robots)
    install("deimos.robots", "stiff", ROBOT)
    assert plugins.names(robots) == sorted([*before, "stiff"])
    robot = quad.Config(robot="stiff", damping=2.0).make_robot()
    assert {(joint.stiffness, joint.damping) for joint in robot.joints} == {(77.0, 2.0)}
