"""Every shape of ground, by itself: its mesh, its formulas and its bounds."""

import dataclasses
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from deimos.terrain import catalog, shapes
from deimos.terrain.mesh import highest_riser, rings, steepest_slope
from deimos.terrain.shape import TileShape

NAMES = catalog.names()
DIFFICULTIES = (0.0, 0.5, 1.0)
RANDOM = {"rough", "rough-slope-up", "rough-slope-down", "discrete", "stepping-stones"}
NANOMETRE = 1e-9


def build(shape, difficulty, seed=0):
    """The mesh of a shape, or of the shape of a name."""
    shape = catalog.make(shape) if isinstance(shape, str) else shape
    return shape.build(difficulty, np.random.default_rng(seed))


def area_from_above(mesh):
    """Sum of the faces' areas as seen from above [m^2]."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return np.cross(b - a, c - a)[:, 2].sum() / 2


def test_every_file_is_a_shape():
    """Every public file of the package gives one name, or two where it has a direction, and each name its own shape."""
    stems = {name.removesuffix("-up").removesuffix("-down") for name in NAMES}
    known = {"flat", "slope", "rough", "rough-slope", "stairs", "discrete", "stepping-stones", "gap", "pit", "waves"}
    assert known <= stems
    for name in NAMES:
        assert catalog.name_of(catalog.make(name)) == name


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
@pytest.mark.parametrize("name", NAMES)
def test_mesh_is_sound(name, difficulty):
    """The mesh is finite, no face is degenerate, normals point up or sideways, and from above the tile is covered."""
    shape = catalog.make(name)
    mesh = build(shape, difficulty)
    assert np.isfinite(mesh.vertices).all()
    assert mesh.area_faces.min() > NANOMETRE
    assert mesh.face_normals[:, 2].min() > -NANOMETRE
    np.testing.assert_allclose(mesh.bounds[:, :2], [[-4.0, -4.0], [4.0, 4.0]], rtol=0, atol=NANOMETRE)
    if name == "stepping-stones":  # its stones stand on the floor
        assert area_from_above(mesh) > shape.tile**2
    else:
        assert area_from_above(mesh) == pytest.approx(shape.tile**2, rel=1e-6)


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
@pytest.mark.parametrize("name", NAMES)
def test_tiles_meet_at_height_zero(name, difficulty):
    """All along the edge of the tile the ground is at height 0, so that any two tiles fit together."""
    vertices = build(name, difficulty).vertices
    on_edge = np.abs(vertices[:, :2]).max(axis=1) > 4.0 - NANOMETRE
    assert on_edge.sum() >= 4
    np.testing.assert_allclose(vertices[on_edge, 2], 0.0, rtol=0, atol=NANOMETRE)


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
@pytest.mark.parametrize("name", NAMES)
def test_middle_is_level(name, difficulty):
    """Every vertex and every edge on the platform, or on the part of it without noise, is at the middle's height."""
    shape = catalog.make(name)
    room = shape.tile if name == "flat" else getattr(shape, "room", shape.platform)
    assert room >= 1.0
    mesh = build(shape, difficulty)
    level = np.linspace(-0.499, 0.499, 9) * room
    x, y = np.meshgrid(level, level)
    heights = heights_under(mesh, x.ravel() + 1e-4, y.ravel() + 2e-4)  # off the edges, which trimesh's rays may miss
    assert np.ptp(heights) <= NANOMETRE


def heights_under(mesh, x, y):
    """Highest point of a mesh at each (x, y), by trimesh's rays."""
    above = mesh.bounds[1, 2] + 1.0
    origins = np.stack([x, y, np.full_like(x, above)], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (len(x), 1))
    locations, rays, _ = mesh.ray.intersects_location(origins, down, multiple_hits=True)
    heights = np.full(len(x), -np.inf)
    np.maximum.at(heights, rays, locations[:, 2])
    assert np.isfinite(heights).all()
    return heights


@pytest.mark.parametrize("name", NAMES)
def test_seed_decides_the_mesh(name):
    """The same seed gives the same bytes; another seed another mesh, if and only if the shape is random."""
    first, again, other = (build(name, 0.7, seed) for seed in (1, 1, 2))
    assert first.vertices.tobytes() == again.vertices.tobytes()
    assert first.faces.tobytes() == again.faces.tobytes()
    same = first.vertices.shape == other.vertices.shape and np.array_equal(first.vertices, other.vertices)
    assert same == (name not in RANDOM)


def test_numpys_global_generator_is_left_alone():
    """No shape draws from NumPy's global state."""
    before = np.random.get_state()[1].tobytes()  # noqa: NPY002
    for name in NAMES:
        build(name, 1.0)
    assert np.random.get_state()[1].tobytes() == before  # noqa: NPY002


@pytest.mark.parametrize("name", NAMES)
def test_steps_are_as_announced(name):
    """No riser is higher than the shape says, but for the walls of what is crossed and not stepped into."""
    shape = catalog.make(name)
    for difficulty in DIFFICULTIES:
        riser = highest_riser(build(shape, difficulty))
        if name in ("gap", "stepping-stones"):
            assert shape.step(difficulty) == 0.0
        else:
            assert riser <= shape.step(difficulty) + NANOMETRE
        if name in ("stairs-up", "stairs-down", "pit"):
            assert riser == pytest.approx(shape.step(difficulty))


@pytest.mark.parametrize("difficulty", np.arange(10) / 10)
@pytest.mark.parametrize(("direction", "sign"), [("up", -1), ("down", 1)])
def test_stairs_are_legged_gyms(direction, sign, difficulty):
    """Nine steps of 0.05 + 0.18 d lead to a middle of 2.6 m, with treads of 0.3 m and vertical risers."""
    mesh = build(f"stairs-{direction}", difficulty)
    step = 0.05 + 0.18 * difficulty
    np.testing.assert_allclose(np.unique(mesh.vertices[:, 2].round(6)), sign * step * np.arange(10)[::sign], atol=1e-6)
    treads = mesh.vertices[mesh.faces[mesh.face_normals[:, 2] > 0.5]]
    for k in range(10):
        half_side = np.abs(treads[np.isclose(treads[:, 0, 2], sign * k * step), :, :2]).max()
        assert half_side == pytest.approx(4.0 - 0.3 * k)
    assert set(np.abs(mesh.face_normals[:, 2]).round(6)) == {0.0, 1.0}


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
@pytest.mark.parametrize(("direction", "sign"), [("up", -1), ("down", 1)])
def test_slopes_have_legged_gyms_gradient(direction, sign, difficulty):
    """All four faces have the gradient 0.4 d, from the edge of the tile to the platform."""
    mesh = build(f"slope-{direction}", difficulty)
    assert steepest_slope(mesh) == pytest.approx(0.4 * difficulty)
    middle = mesh.vertices[np.abs(mesh.vertices[:, :2]).max(axis=1) < 2.0, 2]
    np.testing.assert_allclose(middle, sign * 0.4 * difficulty * 2.5)


def test_rough_slope_is_slope_and_noise():
    """The noise is what remains of a rough slope without its slope: within its amplitude, and not all zero."""
    mesh, smooth = build("rough-slope-down", 0.8), build("slope-down", 0.8)
    inside = np.abs(mesh.vertices[:, :2]).max(axis=1) < 3.9
    vertices = mesh.vertices[inside]
    noise = vertices[:, 2] - heights_under(smooth, vertices[:, 0] + 1e-7, vertices[:, 1] + 2e-7)
    assert np.abs(noise).max() <= 0.05 + 1e-6  # the rays stand 0.2 um beside the vertices
    assert np.abs(noise).max() > 0.04


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_noise_is_uniform(difficulty):
    """All multiples of 5 mm within the amplitude occur equally often, as a chi-square test sees it."""
    amplitude = 0.01 + 0.04 * difficulty
    line = np.linspace(-4, 4, 41)
    samples = np.concatenate([build("rough", difficulty, seed).vertices[:, 2] for seed in range(10)])
    x, y = np.meshgrid(line, line, indexing="ij")
    noisy = (np.maximum(np.abs(x), np.abs(y)) < 3.9) & (np.maximum(np.abs(x), np.abs(y)) > 0.75)
    values = np.rint(samples[np.tile(noisy.ravel(), 10)] / 0.005).astype(int)
    most = round(amplitude / 0.005)
    count = np.bincount(values + most, minlength=2 * most + 1)
    assert len(count) == 2 * most + 1
    expected = len(values) / len(count)
    # The statistic has the mean k and the variance 2 k for k degrees of freedom; five sigmas.
    degrees = len(count) - 1
    assert ((count - expected) ** 2 / expected).sum() < degrees + 5 * np.sqrt(2 * degrees)


def test_rectangles_are_legged_gyms():
    """Heights are -h, -h/2, 0, h/2 and h with h = 0.05 + 0.2 d, and every edge is on the raster of 0.4 m."""
    for seed in range(20):
        mesh = build("discrete", 0.5, seed)
        heights = np.unique(mesh.vertices[:, 2].round(9))
        assert set(heights) <= {-0.15, -0.075, 0.0, 0.075, 0.15}
        x = mesh.vertices[:, :2]
        on_raster = np.isclose(((x + 4.0) / 0.2).round(), (x + 4.0) / 0.2)  # sides are 1.0, 1.4 or 1.8 m
        assert on_raster[np.abs(x) != 1.5].all()


def test_gap_and_pit_are_legged_gyms():
    """A trench of 1.0 d around 3 m, a floor of 4 m that is 1.0 d deep."""
    gap = build("gap", 0.5).vertices
    assert np.abs(gap[gap[:, 2] < -0.5, :2]).max() == pytest.approx(2.0)
    pit = build("pit", 0.5).vertices
    assert np.abs(pit[pit[:, 2] == -0.5, :2]).max() == pytest.approx(2.0)
    assert pit[:, 2].min() == -0.5


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_stones_keep_their_distance(difficulty):
    """Along every row two neighbouring stones are exactly a gap apart, and no two rows are closer."""
    shape = catalog.make("stepping-stones", {"platform": 0.2})
    mesh = build(shape, difficulty)
    tops = mesh.vertices[mesh.faces[mesh.face_normals[:, 2] > 0.5]]
    tops = tops[np.isclose(tops[:, 0, 2], 0.0) & (np.abs(tops[:, :, :2]).max(axis=(1, 2)) < 3.6)]
    gap = 0.05 + 0.05 * difficulty
    rows = np.unique(tops[:, :, 1].min(axis=1).round(6))
    assert np.diff(rows[np.abs(rows) > 0.5]).min() > gap
    for y in rows[np.abs(rows) > 1.8]:
        row = tops[np.isclose(tops[:, :, 1].min(axis=1), y)]
        ends = np.unique(np.stack([row[:, :, 0].min(axis=1), row[:, :, 0].max(axis=1)], axis=1).round(6), axis=0)
        between = ends[1:, 0] - ends[:-1, 1]
        np.testing.assert_allclose(between, gap, rtol=0, atol=1e-5)


@pytest.mark.parametrize("difficulty", [-0.01, 1.01, np.nan])
@pytest.mark.parametrize("name", NAMES)
def test_difficulty_has_a_range(name, difficulty):
    """A difficulty outside [0, 1] is refused by every shape."""
    with pytest.raises(ValueError, match=r"difficulty must be in \[0, 1\], got"):
        build(name, difficulty)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "flat"])
def test_platform_must_fit(name):
    """A tile that is not larger than its platform is refused, and the message says both."""
    with pytest.raises(ValueError, match=r"(platform|tile) must be .*(got|=) 2(\.\d+)? m"):
        catalog.make(name, {"tile": 2.0, "platform": 2.0})


@pytest.mark.parametrize("name", NAMES)
def test_every_number_is_checked(name):
    """Each parameter of each shape refuses a negative value and NaN, and the message names it."""
    cls = type(catalog.make(name))
    for field in dataclasses.fields(cls):
        default = field.default
        if isinstance(default, str):
            continue
        for bad in (-1, float("nan")):
            value = (bad, bad) if isinstance(default, tuple) else bad
            with pytest.raises(ValueError, match=field.name):
                dataclasses.replace(catalog.make(name), **{field.name: value})


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("stairs", {}, r"Unknown shape 'stairs'; choose from: discrete, flat, .*stairs-down, stairs-up"),
        ("gap", {"step": 1}, r"gap has no parameter 'step'; it has: tile, platform, width, depth"),
        ("stairs-up", {"direction": "down"}, r"stairs-up has no parameter 'direction'"),
        ("gap", {"width": 0.3}, r"gap: width must be 2 numbers, got 0.3"),
        ("gap", {"width": (0.0, 3.0)}, r"tile must be larger than platform \+ 2 width = 9 m, got 8 m"),
        ("waves", {"count": 2.5}, r"waves: count must be a whole number, got 2.5"),
        ("waves", {"spacing": 0.5}, r"spacing must be in \[0.01, 0.25\], got 0.5"),
        ("discrete", {"sides": (2.0, 9.0)}, r"sides must rise, from above 0 to at most 7.2 m"),
        ("rough-slope-up", {"room": 4.0}, r"room must be at most platform = 3 m, got 4 m"),
        ("stairs-up", {"tile": 3.0}, r"stairs-up: tile must be at least platform \+ 2 tread = 3.2 m, got 3 m"),
        ("stairs-down", {"tread": 3.0}, r"tile must be at least platform \+ 2 tread = 8.6 m, got 8 m"),
        ("waves", {"fade": 3.5}, r"tile must be larger than platform \+ 2 fade = 8 m, got 8 m"),
        ("stepping-stones", {"rim": 3.0}, r"tile must be larger than platform \+ 2 rim \+ 4 gap"),
    ],
)
def test_refuses_with_a_reason(name, parameters, message):
    """Unknown shapes and parameters, and numbers that do not fit together, are refused with the way out."""
    with pytest.raises(ValueError, match=message):
        catalog.make(name, parameters)


@dataclass(frozen=True, kw_only=True)
class Block(TileShape):
    """A block in the middle, with an edge and an extent that may be wrong."""

    edge: float = 1e-9
    wide: float = 8.0

    def step(self, difficulty):
        """See ``TileShape.step``."""
        return 0.5 * difficulty

    def surface(self, difficulty, generator):
        """See ``TileShape.surface``."""
        return rings(np.array([self.wide, self.platform]) / 2, np.array([self.edge, 0.5 * difficulty]))


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        (Block(edge=0.2), "its mesh must be at height 0 along its edge, got 0.2 m"),
        (Block(wide=7.9), "its mesh must extend over the tile of 8 m"),
        (Block(wide=8.1), "its mesh must extend over the tile of 8 m"),
    ],
)
def test_tiles_that_would_not_meet_are_refused(shape, message):
    """A mesh that leaves a gap or a cliff between two tiles is not built, and the message says what is wrong."""
    with pytest.raises(ValueError, match=f"^{Block.__module__}: {message}"):
        build(shape, 0.5)


def test_dropped_in_file_is_a_shape(tmp_path, monkeypatch):
    """One file in the package's folder, and nothing else, makes a new shape, whose numbers are checked."""
    (tmp_path / "one_bump.py").write_text('''
"""A block."""

from __future__ import annotations

from dataclasses import dataclass

from deimos.terrain.mesh import rings
from deimos.terrain.shape import Ramp, TileShape
import numpy as np


@dataclass(frozen=True, kw_only=True)
class Shape(TileShape):
    """A block in the middle."""

    width: float = 1.0
    slope: Ramp = (0.0, 1.0)

    def step(self, difficulty):
        """See ``TileShape.step``."""
        return difficulty

    def surface(self, difficulty, generator):
        """See ``TileShape.surface``."""
        return rings(np.array([self.tile, self.platform]) / 2, np.array([0.0, difficulty]))
''')
    (tmp_path / "_helper.py").write_text("")
    monkeypatch.setattr(shapes, "__path__", [*shapes.__path__, str(tmp_path)])
    assert "one-bump" in catalog.names()
    shape = catalog.make("one-bump", {"platform": 2})
    assert isinstance(shape, TileShape)
    assert build(shape, 0.5).vertices[:, 2].max() == 0.5
    assert catalog.name_of(shape) == "one-bump"
    with pytest.raises(ValueError, match="one-bump: width must be finite and positive, got -1"):
        catalog.make("one-bump", {"width": -1})
    with pytest.raises(ValueError, match="one-bump: slope must be two finite numbers of at least 0"):
        catalog.make("one-bump", {"slope": [-1, 1]})


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("def", "SyntaxError: "),
        (
            "from deimos.terrain.shape import TileShape as Shape",
            "TypeError: Can't instantiate abstract class TileShape",
        ),
        (
            """
from deimos.terrain.shape import TileShape
class Shape(TileShape):
    def surface(self, difficulty, generator): ...
""",
            "TypeError: Can't instantiate abstract class Shape with.*step",
        ),
    ],
)
def test_broken_file_stops_no_other(tmp_path, monkeypatch, source, reason):
    """A file that is no shape, or none without parameters, is reported by its name, and all others are there."""
    before = catalog.names()
    (tmp_path / "crater.py").write_text(source)
    monkeypatch.setattr(shapes, "__path__", [*shapes.__path__, str(tmp_path)])
    monkeypatch.delitem(sys.modules, "deimos.terrain.shapes.crater", raising=False)
    with pytest.warns(UserWarning, match=rf"The plug-in 'crater' of deimos.shapes, .* is broken \({reason}"):
        assert catalog.names() == before
