"""What the documentation shows works as it is shown."""

import importlib
import importlib.util
import re
import sys
from pathlib import Path

import pytest
import torch

import deimos
from deimos import plugins
from deimos.goals import selectors
from deimos.goals.methods import METHODS
from deimos.learn.ppo import PPOConfig
from deimos.run.loop import spaces
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

HOME = Path(__file__).parent.parent
DOCS = HOME / "docs"
USER_PAGES = [*sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("how_to/*.md"))]
PAGES = [
    HOME / "README.md", HOME / "CONTRIBUTING.md", *USER_PAGES, *sorted(DOCS.glob("reference/*.md")),
    *sorted(DOCS.glob("lab/*.md")),
]  # fmt: skip
SUFFIXES = {".py", ".md", ".toml", ".json", ".csv", ".png", ".svg", ".webp"}
FURTHER_PAGES = {
    "benchmark.md", "cluster.md", "deploy.md", "director.md", "gallery.md", "gpu.md", "integrations.md",
    "legged.md", "multiverse.md", "particle.md", "view.md",
}  # fmt: skip
"""Those that the budget of all pages leaves out."""


@pytest.fixture
def farthest(tmp_path, monkeypatch):
    """The worked example of docs/how_to/selector.md, as a file in the folder of the selectors."""
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "how_to" / "selector.md").read_text(), re.DOTALL)
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
    """docs/reference/selectors.md names every method and every selector's file."""
    text = (DOCS / "reference" / "selectors.md").read_text()
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


def lost(text):
    """Lines of a page that its readers would not see as they are meant, outside its blocks of code.

    On the site a line that begins with % is a comment; a blank line ends a table, and further rows are text.
    """
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"^ *%.*$", text, re.MULTILINE) + re.findall(r"^\|.*\n\n(\|.*)\n(?!\|[-:])", text, re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(HOME).as_posix())
def test_no_line_of_a_page_is_lost(page):
    """No line is a comment of the site by accident, and no table is cut in two."""
    assert lost(page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("with it 7.9\n  % instead of 4.1 %\n", ["  % instead of 4.1 %"]),
        ("```text\n% of a program\n```\n7.9 % of all\n", []),
        ("| a |\n|---|\n| 1 |\n\n| 2 |\n", ["| 2 |"]),
        ("| a |\n|---|\n| 1 |\n\n| b |\n|---|\n| 2 |\n", []),
    ],
)
def test_the_check_of_lines_finds_what_it_looks_for(text, found):
    """Accidental comments and halves of tables are found; code and a second table are not."""
    assert lost(text) == found


def words(page):
    """Words of a page outside its blocks of code."""
    return len(re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL).split())


def test_user_pages_are_short():
    """What users read has at most 7057 words in all, 700 a page, and the README 900; further pages are listed."""
    assert len(USER_PAGES) > 10
    assert sum(words(page) for page in USER_PAGES if page.name not in FURTHER_PAGES) <= 7057
    assert [page.name for page in USER_PAGES if words(page) > 700] == []
    assert words(HOME / "README.md") <= 900


def test_citation_is_of_this_version():
    """What CITATION.cff names is the version of the package."""
    text = (HOME / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", text, re.MULTILINE) == [deimos.__version__]


def test_every_picture_for_dark_pages_has_its_light_one():
    """A picture ``NAME-dark.svg`` stands beside ``NAME.svg``, is another one, and the concepts have nine pairs."""
    dark = sorted((DOCS / "images").rglob("*-dark.svg"))
    for path in dark:
        light = path.with_name(path.name.replace("-dark", ""))
        assert light.is_file()
        assert light.read_bytes() != path.read_bytes()
    assert sum(path.parent.name == "concepts" for path in dark) == 9


def load(path):
    """A program of the repository as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('<script src="_static/a.js"></script><a href="https://e.org">e</a><link href="b.css">', 0),
        ('<script src="https://e.org/a.js"></script>', 1),
        ('<link rel="stylesheet" href="//e.org/a.css"><img src="http://e.org/a.png">', 2),
        ("<style>@font-face { src: url('https://e.org/a.woff2') } p { background: url(b.png) }</style>", 1),
        ('<p style="background: url(https://e.org/a.png)">', 1),
    ],
)
def test_what_a_site_fetches_elsewhere_is_found(tmp_path, text, found, capsys):
    """Scripts, styles, fonts and pictures of other hosts fail the check of the built site; links of readers do not."""
    check = load(HOME / ".ci" / "check_site.py")
    (tmp_path / "index.html").write_text(text, encoding="utf-8")
    assert check.main(tmp_path) == bool(found)
    assert len(check.fetched(tmp_path / "index.html")) == found
    (tmp_path / "index.html").unlink()
    assert check.main(tmp_path) == 1
    capsys.readouterr()


def test_a_release_has_one_version_and_one_date():
    """Package, citation and changelog agree; between releases the changelog has no date."""
    citation = dict(
        re.findall(r'^(version|date-released): "?([^"\n]+)', (HOME / "CITATION.cff").read_text(), re.MULTILINE)
    )
    changes = (HOME / "CHANGELOG.md").read_text(encoding="utf-8")
    assert citation["version"] == deimos.__version__
    base, _, development = deimos.__version__.partition(".dev")
    heading = f"## {base} ({'unreleased' if development else citation['date-released']})"
    assert re.search(r"^## .*", changes, re.MULTILINE)[0] == heading
