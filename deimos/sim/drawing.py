"""Worlds that are points in a box, drawn from above and from the side, and the captions of all pictures."""

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from deimos.sim.env import Env, Sketch

if TYPE_CHECKING:
    from PIL.Image import Image

INK, PAPER, OUTSIDE = (40, 40, 40), (255, 255, 255), (232, 232, 232)
BLUE, ORANGE, RED = (0, 114, 178), (230, 159, 0), (200, 30, 30)
VIEWS = {"from above: x, y": (0, 1), "from the side: x, z": (0, 2)}
REACH = 1.15  # visible half-width, in half sides of the box
TRAIL = 150  # length of the trail [pictures]
FINE = 2  # pixels drawn for every pixel shown, along both axes
LETTERS = 1 / 32  # height of letters, as a share of a picture's width: legible on a phone
LINES = 4.6  # space above the boxes for the caption and the legend, in heights of letters


class Drawing:
    """Draws world 0 of an environment with a ``sketch``, with the trail of its episode and the ends of earlier ones.

    Args:
        env: The environment.
        width: Width of a picture [pixels].
        height: Height of a picture [pixels].
    """

    def __init__(self, env: Env, width: int, height: int) -> None:
        self._env, self._width, self._height = env, width, height
        self._letters = letters(width)
        self._header = round(LINES * self._letters)
        self._side = max(1, min(width // 2, height - self._header) - 8)
        self._top = self._header + max(0, height - self._header - self._side - 8) // 2
        ends = "ends of episodes" if env.time_limit else "crashes"
        self._legend = (("particle", BLUE), ("goal (or where it leads)", ORANGE), (ends, RED))
        self._trail: list[np.ndarray] = []
        self._ends: list[np.ndarray] = []
        self._episode = 0

    def __call__(self) -> np.ndarray:
        """The picture of this moment, uint8, shape (height, width, 3)."""
        from PIL import Image, ImageDraw

        sketch, episode = self._env.sketch(0), int(self._env.tensors["episode_count"][0])
        assert sketch is not None
        if self._trail and episode != self._episode:
            self._ends.append(self._trail[-1])
            self._trail.clear()
        self._episode = episode
        self._trail = [*self._trail[-TRAIL:], sketch.position]
        picture = Image.new("RGB", (self._width, self._height), PAPER)
        gap = (self._width - 2 * self._side) // 3
        for place, (name, axes) in enumerate(VIEWS.items()):
            left = gap + place * (self._side + gap)
            picture.paste(self._view(sketch, axes, name), (left, self._top))
        draw, left = ImageDraw.Draw(picture), gap
        for text, colour in self._legend:
            draw.text((left, self._top - 1.5 * self._letters), text, fill=colour, font_size=self._letters)
            left += round(draw.textlength(text, font_size=self._letters)) + self._letters
        return np.asarray(picture)

    def _view(self, sketch: Sketch, axes: tuple[int, int], name: str) -> "Image":
        """The box, seen along one axis."""
        from PIL import Image, ImageDraw

        size, first, second = FINE * self._side, *axes

        def at(point: np.ndarray) -> tuple[float, float]:
            x, y = point[first], point[second]
            half = REACH * sketch.half_side
            return size / 2 * (1 + x / half), size / 2 * (1 - y / half)

        def around(point: np.ndarray, radius: float) -> tuple[float, float, float, float]:
            x, y = at(point)
            return x - FINE * radius, y - FINE * radius, x + FINE * radius, y + FINE * radius

        image = Image.new("RGB", (size, size), OUTSIDE)
        draw = ImageDraw.Draw(image)
        corner = np.full(3, sketch.half_side)
        (left, bottom), (right, top) = at(-corner), at(corner)
        draw.rectangle((left, top, right, bottom), fill=PAPER, outline=INK, width=FINE)
        for end in self._ends:
            x0, y0, x1, y1 = around(end, 4)
            draw.line((x0, y0, x1, y1), fill=RED, width=2 * FINE)
            draw.line((x0, y1, x1, y0), fill=RED, width=2 * FINE)
        draw.line([*at(sketch.position), *at(sketch.target)], fill=ORANGE, width=FINE)
        draw.ellipse(around(sketch.target, 6), outline=ORANGE, width=2 * FINE)
        draw.line([at(point) for point in self._trail], fill=BLUE, width=FINE + 1)
        draw.ellipse(around(sketch.position, 5), fill=BLUE)
        image = image.reduce(FINE)
        place = (self._letters / 2, self._side - 1.4 * self._letters)
        ImageDraw.Draw(image).text(place, name, fill=INK, font_size=self._letters)
        return image


def letters(width: int) -> int:
    """Height of the letters in a picture of a width [pixels], at least 8."""
    return max(8, round(LETTERS * width))


def with_caption(picture: np.ndarray, text: str) -> np.ndarray:
    """A picture, uint8, shape (height, width, 3), with lines of text in its upper left corner, wrapped at its width."""
    from PIL import Image, ImageDraw

    image = Image.fromarray(picture)
    draw, size = ImageDraw.Draw(image), letters(image.width)
    corner = (size / 2, size / 3)
    columns = max(1, int((image.width - size) / draw.textlength("0", font_size=size)))
    lines = [textwrap.fill(line, columns, break_on_hyphens=False) for line in text.splitlines()]
    box = draw.multiline_textbbox(corner, "\n".join(lines), font_size=size)
    draw.rectangle((0, 0, box[2] + size / 2, box[3] + size / 3), fill=PAPER)
    draw.multiline_text(corner, "\n".join(lines), fill=INK, font_size=size)
    return np.asarray(image)
