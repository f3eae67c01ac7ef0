"""Capsules that fill what a robot collides with."""

import numpy as np
import pytest
from deimos.terrain import Grid, Share
from deimos.terrain.shapes.stairs import Shape as Stairs
from robot_models import write_scout
from scipy.spatial.transform import Rotation

from deimos import terrain
from deimos.sim.legged import engines, robot_draft
from deimos.sim.legged.capsules import fill
from deimos.sim.legged.engines import PhysicsConfig
from deimos.sim.legged.robots import go1


@pytest.mark.parametrize(
    "half", [(0.02,) * 3, (0.015, 0.1, 0.015), (0.13, 0.09, 0.05), (0.4, 0.12, 0.1), (0.3, 0.3, 0.02)]
)
def test_capsules_fill_a_box(half):
    """No piece leaves the box or is larger than a height field bears, and they nearly reach every face of it."""
    pieces = fill(half)
    low = np.array([np.minimum(piece.start, piece.end) - piece.radius for piece in pieces])
    high = np.array([np.maximum(piece.start, piece.end) + piece.radius for piece in pieces])
    np.testing.assert_allclose(high.max(axis=0), -low.min(axis=0), atol=1e-12)
    assert (high.max(axis=0) <= np.array(half) + 1e-9).all()
    assert (high.max(axis=0) >= np.array(half) - 0.3 * min(half) - 1e-9).all()
    for piece in pieces:
        length = np.abs(np.subtract(piece.end, piece.start)).max() / 2 + piece.radius
        assert length <= 0.13 + 1e-9
        assert length * piece.radius <= 0.0065 + 1e-9


def test_a_go1s_trunk_is_filled_as_its_own_file_fills_it():
    """Of the trunk's box of (0.26, 0.18, 0.1) m become the two capsules of go1.py, which never lose a contact."""
    spec = go1.build().spec.compile()
    (left, right) = sorted(fill((0.13, 0.09, 0.05)), key=lambda piece: -piece.start[1])
    for piece, name in ((left, "trunk_left"), (right, "trunk_right")):
        geom = spec.geom(name)
        assert piece.radius == geom.size[0]
        np.testing.assert_allclose(geom.pos, np.add(piece.start, piece.end) / 2, atol=1e-9)
        np.testing.assert_allclose(geom.size[1], (piece.end[0] - piece.start[0]) / 2, atol=1e-9)


def test_pieces_lose_no_contact_on_stairs(tmp_path, torch_device):
    """On stairs at 64 yaws, on all six sides, the pieces of a large box cover no more prisms than are tested."""
    path = write_scout(tmp_path)
    path.write_text(path.read_text().replace('size="0.18 0.08 0.045"', 'size="0.3 0.15 0.12"'))
    robot = robot_draft.draft(path)[0].build(tmp_path)
    shape = Share(shape=Stairs(tile=4.0, platform=1.0))
    ground = terrain.build(Grid(shapes=(shape,), levels=1, columns=1, tile=4.0, border=1.0))
    sides = [(0, 0), (np.pi, 0), (np.pi / 2, 0), (-np.pi / 2, 0), (0, np.pi / 2), (0, -np.pi / 2)]  # roll, pitch
    angles = [(yaw, pitch, roll) for yaw in np.arange(64) * np.pi / 32 for roll, pitch in sides]
    quat = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
    n, rng = len(angles), np.random.default_rng(2)
    place = rng.uniform(-1.5, 1.5, (n, 2))
    i, j = np.round((place - ground.corner) / ground.cell).astype(int).T
    height = ground.heights[i, j] + 0.02
    physics = engines.build(
        "warp", robot, ground, n, torch_device, PhysicsConfig(substeps=1, contacts=400, rows=1200)
    )  # fmt: skip
    qpos = np.column_stack([place, height, quat, np.tile(robot.pose, (n, 1))])
    physics.arrays.qpos.assign(qpos.astype(np.float32))
    physics.step()
    assert not (physics.arrays.overflow.numpy() & physics.lost_contacts).any()
    pressed = physics.arrays.part_force.numpy()[0] > 0
    assert pressed[:, 0].mean() > 0.9, "nearly every robot's box must have been pressed on the ground"
