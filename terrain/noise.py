"""Uniform noise on a coarse lattice."""

import numpy as np


def draw_noise(
    generator: np.random.Generator, tile: float, spacing: float, amplitude: float, quantum: float, room: float
) -> tuple[np.ndarray, np.ndarray]:
    """Independent heights, uniform among the multiples of ``quantum`` in [-amplitude, amplitude].

    They vanish along the edge of the tile and on a square in its middle.

    Args:
        generator: Source of the heights.
        tile: Side of the tile [m].
        spacing: Distance between heights [m]; changed as little as needed for it to divide the tile.
        amplitude: Largest height [m].
        quantum: Step between possible heights [m].
        room: Side of the square without noise [m].

    Returns:
        Coordinates of the lattice around the middle [m], shape (n,), and heights [m], shape (n, n).
    """
    line = tile * (np.arange(round(tile / spacing) + 1) / round(tile / spacing) - 0.5)
    most = int(amplitude / quantum + 1e-6)
    height = quantum * generator.integers(-most, most, size=(len(line), len(line)), endpoint=True)
    # The square is level only if every lattice cell that reaches into it is.
    inside = np.abs(line) < room / 2 + line[1] - line[0]
    height[np.ix_(inside, inside)] = 0.0
    height[[0, -1], :] = 0.0
    height[:, [0, -1]] = 0.0
    return line, height


def interpolate(line: np.ndarray, height: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Bilinear interpolation of a square lattice at all pairs of ``x``, shape (len(x), len(x))."""
    k = np.clip(np.searchsorted(line, x, side="right") - 1, 0, len(line) - 2)
    share = (x - line[k]) / (line[k + 1] - line[k])
    weight = np.zeros((len(x), len(line)))
    rows = np.arange(len(x))
    weight[rows, k] = 1.0 - share
    weight[rows, k + 1] = share
    return weight @ height @ weight.T
