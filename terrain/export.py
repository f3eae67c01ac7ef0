"""What the tool writes: meshes, the height grid, a MuJoCo model."""

import math
import re
import struct
from pathlib import Path

import numpy as np

from deimos.files import write_bytes, write_whole

from .grid import Terrain
from .mesh import Mesh

ENDINGS = (".glb", ".obj", ".ply", ".stl", ".npz", ".png")
MJCF_FILES = ("terrain.xml", "heights.bin")
_NOTE = "height [m] = {low!r} + {unit!r} * grey; {cell!r} m per pixel; lower left pixel at x = {x!r} m, y = {y!r} m"
GREY_NOTE = re.compile(re.sub(r"\\{(\w+)!r\\}", r"(?P<\1>\\S+)", re.escape(_NOTE)))
"""The description in a picture of heights, with the groups ``low``, ``unit``, ``cell``, ``x`` and ``y``."""
BASE = 1.0  # [m] of solid ground below the lowest sample of a MuJoCo model

_MJCF = """\
<mujoco model="terrain">
  <statistic center="{x:.9g} {y:.9g} {low:.9g}" extent="{reach:.9g}"/>
  <visual>
    <headlight ambient="0.35 0.35 0.35" diffuse="0.3 0.3 0.3"/>
    <map znear="0.001" zfar="10"/>
    <global azimuth="135" elevation="-35"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.6 0.75 0.9" rgb2="1 1 1" width="256" height="256"/>
    <material name="ground" rgba="0.55 0.6 0.5 1" specular="0.1"/>
    <hfield name="ground" file="heights.bin" size="{half_x:.9g} {half_y:.9g} {extent:.9g} {base:.9g}"/>
  </asset>
  <worldbody>
    <light type="directional" dir="0.5 -0.4 -0.75" diffuse="0.7 0.7 0.7" castshadow="false"/>
    <geom name="ground" type="hfield" hfield="ground" material="ground" pos="{x:.9g} {y:.9g} {low:.9g}"/>
  </worldbody>
</mujoco>
"""


def save(path: Path, terrain: Terrain, mesh: Mesh) -> None:
    """Write a terrain to a file in the format of its ending, one of ``ENDINGS``; whole or not at all.

    ``.stl``, ``.obj``, ``.ply`` and ``.glb`` hold the mesh [m]; z is up, except in ``.glb``, where y must be.
    ``.npz`` holds the terrain. ``.png`` holds its heights as 16-bit grey values, see ``grey``.

    Raises:
        RunError: If it cannot be written.
    """
    ending = path.suffix.lower()
    if ending == ".npz":
        terrain.save(path)
    elif ending == ".png":
        _save_grey(path, terrain)
    else:
        data = _mesh_bytes(mesh, ending)
        write_bytes(path, data)


def grey(terrain: Terrain) -> tuple[np.ndarray, float, float]:
    """The heights as 16-bit numbers, arranged as on a map: x to the right, y up.

    Returns:
        Numbers n, uint16, shape (ny, nx), and two lengths a and b [m]: the height is a + b n.
    """
    low, high = float(terrain.heights.min()), float(terrain.heights.max())
    unit = (high - low) / 65535 or 1.0
    numbers = np.rint((terrain.heights.astype(np.float64) - low) / unit).astype(np.uint16)
    return np.ascontiguousarray(numbers.T[::-1]), low, unit


def save_mjcf(folder: Path, terrain: Terrain) -> None:
    """Write a MuJoCo model of the terrain alone: ``terrain.xml`` and a file with its heights.

    Raises:
        OSError: If the folder cannot be created.
        RunError: If a file cannot be written.
    """
    folder.mkdir(exist_ok=True)
    low, extent = float(terrain.heights.min()), float(np.ptp(terrain.heights))
    half_x, half_y = (side / 2 for side in terrain.size)
    # The viewer starts at 1.5 times ``reach``.
    text = _MJCF.format(
        x=terrain.corner[0] + half_x, y=terrain.corner[1] + half_y, low=low, half_x=half_x, half_y=half_y,
        extent=extent or 1.0, base=BASE, reach=1.2 * math.hypot(half_x, half_y),
    )  # fmt: skip
    rows = np.ascontiguousarray((terrain.heights - low).T, "<f4")  # MuJoCo itself scales them to [0, 1]
    header = struct.pack("<ii", *rows.shape)
    write_bytes(folder / MJCF_FILES[1], header + rows.tobytes())
    write_bytes(folder / MJCF_FILES[0], text.encode())


def _mesh_bytes(mesh: Mesh, ending: str) -> bytes:
    if ending == ".glb":  # glTF 2.0, section 3.4: y is up
        mesh = mesh.copy()
        mesh.vertices = np.asarray(mesh.vertices)[:, [0, 2, 1]] * [1, 1, -1]
    if ending == ".obj":  # trimesh writes eight decimals, which are not the float32 numbers of the other formats
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces) + 1
        text = "v %.9g %.9g %.9g\n" * len(vertices) % tuple(vertices.ravel().tolist())
        return (text + "f %d %d %d\n" * len(faces) % tuple(faces.ravel().tolist())).encode()
    data = mesh.export(file_type=ending[1:])
    assert isinstance(data, bytes)  # of these three formats
    return data


def _save_grey(path: Path, terrain: Terrain) -> None:
    from PIL import Image, PngImagePlugin

    numbers, low, unit = grey(terrain)
    notes = PngImagePlugin.PngInfo()
    x, y = terrain.corner
    notes.add_text("Description", _NOTE.format(low=low, unit=unit, cell=terrain.cell, x=x, y=y))
    image = Image.fromarray(numbers)
    write_whole(path, lambda file: image.save(file, format="PNG", pnginfo=notes))
