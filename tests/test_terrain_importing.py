"""Ground from files: our own come back as they were, and others are what they say."""

import dataclasses
import re
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from deimos.terrain import export, importing
from deimos.terrain.importing import import_file
from deimos.terrain.mesh import rings
from deimos.terrain.world import build_with_mesh
from PIL import Image, PngImagePlugin

from deimos import terrain

SMALL = {"levels": 2, "columns": 20, "border": 1.3}  # every shape of the preset, and a corner that float32 cannot hold


@pytest.fixture(scope="module")
def ground():
    """A terrain and its mesh."""
    return build_with_mesh(terrain.preset("go1", **SMALL))


@pytest.mark.parametrize("ending", importing.OPTIONS)
def test_our_own_files_give_their_heights_back(tmp_path, ground, ending):
    """Meshes and arrays come back to the bit, in their place; a picture to half a grey value, and then for ever."""
    original, mesh = ground
    path = tmp_path / f"hills{ending}"
    if ending == ".npy":
        np.save(path, original.heights)
    else:
        export.save(path, original, mesh)
    found = import_file(path)
    np.testing.assert_allclose(found.corner, original.corner, rtol=0, atol=1e-9)
    assert found.cell == original.cell
    assert found.heights.dtype == np.float32
    if ending == ".png":
        _, _, unit = export.grey(original)
        assert found.heights.shape == original.heights.shape
        assert np.abs(found.heights - original.heights).max() <= 0.5 * unit * (1 + 1e-3)
        export.save(tmp_path / "again.png", found, mesh)
        assert (tmp_path / "again.png").read_bytes() == path.read_bytes()
    else:
        assert found.heights.tobytes() == original.heights.tobytes()
    if ending == ".npz":  # nothing is lost
        for field in dataclasses.fields(original):
            np.testing.assert_array_equal(getattr(found, field.name), getattr(original, field.name))
    else:
        assert found.shapes == ("hills",)
        middle = found.heights[tuple(np.array(found.heights.shape) // 2)]
        np.testing.assert_allclose(found.origins[0, 0], (0.0, 0.0, middle), atol=1e-6)


def test_imported_terrain_is_a_terrain_file(tmp_path, ground):
    """What was imported is saved and loaded like any other terrain."""
    export.save(tmp_path / "a.stl", *ground)
    found = import_file(tmp_path / "a.stl")
    found.save(tmp_path / "a.npz")
    assert terrain.load(tmp_path / "a.npz").heights.tobytes() == found.heights.tobytes()


def test_unit_and_resolution_of_a_mesh(tmp_path):
    """A mesh in millimetres is scaled along all axes, and sampled as finely as it is asked."""
    block = rings(np.array([1000.0, 500.0]), np.array([0.0, 200.0]))  # [mm]
    (tmp_path / "block.stl").write_bytes(block.export(file_type="stl"))
    found = import_file(tmp_path / "block.stl", scale=0.001, resolution=0.1)
    expected = np.zeros((21, 21), np.float32)
    expected[5:16, 5:16] = 0.2
    np.testing.assert_allclose(found.heights, expected, rtol=1e-6)
    assert found.corner == pytest.approx((-1.0, -1.0))
    assert found.cell == 0.1


def test_mesh_that_no_cell_divides_ends_within(tmp_path):
    """The last sample is the last one above the mesh, and a mesh keeps its place far from the origin."""
    block = rings(np.array([1.03, 0.5]), np.array([0.0, 0.2]))
    block.vertices += [10.0, -20.0, 3.0]
    (tmp_path / "block.obj").write_text(block.export(file_type="obj"))
    found = import_file(tmp_path / "block.obj", resolution=0.1)
    assert found.heights.shape == (21, 21)
    assert found.corner == pytest.approx((8.97, -21.03), abs=1e-4)
    np.testing.assert_allclose(np.unique(found.heights), [3.0, 3.2], rtol=1e-6)
    np.testing.assert_allclose(found.origins[0, 0], [9.97, -20.03, 3.2], atol=1e-4)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_picture_of_another_program(tmp_path, dtype):
    """Black is the lowest height and white the highest; x points to the right and y up."""
    most = np.iinfo(dtype).max
    grey = np.zeros((3, 5), dtype)
    grey[0, 4] = most  # the upper right corner
    grey[2, 1] = most // 5
    Image.fromarray(grey).save(tmp_path / "map.png")
    found = import_file(tmp_path / "map.png", height_range=(-1.0, 4.0), resolution=0.5)
    expected = np.full((5, 3), -1.0)
    expected[4, 2], expected[1, 0] = 4.0, 0.0
    np.testing.assert_allclose(found.heights, expected, atol=1e-6)
    assert (found.cell, found.corner) == (0.5, (-1.0, -0.5))


def test_arguments_come_before_what_a_picture_says(tmp_path, ground):
    """A picture of ours takes other heights and another resolution, and then lies around the origin."""
    export.save(tmp_path / "a.png", *ground)
    found = import_file(tmp_path / "a.png", height_range=(0.0, 1.0), resolution=0.1)
    assert (found.heights.min(), found.heights.max()) == (0.0, 1.0)
    nx, ny = ground[0].heights.shape
    assert (found.cell, found.corner) == (0.1, pytest.approx((-(nx - 1) * 0.05, -(ny - 1) * 0.05)))


def test_a_picture_of_ours_that_became_one_of_8_bits(tmp_path, ground):
    """Where another program keeps the note and half of the bits, heights come back to half of the larger grey value."""
    export.save(tmp_path / "a.png", *ground)
    with Image.open(tmp_path / "a.png") as image:
        note, grey = PngImagePlugin.PngInfo(), np.asarray(image)
        note.add_text("Description", image.info["Description"])
    Image.fromarray(np.rint(grey / 257).astype(np.uint8)).save(tmp_path / "b.png", pnginfo=note)
    found, heights = import_file(tmp_path / "b.png"), ground[0].heights
    assert found.corner == ground[0].corner
    np.testing.assert_allclose(found.heights, heights, rtol=0, atol=0.51 * np.ptp(heights) / 255)


def test_tiles_are_laid_around_the_middle(tmp_path):
    """As many tiles as fit; robots start in their middles, on the ground, and columns have the file's name."""
    heights = np.arange(41)[:, None] + 100.0 * np.arange(21)[None, :]
    np.save(tmp_path / "ramp.npy", heights)
    found = import_file(tmp_path / "ramp.npy", resolution=0.5, tile=4.0)  # 20 m x 10 m
    assert found.origins.shape == (5, 2, 3)
    np.testing.assert_allclose(found.origins[:, 0, 0], [-8, -4, 0, 4, 8])
    np.testing.assert_allclose(found.origins[0, :, 1], [-2, 2])
    assert found.origins[0, 0, 2] == heights[4, 6]
    assert (found.shapes, found.tile, found.difficulty.tolist()) == (("ramp", "ramp"), 4.0, [0.0] * 5)


def broken(path):
    """A file of no kind."""
    path.write_bytes(b"solid nothing at all\x00\x01")


def cut_off(path):
    """A picture that was not written to its end."""
    Image.fromarray(np.random.default_rng(0).integers(0, 2**16, (64, 64), np.uint16)).save(path)
    path.write_bytes(path.read_bytes()[:5000])


def upright(path):
    """A mesh that nothing can stand on."""
    mesh = rings(np.array([1.0]), np.zeros(1))
    mesh.vertices[:, 1] = 0.0
    path.write_bytes(mesh.export(file_type="stl"))


def with_a_hole(path):
    """A mesh that does not cover its extent."""
    mesh = rings(np.array([1.0, 0.5]), np.array([0.0, 0.2]))
    mesh.faces = mesh.faces[2:]
    path.write_bytes(mesh.export(file_type="stl"))


def of_other_things(name):
    """A function that makes a zip archive of a file that is no array."""

    def make(path):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(name, "hello")

    return make


def boundless(path):
    """A NumPy file whose header promises 728 TiB."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000, 10000000), }".ljust(117) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00v\x00" + header)


def sound(path):
    """A mesh with nothing wrong."""
    path.write_bytes(rings(np.array([1.0, 0.5]), np.array([0.0, 0.2])).export(file_type="stl"))


FLAT = partial(np.save, arr=np.zeros((50, 50)))


@pytest.mark.parametrize(
    ("name", "make", "options", "message"),
    [
        ("a.npz", of_other_things("a.txt"), {}, "it is not a NumPy file of numbers, or it is broken (EOF"),
        ("a.npz", of_other_things("schema.npy"), {}, "is not a terrain file of version 1, or it is broken"),
        ("a.npy", boundless, {}, "float64[10000000, 10000000] takes 800000000000000 bytes, got 0)"),
        ("a.npy", lambda path: np.save(path, np.full((3, 3), 1e300)), {}, "heights must be finite everywhere, and"),
        ("a.npy", FLAT, {"tile": 1e-9}, "tile must be at least 0.05 m, the distance between samples, got 1e-09 m"),
        ("a.npy", FLAT, {"resolution": 1e300}, "resolution must be in [1e-06, 1e+06], got 1e+300"),
        ("a.stl", sound, {"resolution": 1e-320}, "resolution must be in [1e-06, 1e+06], got 1e-320"),
        ("a.stl", sound, {"scale": 1e308}, "its vertices must be finite, and within 1e+06 m of the origin"),
        ("a.png", lambda path: Image.new("L", (3, 3)).save(path), {"height_range": (0, 1e308)}, "both within 1e+06 m"),
        ("a.xyz", broken, {}, "must end in one of .glb, .obj, .ply, .stl, .png, .npy, .npz, got"),
        *((f"a{ending}", broken, {}, "cannot be imported: it ") for ending in importing.OPTIONS),
        ("a.png", cut_off, {"height_range": (0, 1)}, "it is not a picture, or it is broken (image file is truncated"),
        ("a.stl", upright, {}, "it must extend over a cell of 0.05 m along x and y, got 40 x 0"),
        ("a.stl", with_a_hole, {}, "mesh must cover the grid, but there is nothing above x = "),
        ("a.stl", with_a_hole, {"resolution": 1e-5}, "resolution must be at least 0.000122 m for at most 16384 cells"),
        ("a.stl", with_a_hole, {"scale": 1000.0}, "The mesh is 2000 m long; if its unit is a millimetre, give"),
        ("a.stl", with_a_hole, {"height_range": (0, 1)}, "height_range does not apply to"),
        ("a.npy", lambda path: np.save(path, np.zeros((3, 3))), {"scale": 2.0}, "takes resolution, tile"),
        ("a.npy", lambda path: np.save(path, np.zeros((3, 3))), {"resolution": -1.0}, "resolution must be finite and"),
        ("a.npy", lambda path: np.save(path, np.zeros((3, 3))), {"tile": 4.0}, "tile must be at most 0.1 m"),
        ("a.npy", lambda path: np.save(path, np.zeros((3, 3, 3))), {}, "one array of numbers with two axes, got float"),
        ("a.npy", lambda path: np.save(path, np.full((3, 3), np.nan)), {}, "heights must be finite everywhere"),
        ("a.npy", lambda path: np.save(path, np.zeros((1, 3))), {}, "heights must have at least 2 x 2 samples"),
        ("a.npz", lambda path: np.savez(path, a=np.zeros(2), b=np.zeros(2)), {}, "got float64[2], float64[2]"),
        ("a.npz", lambda path: terrain.flat().save(path), {"tile": 2.0}, "which takes no options"),
        ("a.png", lambda path: Image.new("L", (3, 3)).save(path), {}, "height_range must be given: the heights of its"),
        ("a.png", lambda path: Image.new("RGB", (3, 3)).save(path), {"height_range": (0, 1)}, "got the mode RGB"),
        ("a.png", lambda path: Image.new("L", (3, 3)).save(path), {"height_range": (1, 0)}, "height_range must rise"),
    ],
)  # fmt: skip
def test_refuses_with_a_reason(tmp_path, name, make, options, message):
    """Whatever cannot be imported gives one sentence that says why."""
    make(tmp_path / name)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        import_file(tmp_path / name, **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("ending", importing.OPTIONS)
def test_missing_file_is_an_os_error(tmp_path, ending):
    """A file that is not there is reported as such."""
    with pytest.raises(FileNotFoundError):
        import_file(Path(tmp_path / f"nothing{ending}"))
