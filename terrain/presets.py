"""Grids from TOML files: the ready-made ones in ``terrain/grids``, and custom ones."""

import tomllib
from pathlib import Path
from typing import Any, get_type_hints

from deimos.files import read_bytes

from .catalog import convert, make
from .grid import Terrain
from .world import Grid, Share, build

_FOLDER = Path(__file__).with_name("grids")


def preset_names() -> list[str]:
    """Names of the presets, sorted: those of the files in ``terrain/grids``."""
    return sorted(path.stem for path in _FOLDER.glob("*.toml"))


def preset(name: str, **changes: Any) -> Grid:
    """A ready-made grid.

    Args:
        name: One of ``preset_names()``.
        changes: Fields of ``Grid`` to change.

    Raises:
        ValueError: If there is no such preset, or a value is out of its range.
    """
    return _grid(_read_preset(name), changes)


def read_grid(path: str | Path, **changes: Any) -> Grid:
    """A grid from a TOML file: fields of ``Grid``, and a table ``[[shape]]`` for each shape.

    A shape's table has its ``name``, its ``share`` and any of its parameters. A file without shapes
    takes those of the preset that it names: ``preset = "go1"``.

    Args:
        path: The file.
        changes: Fields of ``Grid`` to change.

    Raises:
        OSError: If it cannot be read.
        ValueError: If it is not such a file, or a value is out of its range.
    """
    try:
        table = _read(Path(path))
        if "preset" in table:
            table = _read_preset(table.pop("preset")) | table
        if not table.get("shape"):
            raise ValueError(f"it needs a [[shape]], or preset = one of {', '.join(preset_names())}")
        return _grid(table, changes)
    except ValueError as error:  # also TOML's
        raise ValueError(f"{path}: {str(error).rstrip('.')}.") from error


def _read(path: Path) -> dict[str, Any]:
    return tomllib.loads(read_bytes(path).decode())


def _read_preset(name: str) -> dict[str, Any]:
    if name not in preset_names():
        raise ValueError(f"Unknown preset '{name}'; choose from: {', '.join(preset_names())}.")
    return _read(_FOLDER / f"{name}.toml")


def _grid(table: dict[str, Any], changes: dict[str, Any]) -> Grid:
    """The grid that a table, as in a file, describes."""
    hints = {name: hint for name, hint in get_type_hints(Grid).items() if name != "shapes"}
    values = {name: value for name, value in table.items() if name != "shape"}
    if unknown := sorted(set(values) - set(hints)):
        raise ValueError(f"it has '{unknown[0]}', but may have only preset, shape, {', '.join(hints)}")
    if not isinstance(table["shape"], list):
        raise ValueError(f"shape must be a list of tables, [[shape]], got {table['shape']!r:.80}")
    numbers = {name: convert(name, value, hints[name]) for name, value in values.items()}
    return Grid(**({"shapes": tuple(map(_share, table["shape"]))} | numbers | changes))


def _share(table: Any) -> Share:
    if not isinstance(table, dict) or not isinstance(table.get("name"), str):
        raise ValueError("every [[shape]] needs a name")
    parameters = dict(table)
    name, share = parameters.pop("name"), parameters.pop("share", 1.0)
    if "tile" in parameters:
        raise ValueError(f"the tile of '{name}' is that of the grid; write it above the first [[shape]]")
    return Share(shape=make(name, parameters), share=convert("share", share, float))


def rough(*, device: str = "cpu", **changes: Any) -> Terrain:
    """Legged Gym's grid of slopes, stairs and rectangles of rising difficulty, with steps that a Go1 can climb.

    Args:
        device: Warp device that rasterises the mesh.
        changes: Fields of ``Grid`` to change from the preset ``go1``.

    Raises:
        ValueError: If a value is out of its range, or the grid would not fit into memory.
    """
    return build(preset("go1", **changes), device=device)
