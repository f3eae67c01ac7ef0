"""The terrain generator: ``python -m terrain``."""

import dataclasses
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import tyro

from . import catalog, console, export, presets
from .checks import check_range
from .grid import Terrain
from .mesh import highest_riser, steepest_slope
from .world import Grid, Share, build_with_mesh, require_memory

if TYPE_CHECKING:
    from trimesh import Trimesh

USAGE = """Makes ground for legged robots: triangle meshes, height grids, MuJoCo models, pictures.

usage: {program} COMMAND [OPTIONS]

commands:
  list           the shapes and their parameters, and the presets
  shape NAME     build one tile of a shape
  grid           build a grid of many tiles, from a preset, a TOML file or a list of shapes
  bench          measure the speed of the making

Every command explains its options with --help.

examples:
  {program} shape stairs-up --difficulty 0.5 --out stairs.stl --preview stairs.png
  {program} grid --preset go1 --seed 1 --out ground.npz ground.glb --mjcf ground"""


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
    """Difficulty of the first level and of the last, each in [0, 1]."""
    levels: int | None = None
    """Tiles along x, at least 1."""
    columns: int | None = None
    """Tiles along y, at least 1; with --shapes one for each by default."""
    tile: float | None = None
    """Side of a tile [m]."""
    border: float | None = None
    """Width of the level border [m], at least 0."""
    cell: float | None = None
    """Distance of two samples of the height grid [m]; must divide tile and border. Robots take none below 0.05 m."""
    max_step: float | None = None
    """Highest step that any shape may have [m]."""

    def grid(self) -> Grid:
        """The grid that is asked for."""
        names = ("seed", "levels", "columns", "tile", "border", "cell", "max_step")
        changes: dict[str, Any] = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        if self.difficulty is not None:
            changes["easiest"], changes["hardest"] = self.difficulty
        if self.file is not None and (self.preset is not None or self.shapes):
            raise console.UsageError("file excludes preset and shapes; name them in the file.")
        if self.file is not None:
            return presets.read_grid(self.file, **changes)
        if self.shapes:
            if self.preset is not None:
                raise console.UsageError("shapes excludes preset; give one of them.")
            shares = tuple(Share(shape=catalog.make(name)) for name in self.shapes)
            return Grid(shapes=shares, **({"columns": len(shares), "border": 1.0} | changes))
        return presets.preset(self.preset or "go1", **changes)


def main(arguments: list[str] | None = None, program: str = "python -m terrain") -> int:
    """Run the tool; returns the exit code.

    Args:
        arguments: The command line; ``None`` for that of the process.
        program: How the tool is called, for its messages.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    commands = {"list": show_list, "shape": build_shape, "grid": build_grid, "bench": run_bench}
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE.format(program=program))
        return 0
    name, rest = arguments[0], arguments[1:]

    def command() -> None:
        if name not in commands:
            raise console.UsageError(f"There is no command '{name}'; there are: {', '.join(commands)}.")
        commands[name](rest, f"{program} {name}")

    return console.run(command, program)


def show_list(arguments: list[str], program: str) -> None:
    """Print every shape with its parameters, their defaults and their meaning, and the presets."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    @dataclasses.dataclass(frozen=True)
    class ListOptions:
        """Show the shapes with their parameters, and the presets."""

    console.parse(ListOptions, arguments, program)
    screen = Console(highlight=False, markup=False)
    by_class: dict[type, list[str]] = {}
    for name in catalog.names():
        by_class.setdefault(catalog.shape_class(name), []).append(name)
    for cls, names in by_class.items():
        screen.print(", ".join(names), style="bold")
        screen.print(" ".join((cls.__doc__ or "").split("\n\n")[0].split()))
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 2))
        docs = console.field_docs(cls)
        for field in dataclasses.fields(cls):
            if field.name != "direction":
                table.add_row(f"--{field.name}", _words(field.default), Text(docs[field.name]))
        screen.print(table)
        screen.print()
    for name in presets.preset_names():
        grid = presets.preset(name)
        parts = ", ".join(f"{part.share:g} {catalog.name_of(part.shape)}" for part in grid.shapes)
        screen.print(f"preset {name}: {grid.levels} x {grid.columns} tiles; {parts}")


def build_shape(arguments: list[str], program: str) -> None:
    """Build one tile."""
    if not arguments or arguments[0].startswith("-"):
        if "--help" in arguments or "-h" in arguments:
            print(f"usage: {program} NAME [OPTIONS]\n\nNAME is one of: {', '.join(catalog.names())}.\n"
                  f"{program} NAME --help explains its parameters.")  # fmt: skip
            return
        raise console.UsageError(f"shape needs a name first, one of: {', '.join(catalog.names())}.")
    name = arguments[0]
    options = console.parse(_shape_options(name), arguments[1:], f"{program} {name}")
    known = {field.name for field in dataclasses.fields(catalog.shape_class(name))} - {"direction"}
    shape = catalog.make(name, {key: getattr(options, key) for key in known})
    check_range("difficulty", options.difficulty, 0, 1)
    grid = Grid(
        shapes=(Share(shape=shape),), levels=1, columns=1, tile=options.tile, border=options.border,
        cell=options.cell, easiest=options.difficulty, hardest=options.difficulty, max_step=options.max_step,
        seed=options.seed,
    )  # fmt: skip
    _make(grid, options, f"{name}, difficulty {options.difficulty:g}, seed {options.seed}")


def build_grid(arguments: list[str], program: str) -> None:
    """Build a grid."""
    options = console.parse(GridOptions, arguments, program)
    grid = options.grid()
    _make(grid, options, f"{grid.levels} x {grid.columns} tiles of {grid.tile:g} m, seed {grid.seed}")


def run_bench(arguments: list[str], program: str) -> None:
    """Measure."""
    from . import bench

    options = console.parse(bench.BenchOptions, arguments, program)
    console.quiet_warp()
    bench.run(options)


def _shape_options(name: str) -> type:
    """``Outputs`` with the parameters of a shape and what a single tile needs."""
    cls = catalog.shape_class(name)
    docs, hints = console.field_docs(cls), get_type_hints(cls)
    own = [
        (field.name, Annotated[hints[field.name], tyro.conf.arg(help=docs[field.name])], field)
        for field in dataclasses.fields(cls)
        if field.name != "direction"
    ]
    more: list[tuple[str, type, Any, str]] = [
        ("difficulty", float, 0.5, "From 0, the easiest, to 1."),
        ("seed", int, 0, "Seed of what is random, at least 0."),
        ("cell", float, 0.05, "Distance of two samples of the height grid [m]; must divide tile and border."),
        ("border", float, 0.0, "Width of the level border around the tile [m], at least 0."),
        ("max_step", float, float("inf"), "Highest step that is allowed [m]."),
    ]
    fields = [(key, hint, dataclasses.field(default=field.default)) for key, hint, field in own]
    fields += [
        (key, Annotated[kind, tyro.conf.arg(help=text)], dataclasses.field(default=default))
        for key, kind, default, text in more
    ]
    summary = (cls.__doc__ or "").split("\n\n")[0]
    return dataclasses.make_dataclass(
        "ShapeOptions", fields, bases=(Outputs,), frozen=True, kw_only=True, namespace={"__doc__": f"{name}: {summary}"}
    )


def _make(grid: Grid, outputs: Outputs, title: str) -> None:
    """Check, build, write and report; nothing is built where something could not be written."""
    _check_outputs(outputs)
    require_memory(grid)
    console.quiet_warp()
    start = time.perf_counter()
    with console.progress_bar() as progress:
        terrain, mesh = build_with_mesh(grid, progress=progress)
        seconds = time.perf_counter() - start
        jobs: list[tuple[Path, Callable[[], None]]] = []
        for path in outputs.out:
            jobs.append((path, partial(export.save, path, terrain, mesh)))
        if outputs.mjcf is not None:
            jobs.append((outputs.mjcf, partial(export.save_mjcf, outputs.mjcf, terrain)))
        if outputs.preview is not None:
            from .preview import save_preview

            jobs.append((outputs.preview, partial(save_preview, outputs.preview, terrain, mesh, title)))
        for number, (path, job) in enumerate(jobs):
            progress(f"writing {path.name}", number / len(jobs))
            job()
    _report(grid, terrain, mesh, seconds, title)
    for path, _ in jobs:
        print(path)


def _check_outputs(outputs: Outputs) -> None:
    """Raise ``UsageError`` unless everything can be written."""
    for path in outputs.out:
        if path.suffix.lower() not in export.ENDINGS:
            raise console.UsageError(f"out must end in one of {', '.join(export.ENDINGS)}, got {path}.")
    if outputs.preview is not None and outputs.preview.suffix.lower() != ".png":
        raise console.UsageError(f"preview must end in .png, got {outputs.preview}.")
    files = [*outputs.out, *([] if outputs.preview is None else [outputs.preview])]
    if outputs.mjcf is not None:
        if outputs.mjcf.exists() and not outputs.mjcf.is_dir():
            raise console.UsageError(f"mjcf must be a folder, but {outputs.mjcf} is a file.")
        if not outputs.mjcf.parent.is_dir():
            raise console.UsageError(f"The folder {outputs.mjcf.parent} does not exist; make it first.")
        files += [outputs.mjcf / name for name in export.MJCF_FILES]
    for number, path in enumerate(files):
        if path in files[:number]:
            raise console.UsageError(f"{path} is named twice.")
        if path.is_dir():
            raise console.UsageError(f"{path} is a folder.")
        if path.exists() and not outputs.force:
            raise console.UsageError(f"{path} exists and is not overwritten; choose another name, or add --force.")
        if not path.parent.is_dir() and path.parent != outputs.mjcf:
            raise console.UsageError(f"The folder {path.parent} does not exist; make it first.")


def _report(grid: Grid, terrain: Terrain, mesh: "Trimesh", seconds: float, title: str) -> None:
    from rich.console import Console
    from rich.table import Table

    screen = Console(highlight=False, markup=False)
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    sizes = [*terrain.size, float(terrain.heights.max()) - float(terrain.heights.min())]
    nx, ny = terrain.heights.shape
    slope = steepest_slope(mesh)
    easiest, hardest = (float(d) + 0.0 for d in (grid.easiest, grid.hardest))
    for name, value in (
        ("extents [m]", " x ".join(f"{size:.3g}" for size in sizes)),
        ("heights [m]", f"{terrain.heights.min() + 0.0:.3f} to {terrain.heights.max() + 0.0:.3f}"),
        ("difficulty", f"{easiest:g}" if grid.levels == 1 else f"{easiest:g} to {hardest:g} in {grid.levels} levels"),
        ("steepest slope", f"{slope:.3f} rise over run"),
        ("highest riser [m]", f"{highest_riser(mesh):.3f}"),
        ("mesh", f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces"),
        ("height grid", f"{nx:,} x {ny:,} samples, {terrain.cell:g} m apart"),
        ("time [s]", f"{seconds:.2f}"),
    ):
        table.add_row(name, value)
    screen.print(title, style="bold")
    screen.print(table)


def _words(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(f"{part:g}" for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
