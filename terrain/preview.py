"""A picture of a terrain: shaded relief from above and an oblique view, to scale."""

import io
import math
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from deimos.kernels.relief import draw_relief

from .files import write_whole
from .grid import Terrain
from .mesh import from_quads, join

if TYPE_CHECKING:
    from trimesh import Trimesh

LENGTH = 760  # pixels along the longer side of long ground
DPI = 100
WORDS = 180  # pixels for titles, names and the bar of colours
SAMPLES = 2  # rays per pixel, along each axis
TILT = math.radians(35.0)  # of the oblique view above the horizon
TURN = math.radians(25.0)  # of the oblique view about the vertical
# To the light: right, away, up. From above the eye expects it at the upper left; oblique, it shines on what is seen.
LIGHTS = (np.array([-0.45, 0.3, 0.84]), np.array([-0.6, -0.3, 0.74]))
DIMMEST = 0.35  # brightness of what the light does not reach


@dataclass(frozen=True)
class View:
    """Directions of a picture in the world; both are seen with the longer side of the ground across."""

    right: np.ndarray
    """Direction that is right in the picture, of length 1, shape (3,)."""
    up: np.ndarray
    """Direction that is up in the picture, of length 1, shape (3,)."""

    @property
    def forward(self) -> np.ndarray:
        """Direction into the picture."""
        return np.cross(self.up, self.right)


def views(terrain: Terrain) -> tuple[View, View]:
    """The view from above and the oblique one."""
    x, y, z = np.eye(3)
    right, up = (x, y) if terrain.size[0] > terrain.size[1] else (y, -x)
    turned = math.cos(TURN) * right + math.sin(TURN) * up
    away = math.cos(TURN) * up - math.sin(TURN) * right
    return View(right, up), View(turned, math.sin(TILT) * away + math.cos(TILT) * z)


def save_preview(path: Path, terrain: Terrain, mesh: "Trimesh", title: str) -> None:
    """Draw both views of a terrain with scale bars and the numbers of its levels, to a PNG file.

    Args:
        path: The file, written whole or not at all.
        terrain: The terrain.
        mesh: The mesh that it was made from.
        title: What stands above.

    Raises:
        OSError: If the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    mesh = join([mesh, _skirt(terrain)])
    ground = wp.Mesh(
        wp.array(np.asarray(mesh.vertices, np.float32), dtype=wp.vec3, device="cpu"),
        wp.array(np.asarray(mesh.faces, np.int32).reshape(-1), dtype=wp.int32, device="cpu"),
    )
    above, oblique = views(terrain)
    stacked = max(terrain.size) > 1.5 * min(terrain.size)
    pixel = max(terrain.size) / (LENGTH if stacked else 0.55 * LENGTH)  # [m]
    both = zip((above, oblique), LIGHTS, strict=True)
    pictures = [_picture(ground, mesh, view, light, pixel, terrain) for view, light in both]
    heights, widths = (tuple(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    if stacked:
        shape = max(widths) + WORDS, sum(heights) + WORDS
    else:
        shape = sum(widths) + WORDS, max(heights) + WORDS
    figure = Figure(figsize=(shape[0] / DPI, shape[1] / DPI), dpi=DPI, layout="constrained")
    axes = figure.subplots(2, 1, height_ratios=heights) if stacked else figure.subplots(1, 2, width_ratios=widths)
    figure.suptitle(title, fontsize=13)
    for axis, picture, view in zip(axes, pictures, (above, oblique), strict=True):
        span = _span(mesh, view)
        axis.imshow(picture, extent=(*span[0], *span[1]), interpolation="antialiased")
        axis.set_axis_off()
        _scale_bar(axis, span)
    _name_tiles(axes[0], terrain, above)
    _colour_bar(figure, axes, terrain)
    FigureCanvasAgg(figure)  # draws without a display
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", bbox_inches="tight", pad_inches=0.1)  # no name is cut off, however long
    image = Image.open(buffer).convert("RGB")
    image = image.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)  # a third of the bytes
    write_whole(path, lambda file: image.save(file, format="PNG", optimize=True))


def _skirt(terrain: Terrain) -> "Trimesh":
    """Walls around the ground, which is at height 0 along its edge, so that nobody looks under it."""
    near, far = np.array(terrain.corner), np.add(terrain.corner, terrain.size)
    low = min(float(terrain.heights.min()), -0.01 * max(terrain.size))
    around = np.array([near, [far[0], near[1]], far, [near[0], far[1]]])
    foot, top = np.insert(around, 2, low, axis=1), np.insert(around, 2, 0.0, axis=1)
    following = [1, 2, 3, 0]
    return from_quads(np.stack([foot, foot[following], top[following], top], axis=1))


def _span(mesh: "Trimesh", view: View) -> np.ndarray:
    """What the mesh covers along right and up [m], shape (2, 2)."""
    places = np.asarray(mesh.vertices) @ np.stack([view.right, view.up], axis=1)
    return np.stack([places.min(axis=0), places.max(axis=0)], axis=1)


def _picture(
    ground: wp.Mesh, mesh: "Trimesh", view: View, light: np.ndarray, pixel: float, terrain: Terrain
) -> np.ndarray:
    """Colours by height, darkened by shade, white beside the ground, shape (rows, columns, 3) in [0, 1]."""
    (left, right), (bottom, top) = _span(mesh, view)
    columns, rows = max(1, round((right - left) / pixel)), max(1, round((top - bottom) / pixel))
    size = (rows * SAMPLES, columns * SAMPLES)
    height, brightness = (wp.empty(size, dtype=wp.float32, device="cpu") for _ in range(2))
    back = float(np.abs(mesh.bounds).max()) * 4 + 1  # [m], behind everything
    corner = left * view.right + top * view.up - back * view.forward
    away = np.cross([0.0, 0.0, 1.0], view.right)
    draw_relief(
        ground, height, brightness,
        corner=tuple(corner),
        right=tuple(view.right * (right - left) / size[1]),
        down=tuple(-view.up * (top - bottom) / size[0]),
        forward=tuple(view.forward),
        light=tuple(light @ np.stack([view.right, away, [0.0, 0.0, 1.0]]) / np.linalg.norm(light)),
    )  # fmt: skip
    seen = height.numpy()
    shade = DIMMEST + (1 - DIMMEST) * brightness.numpy()
    colour = _colours()(_normed(seen, terrain))[..., :3] * shade[..., None]
    colour[np.isnan(seen)] = 1.0
    return colour.reshape(rows, SAMPLES, columns, SAMPLES, 3).mean(axis=(1, 3))


def _colours() -> Any:
    from matplotlib import colormaps

    return colormaps["YlGnBu_r"]


def _limits(terrain: Terrain) -> tuple[float, float]:
    """Heights of the darkest and the lightest colour [m]: level ground is not at either end."""
    low, high = float(terrain.heights.min()), float(terrain.heights.max())
    room = max(0.05, 0.15 * (high - low))
    return low - room, high + room


def _normed(height: np.ndarray, terrain: Terrain) -> np.ndarray:
    """Shares of the range of colours; those of pixels that see nothing are not used."""
    low, high = _limits(terrain)
    return (np.where(np.isnan(height), low, height) - low) / (high - low)


def _scale_bar(axis: Any, span: np.ndarray) -> None:
    """A bar of a round length below the lower left corner."""
    (left, right), (bottom, top) = span
    rough = (right - left) / 6
    power = 10.0 ** math.floor(math.log10(rough))
    length = next(step * power for step in (5, 2, 1) if step * power <= rough)
    y = bottom - 0.03 * max(top - bottom, (right - left) / 3)
    axis.plot([left, left + length], [y, y], color="black", linewidth=3, solid_capstyle="butt", clip_on=False)
    axis.text(left + length, y, f"  {length:g} m", va="center", ha="left", fontsize=10)
    axis.set_ylim(y - (bottom - y), top)


def _name_tiles(axis: Any, terrain: Terrain, view: View) -> None:
    """Numbers of the levels beside the tiles, names of the shapes above or beside them."""
    if terrain.origins.shape[:2] == (1, 1):
        return  # the title says it all
    axes = np.stack([view.right, view.up], axis=1)
    places = terrain.origins @ axes  # (levels, columns, 2)
    corners = np.array([terrain.corner, np.add(terrain.corner, terrain.size)]) @ axes[:2]
    left, top = corners[:, 0].min(), corners[:, 1].max()
    space = 0.015 * np.ptp(corners[:, 0])
    levels = [
        (places[level].mean(axis=0), f"level {level}\nd = {difficulty:.2g}")
        for level, difficulty in enumerate(terrain.difficulty)
    ]
    columns = []
    for name, group in groupby(range(len(terrain.shapes)), key=lambda j: terrain.shapes[j]):
        columns.append((places[:, list(group)].mean(axis=(0, 1)), name))
    across, beside = (levels, columns) if view.right[0] else (columns, levels)
    for place, text in beside:
        axis.text(left - space, place[1], text, ha="right", va="center", fontsize=9)
    narrow = len(terrain.shapes) > 4 and across is columns
    words = {"rotation": 40, "rotation_mode": "anchor", "ha": "left"} if narrow else {"ha": "center"}
    for place, text in across:
        axis.text(place[0], top + space, text, va="bottom", fontsize=9, **words)


def _colour_bar(figure: Any, axes: Any, terrain: Terrain) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    low, high = _limits(terrain)
    bar = figure.colorbar(
        ScalarMappable(Normalize(low, high), _colours()), ax=list(axes), shrink=0.6, aspect=30, pad=0.02
    )
    bar.set_label("height [m]")
