"""Rotations by MuJoCo's quaternions, against MuJoCo itself."""

import mujoco
import numpy as np
import pytest
import warp as wp
from deimos.kernels.rotations import (
    down_in_body,
    from_yaw,
    heading,
    rotate,
    rotate_by_heading,
    rotate_inverse,
)

# A rotation is about ten float32 operations on numbers of the vector's size.
TOLERANCE = dict(rtol=0, atol=10 * 2.0**-23)
N = 200


@wp.kernel
def _rotate_all(
    quat: wp.array[wp.vec4],
    v: wp.array[wp.vec3],
    forth: wp.array[wp.vec3],
    back: wp.array[wp.vec3],
    down: wp.array[wp.vec3],
    direction: wp.array[wp.vec2],
    turned: wp.array[wp.vec2],
    upright: wp.array[wp.vec4],
):
    i = wp.tid()
    forth[i] = rotate(quat[i], v[i])
    back[i] = rotate_inverse(quat[i], v[i])
    down[i] = down_in_body(quat[i])
    direction[i] = heading(quat[i])
    turned[i] = rotate_by_heading(direction[i], v[i][0], v[i][1])
    upright[i] = from_yaw(wp.atan2(direction[i][1], direction[i][0]))


OUTPUTS = {
    "forth": wp.vec3, "back": wp.vec3, "down": wp.vec3, "direction": wp.vec2, "turned": wp.vec2, "upright": wp.vec4,
}  # fmt: skip


def run(quat, v, device):
    """Everything that the kernel writes, by name."""
    quat, v = np.asarray(quat, np.float32), np.asarray(v, np.float32)
    out = {name: wp.full(len(quat), dtype(np.nan), dtype=dtype, device=device) for name, dtype in OUTPUTS.items()}
    inputs = [wp.array(quat, dtype=wp.vec4, device=device), wp.array(v, dtype=wp.vec3, device=device)]
    wp.launch(_rotate_all, dim=len(quat), inputs=inputs, outputs=list(out.values()), device=device)
    return {name: array.numpy() for name, array in out.items()}


@pytest.fixture
def case():
    """Random unit quaternions and unit vectors."""
    rng = np.random.default_rng(0)
    quat, v = rng.normal(size=(N, 4)), rng.normal(size=(N, 3))
    return quat / np.linalg.norm(quat, axis=1, keepdims=True), v / np.linalg.norm(v, axis=1, keepdims=True)


def matrices(quat):
    """Rotation matrices by MuJoCo, shape (n, 3, 3)."""
    result = np.empty((len(quat), 9))
    for i in range(len(quat)):
        mujoco.mju_quat2Mat(result[i], quat[i])
    return result.reshape(-1, 3, 3)


def test_matches_mujoco(device, case):
    """Both ways, gravity's direction and the heading agree with MuJoCo's own rotation matrix."""
    quat, v = case
    out, matrix = run(quat, v, device), matrices(quat)
    np.testing.assert_allclose(out["forth"], np.einsum("nij,nj->ni", matrix, v), **TOLERANCE)
    np.testing.assert_allclose(out["back"], np.einsum("nji,nj->ni", matrix, v), **TOLERANCE)
    np.testing.assert_allclose(out["down"], -matrix[:, 2], **TOLERANCE)
    # The direction is divided by the length of the x axis's shadow, which may be short.
    shadow = np.linalg.norm(matrix[:, :2, 0], axis=1)
    error = np.linalg.norm(out["direction"] - matrix[:, :2, 0] / shadow[:, None], axis=1)
    assert np.all(error <= 20 * 2.0**-23 / shadow)


def test_turning_there_and_back_is_nothing(device, case):
    """``rotate_inverse`` undoes ``rotate``, and lengths stay."""
    quat, v = case
    forth = run(quat, v, device)["forth"]
    np.testing.assert_allclose(run(quat, forth, device)["back"], v, rtol=0, atol=20 * 2.0**-23)
    np.testing.assert_allclose(np.linalg.norm(forth, axis=1), 1.0, rtol=0, atol=10 * 2.0**-23)


def test_heading_ignores_pitch_and_roll(device, case):
    """Turning by the heading turns as the upright body of that yaw does."""
    quat, v = case
    out = run(quat, v, device)
    upright = run(out["upright"], v, device)
    # The yaw goes through atan2, sin and cos, each good to a few units in the last place.
    np.testing.assert_allclose(upright["forth"][:, :2], out["turned"], rtol=0, atol=30 * 2.0**-23)
    np.testing.assert_allclose(upright["forth"][:, 2], v[:, 2], rtol=0, atol=2.0**-23)
    np.testing.assert_allclose(np.linalg.norm(out["direction"], axis=1), 1.0, rtol=0, atol=4 * 2.0**-23)


def test_known_turn(device):
    """A quarter turn to the left takes x to y; a body on its nose has no heading, and that counts as x."""
    half = np.sqrt(0.5)
    out = run([[half, 0, 0, half], [half, 0, half, 0]], [[1, 0, 0], [1, 2, 3]], device)
    np.testing.assert_allclose(out["forth"][0], [0, 1, 0], **TOLERANCE)
    np.testing.assert_allclose(out["direction"][0], [0, 1], **TOLERANCE)
    np.testing.assert_array_equal(out["direction"][1], [1, 0])
    np.testing.assert_array_equal(out["turned"][1], [1, 2])
