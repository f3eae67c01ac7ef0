"""Tables of struct arrays: one declaration gives memory, checks and names."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.structs import StructTable


@wp.struct
class Bodies:
    """Two arrays of vectors, one of rows, and a number."""

    position: wp.array[wp.vec3]
    mass: wp.array[float]
    joint: wp.array2d[int]
    gravity: float


TABLE = StructTable(Bodies, {"joint": ("num_envs", "num_joints"), "mass": (3,)})


def test_arrays_are_allocated_by_the_table(device):
    """Every array has the declared length or one element for every world, of the struct's own type, all zeros."""
    bodies = TABLE.allocate(device, num_envs=5, num_joints=2)
    assert TABLE.names == ("position", "mass", "joint")
    shapes = {name: (getattr(bodies, name).shape, getattr(bodies, name).dtype) for name in TABLE.names}
    assert shapes == {"position": ((5,), wp.vec3), "mass": ((3,), wp.float32), "joint": ((5, 2), wp.int32)}
    for name in TABLE.names:
        array = getattr(bodies, name)
        assert str(array.device) == device
        np.testing.assert_array_equal(array.numpy(), 0)


def test_what_was_allocated_passes_the_check(device):
    """The check accepts what the table allocates, and names the first array that has another length."""
    bodies = TABLE.allocate(device, num_envs=5, num_joints=2)
    TABLE.require("bodies", bodies, bodies.mass, num_envs=5, num_joints=2)
    with pytest.raises(ValueError, match=r"bodies\.position must be vec3f\(6,\) on .*, got vec3f\(5,\)"):
        TABLE.require("bodies", bodies, bodies.mass, num_envs=6, num_joints=2)
    bodies.joint = wp.zeros((5, 3), dtype=int, device=device)
    with pytest.raises(ValueError, match=r"bodies\.joint must be int32\(5, 2\) on .*, got int32\(5, 3\)"):
        TABLE.require("bodies", bodies, bodies.mass, num_envs=5, num_joints=2)


def test_rows_are_views_of_some_worlds(device):
    """Arrays with an element for every world are views of those rows; others, and numbers, are shared as they are."""
    bodies = TABLE.allocate(device, num_envs=5, num_joints=2)
    bodies.gravity = 9.81
    part = TABLE.rows(bodies, slice(1, 4))
    TABLE.require("part", part, bodies.mass, num_envs=3, num_joints=2)
    part.joint.fill_(7)
    np.testing.assert_array_equal(bodies.joint.numpy(), [[0, 0], [7, 7], [7, 7], [7, 7], [0, 0]])
    assert part.mass.ptr == bodies.mass.ptr
    assert part.gravity == bodies.gravity


def test_a_size_that_is_not_given_is_named(device):
    """A size that a shape needs and nobody gives is named with the shape."""
    with pytest.raises(ValueError, match=r"Bodies\.joint has the shape .*; num_joints must be given"):
        TABLE.allocate(device, num_envs=5)


def test_a_shape_of_no_array_is_refused():
    """A table that names what is no array of the struct is refused with the name."""
    with pytest.raises(ValueError, match="shapes must name arrays of Bodies, got gravity"):
        StructTable(Bodies, {"gravity": (3,)})
