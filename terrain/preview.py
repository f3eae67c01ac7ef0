"""A picture of a terrain: shaded relief from above and an oblique view, to scale."""

import io
import math
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from deimos.files import write_whole

from .grid import Terrain

LENGTH = 760  # pixels along the longer side of long ground
DPI = 100
WORDS = 240  # pixels for titles, names and the colour bar
POINTS = 16  # size of the letters: legible on a page at the width of a phone
SAMPLES = 2  # samples per pixel, along each axis
TURN, TILT = math.radians(25.0), math.radians(35.0)  # of the oblique view: about the vertical, above the horizon
HIGHEST = 10.0  # times the longer side: beyond, a picture takes gigabytes
LONGEST = 1000.0  # times the shorter side: beyond, that is less than a sample of the picture
WALL = 0.45  # grey of the cut around the ground


def save_preview(path: Path, terrain: Terrain, title: str) -> None:
    """Draw both views of a terrain with scale bars and the numbers of its levels, to a PNG file.

    Args:
        path: The file, written whole or not at all.
        terrain: The terrain.
        title: The title.

    Raises:
        RunError: If the file cannot be written.
        ValueError: If the ground is too high or too narrow to be drawn to scale.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from PIL import Image

    low, high = float(terrain.heights.min()), float(terrain.heights.max())
    narrow, long = sorted(terrain.size)
    if high - low > HIGHEST * long:
        raise ValueError(
            f"preview is to scale, so heights must differ by at most {HIGHEST:g} times the longer side of the ground, "
            f"{long:g} m, got {high - low:g} m; are they in metres?"
        )
    if long > LONGEST * narrow:
        raise ValueError(
            f"preview is to scale, so the longer side of the ground must be at most {LONGEST:g} times the shorter one, "
            f"{narrow:g} m, got {long:g} m."
        )
    margin = max(0.05, 0.15 * (high - low))  # so that flat ground has neither the darkest nor the lightest colour
    colours = ScalarMappable(Normalize(low - margin, high + margin), "YlGnBu_r")
    stacked = max(terrain.size) > 1.5 * min(terrain.size)
    pixel = max(terrain.size) / (LENGTH if stacked else 0.55 * LENGTH)  # [m]
    views = [_draw(terrain, colours, pixel / SAMPLES, *angles) for angles in ((0.0, math.pi / 2), (TURN, TILT))]
    heights, widths = zip(*[picture.shape[:2] for picture, _ in views], strict=True)
    width, height = (max(widths), sum(heights)) if stacked else (sum(widths), max(heights))
    inches = (width / SAMPLES + WORDS) / DPI, (height / SAMPLES + WORDS) / DPI
    figure = Figure(inches, dpi=DPI, layout="constrained")
    axes = figure.subplots(2, 1, height_ratios=heights) if stacked else figure.subplots(1, 2, width_ratios=widths)
    figure.suptitle(title, fontsize=POINTS)
    for axis, (picture, span) in zip(axes, views, strict=True):
        axis.imshow(picture, extent=span, interpolation="antialiased")
        axis.set_axis_off()
        _scale_bar(axis, *span)
    _name_tiles(axes[0], terrain)
    bar = figure.colorbar(colours, ax=list(axes), shrink=0.6, aspect=30, pad=0.02)
    bar.set_label("height [m]", fontsize=POINTS)
    bar.ax.tick_params(labelsize=POINTS)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", bbox_inches="tight", pad_inches=0.1)  # cuts off no name, however long
    image = Image.open(buffer).convert("RGB")
    image = image.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)  # a third of the bytes
    write_whole(path, lambda file: image.save(file, format="PNG", optimize=True))


def _is_wide(terrain: Terrain) -> bool:
    """Whether x is to the right and y up in the picture; otherwise y is to the right and x down."""
    return terrain.size[0] > terrain.size[1]


def _draw(terrain: Terrain, colours: Any, step: float, turn: float, tilt: float) -> tuple[np.ndarray, tuple]:
    """A parallel projection of the height grid, white around it.

    Every column of the picture scans the ground from near to far; a pixel shows the first sample that reaches it.

    Args:
        terrain: The terrain.
        colours: Matplotlib's colours of heights.
        step: Side of a pixel [m].
        turn: Angle about the vertical [rad], in [0, pi / 2].
        tilt: Angle above the horizon [rad], in (0, pi / 2].

    Returns:
        The picture, shape (rows, columns, 3), and its left, right, lower and upper end [m] around the middle.
    """
    from matplotlib.colors import LightSource

    stride = max(1, int(step / terrain.cell))
    ground = (terrain.heights.T[::-1] if _is_wide(terrain) else terrain.heights)[::stride, ::stride]
    low, high = float(ground.min()), float(ground.max())
    level = 0.0 if low <= 0.0 <= high else low  # ground far from 0, as in a survey, is cut just below itself
    ground = ground - level
    cell = stride * terrain.cell
    light = LightSource(azdeg=315, altdeg=30)  # brightness 1/2 on flat ground, which keeps the colour of its height
    south, east = np.gradient(ground, cell)
    normals = np.stack([-east, south, np.ones_like(east)], axis=-1)
    brightness = (normals @ light.direction / np.linalg.norm(normals, axis=-1)).clip(0.0, 1.0)

    half_height, half_width = (cell * (side - 1) / 2 for side in ground.shape)
    reach = half_width * math.cos(turn) + half_height * math.sin(turn)
    depth = half_width * math.sin(turn) + half_height * math.cos(turn)
    across = np.arange(-reach + step / 2, reach, step, dtype=np.float32)[None, :]  # middles of the pixels
    away = np.arange(-depth, depth + step, step, dtype=np.float32)[:, None]
    column = np.rint((half_width + across * math.cos(turn) - away * math.sin(turn)) / cell).astype(np.int32)
    row = np.rint((half_height - across * math.sin(turn) - away * math.cos(turn)) / cell).astype(np.int32)
    inside = (column >= 0) & (column < ground.shape[1]) & (row >= 0) & (row < ground.shape[0])
    place = row.clip(0, ground.shape[0] - 1), column.clip(0, ground.shape[1] - 1)
    edge, rise = away * math.sin(tilt), math.cos(tilt)
    top = np.maximum.accumulate(np.where(inside, edge + ground[place] * rise, -np.inf), axis=0)

    foot = min(0.0, float(ground.min())) * rise - 0.01 * max(terrain.size) * rise  # of the cut around the ground
    up = np.arange(edge[0, 0] + foot + step / 2, top.max(), step)[:, None]  # middles of the pixels
    seen = np.stack([np.searchsorted(samples, up[:, 0]) for samples in top.T], axis=1)
    first = inside.argmax(axis=0)
    near = np.minimum(edge[first, 0], np.take_along_axis(top, first[None], axis=0))  # where the ground begins
    beside = (seen == len(top)) | (up < near)
    seen = seen.clip(1, len(top) - 1)
    here, before = (np.take_along_axis(ground[place], index, axis=0) for index in (seen, seen - 1))
    height = ((up - edge[seen, 0]) / rise).clip(np.minimum(here, before), here)  # from the foot of a riser to its top
    shade = np.take_along_axis(brightness[place], seen, axis=0)
    picture = light.blend_soft_light(colours.to_rgba(height + level)[..., :3], shade[..., None])
    picture[beside] = 1.0
    picture[beside & (up < near) & (up >= edge[first, 0] + foot) & inside.any(axis=0)] = WALL
    bottom = up[0, 0] - step / 2
    return picture[::-1], (-reach, step * picture.shape[1] - reach, bottom, step * picture.shape[0] + bottom)


def _scale_bar(axis: Any, left: float, right: float, bottom: float, top: float) -> None:
    """Draw a bar of a round length below the lower left corner."""
    rough = (right - left) / 6
    power = 10.0 ** math.floor(math.log10(rough))
    length = next(step * power for step in (5, 2, 1) if step * power <= rough)
    y = bottom - 0.03 * max(top - bottom, (right - left) / 3)
    axis.plot([left, left + length], [y, y], color="black", linewidth=3, solid_capstyle="butt", clip_on=False)
    axis.text(left + length, y, f"  {length:g} m", va="center", ha="left", fontsize=POINTS)
    axis.set_ylim(y - (bottom - y), top)


def _name_tiles(axis: Any, terrain: Terrain) -> None:
    """Write the numbers of the levels and the names of the shapes next to the tiles and above them."""
    if terrain.origins.shape[:2] == (1, 1):
        return  # the title says it all
    x, y = np.moveaxis(terrain.origins[..., :2] - terrain.corner - np.divide(terrain.size, 2), -1, 0)
    between = "\n" if _is_wide(terrain) else ", "
    levels = [f"level {number}{between}d = {difficulty:.2g}" for number, difficulty in enumerate(terrain.difficulty)]
    groups = [(name, list(group)) for name, group in groupby(range(y.shape[1]), key=lambda j: terrain.shapes[j])]
    columns, middles = [name for name, _ in groups], [y[:, group].mean() for _, group in groups]
    axis.set_axis_on()
    axis.set_frame_on(False)
    axis.xaxis.tick_top()
    axis.tick_params(length=0, labelsize=POINTS)
    if _is_wide(terrain):
        axis.set_xticks(x.mean(axis=1), levels)
        axis.set_yticks(middles, columns)
    else:
        narrow = {"rotation": 55, "rotation_mode": "anchor", "ha": "left"} if len(columns) > 4 else {}
        axis.set_xticks(middles, columns, **narrow)
        axis.set_yticks(-x.mean(axis=1), levels)
