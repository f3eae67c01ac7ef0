"""From mesh to height grid: exact, without a hole, and sharp at risers."""

from itertools import pairwise

import numpy as np
import pytest
from deimos.terrain import catalog, heightfield
from deimos.terrain.heightfield import rasterise
from deimos.terrain.mesh import UPRIGHT, from_triangles, rings, sheet, steepest_slope

NAMES = catalog.names()
CELL = 0.05  # [m]
MILLIMETRE = 1e-3
SAMPLES = (161, 161)
CORNER = (-4.0, -4.0)


def tile_of(name, difficulty, seed=0):
    """The mesh of one tile."""
    return catalog.make(name).build(difficulty, np.random.default_rng(seed))


def heights_under(mesh, points):
    """Highest point of a mesh at each point, by trimesh's rays."""
    origins = np.insert(points, 2, mesh.bounds[1, 2] + 1.0, axis=1)
    down = np.tile([0.0, 0.0, -1.0], (len(points), 1))
    locations, rays, _ = mesh.ray.intersects_location(origins, down, multiple_hits=True)
    heights = np.full(len(points), -np.inf)
    np.maximum.at(heights, rays, locations[:, 2])
    assert np.isfinite(heights).all()
    return heights


def bilinear(heights, corner, cell, points):
    """Heights between the samples, in float64."""
    u, v = ((points - corner) / cell).T
    i, j = np.minimum(u.astype(int), len(heights) - 2), np.minimum(v.astype(int), heights.shape[1] - 2)
    s, t = u - i, v - j
    h = heights.astype(np.float64)
    return (h[i, j] * (1 - s) + h[i + 1, j] * s) * (1 - t) + (h[i, j + 1] * (1 - s) + h[i + 1, j + 1] * s) * t


def beside_risers(mesh, points, distance):
    """Which points are at least ``distance`` away from every riser, along x or along y."""
    risers = mesh.vertices[mesh.faces[np.abs(mesh.face_normals[:, 2]) < UPRIGHT], :2]
    boxes = np.unique(np.concatenate([risers.min(axis=1), risers.max(axis=1)], axis=1).round(6), axis=0)
    free = np.ones(len(points), bool)
    for left, front, right, back in boxes:
        x, y = points.T
        free &= (x < left - distance) | (x > right + distance) | (y < front - distance) | (y > back + distance)
    return free


@pytest.mark.parametrize("name", NAMES)
def test_grid_is_the_mesh(device, name):
    """At 10 000 random points away from risers, the interpolated grid is within 1 mm + slope x half a cell."""
    mesh = tile_of(name, 0.9)
    heights = rasterise(mesh, CORNER, CELL, SAMPLES, device=device)
    points = np.random.default_rng(1).uniform(-4, 4, (10_000, 2))
    points = points[beside_risers(mesh, points, CELL)]
    assert len(points) > 100  # narrow stepping stones leave little else
    error = np.abs(bilinear(heights, CORNER, CELL, points) - heights_under(mesh, points))
    assert error.max() <= MILLIMETRE + steepest_slope(mesh) * CELL / 2


@pytest.mark.parametrize("name", NAMES)
def test_samples_lie_on_the_mesh(device, name):
    """A sample away from risers is the height of the mesh there, up to float32 and the snapping of vertices."""
    mesh = tile_of(name, 0.9)
    heights = rasterise(mesh, CORNER, CELL, SAMPLES, device=device)
    rng = np.random.default_rng(2)
    index = rng.integers(1, 160, (500, 2))
    points = np.asarray(CORNER) + CELL * index
    free = beside_risers(mesh, points, CELL / 2)
    index, points = index[free], points[free]
    beside = 1e-6 * rng.uniform(0.5, 1, points.shape)  # [m]; trimesh's rays may miss edges
    error = np.abs(heights[tuple(index.T)] - heights_under(mesh, points + beside))
    # The vertices of a face move by up to 1/8192 cell along each axis; heights round to 2^-24 of 2 m at most.
    moved = np.sqrt(2) * (CELL / 8192 + 1e-6)
    assert error.max() <= steepest_slope(mesh) * 3 * moved + 3e-7


@pytest.mark.parametrize("level", range(10))
@pytest.mark.parametrize(("direction", "sign"), [("up", -1), ("down", 1)])
def test_stairs_are_sharp(device, direction, sign, level):
    """Each of nine risers is crossed within one cell, and each tread has its exact height from riser to riser."""
    heights = rasterise(tile_of(f"stairs-{direction}", level / 10), CORNER, CELL, SAMPLES, device=device)
    for profile in (heights[:, 80], heights[80, :], heights[::-1, 80], heights[80, ::-1]):
        outside_in = profile[:81].astype(np.float64)
        risers = np.flatnonzero(np.diff(outside_in))
        # A riser at the sample 6 k is the upper edge there: a hill rises just before it, a hollow just after.
        np.testing.assert_array_equal(risers, 6 * np.arange(1, 10) - (1 if sign > 0 else 0))
        expected = sign * (0.05 + 0.018 * level) * np.arange(10)
        bounds = [0, *(risers + 1), 81]
        for (first, last), height in zip(pairwise(bounds), expected, strict=True):
            np.testing.assert_allclose(outside_in[first:last], height, rtol=0, atol=2e-7)


def test_snapping_moves_a_slope_by_micrometres(device):
    """Vertices anywhere on a plane give the plane: moved by up to 1/8192 cell along x and y, they change it by 5 um."""
    rng = np.random.default_rng(0)
    line = np.linspace(-2.0, 2.0, 14)
    x, y = np.meshgrid(line, line, indexing="ij")
    inner = (np.abs(x) < 1.9) & (np.abs(y) < 1.9)
    x, y = (axis + inner * rng.uniform(-0.1, 0.1, axis.shape) for axis in (x, y))
    vertices = np.stack([x, y, 0.5 * x - 0.3 * y], axis=-1).reshape(-1, 3)
    faces = sheet(line, line, 0 * x).faces
    heights = rasterise(from_triangles(vertices, faces), (-2.0, -2.0), CELL, (81, 81), device=device)
    at = -2.0 + CELL * np.arange(81)
    expected = 0.5 * at[:, None] - 0.3 * at[None, :]
    np.testing.assert_allclose(heights, expected, rtol=0, atol=(0.5 + 0.3) * CELL / 8192 + 1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_no_ray_slips_through(device, seed):
    """A random triangulation with edges and vertices on and right beside the samples has no hole for any ray."""
    rng = np.random.default_rng(seed)
    line = np.linspace(-5.0, 5.0, 51)
    x, y = np.meshgrid(line, line, indexing="ij")
    inner = (np.abs(x) < 4.9) & (np.abs(y) < 4.9)
    shift = rng.choice([0.0, 1e-12, -1e-7, 1e-5, 0.03, -0.05], x.shape)
    vertices = np.stack([x + inner * shift, y + inner * rng.permutation(shift.ravel()).reshape(x.shape), 0 * x + 0.25])
    mesh = from_triangles(vertices.reshape(3, -1).T, sheet(line, line, 0 * x).faces)
    heights = rasterise(mesh, (-5.0, -5.0), 0.05, (201, 201), device=device)
    np.testing.assert_allclose(heights, 0.25, rtol=2**-23)


def test_no_ray_slips_through_far_away(device):
    """16 000 cells away from the first sample rays still meet every edge and every vertex."""
    line = np.array([0.0, 790.15, 790.2, 793.35, 800.0])
    mesh = sheet(line, np.array([0.0, 0.3, 0.35, 1.0]), np.random.default_rng(0).uniform(1, 2, (5, 4)))
    heights = rasterise(mesh, (0.0, 0.0), 0.05, (16001, 21), device=device)
    assert heights.min() >= 1.0
    on_vertices = heights[np.ix_([0, 15803, 15804, 15867, 16000], [0, 6, 7, 20])]
    np.testing.assert_array_equal(on_vertices, mesh.vertices[:, 2].reshape(5, 4).astype(np.float32))


def test_sample_on_a_riser_is_its_upper_edge(device):
    """Where a riser stands on samples, they have the height of the upper tread, from either side."""
    block = rings(np.array([1.0, 0.5]), np.array([0.0, 0.2]))
    heights = rasterise(block, (-1.0, -1.0), 0.1, (21, 21), device=device)
    expected = np.zeros((21, 21), np.float32)
    expected[5:16, 5:16] = 0.2
    np.testing.assert_array_equal(heights, expected)


def test_hole_is_an_error(device):
    """A mesh that leaves one sample uncovered is refused, and the message says where."""
    square = sheet(np.linspace(0, 1, 11), np.linspace(0, 1, 11), np.zeros((11, 11)))
    hole = np.delete(square.faces, np.flatnonzero((square.faces == 5 * 11 + 7).any(axis=1)), axis=0)
    with pytest.raises(ValueError, match=r"mesh must cover the grid, .* nothing above x = 0.5 m, y = 0.7 m"):
        rasterise(from_triangles(square.vertices, hole), (0.0, 0.0), 0.1, (11, 11), device=device)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cell": 0.0}, r"cell must be finite and positive, got 0.0"),
        ({"shape": (1, 5)}, r"shape must be from 2 to 16385 samples along each axis, got \(1, 5\)"),
        ({"shape": (5, 20000)}, r"got \(5, 20000\)"),
        ({"mesh": from_triangles(np.full((3, 3), np.nan), np.array([[0, 1, 2]]))}, r"mesh must have finite vertices"),
    ],
)
def test_refuses_with_a_reason(changes, message):
    """Arguments out of their range are refused before anything is cast."""
    right = {"mesh": tile_of("flat", 0.0), "corner": CORNER, "cell": CELL, "shape": SAMPLES}
    with pytest.raises(ValueError, match=message):
        rasterise(**(right | changes))


def test_strips_do_not_show(device, monkeypatch):
    """The result does not depend on how many samples one launch takes, and progress ends at 1."""
    mesh = tile_of("rough", 1.0)
    whole = rasterise(mesh, CORNER, CELL, SAMPLES, device=device)
    monkeypatch.setattr(heightfield, "STRIP", 1000)
    shares = []
    strips = rasterise(mesh, CORNER, CELL, SAMPLES, device=device, progress=shares.append)
    assert strips.tobytes() == whole.tobytes()
    assert shares == sorted(shares)
    assert (len(shares), shares[-1]) == (26, 1.0)
