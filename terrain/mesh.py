"""Triangle meshes of heights, which shapes are made of. Seen from above, faces are counter-clockwise."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from trimesh import Trimesh as Mesh
else:
    Mesh = Any  # trimesh is imported when a mesh is made

UPRIGHT = 1e-6  # a face whose unit normal has a smaller vertical part is a riser


def from_quads(corners: np.ndarray) -> Mesh:
    """Two triangles for every quadrilateral; nothing is shared, so that edges stay sharp when rendered.

    Args:
        corners: Corners in counter-clockwise order [m], shape (n, 4, 3).
    """
    first = 4 * np.arange(len(corners))[:, None]
    faces = (first + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
    return from_triangles(corners.reshape(-1, 3), faces)


def from_triangles(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """A mesh of these vertices [m], shape (n, 3), and faces, shape (m, 3), as they are."""
    from trimesh import Trimesh

    return Trimesh(vertices, faces, process=False, validate=False)


def take_apart(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a mesh that is no longer used; the rest of it is freed.

    A trimesh mesh and its helpers (cache, colours, rays) refer to each other, so it would keep its arrays until
    Python's garbage collector runs, which arrays, however large, do not trigger.
    """
    parts = mesh.vertices, mesh.faces
    vars(mesh).clear()
    return parts


def sheet(x: np.ndarray, y: np.ndarray, height: np.ndarray) -> Mesh:
    """A surface through a lattice of points.

    Each cell is split along the diagonal that points to the middle of the sheet, as the edges of a pyramid do.

    Args:
        x: Coordinates of the lattice [m], rising, shape (n,).
        y: The same along y, shape (m,).
        height: Heights [m], shape (n, m).
    """
    n, m = height.shape
    vertices = np.stack([*np.broadcast_arrays(x[:, None], y[None, :]), height], axis=-1).reshape(-1, 3)
    a = (m * np.arange(n - 1)[:, None] + np.arange(m - 1)).reshape(-1)  # d c
    b, c, d = a + m, a + m + 1, a + 1  #                                  a b
    middle_x, middle_y = (x[:-1] + x[1:] - x[0] - x[-1])[:, None], (y[:-1] + y[1:] - y[0] - y[-1])[None, :]
    rising = (middle_x * middle_y >= 0).reshape(-1, 1)
    faces = np.where(rising, np.stack([a, b, c, a, c, d], axis=1), np.stack([a, b, d, b, c, d], axis=1))
    return from_triangles(vertices, faces.reshape(-1, 3))


def terraces(x: np.ndarray, y: np.ndarray, height: np.ndarray) -> Mesh:
    """Flat rectangles with vertical risers between those of different height.

    Args:
        x: Where a rectangle ends and the next begins [m], rising, shape (n + 1,).
        y: The same along y, shape (m + 1,).
        height: Height of each rectangle [m], shape (n, m).
    """
    n, m = height.shape
    i, j = (index.reshape(-1) for index in np.indices((n, m)))
    h = height[i, j]
    quads = [_quads((x[i], y[j], h), (x[i + 1], y[j], h), (x[i + 1], y[j + 1], h), (x[i], y[j + 1], h))]

    i, j = np.nonzero(height[:-1] != height[1:])
    corners = _riser(height[i, j], height[i + 1, j], y[j], y[j + 1])
    quads.append(_quads(*[(x[i + 1], along, z) for along, z in corners]))
    i, j = np.nonzero(height[:, :-1] != height[:, 1:])
    corners = _riser(height[i, j], height[i, j + 1], x[i + 1], x[i])
    quads.append(_quads(*[(along, y[j + 1], z) for along, z in corners]))
    return from_quads(np.concatenate(quads))


def _riser(here: np.ndarray, there: np.ndarray, right: np.ndarray, left: np.ndarray) -> list[tuple]:
    """Corners of risers, along the edge and in height; ``right`` is seen from the lower side, if ``here`` is higher."""
    right, left = np.where(here > there, (right, left), (left, right))
    low, high = np.minimum(here, there), np.maximum(here, there)
    return [(right, low), (left, low), (left, high), (right, high)]


def rings(half_sides: np.ndarray, heights: np.ndarray) -> Mesh:
    """Nested flat squares around the origin, with vertical risers.

    Args:
        half_sides: Half side of each square [m], falling, shape (n,). A square as large as the one before hides it.
        heights: Height of each square [m], shape (n,).
    """
    lines = np.unique(np.concatenate([-half_sides, half_sides]).round(9))  # [nm]: closer lines are merged
    middle = np.abs((lines[:-1] + lines[1:]) / 2)
    distance = np.maximum(middle[:, None], middle[None, :])
    innermost = (distance[..., None] < half_sides).sum(axis=-1) - 1
    return terraces(lines, lines, heights[innermost])


def blocks(x: np.ndarray, y: np.ndarray, bottom: float, top: float) -> Mesh:
    """Upright blocks without an underside.

    Args:
        x: Where each block begins and ends along x [m], shape (n, 2).
        y: The same along y, shape (n, 2).
        bottom: Height of their bottom [m].
        top: Height of their top [m].
    """
    low, high = np.full(len(x), bottom), np.full(len(x), top)
    (left, right), (front, back) = x.T, y.T
    around = [(left, front), (right, front), (right, back), (left, back)]
    quads = [_quads(*[(px, py, high) for px, py in around])]
    for (ax, ay), (bx, by) in zip(around, around[1:] + around[:1], strict=True):
        quads.append(_quads((ax, ay, low), (bx, by, low), (bx, by, high), (ax, ay, high)))
    return from_quads(np.concatenate(quads))


def steepest_slope(mesh: Mesh) -> float:
    """Rise over run of the steepest face that is not a riser."""
    up = mesh.face_normals[:, 2]
    up = up[up > UPRIGHT]
    return float(np.sqrt(1 / up.min() ** 2 - 1)) if len(up) else 0.0


def highest_riser(mesh: Mesh) -> float:
    """Height of the highest vertical face [m]; 0 if there is none."""
    upright = np.abs(mesh.face_normals[:, 2]) <= UPRIGHT
    z = np.asarray(mesh.vertices)[np.asarray(mesh.faces)[upright], 2]
    return float(np.ptp(z, axis=1).max()) if len(z) else 0.0


def _quads(*corners: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    return np.stack([np.stack(corner, axis=-1) for corner in corners], axis=1)
