"""Imports ground from other programs: meshes, grey pictures and arrays of heights become a terrain."""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from deimos.kernels.ray_cast import SNAP

from deimos.checks import check_positive, check_range
from deimos.files import first_line, load_arrays, open_file

from .export import GREY_NOTE
from .grid import FARTHEST, Terrain, check_heights, on_ground
from .heightfield import rasterise
from .mesh import from_triangles
from .world import BYTES_PER_SAMPLE, require_memory

RESOLUTION = 0.05  # [m]; the finest that robots walk on
FINEST = 1e-6  # [m]
BYTES_PER_TILE = 100  # its origin, and what it is made from
OPTIONS = {
    **dict.fromkeys((".glb", ".obj", ".ply", ".stl"), ("resolution", "scale", "tile")),
    ".png": ("resolution", "height_range", "tile"),
    **dict.fromkeys((".npy", ".npz"), ("resolution", "tile")),
}
"""Options of ``import_file``, by the ending of the file."""

_Field = tuple[np.ndarray, float, tuple[float, float]]  # heights, cell and corner of a ``Terrain``


def import_file(
    path: str | Path,
    *,
    resolution: float | None = None,
    height_range: tuple[float, float] | None = None,
    scale: float | None = None,
    tile: float | None = None,
    device: str = "cpu",
) -> Terrain:
    """A terrain from a file of another program or of ``deimos terrain``. The file's ending gives its format.

    ``.stl``, ``.obj``, ``.ply``, ``.glb``
        A mesh with z up (y in ``.glb``), which keeps its position. Its highest faces count; they must cover its extent.
    ``.png``
        Heights as 8- or 16-bit grey values, arranged as on a map: x to the right, y up.
    ``.npy``, ``.npz``
        An array of heights [m] with x along the first axis and y along the second, or a saved terrain.

    Files of ``deimos terrain`` give their heights back: meshes and arrays exactly, at the resolution of their making,
    pictures to half a grey value. Such pictures store their position, ``resolution`` and ``height_range``. Other
    pictures, and arrays, are put around the origin.

    Args:
        path: The file.
        resolution: Distance between samples [m], positive; by default 0.05, or a picture's own.
        height_range: Heights of the lowest and the highest possible grey value [m]; by default a picture's own.
        scale: Length of a mesh's unit [m], positive, such as 0.001 for millimetres; by default 1.
        tile: Side of the tiles in whose middles robots start [m], positive; by default there is one, in the middle.
        device: Warp device that rasterises a mesh.

    Returns:
        The terrain. Its columns have the file's name; the difficulty of its levels is unknown, and set to 0.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If it is not such a file, or an argument is out of its range or does not apply to it.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in OPTIONS:
        raise ValueError(f"A file to import must end in one of {', '.join(OPTIONS)}, got {path}.")
    is_terrain = ending == ".npz" and _is_terrain(path)
    options = {"resolution": resolution, "height_range": height_range, "scale": scale, "tile": tile}
    _check_options(path, () if is_terrain else OPTIONS[ending], options)
    if is_terrain:
        return Terrain.load(path)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # infinite and NaN heights are refused
            if ending == ".png":
                field = _read_picture(path, resolution, height_range)
            elif ending in (".npy", ".npz"):
                field = _read_array(path, resolution or RESOLUTION)
            else:
                field = _read_mesh(path, resolution or RESOLUTION, scale or 1.0, device)
            return _with_tiles(path.stem, field, tile)
    except ValueError as error:
        raise ValueError(f"{path} cannot be imported: {error}") from error
    except MemoryError as error:
        raise ValueError(f"{path} cannot be imported: it does not fit in memory ({first_line(error)}).") from error


def _check_options(path: Path, takes: Sequence[str], options: dict[str, Any]) -> None:
    """Raise ``ValueError`` unless the given options are within their ranges and apply to the file."""
    given = {name: value for name, value in options.items() if value is not None}
    for name in ("resolution", "scale", "tile"):
        check_positive(name, given.get(name, 1.0), finite=True)
    low, high = given.get("height_range", (0.0, 1.0))
    if not -FARTHEST <= low < high <= FARTHEST:
        raise ValueError(
            f"height_range must rise from one height to another, both within {FARTHEST:g} m, got {(low, high)}."
        )
    if unfit := [name for name in given if name not in takes]:
        raise ValueError(f"{unfit[0]} does not apply to {path}, which takes {', '.join(takes) or 'no options'}.")
    check_range("resolution", given.get("resolution", RESOLUTION), FINEST, FARTHEST)


def _is_terrain(path: Path) -> bool:
    """Whether ``Terrain.save`` has written a file."""
    try:
        with open_file(path) as file, zipfile.ZipFile(file) as archive:
            return "schema.npy" in archive.namelist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError):  # also if it is broken
        return False


def _read_mesh(path: Path, cell: float, scale: float, device: str) -> _Field:
    """Rasterise a mesh from its lowest to its highest x and y."""
    import trimesh

    with open_file(path) as file:
        try:
            mesh = trimesh.load_mesh(file, file_type=path.suffix[1:].lower(), process=False, skip_materials=True)
        except Exception as error:  # its readers raise all sorts of errors on broken files
            raise ValueError(f"it is not a mesh, or it is broken ({first_line(error)}).") from error
    if not len(getattr(mesh, "faces", ())):
        raise ValueError("it has no faces.")
    vertices = scale * np.asarray(mesh.vertices, np.float64)
    if path.suffix.lower() == ".glb":  # glTF 2.0, section 3.4: y is up
        vertices = vertices[:, [0, 2, 1]] * [1, -1, 1]
    if not (np.abs(vertices) <= FARTHEST).all():
        raise ValueError(f"its vertices must be finite, and within {FARTHEST:g} m of the origin.")
    unit = cell / SNAP  # removes float32 rounding errors; vertices are rounded to this too
    low, high = (np.round(end(axis=0)[:2] / unit) * unit for end in (vertices.min, vertices.max))
    nx, ny = (int(cells) + 1 for cells in (high - low) / cell + 1e-6)
    if min(nx, ny) < 2:
        raise ValueError(f"it must extend over a cell of {cell:g} m along x and y, got {nx - 1} x {ny - 1} cells.")
    try:
        require_memory((nx, ny), BYTES_PER_SAMPLE * nx * ny, "resolution", cell)
    except ValueError as error:
        length = float((high - low).max())
        way_out = "if its unit is a millimetre, give the scale 0.001."
        raise ValueError(f"{error} The mesh is {length:g} m long; {way_out}") from error
    corner = float(low[0]), float(low[1])
    heights = rasterise(from_triangles(vertices, mesh.faces), corner, cell, (nx, ny), device=device)
    return heights, cell, corner


def _read_picture(path: Path, resolution: float | None, height_range: tuple[float, float] | None) -> _Field:
    """Grey values as heights; the picture's own description applies where the arguments are ``None``."""
    from PIL import Image

    with open_file(path) as file:
        try:
            with Image.open(file) as image:
                mode, grey = image.mode, np.asarray(image)
                note = GREY_NOTE.match(str(image.info.get("Description")))
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise ValueError(f"it is not a picture, or it is broken ({first_line(error)}).") from error
    if mode not in ("L", "I", "I;16"):
        raise ValueError(f"it must have 8- or 16-bit grey values and nothing else, got the mode {mode}.")
    most = 255 if mode == "L" else 65535
    says = {name: float(value) for name, value in note.groupdict().items()} if note else {}
    if height_range is not None:
        low, high = height_range
        says |= {"low": low, "unit": (high - low) / most}
    elif note:
        says["unit"] *= 65535 / most  # another program may have converted it to 8 bits, and kept the note
    if "low" not in says:
        raise ValueError("height_range must be given: the heights of its lowest and its highest grey value [m].")
    heights = says["low"] + says["unit"] * grey[::-1].T.astype(np.float64)
    if resolution is None and note:
        return heights, says["cell"], (says["x"], says["y"])
    return _around_origin(heights, resolution or RESOLUTION)


def _read_array(path: Path, cell: float) -> _Field:
    """The one array of a NumPy file, around the origin."""
    try:
        arrays = [*load_arrays(path).values()]
    except ValueError as error:
        raise ValueError(f"it is not a NumPy file of numbers, or it is broken ({error}).") from error
    if len(arrays) != 1 or arrays[0].ndim != 2 or arrays[0].dtype.kind not in "fiu":
        shapes = ", ".join(f"{array.dtype}{list(array.shape)}" for array in arrays)
        raise ValueError(f"it must hold one array of numbers with two axes, got {shapes}.")
    return _around_origin(arrays[0], cell)


def _around_origin(heights: np.ndarray, cell: float) -> _Field:
    nx, ny = heights.shape
    return heights, cell, (-(nx - 1) * cell / 2, -(ny - 1) * cell / 2)


def _with_tiles(name: str, field: _Field, tile: float | None) -> Terrain:
    """The terrain of a height grid, with as many tiles as fit around its middle."""
    heights, cell, corner = field
    check_heights(heights)
    size = cell * (np.array(heights.shape) - 1)
    side = float(size.min()) if tile is None else tile
    if tile is not None and tile < cell:
        raise ValueError(f"tile must be at least {cell:g} m, the distance between samples, got {tile:g} m.")
    levels, columns = (1, 1) if tile is None else (int(tiles) for tiles in size / side + 1e-6)
    require_memory((levels, columns), BYTES_PER_TILE * levels * columns, "tile", side)
    if min(levels, columns) < 1:
        raise ValueError(f"tile must be at most {size.min():g} m, the shorter side of the ground, got {tile:g} m.")
    index = np.moveaxis(np.indices((levels, columns)), 0, -1)
    middles = corner + size / 2 + side * (index + 0.5 - np.array([levels, columns]) / 2)
    heights = np.ascontiguousarray(heights, np.float32)
    origins = on_ground(middles, heights, cell, corner)
    return Terrain(heights, cell, corner, origins, (name,) * columns, side, np.zeros(levels, np.float32))
