"""Ready-made grids, and grids from TOML files."""

import tomllib
from pathlib import Path
from typing import Any, get_type_hints

from .catalog import convert, make
from .grid import Terrain
from .world import Grid, Share, build

# Proportions of Legged Gym: smooth slopes (half of them up), rough slopes, stairs up, stairs down, discrete.
_LEGGED_GYM: list[dict[str, Any]] = [
    {"name": "slope-up", "share": 0.05},
    {"name": "slope-down", "share": 0.05},
    {"name": "rough-slope-down", "share": 0.1},
    {"name": "stairs-up", "share": 0.35},
    {"name": "stairs-down", "share": 0.25},
    {"name": "discrete", "share": 0.2},
]
# The Go1's legs are 0.43 m long, so its steps end at 0.18 m. A sunk rectangle beside a raised one makes 2 h.
_LOWER = {
    "rough-slope-down": {"amplitude": (0.01, 0.05)},
    "stairs-up": {"height": (0.05, 0.18)},
    "stairs-down": {"height": (0.05, 0.18)},
    "discrete": {"height": (0.03, 0.09)},
}
_GO1 = [table | _LOWER.get(table["name"], {}) for table in _LEGGED_GYM]
_PRESETS: dict[str, dict[str, Any]] = {
    "legged-gym": {"shape": _LEGGED_GYM},
    "go1": {"shape": _GO1, "border": 5.0, "max_step": 0.18},
}
"""What a file would say; see ``read_grid``."""


def preset_names() -> list[str]:
    """Names of the presets, sorted."""
    return sorted(_PRESETS)


def preset(name: str, **changes: Any) -> Grid:
    """A ready-made grid.

    Args:
        name: One of ``preset_names()``.
        changes: Fields of ``Grid`` that are to be otherwise.

    Raises:
        ValueError: If there is no such preset, or a value is out of its range.
    """
    return _grid(_look_up(name), changes)


def read_grid(path: str | Path, **changes: Any) -> Grid:
    """A grid from a TOML file: fields of ``Grid``, and a table ``[[shape]]`` for each shape.

    A shape's table has its ``name``, its ``share`` and any of its parameters. A file without shapes
    takes those of the preset that it names: ``preset = "go1"``.

    Args:
        path: The file.
        changes: Fields of ``Grid`` that are to be otherwise.

    Raises:
        OSError: If it cannot be read.
        ValueError: If it is not such a file, or a value is out of its range.
    """
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        if "preset" in table:
            table = _look_up(table.pop("preset")) | table
        if not table.get("shape"):
            raise ValueError(f"it needs a [[shape]], or preset = one of {', '.join(preset_names())}")
        return _grid(table, changes)
    except ValueError as error:  # of TOML too
        raise ValueError(f"{path}: {str(error).rstrip('.')}.") from error


def _look_up(name: str) -> dict[str, Any]:
    if name not in _PRESETS:
        raise ValueError(f"There is no preset '{name}'; there are: {', '.join(preset_names())}.")
    return _PRESETS[name]


def _grid(table: dict[str, Any], changes: dict[str, Any]) -> Grid:
    """The grid that a table describes as a file does."""
    hints = {name: hint for name, hint in get_type_hints(Grid).items() if name != "shapes"}
    values = {name: value for name, value in table.items() if name != "shape"}
    if unknown := sorted(set(values) - set(hints)):
        raise ValueError(f"it has '{unknown[0]}', but may have only preset, shape, {', '.join(hints)}")
    numbers = {name: convert(name, value, hints[name]) for name, value in values.items()}
    return Grid(shapes=tuple(map(_share, table["shape"])), **(numbers | changes))


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
        changes: Fields of ``Grid`` that are to be otherwise than in the preset ``go1``.

    Raises:
        ValueError: If a value is out of its range, or the grid would not fit into memory.
    """
    return build(preset("go1", **changes), device=device)
