"""A picture of a mesh by parallel rays."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.relief import draw_relief

U = 2.0**-24  # relative error of one float32 operation


def make_mesh(device):
    """A roof: two slopes of 45 degrees that meet in a ridge at y = 2 m, over 4 m x 4 m."""
    points = np.array([[0, 0, 0], [4, 0, 0], [4, 2, 2], [0, 2, 2], [4, 4, 0], [0, 4, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]], np.int32)
    return wp.Mesh(
        wp.array(points, dtype=wp.vec3, device=device), wp.array(faces.reshape(-1), dtype=wp.int32, device=device)
    )


def draw(device, **changes):
    """The roof from above, ten pixels per metre, x right and y up, 0.5 m more on every side, light from +y."""
    outputs = [wp.full((50, 50), -7.0, dtype=wp.float32, device=device) for _ in range(2)]
    look = {
        "corner": (-0.5, 4.5, 10.0),
        "right": (0.1, 0.0, 0.0),
        "down": (0.0, -0.1, 0.0),
        "forward": (0.0, 0.0, -1.0),
        "light": (0.0, 0.6, 0.8),
    }
    draw_relief(make_mesh(device), *outputs, **(look | changes))
    return [output.numpy() for output in outputs]


def test_matches_reference(device):
    """Every pixel is the roof's height and cosine at its middle, and NaN and darkness beside the roof."""
    height, brightness = draw(device)
    x = -0.5 + 0.1 * (np.arange(50) + 0.5)
    y = 4.5 - 0.1 * (np.arange(50) + 0.5)
    inside = ((x > 0) & (x < 4))[None, :] & ((y > 0) & (y < 4))[:, None]
    expected = np.broadcast_to((2 - np.abs(y - 2))[:, None], (50, 50))
    np.testing.assert_array_equal(np.isnan(height), ~inside)
    # Coordinates up to 10 m are sums of three products; the distance is a quotient.
    np.testing.assert_allclose(height[inside], expected[inside], rtol=0, atol=10 * 8 * U)
    towards, away = (0.6 + 0.8) / np.sqrt(2), (0.8 - 0.6) / np.sqrt(2)
    light = np.where(y > 2, towards, away)[:, None] * inside
    np.testing.assert_allclose(brightness, light, rtol=0, atol=16 * U)


def test_oblique_picture_is_true_to_scale(device):
    """Tilted by 45 degrees about x, the ridge lies where projection puts it, and the slope that faces us is square."""
    s = np.sqrt(0.5)
    view = {"corner": (-0.5, -10 + 1.75 / s, 10 + 1.75 / s), "right": (0.1, 0, 0), "down": (0, -0.1 * s, -0.1 * s)}
    height, _ = draw(device, **view, forward=(0.0, s, -s))
    columns = np.flatnonzero(np.isfinite(height).any(axis=0))
    assert (columns[0], columns[-1]) == (5, 44)
    # The near slope is seen head-on: 2 sqrt(2) m of it make 28 pixels, and the far slope hides behind the ridge.
    rows = np.flatnonzero(np.isfinite(height[:, 25]))
    assert len(rows) == 28
    assert np.all(np.diff(height[rows, 25]) < 0)


def test_back_of_a_face_is_lit_as_its_front(device):
    """Seen from below, faces show their underside, and light from below falls on it."""
    below = {"corner": (-0.5, 4.5, -10.0), "forward": (0.0, 0.0, 1.0)}
    height, brightness = draw(device, **below, light=(0.0, 0.0, -1.0))
    assert np.nanmax(np.abs(brightness[np.isfinite(height)] - np.sqrt(0.5))) <= 16 * U


def test_works_in_shared_memory(device):
    """A torch view of the picture sees it appear at the same address."""
    height, brightness = (wp.zeros((2, 2), dtype=wp.float32, device=device) for _ in range(2))
    view = wp.to_torch(height)
    draw_relief(
        make_mesh(device), height, brightness,
        corner=(0.0, 1.1, 5.0), right=(0.1, 0, 0), down=(0, -0.1, 0), forward=(0, 0, -1), light=(0, 0, 1),
    )  # fmt: skip
    assert view.data_ptr() == height.ptr
    assert (view > 0.9).all()


@pytest.mark.parametrize(
    ("name", "wrong", "message"),
    [
        ("height", ((2, 2), wp.float64), r"height must be float32\(2, 2\).*got float64"),
        ("height", ((4,), wp.float32), r"height must have 2 axes"),
        ("brightness", ((2, 3), wp.float32), r"brightness must be float32\(2, 2\).*got float32\(2, 3\)"),
    ],
)
def test_rejects_a_wrong_argument(device, name, wrong, message):
    """Every array is checked, and the message says what it must be and what it was."""
    shape, dtype = wrong
    right = {key: wp.zeros((2, 2), dtype=wp.float32, device=device) for key in ("height", "brightness")}
    look = {key: (0.0, 0.0, 1.0) for key in ("corner", "right", "down", "forward", "light")}
    with pytest.raises(ValueError, match=message):
        draw_relief(make_mesh(device), **(right | {name: wp.zeros(shape, dtype=dtype, device=device)}), **look)
