"""A terrain as data: its checks and its file."""

import dataclasses
import zipfile

import numpy as np
import pytest

from deimos import files, terrain
from deimos.checks import RunError


def make_terrain(**changes):
    """Two levels of two columns, with random heights."""
    rng = np.random.default_rng(0)
    values = {
        "heights": rng.normal(size=(41, 61)).astype(np.float32),
        "cell": 0.1,
        "corner": (-2.0, -3.0),
        "origins": rng.normal(size=(2, 2, 3)).astype(np.float32),
        "shapes": ("stairs-up", "flat"),
        "tile": 2.0,
        "difficulty": np.array([0.0, 0.9], np.float32),
    }
    return terrain.Terrain(**(values | changes))


def test_file_gives_the_terrain_back(tmp_path):
    """What is saved is loaded with every bit and every type."""
    ground = make_terrain()
    ground.save(tmp_path / "ground.npz")
    loaded = terrain.load(tmp_path / "ground.npz")
    for field in dataclasses.fields(ground):
        a, b = getattr(ground, field.name), getattr(loaded, field.name)
        assert type(a) is type(b)
        if isinstance(a, np.ndarray):
            assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
        else:
            assert a == b
    assert loaded.size == pytest.approx((4.0, 6.0))


def test_file_has_the_same_bytes_every_time(tmp_path, monkeypatch):
    """Saving again, under another name and at another time, gives the same bytes."""
    make_terrain().save(tmp_path / "a.npz")
    monkeypatch.setattr("time.time", lambda: 2e9)
    make_terrain().save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz"]


def test_failed_write_leaves_what_was_there(tmp_path):
    """When writing fails half-way, the old file stays and no part of the new one remains."""
    path = tmp_path / "ground.npz"
    path.write_bytes(b"before")

    def fail(file):
        file.write(b"half")
        raise OSError("disk full")

    with pytest.raises(RunError, match="disk full"):
        files.write_whole(path, fail)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def damaged(path):
    """A terrain file with a flipped byte in its heights."""
    make_terrain().save(path)
    data = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        data[archive.getinfo("heights.npy").header_offset + 2000] ^= 0xFF
    path.write_bytes(data)


def of_another_version(path):
    """A terrain file of a schema to come."""
    make_terrain().save(path)
    with np.load(path) as file:
        np.savez(path, **(dict(file) | {"schema": 99}))


@pytest.mark.parametrize(
    "spoil",
    [
        damaged,
        of_another_version,
        lambda path: path.write_bytes(b""),
        lambda path: path.write_text("not a terrain"),
        lambda path: np.savez(path, heights=np.zeros((2, 2))),
        lambda path: np.savez(path, schema=1, heights=np.zeros((2, 2)), more=1),
        lambda path: path.write_bytes(b"PK\x03\x04"),
    ],
)
def test_foreign_and_broken_files_are_refused(tmp_path, spoil):
    """Whatever is not a whole terrain file gives one sentence that names the file."""
    path = tmp_path / "ground.npz"
    spoil(path)
    with pytest.raises(ValueError, match=r"ground\.npz is not a terrain file of version 1, or it is broken \("):
        terrain.load(path)


def test_missing_file_is_an_os_error(tmp_path):
    """A file that is not there is reported as such."""
    with pytest.raises(FileNotFoundError):
        terrain.load(tmp_path / "nothing.npz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"heights": np.zeros((41, 61))}, r"heights must be float32 of shape \(41, 61\), got float64"),
        (
            {"heights": np.zeros((1, 61), np.float32)},
            r"heights must have at least 2 x 2 samples, got the shape \(1, 61",
        ),
        ({"heights": np.full((41, 61), np.nan, np.float32)}, "heights must be finite everywhere"),
        (
            {"origins": np.zeros((2, 3, 3), np.float32)},
            r"origins must be float32 of shape \(2, 2, 3\), got .* \(2, 3, 3",
        ),
        ({"difficulty": np.zeros((2, 1), np.float32)}, r"difficulty must be float32 of shape \(2,\)"),
        ({"cell": 0.0}, "cell must be finite and positive, got 0.0"),
        ({"tile": float("nan")}, "tile must be finite and positive, got nan"),
    ],
)
def test_arrays_must_fit_together(changes, message):
    """A terrain whose parts contradict each other cannot be made."""
    with pytest.raises(ValueError, match=message):
        make_terrain(**changes)


def test_flat_is_flat():
    """A plain has one tile around the origin, at height 0, with samples on both ends."""
    ground = terrain.flat(3.0, 0.25)
    assert ground.heights.shape == (13, 13)
    assert not ground.heights.any()
    assert not ground.origins.any()
    assert (ground.corner, ground.shapes, ground.tile, ground.size) == ((-1.5, -1.5), ("flat",), 3.0, (3.0, 3.0))


def test_flat_needs_a_cell_that_divides_it():
    """A cell that does not divide the side is refused with one that does."""
    with pytest.raises(ValueError, match=r"cell must divide size = 8 m, got 0.3 m; 0.296296 m would do"):
        terrain.flat(8.0, 0.3)
