"""Looking the ground up around a robot."""

import numpy as np
import pytest
import warp as wp

from kernels.height_scan import sample_height, sample_minimum, scan_heights, scan_points

U = 2.0**-24  # relative error of one float32 operation
CELL = 0.05  # [m]
CORNER = (-3.0, 2.0)
SHAPE = (61, 41)  # 3 m x 2 m
RULES = ("bilinear", "minimum")


def make_ground(seed=0):
    """Random heights [m]."""
    return np.random.default_rng(seed).uniform(-1, 1, SHAPE).astype(np.float32)


def make_poses(count, seed=0, margin=1.0):
    """Positions over the ground and up to ``margin`` beside it, and any orientation."""
    rng = np.random.default_rng(seed)
    low = [CORNER[0] - margin, CORNER[1] - margin, -5.0]
    high = [CORNER[0] + 3.0 + margin, CORNER[1] + 2.0 + margin, 5.0]
    quaternion = rng.normal(size=(count, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    return rng.uniform(low, high, (count, 3)).astype(np.float32), quaternion.astype(np.float32)


def on_device(position, quaternion, points, heights, device):
    """The arrays that a scan takes, and an output that nobody has written yet."""
    position = np.asarray(position, np.float32)
    points = np.asarray(points, np.float32)
    return {
        "heights": wp.array(heights, dtype=wp.float32, device=device),
        "cell": CELL,
        "corner": CORNER,
        "position": wp.array(position, dtype=wp.vec3, device=device),
        "quaternion": wp.array(np.asarray(quaternion, np.float32), dtype=wp.vec4, device=device),
        "points": wp.array(points, dtype=wp.vec2, device=device),
        "out": wp.full((len(position), len(points)), np.nan, dtype=wp.float32, device=device),
    }


def yaw_only(yaw):
    """MuJoCo quaternions of turns about the vertical."""
    yaw = np.asarray(yaw, np.float64)
    return np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=-1)


def world_points(position, quaternion, points):
    """Where the points are in the world, in float64, one robot after another."""
    result = np.empty((len(position), len(points), 2))
    for env, (w, x, y, z) in enumerate(quaternion.astype(np.float64)):
        yaw = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        result[env] = position[env, :2] + points.astype(np.float64) @ turn.T
    return result


def look_up(heights, x, y, rule):
    """One height by the rule, in float64, clamped at the border."""
    u, v = (x - CORNER[0]) / CELL, (y - CORNER[1]) / CELL
    i = int(np.clip(np.floor(u), 0, SHAPE[0] - 2))
    j = int(np.clip(np.floor(v), 0, SHAPE[1] - 2))
    h = heights.astype(np.float64)
    if rule == "minimum":
        return min(h[i, j], h[i + 1, j], h[i, j + 1])
    s, t = np.clip(u - i, 0, 1), np.clip(v - j, 0, 1)
    return (1 - s) * ((1 - t) * h[i, j] + t * h[i, j + 1]) + s * ((1 - t) * h[i + 1, j] + t * h[i + 1, j + 1])


@pytest.mark.parametrize("num_envs", [1, 65])
@pytest.mark.parametrize("rule", RULES)
def test_matches_reference(device, rule, num_envs):
    """Heights equal the reference under 187 points of robots in any pose, over the ground and beside it."""
    heights, points = make_ground(), scan_points()
    position, quaternion = make_poses(num_envs)
    arguments = on_device(position, quaternion, points, heights, device)

    scan_heights(**arguments, rule=rule)

    place = world_points(position, quaternion, points)
    expected = np.array([[look_up(heights, x, y, rule) for x, y in row] for row in place])
    found = arguments["out"].numpy()
    # Coordinates up to 6 m take 8 roundings at most; the heading has its own when the body is almost upright.
    tilt = np.hypot(*world_points(np.zeros((num_envs, 3)), quaternion, np.array([[1.0, 0.0]]))[:, 0].T)
    assert tilt.min() > 0.99
    w, x, y, z = quaternion.astype(np.float64).T
    level = np.hypot(1 - 2 * (y * y + z * z), 2 * (x * y + w * z))[:, None]
    shift = 8 * 6 * U + 12 * U / level  # [m]
    if rule == "bilinear":  # neighbours differ by 2 m at most
        assert np.all(np.abs(found - expected) <= 2 * np.sqrt(2) * shift * 2 / CELL + 6 * U)
    else:  # right beside a sample, rounding may choose the next cell
        u = (place - CORNER) / CELL
        clear = np.all(np.abs(u - np.rint(u)) * CELL > 2 * shift[..., None], axis=-1)
        assert clear.mean() > 0.99
        np.testing.assert_array_equal(found[clear], expected[clear].astype(np.float32))


@pytest.mark.parametrize("rule", RULES)
def test_plane_is_seen_exactly(device, rule):
    """Over a plane the bilinear scan is the plane, and the minimum is at most one cell's drop below it."""
    x = CORNER[0] + CELL * np.arange(SHAPE[0])
    y = CORNER[1] + CELL * np.arange(SHAPE[1])
    heights = (0.3 * x[:, None] - 0.2 * y[None, :]).astype(np.float32)
    position = np.array([[-1.5, 3.0, 0.0]] * 16)
    quaternion = yaw_only(np.linspace(-np.pi, np.pi, 16))
    points = scan_points(1.0, 0.8)
    arguments = on_device(position, quaternion, points, heights, device)
    scan_heights(**arguments, rule=rule)
    place = world_points(position, quaternion, points)
    plane = 0.3 * place[..., 0] - 0.2 * place[..., 1]
    below = plane - arguments["out"].numpy()
    if rule == "bilinear":
        assert np.abs(below).max() < 1e-5  # 1 m / 0.05 m = 20 cells of 2^-24 x 60 cells each, times the slopes
    else:
        assert below.min() > -0.2 * CELL - 1e-5  # (i, j + 1) is the lowest on this plane
        assert below.max() < (0.3 + 0.2) * CELL + 1e-5


def test_samples_are_seen_exactly(device):
    """A robot right above a sample sees that sample, at the border and in the corners too."""
    heights = make_ground()
    cell, corner = 0.0625, (-1.0, 0.5)  # float32 holds these and their multiples exactly
    i, j = (index.ravel() for index in np.indices(SHAPE))
    position = np.stack([corner[0] + i * cell, corner[1] + j * cell, 0 * i], axis=1)
    arguments = on_device(position, yaw_only(0 * i), [[0.0, 0.0]], heights, device)
    scan_heights(**(arguments | {"cell": cell, "corner": corner}))
    np.testing.assert_allclose(arguments["out"].numpy()[:, 0], heights.ravel(), rtol=0, atol=2 * U)


def test_minimum_is_legged_gyms(device):
    """The least of (i, j), (i + 1, j) and (i, j + 1) counts, and (i + 1, j + 1) does not."""
    heights = np.full(SHAPE, 1.0, np.float32)
    lows = {(10, 20): 0.4, (11, 20): 0.3, (10, 21): 0.2, (11, 21): 0.1}
    middle = np.array([[CORNER[0] + 10.5 * CELL, CORNER[1] + 20.5 * CELL, 0.0]])
    for place, low in lows.items():
        heights[:] = 1.0
        heights[place] = low
        arguments = on_device(middle, yaw_only([0.0]), [[0.0, 0.0]], heights, device)
        scan_heights(**arguments, rule="minimum")
        assert arguments["out"].numpy()[0, 0] == np.float32(1.0 if place == (11, 21) else low)


@pytest.mark.parametrize("rule", RULES)
def test_pitch_and_roll_do_not_matter(device, rule):
    """A robot that is tilted sees the same ground as one that stands upright with the same yaw."""
    rng = np.random.default_rng(3)
    yaw, pitch, roll = rng.uniform(-1, 1, (3, 50)) * [[np.pi], [1.2], [np.pi]]
    upright = yaw_only(yaw)
    nod = np.stack([np.cos(pitch / 2), 0 * yaw, np.sin(pitch / 2), 0 * yaw], axis=1)
    lean = np.stack([np.cos(roll / 2), np.sin(roll / 2), 0 * yaw, 0 * yaw], axis=1)
    tilted = multiply(multiply(upright, nod), lean)
    x = CORNER[0] + CELL * np.arange(SHAPE[0])
    heights = np.broadcast_to(x[:, None], SHAPE).astype(np.float32)  # smooth, so that rounding does not jump
    position = np.array([[-1.5, 3.0, 0.0]] * 50)
    results = []
    for quaternion in (upright, tilted):
        arguments = on_device(position, quaternion, scan_points(1.0, 0.8), heights, device)
        scan_heights(**arguments, rule=rule)
        results.append(arguments["out"].numpy())
    difference = np.abs(results[0] - results[1])
    # A heading of length cos(1.2) = 0.36 and more carries its 12 roundings to 0.64 m: 2e-6 m.
    assert difference.max() < 1e-5 + (CELL if rule == "minimum" else 0.0)  # a minimum may fall into the next cell
    assert (difference > 1e-5).mean() < 0.01


def multiply(a, b):
    """Products of quaternions (w, x, y, z)."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a.T, b.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=1,
    )


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("distance", [10.0, 1e6, 1e30, np.inf])
def test_ground_goes_on_beyond_the_border(device, distance, rule):
    """However far beside the grid, a robot sees the height of its edge."""
    heights = np.zeros(SHAPE, np.float32)
    heights[0], heights[1], heights[-2], heights[-1] = 1.0, 1.0, 2.0, 2.0
    position = np.array([[-distance, 3.0, 0.0], [distance, 3.0, 0.0]])
    arguments = on_device(position, yaw_only([0.0, 0.0]), [[0.0, 0.0]], heights, device)
    scan_heights(**arguments, rule=rule)
    assert arguments["out"].numpy()[:, 0].tolist() == [1.0, 2.0]


@pytest.mark.parametrize("rule", RULES)
def test_nan_stays_nan(device, rule):
    """A robot that is nowhere sees NaN and reads no memory beyond the grid; its neighbour sees the ground."""
    position = np.array([[np.nan, 3.0, 0.0], [-2.0, np.nan, 0.0], [-2.0, 3.0, np.nan]])
    arguments = on_device(position, yaw_only([0.0] * 3), scan_points(), make_ground(), device)
    scan_heights(**arguments, rule=rule)
    assert np.isnan(arguments["out"].numpy()).all(axis=1).tolist() == [True, True, False]
    assert np.isfinite(arguments["out"].numpy()[2]).all()


def test_points_are_legged_gyms():
    """187 points, x from -0.8 to 0.8 m in the outer loop, y from -0.5 to 0.5 m."""
    points = scan_points()
    assert points.shape == (187, 2)
    np.testing.assert_allclose(points[:11, 0], -0.8)
    np.testing.assert_allclose(points[:11, 1], np.linspace(-0.5, 0.5, 11), atol=1e-7)
    np.testing.assert_allclose(points[::11, 0], np.linspace(-0.8, 0.8, 17), atol=1e-7)


def test_works_in_shared_memory(device):
    """A torch view of the output sees the heights at the same address, also when the launch is replayed."""
    arguments = on_device([[-1.5, 3.0, 0.0]], yaw_only([0.0]), [[0.0, 0.0]], np.full(SHAPE, 0.5, np.float32), device)
    view = wp.to_torch(arguments["out"])
    launch = scan_heights(**arguments, record=True)
    assert view.isnan().all()
    launch.launch()
    assert view.data_ptr() == arguments["out"].ptr
    assert view.tolist() == [[0.5]]


@wp.kernel
def _look_up_once(heights: wp.array2d[float], place: wp.vec2, out: wp.array[float]):
    corner = wp.vec2(-3.0, 2.0)
    out[0] = sample_height(heights, 0.05, corner, place[0], place[1])
    out[1] = sample_minimum(heights, 0.05, corner, place[0], place[1])


def test_other_kernels_may_look_up(device):
    """Both rules are functions that a kernel of another module can call."""
    heights = make_ground()
    out = wp.zeros(2, dtype=wp.float32, device=device)
    wp.launch(
        _look_up_once, dim=1, device=device, outputs=[out],
        inputs=[wp.array(heights, dtype=wp.float32, device=device), wp.vec2(-1.98765, 3.01234)],
    )  # fmt: skip
    expected = [look_up(heights, -1.98765, 3.01234, rule) for rule in RULES]
    np.testing.assert_allclose(out.numpy(), expected, rtol=0, atol=2 * 2 * 6 * U / CELL)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("cell", 0.0, r"cell must be finite and positive, got 0.0"),
        ("cell", float("nan"), r"cell must be finite and positive, got nan"),
        ("rule", "maximum", r"rule must be bilinear or minimum, got 'maximum'"),
        ("heights", ((1, 41), wp.float32), r"heights must have at least 2 x 2 samples, got the shape \(1, 41\)"),
        ("heights", ((41,), wp.float32), r"heights must have 2 axes"),
        ("heights", ((41, 41), wp.float64), r"heights must be float32\(41, 41\).*got float64"),
        ("position", ((4,), wp.vec4), r"position must be vec3f\(4,\).*got vec4f"),
        ("quaternion", ((5,), wp.vec4), r"quaternion must be vec4f\(4,\).*got vec4f\(5,\)"),
        ("points", ((3,), wp.vec3), r"points must be vec2f\(3,\).*got vec3f"),
        ("points", ((3, 3), wp.vec2), r"points must have 1 axes"),
        ("out", ((4, 2), wp.float32), r"out must be float32\(4, 3\).*got float32\(4, 2\)"),
    ],
)
def test_rejects_a_wrong_argument(device, name, value, message):
    """Every argument is checked, and the message says what it must be and what it was."""
    right = on_device(np.zeros((4, 3)), yaw_only([0.0] * 4), np.zeros((3, 2)), make_ground(), device)
    if isinstance(value, tuple):
        shape, dtype = value
        value = wp.zeros(shape, dtype=dtype, device=device)
    with pytest.raises(ValueError, match=message):
        scan_heights(**(right | {name: value}))
