"""The house: what is documented, what is in the wheel, and how long files and functions are."""

import ast
import re
import tomllib
from pathlib import Path

import pytest
from source_files import HOME, PACKAGES, module_name, sources

LONGEST_FILE, LONGEST_FUNCTION = 450, 60  # lines


def test_wheel_holds_every_package():
    """pyproject.toml lists every package of deimos, kernels and terrain and those that hold data, and nothing else."""
    build = tomllib.loads((HOME / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    there = {module_name(path) for path in sources("deimos", "kernels", "terrain") if path.endswith("__init__.py")}
    assert sorted(build["packages"]) == sorted(there | set(build["package-data"]))


def test_notices_of_others_are_in_the_package():
    """Licence and notice are installed; every robot, and every project that its numbers come from, is in the notice."""
    project = tomllib.loads((HOME / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["license-files"] == ["LICENSE", "NOTICE"]
    notice = (HOME / "NOTICE").read_text(encoding="utf-8")
    robots = sources("deimos/sim/legged/robots")
    named = {path for path in robots if not Path(path).name.startswith("_")}
    assert named == set(re.findall(r"deimos/sim/legged/robots/\w+\.py", notice))
    said = " ".join(map(ast.get_docstring, robots.values()))
    for source in ("MuJoCo Menagerie", "mjlab", "Legged Gym", "interbotix_ros_manipulators"):
        assert source in said, source
        assert source in notice, source
    assert "BSD 3-Clause License" in notice


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
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        tests = [node for node in functions if node.name.startswith("test_")]
        names = [node.name for node in tests]
        assert len(names) == len(set(names)), name
        for node in tests:
            text = ast.get_docstring(node) or ""
            assert text.endswith("."), f"{name}: {node.name}"
            assert not re.search(r"\w{3}\. [A-Z]", text), f"{name}: {node.name} needs more than a sentence"


def test_files_and_functions_are_short():
    """No file of Python has more than 450 lines and no function more than 60, tests included."""
    trees = sources(*PACKAGES, "reproduction", "benchmarks", "examples", "tests")
    long_files = {name for name in trees if len((HOME / name).read_text("utf-8").splitlines()) > LONGEST_FILE}
    assert not long_files
    for name, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert node.end_lineno - node.lineno < LONGEST_FUNCTION, f"{name}: {node.name}"
