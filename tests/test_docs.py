"""What the documentation shows works as it is shown."""

import importlib
import re
import sys
from pathlib import Path

import pytest
import torch

from deimos import plugins
from deimos.goals import selectors
from deimos.goals.methods import METHODS
from deimos.learn.ppo import PPOConfig
from deimos.run.loop import spaces
from deimos.run.training import TrainConfig, Trainer
from deimos.sim.envs import particle

DOCS = Path(__file__).parent.parent / "docs"


@pytest.fixture
def farthest(tmp_path, monkeypatch):
    """The worked example of docs/selectors.md, as a file in the folder of the selectors."""
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "selectors.md").read_text(), re.DOTALL)
    (text,) = [block for block in blocks if "class Farthest" in block]
    assert text.count("\n") <= 60
    (tmp_path / "farthest.py").write_text(text)
    monkeypatch.setattr(selectors, "__path__", [*selectors.__path__, str(tmp_path)])
    importlib.invalidate_caches()
    yield plugins.load(selectors, "farthest")
    sys.modules.pop("deimos.goals.selectors.farthest", None)


def test_worked_example_is_found_and_trains(farthest):
    """The file alone makes the selector known, and a run under it issues goals."""
    assert "farthest" in plugins.names(selectors)
    config = TrainConfig(
        env=particle.Config(goal_period=5), selector=farthest.Config(candidates=4), ppo=PPOConfig(hidden=(8,)),
        num_envs=16, evaluation=False,
    )  # fmt: skip
    trainer = Trainer(config, torch.device("cpu"))
    trainer.iterate()
    assert trainer.loop.interactions.active.any()


def test_worked_example_chooses_the_farthest_candidate(farthest):
    """It does what its docstring says, for every world alike."""
    env = particle.Config().build(8, torch.device("cpu"), 0)
    selector = farthest.Config().build(spaces(env), 0)
    generator = torch.Generator().manual_seed(0)
    goal, candidates = torch.randn(8, 3, generator=generator), torch.randn(8, 10, 3, generator=generator)
    proposal = selector.propose(torch.arange(8), torch.zeros(8, 9), goal, candidates, torch.zeros(8, 4))
    every = (candidates - goal.unsqueeze(1)).norm(dim=2)
    torch.testing.assert_close(proposal.score, every.amax(1))
    assert torch.equal(proposal.goal, candidates[torch.arange(8), every.argmax(1)])


def test_every_method_is_explained():
    """docs/selectors.md names every method and every selector's file."""
    text = (DOCS / "selectors.md").read_text()
    for name in [*METHODS, *plugins.names(selectors)]:
        assert f"`{name}`" in text or f"selector:{name}`" in text, name
