"""The examples: small enough to be read, and run as they stand."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

HOME = Path(__file__).resolve().parent.parent
BUDGETS = {
    "gymnasium_director": ["--steps", "400"],
    "rsl_rl_director": ["--iterations", "8"],
    "stable_baselines3_director": ["--steps", "24576"],
}
ELSEWHERE = {
    "mjlab_director": ".ci/integrations",  # its pins do not go with ours
    "isaac_lab_director": "tests/test_deimos_adapters_directed.py",
}
"""Examples that are run elsewhere, and where."""

NOTEBOOK = HOME / "examples" / "first_hour.ipynb"
PARAMETERS = "NUM_ENVS, ENV_STEPS, WORLDS, ATTACK_STEPS = 64, 240, 32, 400\n"


def test_every_example_is_run():
    """No example is left out of the tests below."""
    assert {path.stem for path in (HOME / "examples").glob("*.py")} == set(BUDGETS) | set(ELSEWHERE)
    assert all(name in (HOME / place).read_text(encoding="utf-8") for name, place in ELSEWHERE.items())
    assert set((HOME / "examples").glob("*.ipynb")) == {NOTEBOOK}


@pytest.mark.parametrize("name", [*BUDGETS, *ELSEWHERE])
def test_examples_are_short(name):
    """None has more than 60 lines."""
    assert len((HOME / "examples" / f"{name}.py").read_text(encoding="utf-8").splitlines()) <= 60


def fears(name, folder, *options):
    """The fears that an example prints on a small budget."""
    done = subprocess.run(
        [sys.executable, HOME / "examples" / f"{name}.py", *BUDGETS[name], *options], cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = re.findall(r"^[+-]?\d\.\d (?:m|rad|m/s)  (\d\.\d\d)$", done.stdout, re.MULTILINE)
    return [float(fear) for fear in found]


@pytest.mark.parametrize("name", BUDGETS)
def test_example(name, tmp_path):
    """It ends well on a small budget, and prints a fear for every goal that it asks about."""
    found = fears(name, tmp_path)
    assert len(found) == 5
    assert 0.0 <= min(found) < max(found) <= 1.0


def test_rsl_rls_checkpoint_holds_the_director(tmp_path):
    """A run that goes on from a checkpoint knows fear before it has seen a single crash of its own."""
    fears("rsl_rl_director", tmp_path)
    assert len(fears("rsl_rl_director", tmp_path, "--resume", "carts.pt", "--iterations", "1")) == 5


def cells():
    """The notebook's cells of code."""
    return [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]


def test_the_notebook_runs(tmp_path):
    """All cells run one after the other in a fresh process, with smaller numbers in the cell of parameters."""
    parameters, *others = cells()
    assert parameters["metadata"]["tags"] == ["parameters"]
    code = "".join(parameters["source"])
    exec(code, known := {})
    small = {}
    exec(PARAMETERS, small)
    assert known.keys() == small.keys()
    script = tmp_path / "notebook.py"
    script.write_text(PARAMETERS + "\n".join("".join(cell["source"]) for cell in others), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-W", "error::DeprecationWarning", script], cwd=tmp_path,
        env=os.environ | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "agg", "TMPDIR": str(tmp_path)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert len(re.findall(r"of goals crash", done.stdout)) == 6


def test_the_notebooks_outputs_are_its_own():
    """Every cell was executed in order, none failed, four drew a picture, and it is small enough to be kept."""
    assert [cell["execution_count"] for cell in cells()] == list(range(1, len(cells()) + 1))
    outputs = [output for cell in cells() for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error" or output.get("name") == "stderr"]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 4
    assert NOTEBOOK.stat().st_size < 300_000
