"""Looking the ground up."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.legged.height_scan import sample_height, sample_minimum, scan_points
from deimos.kernels.legged.state import GROUND, build

U = 2.0**-24  # relative error of one float32 operation
CELL = 0.05  # [m]
CORNER = (-3.0, 2.0)
SHAPE = (61, 41)  # 3 m x 2 m
RULES = ("bilinear", "minimum")


@wp.kernel
def _look_up_all(
    heights: wp.array2d[float],
    cell: float,
    corner: wp.vec2,
    place: wp.array[wp.vec2],
    bilinear: wp.array[float],
    minimum: wp.array[float],
):
    i = wp.tid()
    bilinear[i] = sample_height(heights, cell, corner, place[i][0], place[i][1])
    minimum[i] = sample_minimum(heights, cell, corner, place[i][0], place[i][1])


def look_up_all(heights, place, device, cell=CELL, corner=CORNER):
    """Ground at places (n, 2) by the rules' names."""
    place = np.asarray(place, np.float32)
    out = {rule: wp.full(len(place), np.nan, dtype=wp.float32, device=device) for rule in RULES}
    ground = wp.array(heights, dtype=wp.float32, device=device)
    wp.launch(
        _look_up_all, dim=len(place), device=device, outputs=list(out.values()),
        inputs=[ground, cell, wp.vec2(*corner), wp.array(place, dtype=wp.vec2, device=device)],
    )  # fmt: skip
    return {rule: array.numpy() for rule, array in out.items()}


def make_ground(seed=0):
    """Random heights [m]."""
    return np.random.default_rng(seed).uniform(-1, 1, SHAPE).astype(np.float32)


def look_up(heights, x, y, rule):
    """One height, as the definitions have it, in float64; beyond the grid that of the edge."""
    h = heights.astype(np.float64)
    u, v = (x - CORNER[0]) / CELL, (y - CORNER[1]) / CELL
    i, j = (int(np.clip(np.floor(w), 0, n - 2)) for w, n in ((u, SHAPE[0]), (v, SHAPE[1])))
    if rule == "minimum":
        return min(h[i, j], h[i + 1, j], h[i, j + 1])
    s, t = np.clip(u - i, 0, 1), np.clip(v - j, 0, 1)
    return (1 - s) * ((1 - t) * h[i, j] + t * h[i, j + 1]) + s * ((1 - t) * h[i + 1, j] + t * h[i + 1, j + 1])


@pytest.mark.parametrize("count", [1, 5000])
@pytest.mark.parametrize("rule", RULES)
def test_matches_reference(device, rule, count):
    """Heights equal the reference anywhere over the ground and up to a metre beside it."""
    heights = make_ground()
    low, high = np.array(CORNER) - 1.0, np.add(CORNER, (4.0, 3.0))
    place = np.random.default_rng(1).uniform(low, high, (count, 2)).astype(np.float32)
    found = look_up_all(heights, place, device)[rule]
    expected = np.array([look_up(heights, x, y, rule) for x, y in place.astype(np.float64)])
    # In cells: difference and quotient are rounded, and the cell's own float32 is off by one more, of 80 cells.
    shift = 3 * 80 * U
    if rule == "bilinear":  # neighbours differ by 2 m at most, along both axes
        assert np.all(np.abs(found - expected) <= 2 * 2 * shift + 6 * U)
    else:  # right beside a sample, rounding may choose the next cell
        u = (place.astype(np.float64) - CORNER) / CELL
        clear = np.all(np.abs(u - np.rint(u)) > 2 * shift, axis=-1)
        assert clear.mean() > 0.99
        np.testing.assert_array_equal(found[clear], expected[clear].astype(np.float32))


@pytest.mark.parametrize("rule", RULES)
def test_plane_is_seen_exactly(device, rule):
    """Over a plane the bilinear height is the plane, and the minimum is at most one cell's drop below it."""
    x = CORNER[0] + CELL * np.arange(SHAPE[0])
    y = CORNER[1] + CELL * np.arange(SHAPE[1])
    heights = (0.3 * x[:, None] - 0.2 * y[None, :]).astype(np.float32)
    place = np.random.default_rng(2).uniform(CORNER, np.add(CORNER, (3.0, 2.0)), (3000, 2))
    below = 0.3 * place[:, 0] - 0.2 * place[:, 1] - look_up_all(heights, place, device)[rule]
    if rule == "bilinear":
        assert np.abs(below).max() < 1e-5  # 60 cells of 3 x 2^-24 each, times the slopes and 0.05 m
    else:
        assert below.min() > -0.2 * CELL - 1e-5  # (i, j + 1) is the lowest on this plane
        assert below.max() < (0.3 + 0.2) * CELL + 1e-5


def test_samples_are_seen_exactly(device):
    """Right above a sample that sample is seen, at the border and in the corners too."""
    heights = make_ground()
    cell, corner = 0.0625, (-1.0, 0.5)  # float32 holds these and their multiples exactly
    i, j = (index.ravel() for index in np.indices(SHAPE))
    place = np.stack([corner[0] + i * cell, corner[1] + j * cell], axis=1)
    found = look_up_all(heights, place, device, cell, corner)["bilinear"]
    np.testing.assert_allclose(found, heights.ravel(), rtol=0, atol=2 * U)


def test_minimum_is_legged_gyms(device):
    """The least of (i, j), (i + 1, j) and (i, j + 1) counts, and (i + 1, j + 1) does not."""
    lows = {(10, 20): 0.4, (11, 20): 0.3, (10, 21): 0.2, (11, 21): 0.1}
    middle = [[CORNER[0] + 10.5 * CELL, CORNER[1] + 20.5 * CELL]]
    for place, low in lows.items():
        heights = np.full(SHAPE, 1.0, np.float32)
        heights[place] = low
        found = look_up_all(heights, middle, device)["minimum"]
        assert found[0] == np.float32(1.0 if place == (11, 21) else low)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("distance", [10.0, 1e6, 1e30, np.inf])
def test_ground_goes_on_beyond_the_border(device, distance, rule):
    """However far beside the grid, the ground is as high as its edge."""
    heights = np.zeros(SHAPE, np.float32)
    heights[0], heights[1], heights[-2], heights[-1] = 1.0, 1.0, 2.0, 2.0
    found = look_up_all(heights, [[-distance, 3.0], [distance, 3.0]], device)[rule]
    assert found.tolist() == [1.0, 2.0]


@pytest.mark.parametrize("rule", RULES)
def test_nan_stays_nan(device, rule):
    """Nowhere there is no ground, and no memory beyond the grid is read."""
    found = look_up_all(make_ground(), [[np.nan, 3.0], [-2.0, np.nan], [-2.0, 3.0]], device)[rule]
    assert np.isnan(found).tolist() == [True, True, False]


def test_points_are_legged_gyms():
    """187 points, x from -0.8 to 0.8 m in the outer loop, y from -0.5 to 0.5 m."""
    points = scan_points()
    assert points.shape == (187, 2)
    np.testing.assert_allclose(points[:11, 0], -0.8)
    np.testing.assert_allclose(points[:11, 1], np.linspace(-0.5, 0.5, 11), atol=1e-7)
    np.testing.assert_allclose(points[::11, 0], np.linspace(-0.8, 0.8, 17), atol=1e-7)


@pytest.mark.parametrize(
    ("shape", "dtype", "message"),
    [
        ((1, 41), wp.float32, r"ground.heights must be float32\(61, 41\).*got float32\(1, 41\)"),
        ((61, 0), wp.float32, r"ground.heights must be float32\(61, 41\).*got float32\(61, 0\)"),
        ((61,), wp.float32, r"'heights' expects an array with 2 dimension.*got 1"),
        ((61, 41), wp.float64, r"'heights' expects dtype float32, got float64"),
    ],
)
def test_rejects_what_is_no_grid(device, shape, dtype, message):
    """The message says what a height grid must be and what it was."""
    ground = build(GROUND, device, heights=make_ground(), origin=np.zeros((1, 1, 3)))
    sizes = {"nx": SHAPE[0], "ny": SHAPE[1], "levels": 1, "columns": 1}
    GROUND.require("ground", ground, ground.heights, **sizes)

    def check():
        ground.heights = wp.zeros(shape, dtype=dtype, device=device)  # a struct knows types and axes, a table lengths
        GROUND.require("ground", ground, ground.origin, **sizes)

    with pytest.raises((TypeError, ValueError), match=message):
        check()
