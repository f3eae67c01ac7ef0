"""Robots in the picture of ``deimos view``: where they are, what is feared before them, what an arm reaches for."""

from pathlib import Path

import numpy as np
import torch

from deimos.app.viewer_scene import RobotScene, build_scene, palette, shades
from deimos.app.viewer_session import SIDE, FearMap, Session
from deimos.run.saved import SavedRun

WALK = Path(__file__).parent.parent / "docs" / "results" / "quad_flat"
ARM = WALK.parent / "quad_arm_stand"


def session_of(path, **options):
    """A session of one robot under the policy of a run."""
    return Session(SavedRun.open(path, **options), 1, seed=5)


def test_components_have_names_and_units():
    """Components of a goal are called after its groups, with units, and have the scale that the policy sees."""
    session = session_of(WALK)
    assert [component.label for component in session.components] == [
        "velocity x [m/s]", "velocity y [m/s]", "yaw rate [rad/s]"
    ]  # fmt: skip
    assert [component.scale for component in session.components] == [2.0, 2.0, 0.25]
    low, high = session.bounds()
    torch.testing.assert_close(high, torch.ones(3))
    torch.testing.assert_close(low, -torch.ones(3))


def test_a_robot_is_shown_where_it_is():
    """The picture's data are those of the world, the camera follows the base, and a session's step moves it."""
    session = session_of(WALK)
    scene = build_scene(session)
    assert isinstance(scene, RobotScene)
    assert scene.model.body(scene.body).name == scene.model.body(int(scene.model.jnt_bodyid[0])).name
    before = scene.data.qpos.copy()
    for _ in range(10):
        session.step()
    scene.update()
    np.testing.assert_allclose(scene.data.qpos, session.env.tensors["qpos"][0].numpy(), atol=1e-6)
    assert np.abs(scene.data.qpos - before).max() > 1e-3


def ramp(axes=(0, 1)):
    """A map whose fear grows with its first component."""
    return FearMap(axes, (-1.0, -1.0), (1.0, 1.0), torch.linspace(0.1, 0.9, SIDE).expand(SIDE, SIDE))


def test_tiles_are_brightest_where_fear_is_highest():
    """Where fear grows with forward velocity, the tiles of fear get brighter along the robot's heading."""
    session = session_of(WALK)
    scene = RobotScene(session)
    w, x, y, z = scene.data.qpos[3:7]
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    tiles = scene.shapes(ramp())
    assert len(tiles) == 121
    ahead = [float((tile.pos[:2] - scene.data.qpos[:2]) @ [np.cos(yaw), np.sin(yaw)]) for tile in tiles]
    brightness = [float(np.sum(tile.rgba[:3])) for tile in tiles]
    assert np.corrcoef(ahead, brightness)[0, 1] > 0.95
    assert scene.shapes(ramp((0, 2))) == []  # not over a yaw rate
    assert scene.shapes(None) == []
    scene.has_tiles = False
    assert scene.shapes(ramp()) == []


def test_there_are_no_tiles_on_rough_ground():
    """On another ground than the policy was trained on it acts as well, and there are no tiles of fear."""
    scene = RobotScene(session_of(WALK, terrain="rough"))
    assert scene.shapes(ramp()) == []
    assert scene.model.nhfield == 1


def test_an_arm_reaches_for_a_ball():
    """Where a goal is a place, it is a ball in the picture; goals that fill no box have bounds all the same."""
    session = session_of(ARM)
    (ball,) = build_scene(session).shapes(None)
    np.testing.assert_allclose(ball.pos, session.env.goal_point(0), atol=1e-6)
    low, high = session.bounds()
    assert bool((low <= torch.tensor(session.goal) + 0.2).all())
    assert bool((high <= 1.0 + 1e-5).all())
    assert bool((low[3:] < high[3:]).all())


def test_colours_span_the_map():
    """The lowest probability of a map has the darkest colour, the highest the brightest; a level map has one."""
    shade = shades(ramp())
    assert (shade.min(), shade.max()) == (0, 255)
    assert (np.diff(shade[0]) > 0).all()
    assert set(shades(FearMap((0, 1), (0, 0), (1, 1), torch.full((SIDE, SIDE), 0.3))).ravel().tolist()) == {0}
    assert (np.diff(palette().sum(axis=1)) > -0.02).all()
