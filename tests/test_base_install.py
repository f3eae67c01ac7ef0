"""The base install: torch and NumPy alone give the Director in other people's loops, and trained policies.

Every program runs in a process of its own in which nothing else can be imported, whatever is installed here.
"""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

HOME = Path(__file__).resolve().parent.parent
BASE_TESTS = HOME / ".ci" / "base_tests"

BLOCK = """
import sys
for name in (
    "warp", "mujoco", "mujoco_warp", "matplotlib", "tyro", "rich", "tensorboard", "scipy", "trimesh", "PIL",
    "imageio_ffmpeg", "onnx", "ray",
):
    sys.modules[name] = None  # as if it were not installed
"""

LOOP = """
import sys, torch
import deimos
from deimos.goals.methods import METHODS, method

worlds, steps = 32, 60
worked = 0
for name in [*METHODS, "p33", "mix"]:
    director = deimos.GoalDirector(name, goal_period=4, learn_every=8, total_steps=steps)
    generator = torch.Generator().manual_seed(0)
    state, goal = torch.zeros(worlds, 3), torch.zeros(worlds, 2)
    never = torch.zeros(worlds, dtype=torch.bool)
    for _ in range(steps):
        candidates = 2 * torch.rand(worlds, 10, 2, generator=generator) - 1
        state = 0.9 * state + torch.nn.functional.pad(goal, (0, 1))
        terminated = state.norm(dim=1) > 2.5
        goal = director.step(state, goal, terminated, never, candidates).goal
        state[terminated] = 0.0
    assert goal.isfinite().all() and goal.abs().max() <= 1.0, name
    worked += 1
print(worked)
"""


def run(code, *arguments):
    """A program on the base install."""
    return subprocess.run(
        [sys.executable, "-c", BLOCK + code, *arguments], capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": str(HOME), "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def test_director_serves_another_loop():
    """Every method chooses goals in a loop on torch alone."""
    done = run(LOOP)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 24


def test_trained_policy_loads_and_acts():
    """A policy file needs nothing but torch."""
    code = f"""
import deimos, torch
policy = deimos.load_policy({str(HOME / "docs" / "results" / "quad_flat")!r})
size = sum(field.size for field in policy.layout)
assert policy.physical(torch.zeros(2, size)).shape == (2, 12)
"""
    done = run(code)
    assert done.returncode == 0, done.stderr


def test_contracts_need_no_simulator():
    """What a plug-in is written against is there without Warp."""
    done = run("import deimos\nassert deimos.Env and deimos.GoalSelector and deimos.check_env")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ["train", "TrainConfig", "evaluate"])
def test_what_is_missing_names_its_extra(name):
    """What needs a simulator says in one line which extra brings it."""
    done = run(f"import deimos\ndeimos.{name}")
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: deimos.{name} needs "), last
    assert "pip install 'deimos-rl[sim]'" in last


@pytest.mark.parametrize("arguments", [["train"], ["evaluate", "runs/x"], ["terrain", "list"]])
def test_command_line_names_its_extra(arguments):
    """The ``deimos`` command says in one line which extra it needs, with exit code 2."""
    done = run("import runpy\nrunpy.run_module('deimos', run_name='__main__', alter_sys=True)", *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert "pip install 'deimos-rl[sim]'" in done.stderr


def test_base_tests_need_the_base_install():
    """The tests that .ci/base_tests runs import torch, NumPy, pytest and what Deimos builds on these alone."""
    files = re.findall(r"\btest_\w+\.py\b", re.search(r"tests=\((.*?)\n\)", BASE_TESTS.read_text(), re.DOTALL)[1])
    assert {"test_base_install.py", "test_deimos_goal_director.py", "test_deimos_fear.py"} <= set(files)
    for file in set(files):
        for node in ast.walk(ast.parse((HOME / "tests" / file).read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module]
                for name in names:
                    top, _, rest = name.partition(".")
                    assert top in {"deimos", "torch", "numpy", "pytest"} | sys.stdlib_module_names, f"{file}: {name}"
                    assert rest.split(".")[0] in {"", "checks", "goals", "learn", "nn"} or top != "deimos", file
