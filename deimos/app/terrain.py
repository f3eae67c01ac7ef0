"""``deimos terrain``: generate terrain as meshes, height grids, MuJoCo models and pictures."""

import dataclasses
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from deimos.app import console
from deimos.checks import RunError, check_range
from deimos.files import require_place
from deimos.terrain import catalog, export, presets
from deimos.terrain.grid import Terrain
from deimos.terrain.importing import import_file
from deimos.terrain.mesh import Mesh, highest_riser, sheet, steepest_slope
from deimos.terrain.preview import save_preview
from deimos.terrain.shape import TileShape
from deimos.terrain.world import Grid, Share, build_with_mesh


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outputs:
    """What is written."""

    out: tuple[Path, ...] = ()
    """Files: .stl, .obj, .ply or .glb for the mesh, .npz for Deimos, .png for heights as 16-bit grey values."""
    mjcf: Path | None = None
    """Folder for a MuJoCo model; python -m mujoco.viewer --mjcf=FOLDER/terrain.xml shows it."""
    preview: Path | None = None
    """PNG file for a picture: shaded relief from above and an oblique view."""
    force: bool = False
    """Overwrite what exists."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileOptions(Outputs):
    """Options of a single tile besides the parameters of its shape."""

    difficulty: float = 0.5
    """From 0, the easiest, to 1."""
    seed: int = 0
    """Seed of what is random, at least 0."""
    cell: float = 0.05
    """Distance between two samples of the height grid [m]; must divide tile and border."""
    border: float = 0.0
    """Width of the flat border around the tile [m], at least 0."""
    max_step: float = float("inf")
    """Highest step that is allowed [m]."""

    def __post_init__(self) -> None:
        """Leave the checks to the shape and the grid that are made from it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GridOptions(Outputs):
    """Build a grid: levels of rising difficulty along x, a column for each shape along y."""

    preset: str | None = None
    """go1 (the default) or legged-gym."""
    file: Path | None = None
    """TOML file with fields of the grid and a [[shape]] table for each shape; excludes --preset."""
    shapes: tuple[str, ...] = ()
    """Names of shapes that share the columns evenly, instead of those of the preset."""
    seed: int | None = None
    """Seed of all tiles, at least 0."""
    difficulty: tuple[float, float] | None = None
    """Difficulty of the first level and of the last, each in [0, 1]; a single level has the first."""
    levels: int | None = None
    """Tiles along x, at least 1."""
    columns: int | None = None
    """Tiles along y, at least 1; with --shapes one for each by default."""
    tile: float | None = None
    """Side of a tile [m]."""
    border: float | None = None
    """Width of the flat border [m], at least 0; with --shapes 1 by default."""
    cell: float | None = None
    """Distance between two samples of the height grid [m]; must divide tile and border. Robots need at least 0.05 m."""
    max_step: float | None = None
    """Highest step that any shape may have [m]."""

    def grid(self) -> Grid:
        """The grid that is asked for."""
        names = ("seed", "levels", "columns", "tile", "border", "cell", "max_step")
        changes: dict[str, Any] = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        if self.difficulty is not None:
            changes["easiest"], changes["hardest"] = self.difficulty
        if self.file is not None and (self.preset is not None or self.shapes):
            raise RunError("file excludes preset and shapes; name them in the file.")
        if self.file is not None:
            return presets.read_grid(self.file, **changes)
        if not self.shapes:
            return presets.preset(self.preset or "go1", **changes)
        if self.preset is not None:
            raise RunError("shapes excludes preset; give one of them.")
        shares = tuple(Share(shape=catalog.make(name)) for name in self.shapes)
        return Grid(shapes=shares, **({"columns": len(shares), "border": 1.0} | changes))


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImportOptions(Outputs):
    """Make a terrain from a mesh, a grey picture or an array of heights, for --env.terrain and for other programs.

    Without --out, --mjcf and --preview it is written to NAME.npz here. What deimos terrain wrote comes back exactly.
    """

    file: tyro.conf.Positional[Path]
    """STL, OBJ, PLY or GLB mesh with z up (y in GLB), PNG height map, or NumPy array of heights [m], x along axis 0."""
    resolution: float | None = None
    """Distance between two samples of the height grid [m], positive. By default as stored in the picture, or 0.05."""
    height_range: tuple[float, float] | None = None
    """Heights of a picture's lowest and highest possible grey value [m]. By default as stored in it."""
    scale: float | None = None
    """Length of a mesh's unit [m], positive: 0.001 for millimetres. By default 1."""
    tile: float | None = None
    """Side of the tiles in whose middles robots start [m], positive. By default there is one, in the middle."""


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos terrain``."""
    commands = {
        "list": ("show the shapes with their parameters, and the presets", show_list),
        "shape": ("build one tile: deimos terrain shape stairs-up --out stairs.stl --preview stairs.png", build_shape),
        "grid": ("build a grid of tiles, from a preset, a TOML file or a list of shapes", build_grid),
        "import": ("make a terrain from an STL, OBJ, PLY, GLB, PNG or NumPy file", import_terrain),
    }
    about = "Generates terrain for legged robots: triangle meshes, height grids, MuJoCo models, pictures."
    try:
        console.dispatch(commands, about, arguments, program)
    except ValueError as error:  # a value that the terrain cannot have
        raise RunError(str(error)) from error
    except MemoryError as error:
        raise RunError("There is not enough memory; enlarge cell, or ask for fewer levels or columns.") from error


@dataclasses.dataclass(frozen=True)
class ListOptions:
    """Show the shapes with their parameters, and the presets; ``deimos terrain shape NAME --help`` explains them."""


def show_list(arguments: list[str], program: str) -> None:
    """Print every shape with its parameters and their defaults, and the presets."""
    console.parse(ListOptions, arguments, program)
    for name in catalog.names():
        shape = catalog.make(name)
        print(f"{name}: {_about(shape)}")
        print("   ", *[f"--{key} {_spelled(getattr(shape, key))}" for key in shape.parameters()])
    for name in presets.preset_names():
        grid = presets.preset(name)
        parts = ", ".join(f"{part.share:g} {catalog.name_of(part.shape)}" for part in grid.shapes)
        print(f"preset {name}: {grid.levels} x {grid.columns} tiles; {parts}")


def _spelled(value: Any) -> str:
    return " ".join(f"{number:g}" for number in value) if isinstance(value, tuple) else f"{value:g}"


def build_shape(arguments: list[str], program: str) -> None:
    """Build one tile, of the shape that the first argument names."""
    commands = {name: (_about(catalog.make(name)), partial(_build_tile, name)) for name in catalog.names()}
    console.dispatch(commands, "Builds one tile of a shape.", arguments, program)


def _about(shape: TileShape) -> str:
    return (shape.__doc__ or "").splitlines()[0]


def _build_tile(name: str, arguments: list[str], program: str) -> None:
    default = catalog.make(name)
    options = console.parse(_tile_options(default), arguments, program)
    check_range("difficulty", options.difficulty, 0, 1)
    shape = catalog.make(name, {key: getattr(options, key) for key in default.parameters()})
    grid = Grid(
        shapes=(Share(shape=shape),), levels=1, columns=1, tile=options.tile, border=options.border, cell=options.cell,
        easiest=options.difficulty, hardest=options.difficulty, max_step=options.max_step, seed=options.seed,
    )  # fmt: skip
    _make(grid, options, f"{name}, difficulty {options.difficulty:g}, seed {options.seed}")


def _tile_options(shape: TileShape) -> type:
    """``TileOptions`` with the parameters of a shape, whose direction is in its name."""
    direction = [("direction", tyro.conf.Suppress[str], shape.direction)] if hasattr(shape, "direction") else []
    return dataclasses.make_dataclass(
        "ShapeOptions", direction, bases=(TileOptions, type(shape)), frozen=True, kw_only=True,
        namespace={"__doc__": f"{catalog.name_of(shape)}: {_about(shape)}"},
    )  # fmt: skip


def build_grid(arguments: list[str], program: str) -> None:
    """Build a grid."""
    options: GridOptions = console.parse(GridOptions, arguments, program)
    grid = options.grid()
    _make(grid, options, f"{grid.levels} x {grid.columns} tiles of {grid.tile:g} m, seed {grid.seed}")


def _make(grid: Grid, outputs: Outputs, title: str) -> None:
    """Check, build, write and report; nothing is built where something could not be written."""
    _check_outputs(outputs)
    console.quiet_warp()
    start = time.perf_counter()
    with console.progress("terrain") as progress:
        terrain, mesh = build_with_mesh(grid, progress=progress)
        seconds = time.perf_counter() - start
        files = _write(terrain, mesh, outputs, title, progress)
    levels = f"{grid.easiest:g} to {grid.hardest:g} in {grid.levels} levels"
    report = _measure(terrain, mesh) | {
        "columns": _columns(grid),
        "difficulty": f"{grid.easiest:g}" if grid.levels == 1 else levels,
        "highest riser [m]": f"{highest_riser(mesh):.3f}",
        "time [s]": f"{seconds:.2f}",
    }
    print(title, *[f"{name:18} {value}" for name, value in report.items()], *files, sep="\n")


def _columns(grid: Grid) -> str:
    """How many columns every shape gets: with few of them, a small share may be none."""
    counts = Counter(map(catalog.name_of, grid.column_shapes))
    return ", ".join(f"{counts[name]} {name}" for name in dict.fromkeys(catalog.name_of(p.shape) for p in grid.shapes))


def import_terrain(arguments: list[str], program: str) -> None:
    """Make a terrain from another program's file."""
    options: ImportOptions = console.parse(ImportOptions, arguments, program)
    if not (options.out or options.mjcf or options.preview):
        options = dataclasses.replace(options, out=(Path(f"{options.file.stem}.npz"),))
    _check_outputs(options)
    console.quiet_warp()
    with console.progress("terrain") as progress:
        names = ("resolution", "height_range", "scale", "tile")
        terrain = import_file(options.file, **{name: getattr(options, name) for name in names})
        x, y = (low + terrain.cell * np.arange(n) for low, n in zip(terrain.corner, terrain.heights.shape, strict=True))
        mesh = sheet(x, y, terrain.heights)
        files = _write(terrain, mesh, options, options.file.name, progress)
    levels, columns = terrain.origins.shape[:2]
    report = _measure(terrain, mesh) | {"tiles": f"{levels} x {columns} of {terrain.tile:g} m"}
    print(options.file.name, *[f"{name:18} {value}" for name, value in report.items()], *files, sep="\n")


def _write(
    terrain: Terrain, mesh: Mesh, outputs: Outputs, title: str, progress: Callable[[str, float], None]
) -> list[Path]:
    """Write all outputs; returns where they are."""
    jobs: dict[Path, Callable[[], None]] = {path: partial(export.save, path, terrain, mesh) for path in outputs.out}
    if outputs.mjcf:
        jobs[outputs.mjcf] = partial(export.save_mjcf, outputs.mjcf, terrain)
    if outputs.preview:
        jobs[outputs.preview] = partial(save_preview, outputs.preview, terrain, title)
    for number, (path, job) in enumerate(jobs.items()):
        progress(f"writing {path.name}", number / len(jobs))
        job()
    return list(jobs)


def _measure(terrain: Terrain, mesh: Mesh) -> dict[str, str]:
    """The facts to report about any terrain."""
    low, high = float(terrain.heights.min()) + 0.0, float(terrain.heights.max()) + 0.0  # no -0
    nx, ny = terrain.heights.shape
    return {
        "extents [m]": " x ".join(f"{size:.3g}" for size in (*terrain.size, high - low)),
        "heights [m]": f"{low:.3f} to {high:.3f}",
        "steepest slope": f"{steepest_slope(mesh):.3f} rise over run",
        "mesh": f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces",
        "height grid": f"{nx:,} x {ny:,} samples, {terrain.cell:g} m apart",
    }


def _check_outputs(outputs: Outputs) -> None:
    """Raise ``RunError`` unless everything can be written."""
    for path in outputs.out:
        if path.suffix.lower() not in export.ENDINGS:
            raise RunError(f"out must end in one of {', '.join(export.ENDINGS)}, got {path}.")
    preview, mjcf = outputs.preview, outputs.mjcf
    if preview and preview.suffix.lower() != ".png":
        raise RunError(f"preview must end in .png, got {preview}.")
    if mjcf and mjcf.exists() and not mjcf.is_dir():
        raise RunError(f"mjcf must be a folder, but {mjcf} is a file.")
    files = [*outputs.out, *filter(None, [preview])]
    inside = [mjcf / name for name in export.MJCF_FILES] if mjcf else []
    for path in [*files, *(inside if mjcf is None or mjcf.exists() else [mjcf])]:
        require_place(path)
    files += inside
    for number, path in enumerate(files):
        if path in files[:number]:
            raise RunError(f"{path} is named twice.")
        if path.exists() and not outputs.force:
            raise RunError(f"{path} exists and is not overwritten; choose another name, or add --force.")
