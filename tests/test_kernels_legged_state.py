"""Arrays, sizes and parameters of legged robots that do not fit are refused."""

from dataclasses import replace

import pytest
import warp as wp
from deimos.kernels.legged.state import TABLES, LocomotionParams, make_params, sizes
from legged_arrays import PARAMS, SUBSTEPS, J, World, make_world


@pytest.mark.parametrize(
    ("label", "name"), [(label, name) for label, table in TABLES.items() for name in table.names]
)  # fmt: skip
@pytest.mark.parametrize("axis", [0, 1])
def test_rejects_arrays_of_another_length(device, label, name, axis):
    """Every array of every struct is checked when worlds are put together, and the message names it."""
    legged = World(make_world(5), device).legged
    struct = getattr(legged, label)
    shape = list(getattr(struct, name).shape)
    axis = min(axis, len(shape) - 1)
    shape[axis] += 1
    setattr(struct, name, wp.zeros(tuple(shape), dtype=TABLES[label].dtype(name), device=device))
    with pytest.raises(ValueError, match=rf"^{label}.{name} must be \w+\(.*got \w+\("):
        replace(legged)


@pytest.mark.parametrize(
    ("label", "name", "shape", "message"),
    [
        ("sim", "qpos", (5, 18), r"sim.qpos must be float32\(5, 19\).*got float32\(5, 18\)"),
        ("sim", "part_force", (4, 5, 3), r"sim.part_force must be float32\(4, 5, 13\)"),
        ("state", "air_time", (5, 3), r"state.air_time must be float32\(5, 4\)"),
        ("worlds", "goal", (5, 2), r"worlds.goal must be float32\(5, 3\)"),
        ("worlds", "fault", (2,), r"worlds.fault must be int32\(3,\)"),
        ("worlds", "action", (5, 11), r"worlds.action must be float32\(5, 12\)"),
        ("out", "term", (5, 3), r"out.term must be float32\(5, 12\)"),
        ("worlds", "tracking", (5, 1), r"worlds.tracking must be float32\(5, 2\)"),
        ("worlds", "obs", (5, 47), r"worlds.obs must be float32\(5, 48\)"),
        ("joints", "pose", (11,), r"joints.pose must be float32\(12,\)"),
        ("ground", "heights", (1, 9), r"ground.heights must be float32\(2, 2\).*got float32\(1, 9\)"),
    ],
)
def test_rejects_arrays_that_are_too_narrow(device, label, name, shape, message):
    """The message names the array, what it must be and what it was."""
    legged = World(make_world(5), device).legged
    setattr(getattr(legged, label), name, wp.zeros(shape, dtype=TABLES[label].dtype(name), device=device))
    with pytest.raises(ValueError, match=message):
        replace(legged)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("heights", (1, 9), "nx must be at least 2, got 1"), ("heights", (9, 1), "ny must be at least 2, got 1"),
        ("goal_dim", 2, "goal_dim must be at least 3, got 2"), ("num_joints", 11, "num_joints must be at least 12"),
        ("num_groups", 1, "num_groups must be at least 2"), ("num_terms", 3, "num_terms must be at least 12, got 3"),
    ],
)  # fmt: skip
def test_rejects_sizes_that_are_too_small(name, value, message):
    """A robot has four legs, a velocity goal, their terms, and stands on at least 2 x 2 samples."""
    right = {"num_envs": 5, "num_joints": J, "substeps": SUBSTEPS, "num_points": 0, "heights": (2, 2)}
    with pytest.raises(ValueError, match=message):
        sizes(**(right | {name: value}))


def test_parameters_are_given_all_and_by_name():
    """A parameter that is forgotten or misspelt is an error."""
    with pytest.raises(ValueError, match=r"params must be dt, stagger, .*high, got dt"):
        make_params(**{name: PARAMS[name] for name in PARAMS if name != "noise"})
    assert PARAMS.keys() == LocomotionParams.vars.keys()
