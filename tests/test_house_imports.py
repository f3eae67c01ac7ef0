"""What imports what, what an import starts, and the one name that every file of a checkout has."""

import ast
import os
import pickle
import subprocess
import sys
from pathlib import Path

from deimos.kernels.random import Purpose
from source_files import HOME, PACKAGES, module_name, module_names, sources

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


def python(code, *, cwd, path=HOME):
    """Run a program with our packages on the path, or with another folder there."""
    return subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, env=os.environ | {"PYTHONPATH": str(path)}, capture_output=True,
        text=True, check=False,
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


def test_adapters_are_optional(tmp_path):
    """Importing the package of adapters, or what they wrap, needs neither rsl_rl nor gymnasium."""
    code = """
import sys, deimos.adapters, deimos.run.loop, deimos.sim.envs.particle
assert not {"rsl_rl", "gymnasium", "tensordict"} & set(sys.modules)
"""
    done = python(code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


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
    done = python(code, cwd=HOME, path=tmp_path / "site")
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
