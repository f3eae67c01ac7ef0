"""The examples: small enough to be read, and run as they stand."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

HOME = Path(__file__).resolve().parent.parent
BUDGETS = {
    "gymnasium_director": ["--steps", "400"],
    "rsl_rl_director": ["--iterations", "8", "--num-envs", "256"],
}


def test_every_example_is_run():
    """No example is left out of the test below."""
    assert {path.stem for path in (HOME / "examples").glob("*.py")} == set(BUDGETS)


@pytest.mark.parametrize("name", BUDGETS)
def test_example(name, tmp_path):
    """It has fewer than 60 lines, ends well on a small budget, and prints a fear for every goal that it asks about."""
    path = HOME / "examples" / f"{name}.py"
    assert len(path.read_text(encoding="utf-8").splitlines()) < 60
    done = subprocess.run(
        [sys.executable, path, *BUDGETS[name]], cwd=tmp_path, env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    fears = [float(fear) for fear in re.findall(r"^[+-]?\d\.\d (?:rad|m/s)  (\d\.\d\d)$", done.stdout, re.MULTILINE)]
    assert len(fears) == 5
    assert 0.0 <= min(fears) < max(fears) <= 1.0
