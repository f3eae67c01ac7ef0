"""The check that every launcher makes on its arguments."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.check import require, require_axes


def test_accepts_what_fits(device):
    """An array that has what is asked for passes, by value and by example, and comes out as it went in."""
    array = wp.array([1.0, 2.0, 3.0], dtype=wp.float32, device=device)
    address = array.ptr

    require("a", array)
    require("a", array, dtype=wp.float32)
    require("a", array, shape=(3,))
    require("a", array, shape=[3])
    require("a", array, dtype=wp.float32, shape=(3,), like=wp.zeros((2, 2), dtype=wp.int32, device=device))
    require("a", array, like=wp.zeros(3, dtype=wp.float32, device=device))

    assert array.ptr == address
    np.testing.assert_array_equal(array.numpy(), [1.0, 2.0, 3.0])


@pytest.mark.parametrize("array", [np.zeros(3), [0.0], None])
def test_rejects_what_is_no_warp_array(array):
    """The message names the argument and the type that came instead of a Warp array."""
    with pytest.raises(ValueError, match=rf"force must be a Warp array, got {type(array).__name__}\."):
        require("force", array)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"dtype": wp.float32}, r"a must be float32\(4,\) on .*, got vec3f\(4,\) on "),
        ({"dtype": wp.vec4}, r"a must be vec4f\(4,\) on .*, got vec3f\(4,\) on "),
        ({"shape": (5,)}, r"a must be vec3f\(5,\) on .*, got vec3f\(4,\) on "),
        ({"shape": (4, 1)}, r"a must be vec3f\(4, 1\) on .*, got vec3f\(4,\) on "),
        ({"dtype": wp.vec3, "shape": ()}, r"a must be vec3f\(\) on .*, got vec3f\(4,\) on "),
    ],
)
def test_rejects_what_does_not_fit(device, asked, message):
    """A wrong dtype, shape or number of dimensions is refused with what was asked for and what came."""
    with pytest.raises(ValueError, match=message):
        require("a", wp.zeros(4, dtype=wp.vec3, device=device), **asked)


def test_example_gives_what_is_not_named(device):
    """The dtype and the shape of ``like`` hold unless they are named."""
    array, example = wp.zeros(4, dtype=wp.float32, device=device), wp.zeros(5, dtype=wp.int32, device=device)

    require("a", array, dtype=wp.float32, shape=(4,), like=example)
    with pytest.raises(ValueError, match=r"a must be int32\(4,\)"):
        require("a", array, shape=(4,), like=example)
    with pytest.raises(ValueError, match=r"a must be float32\(5,\)"):
        require("a", array, dtype=wp.float32, like=example)


def test_rejects_another_device(device):
    """An array on another device than that of ``like`` is refused with both devices."""
    if device == "cpu":
        pytest.skip("There is only one device here.")
    array, example = wp.zeros(4, dtype=wp.float32, device="cpu"), wp.zeros(4, dtype=wp.float32, device=device)
    with pytest.raises(ValueError, match=rf"on {device}, got float32\(4,\) on cpu"):
        require("a", array, like=example)


def test_rejects_an_unset_array_of_a_struct(device):
    """A struct's array that was never set is refused by its name, before a kernel could read it."""

    @wp.struct
    class Bodies:
        mass: wp.array[float]

    with pytest.raises(ValueError, match=r"bodies\.mass must be a Warp array, got NoneType"):
        require("bodies.mass", Bodies().mass)


def test_the_number_of_axes_is_checked():
    """An array with another number of axes is refused with its shape."""
    array = wp.zeros((2, 3), dtype=float, device="cpu")
    require_axes("candidate", array, 2)
    with pytest.raises(ValueError, match=r"candidate must have 3 axes, got the shape \(2, 3\)\."):
        require_axes("candidate", array, 3)
