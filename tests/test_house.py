"""The house: what imports what, what is documented, and how a plugin is found."""

import ast
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import deimos
from deimos import plugins
from deimos.app import cli
from deimos.goals import selectors
from deimos.run import config
from deimos.run.folder import RunFolder
from deimos.sim import envs

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


def sources(*packages):
    """Paths of the source files of packages, with their syntax trees."""
    paths = [path for package in packages for path in sorted((HOME / package).rglob("*.py"))]
    assert len(paths) >= len(packages)
    return {path.relative_to(HOME).as_posix(): ast.parse(path.read_text(encoding="utf-8")) for path in paths}


def module_names(*packages):
    """Names of all modules of packages."""
    return [name.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for name in sources(*packages)]


def imports(tree):
    """Full names of all modules that a file imports, wherever in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            assert node.module is not None
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def python(code, *, cwd, first=()):
    """Run a program with our packages on the path, behind those of ``first``."""
    path = os.pathsep.join(str(folder) for folder in [*first, HOME])
    return subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip


def test_imports_are_silent_and_light(tmp_path):
    """Importing the packages prints nothing and starts no device; none loads mujoco, and by themselves none torch."""
    modules = module_names("kernels", "terrain")
    assert {"kernels", "deimos.kernels.particle", "terrain"} <= set(modules)
    code = f"""
import importlib, sys
for name in {modules}:
    importlib.import_module(name)
loaded = {{"torch", "mujoco", "mujoco_warp", "deimos"}} & set(sys.modules)
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
loaded = {"torch", "warp", "kernels", "terrain", "numpy", "tyro"} & set(sys.modules)
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


def test_dependencies_point_one_way():
    """Kernels import Warp, NumPy and themselves; terrain adds trimesh and its tool's; only deimos imports deimos."""
    allowed = {
        "kernels": {"warp", "numpy", "kernels"},
        "terrain": {"warp", "numpy", "trimesh", "tyro", "rich", "matplotlib", "PIL", "kernels", "terrain"},
    }
    for package, others in allowed.items():
        for name, tree in sources(package).items():
            tops = {module.split(".")[0] for module in imports(tree)}
            assert tops <= others | set(sys.stdlib_module_names), name


def test_what_selectors_are_made_of_sees_tensors_only():
    """Selectors, interactions, the fear network and the learner's parts import torch, and neither Warp nor a kernel."""
    trees = sources("deimos")
    parts = [
        "selector",
        "fear_selector",
        "interactions",
        "fear",
        "calibration",
        "picks",
        "networks",
        "ensemble",
        "products",
        "seeds",
    ]
    parts += ["rollout", "adam", "ppo", "goal_director"]
    names = [f"deimos/{part}.py" for part in parts] + [name for name in trees if name.startswith("deimos/selectors/")]
    for name in names:
        found = set(imports(trees[name]))
        assert not {module for module in found if module.split(".")[0] in ("warp", "kernels", "terrain")}, name
        if name.startswith(("deimos/selector", "deimos/fear_selector")):
            assert (
                not {
                    "deimos.sim.env",
                    "deimos.sim.envs",
                    "deimos.run.loop",
                    "deimos.learn.ppo.PPO",
                    "deimos.run.training",
                }
                & found
            ), name


@pytest.mark.parametrize("name", ["kernels", "terrain"])
def test_foreign_package_is_refused(tmp_path, name):
    """A foreign package of the same name that comes first on the path stops ``import deimos`` with a clear message."""
    (tmp_path / "foreign" / name).mkdir(parents=True)
    (tmp_path / "foreign" / name / "__init__.py").touch()
    done = python("import deimos", cwd=tmp_path, first=[tmp_path / "foreign"])
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: Deimos needs its own package '{name}' from {HOME}, but Python found ")
    assert str(tmp_path / "foreign" / name) in last
    assert "environment of its own" in last


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
    assert {"TrainConfig", "PPOConfig", "FearConfig", "EvalConfig", "BenchOptions", "Config"} <= set(checked)


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
        ValueError, match=r"deimos\.selectors has no 'nope'; it has: boltzmann, cl, director, .*, uniform, vds\."
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


def test_entry_point_is_a_selector(tmp_path, monkeypatch, capsys):
    """A module of another distribution that is registered under ``deimos.goals.selectors`` is a selector too."""
    (tmp_path / "other_module.py").write_text(SELECTOR)
    information = tmp_path / "other-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[deimos.goals.selectors]\nfurthest = other_module\n")
    before = plugins.names(selectors)
    monkeypatch.syspath_prepend(str(tmp_path))
    try:
        assert plugins.names(selectors) == sorted([*before, "furthest"])
        assert_selector_works(tmp_path, "furthest", capsys)
    finally:
        sys.modules.pop("other_module", None)
