"""The house: what imports what, what is documented, and how a plugin is found."""

import ast
import importlib
import os
import pickle
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from deimos.kernels.random import Purpose

import deimos
from deimos import plugins
from deimos.app import cli
from deimos.goals import selectors
from deimos.run import config
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim import envs
from deimos.sim.envs import particle, quad
from deimos.sim.legged import robots

HOME = Path(deimos.__file__).resolve().parent.parent
PACKAGES = ("deimos", "kernels", "terrain")

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


ROOMS = {  # package: those that it may import, and those that these may import
    "nn": set(),
    "kernels": set(),
    "terrain": {"kernels"},
    "goals": {"nn"},
    "learn": {"nn"},
    "sim": {"nn", "kernels", "terrain"},
    "run": {"learn", "sim", "goals"},
    "study": {"run"},
    "app": {"study", "terrain"},
    "adapters": {"run"},
}
LEAVES = {"_version", "checks", "files", "lock", "plugins"}  # modules that everybody may import
BACKENDS = {"deimos/nn/cpu.py"}  # imported by functions, where Warp is installed
ENTRIES = {"train.py", "deimos/__main__.py", "terrain/__main__.py"}  # may import app


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


def imports(tree, path=""):
    """Full names of all modules that a file imports, wherever in it, and of what it takes from them."""
    package = module_name(path).split(".")
    if not path.endswith("/__init__.py"):
        package = package[:-1]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            assert not node.level or path.startswith(("kernels/", "terrain/")), f"{path}: only these import relatively"
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def reachable(room):
    """The packages that a package may import."""
    return ROOMS[room].union(*(reachable(other) for other in ROOMS[room]))


def arrows():
    """Every module of ours with the modules of ours that it imports, and its path."""
    trees = sources("deimos", "kernels", "terrain")
    known = {module_name(path) for path in trees}
    return {path: {name for name in imports(tree, path) if name in known} for path, tree in trees.items()}


def python(code, *, cwd, first=()):
    """Run a program with our packages on the path, behind those of ``first``."""
    path = os.pathsep.join(str(folder) for folder in [*first, HOME])
    return subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip


def test_imports_are_silent_and_light(tmp_path):
    """Importing the packages prints nothing and starts no device; none loads mujoco, and by themselves none torch."""
    modules = [name for name in module_names("kernels", "terrain") if not name.endswith("__main__")]
    assert {"deimos.kernels", "deimos.kernels.particle", "deimos.terrain"} <= set(modules)
    code = f"""
import importlib, sys
for name in {modules}:
    importlib.import_module(name)
loaded = {{"torch", "mujoco", "mujoco_warp"}} & set(sys.modules)
assert not loaded, loaded
import deimos
from deimos.app import cli
from deimos import plugins
assert deimos.__version__
loaded = {{"mujoco", "mujoco_warp", "matplotlib", "tensorboard"}} & set(sys.modules)
assert not loaded, loaded
import warp
assert warp._src.context.runtime is None, "a device was started"
"""
    done = python(code, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_deimos_alone_loads_no_torch(tmp_path):
    """``import deimos`` loads neither torch nor Warp, and ``deimos.load_policy`` is there when it is asked for."""
    code = """
import sys
import deimos
loaded = {"torch", "warp", "deimos.kernels", "deimos.terrain", "numpy", "tyro"} & set(sys.modules)
assert not loaded, loaded
assert callable(deimos.load_policy)
assert "torch" in sys.modules
"""
    done = python(code, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_all_of_deimos_imports_without_starting_a_device(tmp_path):
    """No module of deimos, its adapters and command line included, starts a device or prints when it is imported."""
    modules = module_names("deimos")
    modules.remove("deimos.__main__")  # runs the command line
    code = f"""
import importlib
for name in {modules}:
    importlib.import_module(name)
import warp
assert warp._src.context.runtime is None, "a device was started"
"""
    done = python(code, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_imports_follow_the_arrows():
    """A package imports only those below it; learn, sim and goals do not know each other."""
    for path, targets in arrows().items():
        own = module_name(path).split(".")[1:2]
        if path in ENTRIES or not own or own[0] in LEAVES | {"__main__"}:
            continue
        for target in targets:
            other = target.split(".")[1:2]
            if not other or other[0] in LEAVES | {own[0]} or (path in BACKENDS and other == ["kernels"]):
                continue
            assert other[0] in reachable(own[0]), f"{path} imports {target}"


def test_leaves_import_no_room():
    """The modules that everybody may import need nobody's, so that they can be imported from anywhere."""
    for path, targets in arrows().items():
        if path.removeprefix("deimos/").removesuffix(".py") in LEAVES:
            rooms = {target.split(".")[1] for target in targets if "." in target}
            assert rooms <= LEAVES, path


def test_no_import_circle():
    """No module imports itself over others, inside of functions neither."""
    graph = {module_name(path): targets - {"deimos"} for path, targets in arrows().items()}
    graph = {name: {other for other in targets if not name.startswith(f"{other}.")} for name, targets in graph.items()}
    open_, closed = [], set()

    def visit(name):
        assert name not in open_, " -> ".join([*open_[open_.index(name) :], name])
        if name not in closed:
            open_.append(name)
            for other in sorted(graph[name]):
                visit(other)
            closed.add(open_.pop())

    for name in graph:
        visit(name)


def test_what_is_not_in_the_wheel_is_not_imported():
    """The library knows neither the reproduction nor the benchmarks, and only entry points import the command line."""
    for path, tree in sources("deimos", "kernels", "terrain").items():
        found = {name.split(".")[0] for name in imports(tree, path)}
        assert not found & {"reproduction", "benchmarks", "kernels", "terrain", "tests"}, path
    users = [path for path, targets in arrows().items() if any(name.startswith("deimos.app") for name in targets)]
    assert {path for path in users if not path.startswith("deimos/app/")} <= ENTRIES


def test_packages_import_what_they_are_allowed_from_outside():
    """Networks, goals and the learner need torch and NumPy alone; kernels need Warp; terrain adds trimesh."""
    base = {"torch", "numpy"}
    allowed = {
        "deimos/nn": base, "deimos/goals": base, "deimos/learn": base, "kernels": {"warp", "numpy"},
        "terrain": {"warp", "numpy", "trimesh", "matplotlib", "PIL", "mujoco", "scipy"},
    }  # fmt: skip
    for package, others in allowed.items():
        for path, tree in sources(package).items():
            tops = {name.split(".")[0] for name in imports(tree, path)} - {"deimos"}
            extra = {"warp"} if path in BACKENDS else set()
            assert tops <= others | extra | set(sys.stdlib_module_names), path


def test_wheel_holds_every_package():
    """pyproject.toml lists every package of deimos, kernels and terrain, and nothing else."""
    listed = tomllib.loads((HOME / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"]
    there = {module_name(path) for path in sources("deimos", "kernels", "terrain") if path.endswith("__init__.py")}
    assert sorted(listed) == sorted(there)


def test_checkout_is_used_where_a_wheel_is_installed(tmp_path):
    """In a checkout, its own kernels are imported even if another deimos is installed; nothing has two names."""
    installed = tmp_path / "site" / "deimos" / "kernels"
    installed.mkdir(parents=True)
    for folder in (installed, installed.parent):
        (folder / "__init__.py").write_text("raise AssertionError('the installed one')")
    code = """
import sys
import deimos, deimos.kernels.particle, deimos.terrain.shapes.pit, deimos.terrain
files = [module.__file__ for module in sys.modules.values() if getattr(module, "__file__", None)]
ours = [name for name in files if "site-packages" not in name and "/lib/python" not in name]
assert len(ours) == len(set(ours)), sorted(ours)
print(deimos.kernels.__file__)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=HOME, env=os.environ | {"PYTHONPATH": str(tmp_path / "site")},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()) == HOME / "kernels" / "__init__.py"


def test_checkout_is_used_beside_an_editable_install_of_another(tmp_path):
    """The import hook of another checkout's editable install gives this one none of its kernels."""
    (tmp_path / "kernels.py").write_text("raise AssertionError('the other one')")
    code = f"""
import importlib.util, sys
class Hook:
    def find_spec(name, path=None, target=None):
        if name == "deimos.kernels":
            return importlib.util.spec_from_file_location(name, {str(tmp_path / "kernels.py")!r})
sys.meta_path.append(Hook)  # where setuptools puts its own
import deimos.kernels
print(deimos.kernels.__file__)
"""
    done = python(code, cwd=tmp_path)
    assert (done.stdout.strip(), done.stderr) == (str(HOME / "kernels" / "__init__.py"), "")


def test_nothing_else_of_a_checkout_is_in_the_package():
    """Of what lies beside the package only ``kernels`` and ``terrain`` are its modules: ``deimos.train`` is none."""
    beside = {path.stem for path in HOME.glob("[!.]*") if path.suffix == ".py" or list(path.glob("*.py"))}
    assert {"train", "tests", "benchmarks", "reproduction", "kernels", "terrain"} <= beside
    code = f"""
import importlib.util
print(*[name for name in {sorted(beside)} if importlib.util.find_spec("deimos." + name)])
"""
    for folder in (HOME, HOME / "tests"):
        done = python(code, cwd=folder)
        assert (done.stdout.split(), done.stderr) == (["kernels", "terrain"], "")


def test_no_file_is_loaded_twice():
    """After all of the library was imported, no file of it has two names."""
    modules = [name for name in module_names(*PACKAGES) if not name.endswith("__main__")]
    code = f"""
import importlib, sys
for name in {modules}:
    importlib.import_module(name)
names = {{}}
for name, module in sys.modules.items():
    if (getattr(module, "__file__", None) or "").startswith({tuple(f"{HOME / name}{os.sep}" for name in PACKAGES)}):
        names.setdefault(module.__file__, []).append(name)
assert len(names) == {len(modules)}, names
print([twice for twice in names.values() if len(twice) > 1])
"""
    done = python(code, cwd=HOME)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


def test_another_process_unpickles(tmp_path):
    """A process that has imported nothing of Deimos yet finds what a pickle names, in ``kernels`` too."""
    code = f"import pickle; print(repr(pickle.loads({pickle.dumps(Purpose.PUSH)})))"
    done = python(code, cwd=tmp_path)
    assert (done.stdout.strip(), done.stderr) == (repr(Purpose.PUSH), "")


def test_terrain_of_a_checkout_runs_under_one_name():
    """``python -m terrain`` loads no file twice but the package's own ``__init__``, which defines nothing itself."""
    code = """
import runpy, sys
sys.argv = ["terrain", "--help"]
try:
    runpy.run_module("terrain", run_name="__main__", alter_sys=False)
except SystemExit as stop:
    assert not stop.code, stop.code
files = [(module.__file__, name) for name, module in sys.modules.items() if getattr(module, "__file__", None)]
twice = {file for file, name in files if sum(file == other for other, _ in files) > 1 and "terrain" in file}
assert all(file.endswith("terrain/__init__.py") for file in twice), twice
"""
    done = python(code, cwd=HOME)
    assert done.returncode == 0, done.stderr
    tree = sources("terrain")["terrain/__init__.py"]
    assert {type(node) for node in tree.body} <= {ast.Expr, ast.ImportFrom, ast.Assign}


def test_readme_holds_two_setup_lines():
    """README.md has exactly the two set-up lines that .ci/run takes from it: run the main job, run the tests."""
    pattern = re.search(r"grep -E '([^']+)' README\.md", (HOME / ".ci" / "run").read_text(encoding="utf-8"))
    assert pattern is not None
    lines = [
        line for line in (HOME / "README.md").read_text(encoding="utf-8").splitlines() if re.search(pattern[1], line)
    ]
    assert len(lines) == 2
    assert lines[0].startswith("python3 -m venv .venv && ")
    assert lines[0].endswith(" && python train.py")
    assert lines[1].startswith(". .venv/bin/activate && ")
    assert lines[1].endswith(" && pytest")


def public_definitions(tree, prefix=""):
    """Public functions, methods and classes of a module, without what is defined within functions."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            if any(ast.unparse(decorator).endswith(".setter") for decorator in node.decorator_list):
                continue  # its getter says what it is
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public_definitions(node, f"{prefix}{node.name}.")


@pytest.mark.parametrize("package", PACKAGES)
def test_everything_public_has_a_docstring(package):
    """Every module, and every public function, method and class in it, says what it is."""
    for name, tree in sources(package).items():
        assert ast.get_docstring(tree), name
        for definition, node in public_definitions(tree):
            assert ast.get_docstring(node), f"{name}: {definition}"


def test_every_configuration_field_has_a_docstring():
    """Every field of a configuration or of options is followed by a docstring, which --help shows."""
    checked = []
    for name, tree in sources("deimos").items():
        for node in ast.walk(tree):
            if not isinstance(node, ast.ClassDef) or not re.search(r"(Config|Options)$", node.name):
                continue
            for field, after in zip(node.body, [*node.body[1:], None], strict=True):
                if isinstance(field, ast.AnnAssign):
                    assert isinstance(after, ast.Expr), f"{name}: {node.name}.{ast.unparse(field.target)}"
                    checked.append(node.name)
    assert {"TrainConfig", "PPOConfig", "FearConfig", "EvalConfig", "Config"} <= set(checked)


def test_every_test_says_what_holds():
    """Every test has a docstring of one sentence, and no two of a file share a name."""
    for name, tree in sources("tests").items():
        tests = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
        names = [node.name for node in tests]
        assert len(names) == len(set(names)), name
        for node in tests:
            text = ast.get_docstring(node) or ""
            assert text.endswith("."), f"{name}: {node.name}"
            assert not re.search(r"\w{3}\. [A-Z]", text), f"{name}: {node.name} needs more than a sentence"


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


def test_entry_point_is_a_robot(install):
    """A module of another distribution that is registered under ``deimos.robots`` can be asked for by its name."""
    before = plugins.names(robots)
    install("deimos.robots", "stiff", ROBOT)
    assert plugins.names(robots) == sorted([*before, "stiff"])
    robot = quad.Config(robot="stiff", damping=2.0).make_robot()
    assert {(joint.stiffness, joint.damping) for joint in robot.joints} == {(77.0, 2.0)}
