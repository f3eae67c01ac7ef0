"""Pictures of terrains: colours are heights, lengths are to scale, and what is in front hides what is behind."""

import dataclasses
import math

import numpy as np
import pytest
from deimos.terrain import preview
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from deimos import terrain

STEP = 0.05  # [m] per pixel; the height grid has a sample for each
COLOURS = ScalarMappable(Normalize(-1.0, 2.0), colormaps["YlGnBu_r"])


def wall(height):
    """A plain of 10 m along x and 8 m along y with a wall across it, from y = 0 m to 0.5 m."""
    heights = np.zeros((201, 161), np.float32)
    heights[:, 80:91] = height
    return terrain.Terrain(
        heights, 0.05, (-5.0, -4.0), np.zeros((1, 1, 3), np.float32), ("flat",), 8.0, np.zeros(1, np.float32)
    )


def coloured(picture, height):
    """Where a picture has the colour of flat ground at a height."""
    return np.isclose(picture, COLOURS.to_rgba(height)[:3], atol=1e-6).all(axis=-1)


def test_from_above_colours_are_heights():
    """Seen from above, flat ground has the colour that the bar shows for its height, in its place and size."""
    picture, (left, right, bottom, top) = preview._draw(wall(1.0), COLOURS, STEP, 0.0, math.pi / 2)
    np.testing.assert_allclose((left, right, bottom, top), (-5, 5, -4, 4), atol=STEP)
    assert picture.shape == pytest.approx((160, 200, 3), abs=1)
    rows = np.flatnonzero(coloured(picture, 1.0)[:, 100])  # less the shaded pixels of its risers
    assert len(rows) == pytest.approx(0.5 / STEP, abs=2)
    assert rows.mean() == pytest.approx((4 - 0.25) / STEP, abs=1)  # the first row is at the top
    assert coloured(picture, 0.0)[:68].all()
    assert coloured(picture, 0.0)[-70:].all()


@pytest.mark.parametrize("axis", [0, 1])
def test_slopes_that_face_the_light_are_brighter(axis):
    """Light comes from the upper left: sides of a roof that face it are brighter than flat ground, others darker."""
    x = np.linspace(-1.0, 1.0, 201 if axis == 0 else 161)
    roof = (0.8 * (1.0 - np.abs(x))).astype(np.float32)
    ground = wall(0.0)
    ground.heights[:] = roof[:, None] if axis == 0 else roof
    picture, _ = preview._draw(ground, COLOURS, STEP, 0.0, math.pi / 2)
    side = picture.sum(axis=-1)[80] if axis == 0 else picture.sum(axis=-1)[:, 100]
    quarter = len(side) // 4
    flat = sum(COLOURS.to_rgba(0.4)[:3])
    assert side[quarter] > flat + 0.05
    assert side[-quarter] < flat - 0.05


@pytest.mark.parametrize("height", [0.0, 0.5, 1.5])
def test_oblique_wall_hides_the_ground_behind(height):
    """Seen from 45 degrees, a wall hides as much ground behind it as it is high, and lengths shrink by sqrt(1/2)."""
    picture, _ = preview._draw(wall(height), COLOURS, STEP, 0.0, math.pi / 4)
    column, s = picture[:, 100], math.sqrt(0.5)
    behind, before = (8 / 2 - 0.5 - height) * s / STEP, 8 / 2 * s / STEP
    expected = behind + before + (0 if height else 0.5 * s / STEP)
    assert np.count_nonzero(coloured(column, 0.0)) == pytest.approx(expected, abs=3)
    if height:
        assert np.count_nonzero(coloured(column, height)) == pytest.approx(0.5 * s / STEP, abs=2)


def test_beside_the_ground_is_white():
    """A turned view is white around the ground and grey where the ground is cut below its near edges."""
    picture, (left, right, _, _) = preview._draw(wall(1.0), COLOURS, STEP, math.radians(30.0), math.pi / 4)
    assert right - left == pytest.approx(10 * math.cos(math.radians(30)) + 8 * 0.5, abs=2 * STEP)
    for row, column in ((0, 0), (0, -1), (-1, 0)):
        np.testing.assert_array_equal(picture[row, column], 1.0)
    cut = np.isclose(picture, preview.WALL).all(axis=-1)
    np.testing.assert_allclose(cut.sum(axis=0)[5:-5], 0.01 * 10 * math.sqrt(0.5) / STEP, atol=1.5)


@pytest.mark.parametrize("height", [-30.0, 500.0])
def test_ground_may_be_at_any_height(height):
    """Far above 0, as surveys are, and below it, ground is drawn in full, and above a cut as low as elsewhere."""
    ground = wall(1.0)
    ground.heights[:] += np.float32(height)
    colours = ScalarMappable(Normalize(height - 1.0, height + 2.0), "YlGnBu_r")
    angles = math.radians(30.0), math.pi / 4
    picture, expected = (preview._draw(*each, STEP, *angles)[0] for each in ((ground, colours), (wall(1.0), COLOURS)))
    assert picture.shape == pytest.approx(expected.shape, abs=1)
    for each in (preview.WALL, 1.0):
        counts = [np.isclose(seen, each).all(axis=-1).sum(axis=0) for seen in (picture, expected)]
        np.testing.assert_allclose(*counts, rtol=0, atol=2)


def test_ground_whose_near_edge_is_below_0_is_drawn():
    """A slope that begins below 0 and ends above it is seen from its near edge on, and the cut is below that."""
    ground = wall(0.0)
    ground.heights[:] = np.linspace(-2.0, 2.0, 161, dtype=np.float32)
    picture, _ = preview._draw(ground, COLOURS, STEP, 0.0, math.pi / 4)
    column, s = picture[:, 100], math.sqrt(0.5)
    cut = np.isclose(column, preview.WALL).all(axis=-1)
    assert np.count_nonzero(cut) == pytest.approx(0.01 * 10 * s / STEP, abs=2)
    assert np.count_nonzero(~cut) == pytest.approx((8 + 4) * s / STEP, abs=3)


def test_ground_that_is_too_high_is_not_drawn(tmp_path):
    """Heights in a wrong unit would make a picture of gigabytes: they are named."""
    with pytest.raises(ValueError, match=r"at most 10 times .* ground, 10 m, got 101 m; are they in metres\?"):
        preview.save_preview(tmp_path / "x.png", wall(101.0), "wall")


@pytest.mark.parametrize("turned", [False, True])
def test_ground_may_be_a_narrow_track(tmp_path, turned):
    """A track a thousand times as long as it is wide is drawn, and one that no pixel would show is named."""
    for length, is_drawn in ((3999, True), (4003, False)):
        heights = np.zeros((5, length + 1), np.float32)
        ground = dataclasses.replace(wall(0.0), heights=heights.T if turned else heights, corner=(0.0, 0.0))
        path = tmp_path / f"{length}.png"
        if is_drawn:
            preview.save_preview(path, ground, "track")
            assert path.exists()
        else:
            with pytest.raises(ValueError, match=r"at most 1000 times the shorter one, 0.2 m, got 200.15 m"):
                preview.save_preview(path, ground, "track")


def test_large_grids_are_thinned():
    """A grid that is finer than the picture is thinned first, and the picture stays to scale."""
    picture, span = preview._draw(wall(1.0), COLOURS, 10 * STEP, 0.0, math.pi / 2)
    assert picture.shape == pytest.approx((16, 20, 3), abs=1)
    np.testing.assert_allclose(span, (-5, 5, -4, 4), atol=10 * STEP)
