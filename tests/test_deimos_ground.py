"""The height grid in MuJoCo: where it is, and that nothing falls through."""

import mujoco
import mujoco_warp
import numpy as np
import pytest
import trimesh
import warp as wp
from deimos.terrain import catalog

from deimos import terrain
from deimos.sim.legged.height_field import add_height_field

NAMES = tuple(catalog.names())
RADIUS = 0.04  # [m]
SPHERES = 8  # per shape
MILLIMETRE = 1e-3


@pytest.fixture(scope="module")
def ground():
    """A column of each shape at difficulty 0.6."""
    shapes = tuple(terrain.Share(shape=catalog.make(name)) for name in NAMES)
    grid = terrain.Grid(shapes=shapes, levels=1, columns=len(shapes), border=1.0, easiest=0.6, hardest=0.6)
    return terrain.build(grid)


def make_model(ground, num_spheres):
    """Spheres that touch the ground and not each other; what rolls comes to rest."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    field = add_height_field(spec, ground)
    field.contype, field.conaffinity = 0, 1
    for _ in range(num_spheres):
        body = spec.worldbody.add_body()
        body.add_freejoint()
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=0.1,
            contype=1, conaffinity=0, condim=6, friction=[1, 0.02, 0.02],
        )  # fmt: skip
    return spec.compile()


def starts(ground):
    """Poses above random points of every shape, free of the ground, shape (n, 7)."""
    rng = np.random.default_rng(0)
    xy = (ground.origins[0, :, None, :2] + rng.uniform(-3.9, 3.9, (len(NAMES), SPHERES, 2))).reshape(-1, 2)
    i, j = np.rint((xy - ground.corner) / ground.cell).astype(int).T
    around = [ground.heights[a - 2 : a + 3, b - 2 : b + 3].max() for a, b in zip(i, j, strict=True)]
    pose = np.zeros((len(xy), 7))
    pose[:, :2], pose[:, 2], pose[:, 3] = xy, np.array(around) + RADIUS + 0.02, 1.0
    return pose


def surface(ground, x, y):
    """Height of MuJoCo's surface: two triangles per cell, split from (i, j) to (i + 1, j + 1)."""
    u, v = (x - ground.corner[0]) / ground.cell, (y - ground.corner[1]) / ground.cell
    i, j = u.astype(int), v.astype(int)
    s, t = u - i, v - j
    h = ground.heights.astype(np.float64)
    a, b, c, d = h[i, j], h[i + 1, j], h[i, j + 1], h[i + 1, j + 1]
    return np.where(s >= t, a + s * (b - a) + t * (d - b), a + t * (c - a) + s * (d - c))


def clearance(ground, centre):
    """Distance of each sphere from the triangles of its cell and of the two around [m], negative inside."""
    first = ((centre[:, :2] - ground.corner) / ground.cell).astype(int) - 2
    i, j = first[:, :1] + np.repeat(np.arange(5), 5), first[:, 1:] + np.tile(np.arange(5), 5)

    def sample(i, j):
        x, y = ground.corner[0] + i * ground.cell, ground.corner[1] + j * ground.cell
        return np.stack([x, y, ground.heights[i, j]], axis=-1)

    a, b, c, d = sample(i, j), sample(i + 1, j), sample(i, j + 1), sample(i + 1, j + 1)
    corners = np.stack([np.stack([a, b, d], axis=2), np.stack([a, d, c], axis=2)], axis=2)  # (n, 25, 2, 3, 3)
    points = np.repeat(centre, 50, axis=0)
    closest = trimesh.triangles.closest_point(corners.reshape(-1, 3, 3), points)
    return np.linalg.norm(closest - points, axis=1).reshape(len(centre), 50).min(axis=1) - RADIUS


def fall_with_mujoco(ground, pose, num_steps):
    """Where the spheres are after every 100 steps of MuJoCo C, shape (num_steps / 100, n, 3)."""
    model = make_model(ground, len(pose))
    data = mujoco.MjData(model)
    data.qpos[:] = pose.reshape(-1)
    frames = []
    for _ in range(num_steps // 100):
        mujoco.mj_step(model, data, 100)
        frames.append(data.qpos.reshape(-1, 7)[:, :3].copy())
    assert not data.warning.number.any()
    return np.array(frames)


def fall_with_mujoco_warp(ground, pose, num_steps):
    """The same by mujoco-warp, a world for each sphere."""
    model = make_model(ground, 1)
    data = mujoco.MjData(model)
    warp_model = mujoco_warp.put_model(model)
    warp_data = mujoco_warp.put_data(model, data, nworld=len(pose), nconmax=24, njmax=144)
    warp_data.qpos = wp.array(pose, dtype=wp.float32)
    mujoco_warp.step(warp_model, warp_data)  # compiles, which a capture cannot
    with wp.ScopedCapture() as capture:
        mujoco_warp.step(warp_model, warp_data)
    frames = []
    for _ in range(num_steps // 100):
        for _ in range(100):
            wp.capture_launch(capture.graph)
        frames.append(warp_data.qpos.numpy()[:, :3].astype(np.float64))
    assert not warp_data.overflow.numpy().any()
    return np.array(frames)


@pytest.mark.parametrize("fall", [fall_with_mujoco, fall_with_mujoco_warp])
def test_spheres_stay_on_the_ground(ground, fall):
    """Spheres that are dropped on random points of every shape never fall through, and end on the grid's surface."""
    pose = starts(ground)
    frames = fall(ground, pose, num_steps=1500)
    assert np.isfinite(frames).all()
    for centres in frames:
        assert np.all(centres[:, 2] > surface(ground, *centres[:, :2].T))  # no centre below the ground, at any time
    gap = clearance(ground, frames[-1])
    by_shape = dict(zip(NAMES, gap.reshape(len(NAMES), SPHERES), strict=True))
    for name, distance in by_shape.items():
        # Between two stones a sphere is a wedge: walls of 1 m per cell carry ten times its weight, and contacts yield.
        wedged = name == "stepping-stones"
        assert np.abs(distance).max() < (2 if wedged else 1) * MILLIMETRE, name


@pytest.mark.parametrize("name", NAMES)
def test_rays_meet_the_samples(ground, name):
    """MuJoCo's own rays, right beside samples of every shape, find the heights of the grid."""
    model = make_model(ground, 0)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng(1)
    middle = ground.origins[0, NAMES.index(name), :2]
    index = np.rint((middle + rng.uniform(-4, 4, (200, 2)) - ground.corner) / ground.cell).astype(int)
    beside = 1e-6  # [m]; exactly on an edge of two triangles a ray may slip through
    down, geom = np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
    for i, j in index:
        x, y = ground.corner[0] + i * ground.cell + beside, ground.corner[1] + j * ground.cell + beside / 2
        height = 10.0 - mujoco.mj_ray(model, data, np.array([x, y, 10.0]), down, None, 1, -1, geom)
        assert abs(height - ground.heights[i, j]) < 1e-4  # 1 m / 0.05 m x 1 um, and float32


def test_samples_are_kept_to_a_micrometre(ground):
    """What MuJoCo stores is the grid, transposed: rows along y, shares of the extent, geom at the lowest sample."""
    model = make_model(ground, 0)
    shares = model.hfield_data.reshape(model.hfield_nrow[0], model.hfield_ncol[0])
    heights = model.geom_pos[0, 2] + model.hfield_size[0, 2] * shares.T.astype(np.float64)
    np.testing.assert_allclose(heights, ground.heights, rtol=0, atol=1e-6)
    half = model.hfield_size[0, :2]
    np.testing.assert_allclose(model.geom_pos[0, :2] - half, ground.corner, atol=1e-12)
    np.testing.assert_allclose(2 * half, ground.size, atol=1e-12)


@pytest.mark.parametrize("height", [0.0, 0.7, -3.0])
def test_level_ground_keeps_its_height(height):
    """A constant grid, whose own range is 0, is where it should be: a sphere comes to rest on it."""
    heights = np.full((21, 31), height, np.float32)
    plain = terrain.Terrain(
        heights, 0.1, (-1.0, -1.0), np.zeros((1, 1, 3), np.float32), ("flat",), 2.0, np.zeros(1, np.float32)
    )
    pose = np.array([[0.5, 1.0, height + RADIUS + 0.01, 1.0, 0.0, 0.0, 0.0]])
    centre = fall_with_mujoco(plain, pose, num_steps=500)[-1]
    assert centre[0, 2] == pytest.approx(height + RADIUS, abs=MILLIMETRE)
