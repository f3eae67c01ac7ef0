"""The report: complete, self-contained, and the figures that stand in it."""

import base64
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deimos.checks import RunError
from deimos.study import document, figures, outcomes, report, stats
from deimos.study.data import Data, Style
from deimos.study.results import CURVE_COLUMNS, RESULT_COLUMNS, Results
from reproduction import report as thesis
from reproduction.claim_list import CLAIMS
from reproduction.figures import STYLE

METHODS = ["coop", "p25", "p75", "antagonist", "uniform", "vds"]


def fill(folder, seeds=4, points=20):
    """Write the tables of a study of six methods in two environments."""
    rng = np.random.default_rng(0)
    values = {str: "v", int: 100, float: 0.5, bool: False, tuple: (), dict: {}, list: []}
    rows, lines = [], []
    for environment in ("directional", "quad"):
        for method in METHODS:
            for seed in range(seeds):
                key = {"environment": environment, "method": method, "seed": seed, "setting": environment,
                       "selector": method, "hash": f"{environment}-{method}-{seed}", "block": None,
                       "weights": f"{environment}-{method}-{seed}"}  # fmt: skip
                for goals in ("naive", "adversary"):
                    row = {name: values[kind] for name, kind in RESULT_COLUMNS.items()} | key
                    crashes = int(np.exp(rng.normal(5, 0.5))) if goals == "adversary" else 0
                    weak = method == "coop" and seed == 0 and goals == "adversary"
                    if environment == "quad":
                        row |= {
                            "tracking": tuple(rng.uniform(0.6, 0.7, 2)),
                            "goal_groups": ["velocity", "yaw rate"],
                            "errors": {"end effector [m]": rng.uniform(0.3, 0.4)},
                        }
                    rows.append(row | {"goals": goals, "crashes": crashes, "crashes_per_1000": crashes / 4000,
                                       "crash_rate": min(1.0, crashes / 1000) if goals == "adversary" else 0.5,
                                       "reward": rng.normal(0.8, 0.01), "fps": rng.normal(1e5, 1e3),
                                       "weak_adversary": weak})  # fmt: skip
                line = {name: values[kind] for name, kind in CURVE_COLUMNS.items()} | key
                line |= dict.fromkeys(
                    ("reward", "crashes_per_1000", "selected_fraction"), tuple(rng.uniform(0.1, 1, points))
                )
                lines.append(line | {"num_envs": 100, "env_steps": tuple(24.0 * np.arange(1, points + 1))})
    folder.mkdir(exist_ok=True)
    Results(rows, lines).write(folder)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A study folder with the thesis's report."""
    path = tmp_path_factory.mktemp("study")
    fill(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stats, "RESAMPLES", 200)  # nothing here looks at the ends of an interval
        thesis.write(path, path)
    return path


class Page(HTMLParser):
    """Collects what a browser would load, and checks that every element is closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.sources, self.links = [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        """Take note of what an element loads."""
        given = dict(attributes)
        self.sources += [given["src"]] if "src" in given else []
        self.links += [given["href"]] if "href" in given else []
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        """Close the innermost element."""
        assert self.open.pop() == tag


def test_page_needs_no_other_file(folder):
    """The HTML page is well formed, holds every figure as a readable PNG, loads nothing, and is under 5 MB."""
    text = (folder / "report.html").read_text()
    page = Page(text)
    assert page.open == []
    assert page.links == []
    prefix = "data:image/png;base64,"
    assert all(source.startswith(prefix) for source in page.sources)
    drawn = {path.read_bytes() for path in (folder / "figures").glob("*.png")}
    assert {base64.b64decode(source.removeprefix(prefix)) for source in page.sources} == drawn
    assert len(text.encode()) < 5e6


def test_every_figure_is_there_twice(folder):
    """The page of clauses, and each environment's training, boxes, profiles and score against safety, are there."""
    names = {"clauses"} | {f"training-{name}" for name in ("directional", "quad")}
    names |= {f"{kind}-{e}-T100" for kind in ("evaluation", "profile", "pareto") for e in ("directional", "quad")}
    for ending in ("png", "svg"):
        assert {path.stem for path in (folder / "figures").glob(f"*.{ending}")} == names
    for path in (folder / "figures").glob("*.png"):
        with Image.open(path) as image:
            assert len(image.convert("RGB").getcolors(2**24)) > 10, path


def test_markdown_says_the_same(folder):
    """The Markdown twin has every claim with its verdict, and links to figures that exist."""
    text = (folder / "report.md").read_text()
    page = (folder / "report.html").read_text()
    for claim in CLAIMS:
        heading = re.search(rf"^### {claim.id}: (.+)$", text, re.MULTILINE)
        assert heading is not None
        assert f"<h3>{claim.id}: {heading[1]}</h3>" in page
    links = re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)
    assert len(links) == 9
    assert links[0] == "figures/clauses.png"  # the report leads with them
    assert all((folder / link).is_file() for link in links)


def test_report_says_what_limits_it(folder):
    """Attackers that met no crash are counted; the caveat of training curves and the detectable effects are printed."""
    text = (folder / "report.md").read_text()
    assert "In 2 of 48 attacks the attacker had met few crashes or none before it attacked" in text
    assert "(directional: coop 1; quad: coop 1)" in text
    assert figures.CAVEAT in text
    assert "minimum detectable effect" in text
    assert "| quad | vds |" in text


def test_tracking_and_errors_stand_beside_the_crashes(folder):
    """Where goals have several groups, and an environment errors, the tables of its policies have their means."""
    text = (folder / "report.md").read_text()
    particle, quad = text.split("## Distributions")[1].split("### directional, Naive")[1].split("### quad, Naive")
    for name in (
        "tracking of velocity: IQM",
        "tracking of yaw rate: IQM",
        "end effector [m], median over goals: IQM",
    ):
        assert name not in particle
        assert name in quad
    line = next(line for line in quad.splitlines() if "| uniform |" in line or line.startswith("uniform"))
    values = [float(cell.split()[0]) for cell in line.strip("| ").split("|")[-3:]]
    assert 0.6 < values[0] < 0.7
    assert 0.6 < values[1] < 0.7
    assert 0.3 < values[2] < 0.4


def test_report_is_the_same_twice(folder, tmp_path, monkeypatch):
    """The bootstrap is seeded: another call writes the same Markdown."""
    monkeypatch.setattr(stats, "RESAMPLES", 200)
    monkeypatch.setattr(figures, "write", lambda figures, out: [])
    thesis.write(folder, tmp_path)
    text = re.sub(r"(!\[|There are no data for this figure).*\n\n", "", (folder / "report.md").read_text())
    assert (tmp_path / "report.md").read_text() == text


def test_committed_studies_can_be_read():
    """The tables under docs/results can be read, and their claims can be tested."""
    tables = sorted((Path(__file__).parent.parent / "docs" / "results").glob("*/results.csv"))
    assert len(tables) >= 1
    for table in tables:
        data = Data.read(table.parent)
        assert data.environments
        assert all(data.curves(environment, name) for environment in data.environments
                   for name in data.methods(environment))  # fmt: skip


def test_empty_folder_has_no_report(tmp_path):
    """There is no report of nothing."""
    with pytest.raises(RunError, match="holds no results; it is empty, or not a study's folder"):
        report.write(tmp_path, tmp_path)


@pytest.mark.parametrize("count", [1, 2, 6])
def test_titles_fit_above_their_axes(folder, count):
    """However few methods there are, the titles of the boxes keep apart and inside the figure."""
    with figures.print_size():
        figure = outcomes.boxes(Data.read(folder).only(METHODS[:count]), "directional", 100)
        figure.draw_without_rendering()
    titles = [axes.title.get_window_extent() for axes in figure.axes]
    assert len(titles) == 3
    ends = [figure.bbox.x0, *(end for title in titles for end in (title.x0, title.x1)), figure.bbox.x1]
    assert ends == sorted(ends)


def test_mean_without_an_interval_says_so(tmp_path, monkeypatch):
    """Where resamples have no spread the mean stands alone; shares of goals are in percent."""
    monkeypatch.setattr(stats, "RESAMPLES", 200)
    fill(tmp_path, seeds=2)
    report.write(tmp_path, tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "(no interval)" in text
    assert "inf]" not in text
    assert "crashes: median" in text
    assert max(float(high) for high in re.findall(r"\[[\d.]+, ([\d.e+]+)\]", text.split("## Distributions")[1])) <= 100
    assert "| 50 [50, 50] |" in text
    assert "Run on v, v." in text


def changed(folder, *changes):
    """The rows of a study, those of each change, (where, what), with what it says."""
    rows = Results.read(folder).rows
    for where, what in changes:
        for row in rows:
            if all(row[name] == value for name, value in where.items()):
                row |= what
    return Data(Results(rows, []))


def test_pairs_leave_out_what_one_of_them_does_not_have(folder):
    """A policy without a rate takes its pair with it; bases that all agree have an interval as wide as so few leave."""
    in_pairs = [({"seed": seed}, {"block": str(seed)}) for seed in range(4)]
    rates = [({"method": name}, {"crash_rate": rate}) for name, rate in (("uniform", 0.3), ("p25", 0.1))]
    unknown = ({"method": "p25", "seed": 2}, {"crash_rate": math.nan})
    (_, _, rows, *_) = report.outcomes(changed(folder, *in_pairs, *rates, unknown), "quad", 100)
    shown = {row["method"]: row["P(safer than uniform)"] for row in rows}
    assert shown["p25"] == "1.00 [0.29, 1.00]"  # Clopper and Pearson, 3 of 3


def test_tables_say_nothing_of_what_is_not_there(folder):
    """Columns that no method has are left out, and methods that nobody evaluated at a T; policies count without one."""
    easy = [row for row in changed(folder, ({}, {"score": math.nan})).rows if row["goals"] == "naive"]
    (_, text, rows, *_) = report.outcomes(Data(Results(easy, [])), "quad", 100)
    assert "under the Adversary (nobody attacked)" in text
    assert {tuple(row) for row in rows} == {("method", "seeds", "delivered dose")}
    assert {row["seeds"] for row in rows} == {"4"}
    two = changed(folder, ({"method": "p75", "environment": "quad"}, {"goal_period": 200}))
    (_, _, first, *_), (_, _, second, *_) = (report.outcomes(two, "quad", period) for period in (100, 200))
    assert {row["method"] for row in first} == {*METHODS} - {"p75"}
    assert [row["method"] for row in second] == ["p75"]
    assert "P(safer than uniform)" not in second[0]


def test_means_of_some_policies_are_not_taken_for_all(folder):
    """An attacker that some policies met stands in the table of means, which says so; nobody else is named."""
    rows = [row for row in Results.read(folder).rows if row["goals"] == "naive" or row["seed"] < 2]
    assert "the goals (adversary: of some policies):" in report.outcomes(Data(Results(rows, [])), "quad", 100)[3]
    assert report.outcomes(Data.read(folder), "quad", 100)[3].endswith("by who chooses the goals:")


def test_small_populations_are_told_what_so_few_can_say(folder):
    """Four policies have the median between them in 1 - 2 / 2^4 of studies; thirty have no such limit."""
    results = Results.read(folder)
    assert "The smallest population here has 4 policies." in report.limits(Data(results))[1]
    assert "of 4 of its policies in 87.5 % of studies" in report.limits(Data(results))[1]
    one = Data(Results([row for row in results.rows if row["seed"] == 0], []))
    assert "has 1 policy. With" in report.limits(one)[1]
    assert "% of studies" not in report.limits(one)[1]


def test_an_attacker_that_saw_no_survival_makes_no_policy_safe(folder):
    """Attackers without crashes to learn from are told apart from those without survivals, or without goals."""
    rows = [row | {"weak_adversary": False} for row in Results.read(folder).rows]
    attacks = [row for row in rows if row["goals"] != "naive"]
    for row, crashes in zip(attacks, (0, 97, math.nan), strict=False):
        row |= {"uninformed": True, "adversary_interactions": 100, "adversary_crashes": crashes}
    said = report.what_was_run(Data(Results(rows, [])))
    number = f"of {len(attacks)} attacks the attacker"
    assert sum(str(block).startswith(f"In 1 {number} had met few crashes or none") for block in said) == 1
    assert sum(str(block).startswith(f"In 2 {number}'s goals were uniform although") for block in said) == 1


def test_cells_without_results_are_named(folder, tmp_path):
    """A report of what is left says that it is not all; cells whose rows are in the tables are not missing."""
    fill(tmp_path)
    for name in ("quad-p25-literal-s3-0123abcd", "quad-p25-literal-s4-4567abcd", "quad-vds-s0-89ab89ab"):
        (tmp_path / "cells" / name).mkdir(parents=True)
        (tmp_path / "cells" / name / "cell.json").write_text('{"environment": "quad", "config": {}}')
    results = Results.read(tmp_path)
    for row in results.rows:
        row["hash"] = row["hash"].replace("quad-vds-0", "89ab89ab0123")
    results.write(tmp_path)
    data = Data.read(tmp_path)
    said = [block for block in report.what_was_run(data) if "Cells without results" in block]
    assert said == ["Cells without results: quad-p25-literal 2. They were given up or have not finished yet, and count "
                    "nowhere."]  # fmt: skip
    assert not any("Cells without results" in block for block in report.what_was_run(Data.read(folder)))


def test_share_of_safe_policies_has_its_exact_interval(tmp_path):
    """Where no policy is safe, or every one, the interval of the share is as wide as so few policies leave it."""
    fill(tmp_path)
    rows = report.outcomes(Data.read(tmp_path), "quad", 100)[2]
    found = {row["method"]: row["policies below 1 % [%]"] for row in rows}
    assert found["uniform"] == "0 [0, 60.2]"  # of 4: 1 - 0.025^(1/4)
    data = Data.read(tmp_path)
    for row in data.rows:
        row["crash_rate"] = 0.001
    safe = report.outcomes(data, "quad", 100)[2]
    assert {row["policies below 1 % [%]"] for row in safe} == {"100 [39.8, 100]"}


def test_text_is_escaped():
    """What HTML or a Markdown table would take for markup is only text."""
    blocks = ["# a < b", [{"x": "P(a | b) & <c>"}]]
    assert "<h1>a &lt; b</h1>" in document.to_html(blocks, None)
    assert "<td>P(a | b) &amp; &lt;c&gt;</td>" in document.to_html(blocks, None)
    assert "| P(a \\| b) & &lt;c> |" in document.to_markdown(blocks, "figures")


def test_methods_have_their_own_colours():
    """No two of the thesis's methods share a colour or a marker, nor are two colours close to each other."""
    names = [*METHODS, "p10", "p50", "p90", "rnd", "cl", "vds+p75", "learnability"]
    assert len({STYLE.colours[name] for name in names}) == len(names)
    assert len({STYLE.marker(name) for name in names}) == len(names)
    codes = np.array([[int(STYLE.colours[name][i : i + 2], 16) for i in (1, 3, 5)] for name in names])
    apart = np.abs(codes[:, None] - codes[None]).sum(axis=2) + 1000 * np.eye(len(names))
    assert apart.min() > 40


def test_methods_without_a_style_are_told_apart():
    """Methods that nobody gave a colour have one each; those that have one keep it, and it is not given again."""
    style = Style(colours={"mine": "#0072B2"}).complete(["a", "b", "mine", "c"])
    assert style.colours["mine"] == "#0072B2"
    assert len({style.colours[name] for name in ("a", "b", "c", "mine")}) == 4
    assert len({style.marker(name) for name in ("a", "b", "c", "mine")}) == 4
    many = Style().complete([f"method {i}" for i in range(40)])
    assert many.colours["method 39"].startswith("#")


def test_order_is_the_callers_and_then_by_name(folder):
    """What the caller orders comes first; other names follow, with their numbers as numbers."""
    data = Data.read(folder, Style(order=["quad", "vds", "uniform"]))
    assert data.environments == ["quad", "directional"]
    assert data.methods("quad") == ["vds", "uniform", "antagonist", "coop", "p25", "p75"]
    assert data._sorted({"p100", "p5", "p75"}) == ["p5", "p75", "p100"]


def test_report_without_a_thesis(folder, tmp_path, monkeypatch):
    """The report of any study has its tables and figures in one panel, compares with its own method, and no claims."""
    monkeypatch.setattr(stats, "RESAMPLES", 200)
    report.write(folder, tmp_path, style=Style(reference="vds"))
    text = (tmp_path / "report.md").read_text()
    assert "P(safer than vds)" in text
    assert "ratio to vds" in text
    assert not re.search("thesis|claim|published|C1", text)
    names = {f"{kind}-{e}-T100" for kind in ("evaluation", "profile", "pareto") for e in ("directional", "quad")}
    assert {path.stem for path in (tmp_path / "figures").glob("*.png")} == names | {
        "training-directional", "training-quad",
    }  # fmt: skip
    headings = re.findall("^## (.*)$", text, re.MULTILINE)
    assert headings == [
        "directional", "quad", "Over all environments", "What was run", "Speed", "Distributions", "Limits",
    ]  # fmt: skip


def test_caller_supplies_sections(folder, tmp_path, monkeypatch):
    """A page of the caller's own is what is written, figures that it names included."""
    monkeypatch.setattr(stats, "RESAMPLES", 200)

    def page(data, pictures):
        assert [each.name for own in pictures.values() for each in own] == ["own-directional", "own-quad"]
        return ["# Mine", *pictures["directional"], *pictures["quad"]]

    def draw(data, environment):
        return {f"own-{environment}": ("A caption.", outcomes.boxes(data, environment, 100))}

    report.write(folder, tmp_path, page=page, draw=draw)
    assert (tmp_path / "report.md").read_text().startswith("# Mine\n\n![A caption.](figures/own-directional.png)")


def test_rolling_mean_is_short_at_the_start():
    """The rolling mean takes what there is until its window is full."""
    assert figures.rolling(np.array([1.0, 3, 5, 7]), 2).tolist() == [1, 2, 4, 6]
