"""The figures of a run: what stands in them, and what does not."""

import math

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from scipy.stats import binomtest

from deimos.app import figures
from deimos.app.findings import wilson
from deimos.run.folder import RunFolder

HEADER = "env_steps,reward,crashes_per_1000,explained_variance,fear/auroc\n"


def evaluated(score=0.754, weights="w", **more):
    """The rows of one evaluation, as far as they are drawn."""
    shared = {"goal_period": 100, "worlds": 8, "steps": 200, "score": score, "seed": 1, "weights": weights} | more
    return [shared | {"goals": "naive", "crash_rate": 0.005}, shared | {"goals": "adversary", "crash_rate": 0.36}]


@pytest.fixture
def saved(monkeypatch):
    """The figures that were drawn, in place of their files."""
    drawn = []
    monkeypatch.setattr(figures, "_save", lambda figure, path: drawn.append(figure))
    return drawn


def folder_of(tmp_path, progress="", rows=()):
    """A run folder with rows of its training and of its evaluations."""
    folder = RunFolder(tmp_path)
    if progress:
        lines = (HEADER + progress).splitlines()
        numbered = [f"{number or 'iteration'},{line}\n" for number, line in enumerate(lines)]
        (tmp_path / "progress.csv").write_text("".join(numbered))
    if rows:
        folder.write_json("evaluation.json", rows)
    return folder


@pytest.mark.parametrize(("score", "note"), [(0.754, "\nscore 0.75"), (0.0, "\nscore 0"), (None, "")])
def test_score_is_written_only_where_there_is_one(score, note):
    """Above each bar stands its share in percent, and the score where there is a reference policy."""
    axes = Figure().subplots()
    figures._bars(axes, evaluated(score))
    assert [text.get_text() for text in axes.texts] == [f"0.5 %{note}", f"36 %{note}"]


def test_evaluations_stand_beside_each_other():
    """A small later evaluation does not replace a large one: the large one comes first, each says its size."""
    axes = Figure().subplots()
    figures._bars(axes, [*evaluated(worlds=8), *evaluated(worlds=2000), *evaluated(goal_period=50)])
    assert [label.get_text().replace("\n", " ") for label in axes.get_xticklabels()] == [
        "2,000 worlds x 200 steps, a goal every 100 steps", "8 worlds x 200 steps, a goal every 100 steps",
        "8 worlds x 200 steps, a goal every 50 steps",
    ]  # fmt: skip
    assert len(axes.patches) == 6
    assert [text.get_text() for text in axes.get_legend().texts] == [
        "uniform goals (Naive)",
        "attacked by adversary",
    ]


def test_a_share_that_is_not_known_is_a_dash():
    """Where no goal was pursued to its end there is a dash and no bar."""
    axes = Figure().subplots()
    figures._bars(axes, [evaluated()[0] | {"crash_rate": None}])
    assert axes.texts[0].get_text().startswith("-")


@pytest.mark.parametrize(
    ("progress", "rows", "panels"),
    [
        ("24,0.1,3.0,,\n48,0.2,2.0,0.5,\n", [], 3),
        ("24,0.1,3.0,,\n", [], 2),
        ("24,0.1,3.0,0.1,0.6\n48,0.2,2.0,0.5,0.7\n", evaluated(), 4),
        ("24,0.1,3.0,0.1,0.6\n48,0.2,2.0,0.5,0.7\n", [], 3),
        ("", evaluated(None), 1),
    ],
)
def test_no_panel_is_empty(tmp_path, saved, progress, rows, panels):
    """There is a panel for what the run has numbers of, with a line or bars in it, and no other."""
    figures.draw_summary(folder_of(tmp_path, progress, rows), "title", "w")
    (figure,) = saved
    assert len(figure.axes) == panels
    for axes in figure.axes:
        assert axes.lines or axes.patches
        assert axes.get_ylabel()
        assert all(np.isfinite(line.get_ydata()).all() and len(line.get_ydata()) for line in axes.lines)


def test_a_run_without_numbers_has_no_picture(tmp_path, saved):
    """Where nothing was trained and nothing evaluated, nothing is drawn."""
    figures.draw_summary(folder_of(tmp_path), "title", "w")
    assert not saved


def test_evaluations_of_an_earlier_policy_are_not_drawn(tmp_path, saved):
    """A run that went on is drawn with what was found of its policy as it is now."""
    rows = [*evaluated(weights="old", worlds=2000), *evaluated(weights="new")]
    figures.draw_summary(folder_of(tmp_path, "24,0.1,3.0,,\n", rows), "title", "new")
    assert len(saved[0].axes[-1].patches) == 2
    figures.draw_summary(folder_of(tmp_path), "title", "trained on since")
    assert not any(axes.patches for axes in saved[1].axes)


def test_summary_is_a_picture(tmp_path):
    """The file is a picture with something in it."""
    figures.draw_summary(folder_of(tmp_path, "24,0.1,3.0,,\n48,0.2,2.0,0.5,\n", evaluated(math.nan)), "title", "w")
    with Image.open(tmp_path / "summary.png") as image:
        assert len(image.convert("RGB").getcolors(2**24)) > 10


def test_intervals_of_rates_are_wilsons():
    """The interval of every proportion is SciPy's, at 0 and 1 too."""
    count = np.array([1, 7, 50, 50, 1000])
    share = np.array([1, 2, 0, 50, 333]) / count
    low, high = wilson(share, count)
    for k, n, found in zip(share * count, count, zip(low, high, strict=True), strict=True):
        expected = binomtest(round(k), n).proportion_ci(method="wilson")
        np.testing.assert_allclose(found, (expected.low, expected.high), atol=1e-7)
