"""The figures of a run: what stands above the bars of an evaluation."""

import math

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from scipy.stats import binomtest

from deimos.app import figures
from deimos.run.folder import RunFolder


def evaluated(score):
    """The rows of one evaluation, as far as they are drawn."""
    shared = {"goal_period": 100, "worlds": 8, "steps": 200, "score": score}
    return [
        shared | {"goals": "naive", "crashes_per_1000": 0.5},
        shared | {"goals": "adversary", "crashes_per_1000": 2},
    ]


@pytest.mark.parametrize(
    ("score", "note"), [(0.754, "\nscore 0.75"), (0.0, "\nscore 0.00"), (math.nan, ""), (None, "")]
)
def test_score_is_written_only_where_there_is_one(score, note):
    """Without a reference policy a row has no score, NaN from the evaluation or None from a file; none is written."""
    axes = Figure().subplots()
    figures._bars(axes, evaluated(score))
    assert [text.get_text() for text in axes.texts] == [f"0.5{note}", f"2{note}"]


@pytest.mark.parametrize("rows", [[], evaluated(math.nan)])
def test_summary_is_drawn(tmp_path, rows):
    """A run is drawn evaluated or not, and with an environment that has no score."""
    header = "env_steps,reward,crashes_per_1000,explained_variance\n"
    (tmp_path / "progress.csv").write_text(header + "24,0.1,3.0,\n48,0.2,2.0,0.5\n")
    path = figures.draw_summary(RunFolder(tmp_path), "title", rows)
    with Image.open(path) as image:
        assert len(image.convert("RGB").getcolors(2**24)) > 10


def test_intervals_of_rates_are_wilsons():
    """The interval of every proportion is SciPy's, at 0 and 1 too."""
    count = np.array([1, 7, 50, 50, 1000])
    share = np.array([1, 2, 0, 50, 333]) / count
    low, high = figures.wilson(share, count)
    for k, n, found in zip(share * count, count, zip(low, high, strict=True), strict=True):
        expected = binomtest(round(k), n).proportion_ci(method="wilson")
        np.testing.assert_allclose(found, (expected.low, expected.high), atol=1e-7)
