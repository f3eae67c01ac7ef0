"""Vertical rays through a mesh."""

from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from deimos.kernels.ray_cast import cast_rays

LOW, HIGH, MISS = -100.0, 100.0, -200.0


def make_mesh(vertices, faces, device):
    """A Warp mesh of these triangles."""
    points = wp.array(np.asarray(vertices, np.float32), dtype=wp.vec3, device=device)
    return wp.Mesh(points, wp.array(np.asarray(faces, np.int32).reshape(-1), dtype=wp.int32, device=device))


def lattice(samples, spacing):
    """Vertices (x, y) of a square lattice, shape (n, n, 2), and its faces."""
    line = np.arange(0, samples, spacing)
    n = len(line)
    a = (n * np.arange(n - 1)[:, None] + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate([np.stack([a, a + n, a + n + 1], axis=1), np.stack([a, a + n + 1, a + 1], axis=1)])
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1), faces


def heights_by_fractions(vertices, faces, samples):
    """Highest point of integer triangles at integer samples, by rational arithmetic; None where there is none."""
    best = {}
    for face in faces:
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (tuple(map(int, vertices[k])) for k in face)
        for x in range(max(0, min(ax, bx, cx)), min(samples - 1, max(ax, bx, cx)) + 1):
            for y in range(max(0, min(ay, by, cy)), min(samples - 1, max(ay, by, cy)) + 1):
                u = (bx - x) * (cy - y) - (by - y) * (cx - x)
                v = (cx - x) * (ay - y) - (cy - y) * (ax - x)
                w = (ax - x) * (by - y) - (ay - y) * (bx - x)
                area = u + v + w
                if area == 0 or not (min(u, v, w) >= 0 or max(u, v, w) <= 0):
                    continue
                z = Fraction(u * az + v * bz + w * cz, area)
                best[x, y] = max(z, best.get((x, y), z))
    return best


@pytest.mark.parametrize("seed", range(5))
def test_matches_rational_arithmetic(device, seed):
    """Where most samples are on an edge or a vertex, the heights are those of exact arithmetic, and none is missed."""
    rng = np.random.default_rng(seed)
    xy, faces = lattice(31, 3)
    inner = np.all((xy > 0) & (xy < 30), axis=-1, keepdims=True)
    xy = xy + inner * rng.integers(-1, 2, xy.shape)  # all vertices stay on samples
    vertices = np.insert(xy.reshape(-1, 2), 2, rng.integers(-9, 10, xy[..., 0].size), axis=1)
    height = wp.full((31, 31), np.nan, dtype=wp.float32, device=device)

    cast_rays(make_mesh(vertices, faces, device), height, low=LOW, high=HIGH, miss=MISS)

    expected = heights_by_fractions(vertices, faces, 31)
    assert len(expected) == 31 * 31
    table = np.array([[float(expected[i, j]) for j in range(31)] for i in range(31)])
    np.testing.assert_allclose(height.numpy(), table, rtol=2.0**-23, atol=0)


def test_turning_the_mesh_turns_the_heights(device):
    """A mesh that is mirrored along its diagonal, faces turned over, gives the transposed heights to the bit."""
    rng = np.random.default_rng(7)
    xy, faces = lattice(25, 4)
    inner = np.all((xy > 0) & (xy < 24), axis=-1, keepdims=True)
    xy = xy + inner * rng.integers(-6000, 6001, xy.shape) / 4096
    vertices = np.insert(xy.reshape(-1, 2), 2, rng.normal(size=xy[..., 0].size), axis=1)
    results = []
    for points, triangles in ((vertices, faces), (vertices[:, [1, 0, 2]], faces[:, ::-1])):
        height = wp.full((25, 25), np.nan, dtype=wp.float32, device=device)
        cast_rays(make_mesh(points, triangles, device), height, low=LOW, high=HIGH, miss=MISS)
        results.append(height.numpy())
    assert results[0].min() > LOW
    np.testing.assert_allclose(results[0], results[1].T, rtol=2.0**-23, atol=2.0**-26)


def test_edges_and_corners_belong_to_their_faces(device):
    """Of one triangle, the samples on its edges and corners are met, those beside it are not, and the higher wins."""
    height = wp.full((5, 5), np.nan, dtype=wp.float32, device=device)
    vertices = [[0, 0, 1], [4, 0, 1], [0, 4, 1], [0, 0, 2], [2, 0, 2], [0, 2, 2], [0, 0, 3], [4, 0, 3], [4, 0, 9]]
    faces = [[0, 1, 2], [3, 4, 5], [6, 7, 8]]  # the last is upright
    cast_rays(make_mesh(vertices, faces, device), height, low=LOW, high=HIGH, miss=MISS)
    i, j = np.indices((5, 5))
    expected = np.where(i + j <= 2, 2.0, np.where(i + j <= 4, 1.0, MISS))
    np.testing.assert_array_equal(height.numpy(), expected)


def test_writes_only_what_is_asked_for(device):
    """Samples before ``first`` and after ``count`` stay as they were, and a torch view sees the others change."""
    height = wp.full((3, 4), np.nan, dtype=wp.float32, device=device)
    view = wp.to_torch(height)
    mesh = make_mesh([[0, 0, 1], [9, 0, 1], [0, 9, 1]], [[0, 1, 2]], device)
    cast_rays(mesh, height, low=LOW, high=HIGH, miss=MISS, first=2, count=5)
    assert view.data_ptr() == height.ptr
    assert view.isfinite().flatten().tolist() == [False] * 2 + [True] * 5 + [False] * 5
    cast_rays(mesh, height, low=LOW, high=HIGH, miss=MISS, first=12)
    cast_rays(mesh, height, low=LOW, high=HIGH, miss=MISS)
    assert (view == 1).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"low": 100.0}, r"miss, low and high must rise, got -200.0, 100.0 and 100.0"),
        ({"miss": float("nan")}, r"miss, low and high must rise, got nan"),
        ({"first": -1}, r"first and count must stay within 12 samples, got -1 and 13"),
        ({"first": 5, "count": 8}, r"first and count must stay within 12 samples, got 5 and 8"),
        ({"height": ((3, 4), wp.float64)}, r"height must be float32\(3, 4\).*got float64"),
        ({"height": ((12,), wp.float32)}, r"height must have 2 axes"),
        (
            {"height": ((1, 20000), wp.float32)},
            r"height must have from 1 to 16385 samples along each axis, got \(1, 20000",
        ),
    ],
)
def test_rejects_a_wrong_argument(device, changes, message):
    """Every argument is checked, and the message says what it must be and what it was."""
    if "height" in changes:
        shape, dtype = changes["height"]
        changes = {"height": wp.zeros(shape, dtype=dtype, device=device)}
    mesh = make_mesh([[0, 0, 1], [9, 0, 1], [0, 9, 1]], [[0, 1, 2]], device)
    height = wp.zeros((3, 4), dtype=wp.float32, device=device)
    right = {"mesh": mesh, "height": height, "low": LOW, "high": HIGH, "miss": MISS}
    with pytest.raises(ValueError, match=message):
        cast_rays(**(right | changes))
