"""The environment that docs/add_an_environment.md builds works as the page shows it."""

import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest

from deimos import plugins
from deimos.app import cli
from deimos.run.folder import RunFolder
from deimos.sim import envs

PAGE = Path(__file__).parent.parent / "docs" / "add_an_environment.md"
SMALL = "--num-envs 16 --ppo.hidden 8 --eval.worlds 16 --eval.steps 80 --eval.adversary-steps 40 --threads 1".split()


def blocks(language):
    """The page's blocks of code in a language."""
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture
def cart(tmp_path, monkeypatch):
    """The page's environment as a module of another distribution, registered by the entry point that the page shows."""
    (tmp_path / "cart.py").write_text(blocks("python")[0])
    group, entry = blocks("toml")[0].splitlines()
    assert group == '[project.entry-points."deimos.envs"]'
    information = tmp_path / "cart-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: cart\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(f"[deimos.envs]\n{entry.replace(chr(34), '')}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield plugins.load(envs, "cart")
    sys.modules.pop("cart", None)


def test_the_environment_is_short():
    """The whole environment, its kernels included, takes at most 120 lines."""
    assert blocks("python")[0].count("\n") <= 120


def test_the_check_passes(cart, tmp_path):
    """The page's own call of ``check_env`` finds nothing."""
    script = tmp_path / "check.py"
    script.write_text(blocks("python")[1])
    runpy.run_path(str(script))


def test_it_trains_is_evaluated_and_resumes(cart, tmp_path, monkeypatch):
    """The page's commands work, on fewer worlds and steps: it trains under p25, is evaluated, and resumes exactly."""
    monkeypatch.chdir(tmp_path)
    train, evaluate, resume = (shlex.split(line)[1:] for line in blocks("sh")[0].splitlines())
    assert "p25" in train
    steps = train.index("--env-steps") + 1
    train[steps] = "48"
    train[train.index("--num-envs") : train.index("--num-envs") + 2] = SMALL[:2]
    resume[resume.index("--env-steps") + 1] = "96"
    assert cli.main([*train, *SMALL[2:], "--no-evaluation"]) == 0
    assert cli.main(evaluate) == 0
    evaluation = RunFolder(tmp_path / "runs/cart").read_json("evaluation.json")
    assert [row["goals"] for row in evaluation] == ["naive", "argmax", "scripted"]
    assert cli.main(resume) == 0
    rows = RunFolder(tmp_path / "runs/cart").read_csv("progress.csv")
    assert [row["env_steps"] for row in rows] == ["24", "48", "72", "96"]

    straight = [*train, *SMALL[2:], "--no-evaluation"]
    straight[steps] = "96"
    straight[straight.index("--out") + 1] = "runs/straight"
    assert cli.main(straight) == 0
    assert RunFolder(tmp_path / "runs/straight").read_csv("progress.csv") == rows
