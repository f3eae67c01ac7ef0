"""Grids of tiles: their layout, their seeds, their presets and files."""

import dataclasses
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from deimos.terrain import catalog, presets, world
from deimos.terrain.mesh import highest_riser, rings, steepest_slope
from deimos.terrain.shape import TileShape

from deimos import terrain

HOME = Path(terrain.__file__).resolve().parent.parent
ALL = tuple(world.Share(shape=catalog.make(name)) for name in catalog.names())


def small(**changes):
    """Two levels of all shapes, coarse and without a border."""
    values = {"shapes": ALL, "levels": 2, "columns": len(ALL), "border": 0.0, "cell": 0.1, "hardest": 1.0}
    return terrain.Grid(**(values | changes))


def tile_heights(ground, level, column):
    """The samples of one tile, its edges included."""
    samples = round(ground.tile / ground.cell)
    first = -np.array(ground.corner) / ground.cell  # of the origin
    count = np.array([len(ground.difficulty), len(ground.shapes)])
    i, j = np.rint(first + (np.array([level, column]) - count / 2) * samples).astype(int)
    return ground.heights[i : i + samples + 1, j : j + samples + 1]


def test_columns_are_legged_gyms():
    """20 columns make 1 + 1 slopes, 2 rough slopes, 7 stairs up, 5 stairs down and 4 columns of rectangles."""
    for name in presets.preset_names():
        columns = [catalog.name_of(shape) for shape in terrain.preset(name).column_shapes]
        expected = [("slope-up", 1), ("slope-down", 1), ("rough-slope-down", 2), ("stairs-up", 7), ("stairs-down", 5)]
        assert columns == [n for n, count in [*expected, ("discrete", 4)] for _ in range(count)]


def test_difficulties_are_legged_gyms():
    """Ten levels go from 0 to 0.9 in tenths; any other number of levels spans the same."""
    np.testing.assert_allclose(terrain.preset("legged-gym").difficulty, np.arange(10) / 10, rtol=1e-6)
    np.testing.assert_allclose(terrain.preset("legged-gym", levels=4).difficulty, [0.0, 0.3, 0.6, 0.9], rtol=1e-6)


def test_go1_preset_keeps_steps_low():
    """No riser in the mesh of the Go1 preset is higher than 0.18 m, even at difficulty 1."""
    grid = terrain.preset("go1", hardest=1.0)
    mesh = world.build_mesh(grid)
    assert 0.17 < highest_riser(mesh) <= 0.18 + 1e-9
    assert steepest_slope(mesh) < 1.1


def test_every_tile_is_its_shape():
    """Each tile of the world is that shape at that level, built by a generator of (seed, level, column)."""
    grid = small(seed=3)
    ground = terrain.build(grid)
    assert ground.shapes == tuple(catalog.names())
    for level, difficulty in enumerate(ground.difficulty):
        for column, name in enumerate(ground.shapes):
            generator = np.random.default_rng(np.random.SeedSequence(3, spawn_key=(level, column)))
            mesh = catalog.make(name).build(float(difficulty), generator)
            alone = world.rasterise(mesh, (-4.0, -4.0), grid.cell, (81, 81))
            # Vertices are rounded to float32 at another place, heights not at all; tiles meet at height 0.
            np.testing.assert_allclose(tile_heights(ground, level, column), alone, rtol=0, atol=1e-3)


def test_origins_stand_on_level_ground():
    """Each origin is in the middle of its tile, on the ground, and 1 m around it nothing differs by 1 cm."""
    ground = terrain.build(small(border=1.0))
    assert ground.origins.shape == (2, len(ALL), 3)
    np.testing.assert_allclose(ground.origins[:, 0, 0], [-4.0, 4.0])
    np.testing.assert_allclose(np.diff(ground.origins[0, :, 1]), 8.0)
    for level in range(2):
        for column in range(len(ALL)):
            tile = tile_heights(ground, level, column)
            room = tile[36:45, 36:45]  # 0.4 m either way
            assert np.abs(room - ground.origins[level, column, 2]).max() < 0.01


def test_border_is_level_and_seamless():
    """Around the tiles the ground is at height 0, and so it is along every seam."""
    ground = terrain.build(small(border=2.0))
    inner = ground.heights[20:-20, 20:-20]
    outside = ground.heights.copy()
    outside[21:-21, 21:-21] = 0.0
    assert np.abs(outside).max() < 1e-6
    for seam in (inner[::80], inner[:, ::80]):
        assert np.abs(seam).max() < 1e-6


def test_tiles_do_not_depend_on_each_other():
    """Other shapes, more columns or another border leave a tile as it was, and another seed does not."""
    rough = world.Share(shape=catalog.make("rough"))
    flat = world.Share(shape=catalog.make("flat"))
    first = terrain.build(small(shapes=(rough, rough), columns=2))
    second = terrain.build(small(shapes=(flat, rough), columns=2, border=1.0))
    wider = terrain.build(small(shapes=(flat, rough, rough), columns=3))
    other = terrain.build(small(shapes=(rough, rough), columns=2, seed=1))
    expected = tile_heights(first, 1, 1)
    assert np.ptp(expected) > 0.05
    for ground in (second, wider):
        np.testing.assert_allclose(tile_heights(ground, 1, 1), expected, rtol=0, atol=1e-4)
    assert np.abs(tile_heights(other, 1, 1) - expected).max() > 0.05
    assert np.abs(tile_heights(first, 1, 0) - expected).max() > 0.05


def test_same_seed_gives_the_same_bytes_on_any_number_of_threads(tmp_path):
    """Two processes with other thread counts and hash seeds write the very file that this one writes."""
    code = "import sys, terrain; terrain.rough(seed=5, levels=2, columns=10, cell=0.1).save(sys.argv[1])"
    terrain.rough(seed=5, levels=2, columns=10, cell=0.1).save(tmp_path / "here.npz")
    digests = {hashlib.sha256((tmp_path / "here.npz").read_bytes()).hexdigest()}
    for threads in ("1", "4"):
        path = tmp_path / f"{threads}.npz"
        changes = {"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads, "PYTHONHASHSEED": threads}
        subprocess.run([sys.executable, "-c", code, path], cwd=HOME, env=os.environ | changes, check=True)
        digests.add(hashlib.sha256(path.read_bytes()).hexdigest())
    assert len(digests) == 1


def test_rough_is_the_go1_preset():
    """``terrain.rough`` builds the preset with the arguments that it is given."""
    ground = terrain.rough(seed=1, levels=2, columns=3, cell=0.1, border=1.0)
    expected = terrain.build(terrain.preset("go1", seed=1, levels=2, columns=3, cell=0.1, border=1.0))
    assert ground.heights.tobytes() == expected.heights.tobytes()
    assert (len(ground.difficulty), ground.shapes) == (2, ("slope-up", "stairs-up", "stairs-down"))


def test_progress_counts_tiles_and_rays():
    """Both stages report rising shares and end at 1."""
    reports = []
    terrain.build(small(), progress=lambda stage, share: reports.append((stage, share)))
    for stage in ("tiles", "rays"):
        shares = [share for name, share in reports if name == stage]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cell": 0.3}, r"cell must divide tile = 8 m, got 0.3 m; 0.296296 m would do"),
        ({"border": 0.25}, r"cell must divide border = 0.25 m, got 0.1 m"),
        ({"tile": 3.0}, r"discrete: platform must be smaller than tile = 3 m, got 3 m"),
        ({"max_step": float("nan")}, r"max_step must be in \[0, inf\], got nan"),
        ({"hardest": 1.1}, r"hardest must be in \[0, 1\], got 1.1"),
        ({"easiest": -0.1}, r"easiest must be in \[0, 1\], got -0.1"),
        ({"easiest": 0.9, "hardest": 0.1}, r"hardest must be at least easiest = 0.9, got 0.1"),
        ({"levels": 0}, r"levels must be at least 1, got 0"),
        ({"columns": 1.5}, r"columns must be a whole number, got 1.5"),
        ({"seed": -1}, r"seed must be at least 0, got -1"),
        ({"shapes": ()}, r"shapes must have at least one entry"),
        (
            {"shapes": (world.Share(shape=catalog.make("flat"), share=0.0),)},
            r"share must be finite and positive, got 0",
        ),
        (
            {"max_step": 0.6},
            r"max_step is 0.6 m, but pit at difficulty 1 has steps of 1 m; lower them or raise max_step",
        ),
        (
            {"max_step": 0.6, "shapes": (world.Share(shape=catalog.make("pit", {"depth": [0.8, 0.1]})),)},
            r"max_step is 0.6 m, but pit at difficulty 0 has steps of 0.8 m; lower them or raise max_step",
        ),
    ],
)
def test_refuses_with_a_reason(changes, message):
    """A grid whose numbers do not fit together is refused before anything is built, with the way out."""
    with pytest.raises(ValueError, match=message):
        small(**changes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hump(TileShape):
    """A block that is highest at difficulty 0.5."""

    def step(self, difficulty):
        """See ``TileShape.step``."""
        return difficulty * (1.0 - difficulty)

    def surface(self, difficulty, generator):
        """See ``TileShape.surface``."""
        return rings(np.array([self.tile, self.platform]) / 2, np.array([0.0, self.step(difficulty)]))


@pytest.mark.parametrize(("levels", "hardest", "most"), [(1, 0.5, 0.0), (2, 1.0, 0.0), (3, 1.0, 0.25)])
def test_steps_are_those_of_the_levels_that_there_are(levels, hardest, most):
    """The highest step is looked for among all levels, and at no difficulty that none has."""
    hump = (world.Share(shape=Hump()),)
    assert small(shapes=hump, levels=levels, hardest=hardest, max_step=most).max_step == most
    if most:
        with pytest.raises(ValueError, match=r"at difficulty 0\.5 has steps of 0\.25 m"):
            small(shapes=hump, levels=levels, hardest=hardest, max_step=0.99 * most)


def test_grid_that_does_not_fit_is_refused(monkeypatch):
    """A grid beyond the free memory says how much it needs and how much there is, and nothing is built."""
    monkeypatch.setattr(world, "_free_memory", lambda: 2**30)
    grid = terrain.preset("legged-gym", cell=0.02)
    assert grid.memory > 2**30
    message = r"6501 x 10501 samples needs about \d\.\d GiB of memory, but 1\.0 GiB are free; enlarge cell"
    with pytest.raises(ValueError, match=message):
        terrain.build(grid)


@pytest.mark.parametrize("names", [{}, {"SC_PAGE_SIZE": 30, "SC_PHYS_PAGES": 85}])
def test_memory_is_known_where_the_system_says_it(monkeypatch, names):
    """Without ``/proc`` the whole memory counts; where nobody tells that either, no grid is refused for it."""

    def refuse(*args, **kwargs):
        raise FileNotFoundError("no /proc")

    monkeypatch.setattr("builtins.open", refuse)
    monkeypatch.setattr(os, "sysconf_names", names)
    monkeypatch.setattr(os, "sysconf", lambda name: 2**14)
    free = world._free_memory()
    monkeypatch.undo()
    assert free == (2**28 if names else np.inf)
    monkeypatch.setattr(world, "_free_memory", lambda: free)
    if names:
        with pytest.raises(ValueError, match=r"but 0\.2 GiB are free"):
            world.require_memory((10, 10), 2**29, "cell", 0.1)
    else:
        world.require_memory((10, 10), 2**60, "cell", 0.1)


def test_grid_with_too_many_cells_is_refused():
    """More cells along an axis than the exact ray test allows are refused with the least cell that works."""
    with pytest.raises(ValueError, match=r"cell must be at least 0.0128 m for at most 16384 cells along an axis"):
        terrain.build(terrain.preset("legged-gym", cell=0.01))


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the peak of a process is read from Linux")
def test_estimate_of_memory_holds(tmp_path):
    """A process that builds and saves a grid needs no more memory than was estimated, and at least a quarter."""
    code = """
import sys, terrain
from deimos.terrain import catalog, world
def peak():
    return next(1024 * int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
names = ("rough-slope-up", "waves", "stepping-stones")
shapes = tuple(world.Share(shape=catalog.make(name)) for name in names)
terrain.build(terrain.Grid(shapes=shapes, levels=1, columns=3, border=0.0))  # loads what is needed
grid = terrain.Grid(shapes=shapes, levels=8, columns=12, border=20.0, hardest=1.0)
before = peak()
terrain.build(grid).save(sys.argv[1])
print(peak() - before, grid.memory)
"""
    run = [sys.executable, "-W", "ignore", "-c", code, tmp_path / "ground.npz"]
    done = subprocess.run(run, cwd=HOME, capture_output=True, text=True, check=True)
    used, estimated = map(int, done.stdout.split()[-2:])
    assert estimated / 4 < used < estimated, (used, estimated)


TOML = """
levels = 2
columns = 4
border = 1
cell = 0.1
hardest = 0.5
max_step = 0.2

[[shape]]
name = "stairs-down"
share = 3
height = [0.1, 0.3]
tread = 0.5

[[shape]]
name = "waves"
"""


def test_toml_file_is_a_grid(tmp_path):
    """Fields above, a table for each shape, whole numbers for fractions; the caller has the last word."""
    path = tmp_path / "grid.toml"
    path.write_text(TOML)
    grid = presets.read_grid(path, seed=4)
    stairs = catalog.make("stairs-down", {"height": (0.1, 0.3), "tread": 0.5})
    shares = (world.Share(shape=stairs, share=3.0), world.Share(shape=catalog.make("waves")))
    expected = terrain.Grid(shapes=shares, levels=2, columns=4, border=1.0, cell=0.1, hardest=0.5, max_step=0.2, seed=4)
    assert grid == expected
    assert [catalog.name_of(shape) for shape in grid.column_shapes] == ["stairs-down"] * 3 + ["waves"]


def test_toml_file_may_build_on_a_preset(tmp_path):
    """A file that names a preset changes only what it says."""
    path = tmp_path / "grid.toml"
    path.write_text('preset = "go1"\nlevels = 3\n')
    assert presets.read_grid(path) == terrain.preset("go1", levels=3)
    path.write_text('preset = "go1"\n[[shape]]\nname = "flat"\n')
    flat = (world.Share(shape=catalog.make("flat")),)
    assert presets.read_grid(path) == dataclasses.replace(terrain.preset("go1"), shapes=flat)
    assert presets.read_grid(path) == terrain.preset("go1", shapes=flat)


def test_dropped_in_file_is_a_preset(tmp_path, monkeypatch):
    """One file in the folder of presets, and nothing else, makes a new preset."""
    (tmp_path / "mine.toml").write_text(TOML)
    monkeypatch.setattr(presets, "_FOLDER", tmp_path)
    assert presets.preset_names() == ["mine"]
    assert terrain.preset("mine", seed=2) == presets.read_grid(tmp_path / "mine.toml", seed=2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("levels = ", r"grid.toml: Invalid value"),
        ("levels = 3", r"it needs a \[\[shape\]\], or preset = one of go1, legged-gym"),
        ('preset = "go2"', r"Unknown preset 'go2'; choose from: go1, legged-gym"),
        ('preset = "go1"\nstep = 3', r"it has 'step', but may have only preset, shape, levels, columns, tile"),
        ('preset = "go1"\nlevels = 2.5', r"levels must be a whole number, got 2.5"),
        ('preset = "go1"\nmax_step = 0.1', r"max_step is 0.1 m, but stairs-up at difficulty 0.9 has steps of 0.167 m"),
        ('[[shape]]\nname = "stairs"', r"Unknown shape 'stairs'; choose from: discrete, flat"),
        ("[[shape]]\nshare = 1", r"every \[\[shape\]\] needs a name"),
        ('[[shape]]\nname = "flat"\nshare = "all"', r"share must be a number, got 'all'"),
        ('[[shape]]\nname = "flat"\ntile = 4.0', r"the tile of 'flat' is that of the grid"),
        ('[[shape]]\nname = "gap"\nwidth = 1', r"gap: width must be 2 numbers, got 1"),
        ('shape = "flat"', r"shape must be a list of tables, \[\[shape\]\], got 'flat'"),
        ('[shape]\nname = "flat"', r"shape must be a list of tables, \[\[shape\]\], got {'name': 'flat'}"),
        ("shape = 5", r"shape must be a list of tables, \[\[shape\]\], got 5"),
        ("preset = 3", r"Unknown preset '3'"),
    ],
)
def test_toml_file_is_refused_with_a_reason(tmp_path, text, message):
    """Whatever is wrong with a file gives one sentence that begins with its name."""
    path = tmp_path / "grid.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        presets.read_grid(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)
