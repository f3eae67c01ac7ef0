"""MuJoCo's rows of doubles beside the arrays of the kernels."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.legged.rows import ROWS, narrow, reset_rows, widen
from deimos.kernels.legged.state import NUM_PARTS, SIMULATION, build

WORLDS, NQ, NV, JOINTS, ROW, SUBSTEPS, WARNINGS = 5, 19, 18, 12, 60, 3, 7
PART = np.array([0, 0, 1, 4, 4, 4, 12], np.int32)
SIZES = {
    "num_envs": WORLDS, "num_joints": JOINTS, "nq": NQ, "nv": NV, "substeps": SUBSTEPS, "row": ROW, "slots": len(PART),
    "warnings": WARNINGS,
}  # fmt: skip


@pytest.fixture
def case(device):
    """Random rows, of which positions, velocities and targets are parts, and arrays of other numbers."""
    rng = np.random.default_rng(0)
    state = wp.array(rng.normal(size=(WORLDS, ROW)), dtype=wp.float64, device=device)
    warning = np.zeros((WORLDS, WARNINGS, 2), np.int32)
    warning[1, 2], warning[3, 0], warning[3, 6] = (9, 1), (0, 4), (5, 2)
    rows = build(
        ROWS, device, state=state, qpos=state[:, 1:20], qvel=state[:, 20:38], ctrl=state[:, 45:57], part=PART,
        rest=rng.normal(size=ROW), torque=rng.normal(size=(WORLDS, JOINTS)), warning=warning,
        contact=rng.uniform(0, 9, size=(WORLDS, SUBSTEPS, len(PART), 3)),
    )  # fmt: skip
    shapes = {name: SIMULATION.shape(name, **SIZES) for name in SIMULATION.names}
    sim = build(SIMULATION, device, **{name: rng.normal(size=shape) for name, shape in shapes.items()})
    ROWS.require("rows", rows, rows.state, **SIZES)
    return rows, sim


def test_widening_writes_what_a_control_step_starts_from(case):
    """Positions, velocities and targets are the arrays' numbers as doubles; the rest of a row stays as it is."""
    rows, sim = case
    expected = rows.state.numpy()
    expected[:, 1:20], expected[:, 20:38], expected[:, 45:57] = (
        array.numpy().astype(np.float64) for array in (sim.qpos, sim.qvel, sim.ctrl)
    )
    widen(sim, rows)
    np.testing.assert_array_equal(rows.state.numpy(), expected)


def test_narrowing_reads_what_came_of_it(case):
    """State and torques are rounded once; a part's force is the sum of its slots' normal ones, in every substep."""
    rows, sim = case
    before = {name: getattr(rows, name).numpy() for name in ROWS.names}
    targets = sim.ctrl.numpy()
    narrow(rows, sim)
    for name in ("qpos", "qvel", "torque"):
        np.testing.assert_array_equal(getattr(sim, name).numpy(), before[name].astype(np.float32), err_msg=name)
    force = np.zeros((SUBSTEPS, WORLDS, NUM_PARTS))
    for slot, part in enumerate(PART):
        force[:, :, part] += before["contact"][:, :, slot, 0].T
    np.testing.assert_allclose(sim.part_force.numpy(), force, rtol=1e-6)  # three float32 additions
    np.testing.assert_array_equal(sim.ctrl.numpy(), targets)
    for name in set(ROWS.names) - {"warning"}:
        np.testing.assert_array_equal(getattr(rows, name).numpy(), before[name], err_msg=name)


def test_narrowing_turns_warnings_into_bits_once(case):
    """A warning of kind i sets bit i and leaves the others as they were; its count starts anew."""
    rows, sim = case
    sim.overflow.assign(np.array([0, 1 << 9, 0, 0, 4]))
    narrow(rows, sim)
    expected = [0, 1 << 9 | 1 << 2, 0, 1 << 0 | 1 << 6, 4]
    assert sim.overflow.numpy().tolist() == expected
    assert not rows.warning.numpy()[:, :, 1].any()
    narrow(rows, sim)
    assert sim.overflow.numpy().tolist() == expected


def test_a_reset_touches_the_masked_worlds_only(case):
    """Their rows become the row at rest and their arrays its numbers; no bit of the others changes."""
    rows, sim = case
    arrays = {name: getattr(sim, name).numpy() for name in SIMULATION.names}
    state, rest = rows.state.numpy(), rows.rest.numpy()
    mask = np.array([False, True, False, False, True])
    reset_rows(wp.array(mask, dtype=wp.bool, device=rows.state.device), rows, sim)
    np.testing.assert_array_equal(rows.state.numpy(), np.where(mask[:, None], rest, state))
    for name, part in ("qpos", slice(1, 20)), ("qvel", slice(20, 38)), ("ctrl", slice(45, 57)):
        expected = np.where(mask[:, None], rest[part].astype(np.float32), arrays[name])
        np.testing.assert_array_equal(getattr(sim, name).numpy(), expected, err_msg=name)


def test_positions_are_the_rows_own_memory(case):
    """What is written into a part of the rows is in the rows: nothing is copied between them."""
    rows, _ = case
    rows.state.fill_(2.5)
    assert (rows.qpos.numpy() == 2.5).all()
    assert rows.qpos.ptr == rows.state.ptr + 8
