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
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

HOME = Path(__file__).parent.parent
DOCS = HOME / "docs"
PAGES = [HOME / "README.md", HOME / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("lab/*.md"))]
SUFFIXES = {".py", ".md", ".toml", ".json", ".csv", ".png", ".svg"}


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


def named_paths(page):
    """Paths of the repository that a page names in backticks, from its root, or links to."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for name in re.findall(r"`([\w./-]+)`", text):
        if "/" in name and Path(name).suffix in SUFFIXES and not re.search(r"\b[A-Z]+\b", name):
            yield name, (HOME / name,)
    for link in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        if "://" not in link:
            yield link, (page.parent / link,)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(HOME).as_posix())
def test_every_path_that_a_page_names_exists(page):
    """Files of the repository in backticks and in links are there; NAME stands for any name."""
    missing = [name for name, places in named_paths(page) if not any(place.exists() for place in places)]
    assert not missing, missing


def test_every_link_into_a_page_has_its_heading():
    """A link to a part of a page names one of its headings, as GitHub abbreviates them."""
    for page in PAGES:
        for link, anchor in re.findall(r"\]\(([^)#\s]*)#([^)\s]+)\)", page.read_text(encoding="utf-8")):
            if "://" in link:
                continue
            target = (page.parent / link if link else page).read_text(encoding="utf-8")
            titles = re.findall(r"^#+ (.*)$", target, re.MULTILINE)
            known = {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
            assert anchor in known, f"{page.name}: {link}#{anchor}"


def test_the_check_of_paths_finds_what_it_looks_for(tmp_path):
    """Backticked files, images and links are found; placeholders, commands and other sites are not."""
    page = tmp_path / "page.md"
    page.write_text(
        "`a/b.py` `a/NAME.py` `python x/y.py` `b.py` ![p](images/c.png) [q](d.md#part) [r](https://e.org/f.md)\n"
        "```sh\n`g/h.py`\n```\n"
    )
    assert [name for name, _ in named_paths(page)] == ["a/b.py", "images/c.png", "d.md"]
