"""Copies between the kernels' arrays and MuJoCo's rows of doubles, around a control step of the native engine.

A row is the integration state of a world. Between control steps the state is that of the arrays, in single precision,
except for the warm start, which stays in the row: a control step widens positions, velocities and targets once, and
narrows the results once.
"""

import warp as wp

from ..structs import StructTable
from .state import Simulation

wp.set_module_options({"enable_backward": False})


@wp.struct
class Rows:
    """MuJoCo's memory of all worlds."""

    state: wp.array2d[wp.float64]  # the rows
    rest: wp.array[wp.float64]  # the row of a world at the model's defaults
    qpos: wp.array2d[wp.float64]  # a part of the rows, like the next two
    qvel: wp.array2d[wp.float64]
    ctrl: wp.array2d[wp.float64]
    torque: wp.array2d[wp.float64]  # of the last substep [N m]
    contact: wp.array3d[wp.vec3d]  # of every substep, in slots: forces in the contact's frame, the normal one first [N]
    part: wp.array[int]  # part of the robot whose contact a slot holds
    warning: wp.array3d[int]  # of every kind: its last detail, and its count


ROWS = StructTable(Rows, {
    "state": ("num_envs", "row"), "rest": ("row",), "qpos": ("num_envs", "nq"), "qvel": ("num_envs", "nv"),
    "ctrl": ("num_envs", "num_joints"), "torque": ("num_envs", "num_joints"),
    "contact": ("num_envs", "substeps", "slots"), "part": ("slots",), "warning": ("num_envs", "warnings", 2),
})  # fmt: skip


@wp.func
def widen_row(source: wp.array2d[wp.float32], target: wp.array2d[wp.float64], env: int):
    """Copy a world's row of singles to doubles."""
    for i in range(source.shape[1]):
        target[env, i] = wp.float64(source[env, i])


@wp.func
def narrow_row(source: wp.array2d[wp.float64], target: wp.array2d[wp.float32], env: int):
    """Copy a world's row of doubles to singles."""
    for i in range(source.shape[1]):
        target[env, i] = wp.float32(source[env, i])


@wp.kernel
def _widen(
    # In
    sim: Simulation,
    # Out
    rows: Rows,
):
    env = wp.tid()
    widen_row(sim.qpos, rows.qpos, env)
    widen_row(sim.qvel, rows.qvel, env)
    widen_row(sim.ctrl, rows.ctrl, env)


@wp.kernel
def _narrow(
    # In and out
    rows: Rows,
    # Out
    sim: Simulation,
):
    env = wp.tid()
    narrow_row(rows.qpos, sim.qpos, env)
    narrow_row(rows.qvel, sim.qvel, env)
    narrow_row(rows.torque, sim.torque, env)
    for substep in range(sim.part_force.shape[0]):
        for part in range(sim.part_force.shape[2]):
            sim.part_force[substep, env, part] = 0.0
        for slot in range(rows.part.shape[0]):
            normal = wp.float32(rows.contact[env, substep, slot][0])
            sim.part_force[substep, env, rows.part[slot]] += normal
    for kind in range(rows.warning.shape[1]):
        if rows.warning[env, kind, 1] > 0:
            sim.overflow[env] = sim.overflow[env] | (1 << kind)
            rows.warning[env, kind, 1] = 0


@wp.kernel
def _reset(
    # In
    mask: wp.array[wp.bool],
    # In and out
    rows: Rows,
    # Out
    sim: Simulation,
):
    env = wp.tid()
    if mask[env]:
        for i in range(rows.rest.shape[0]):
            rows.state[env, i] = rows.rest[i]
        narrow_row(rows.qpos, sim.qpos, env)
        narrow_row(rows.qvel, sim.qvel, env)
        narrow_row(rows.ctrl, sim.ctrl, env)


def widen(sim: Simulation, rows: Rows) -> None:
    """Write positions, velocities and targets into every world's row.

    Args:
        sim: The kernels' arrays, as in ``SIMULATION``.
        rows: MuJoCo's memory, as in ``ROWS``.
    """
    wp.launch(_widen, dim=rows.state.shape[0], inputs=[sim, rows], device=rows.state.device)


def narrow(rows: Rows, sim: Simulation) -> None:
    """Read back the results of a control step in every world: state, torques, forces of the parts, and warnings.

    The force of a part is the sum of the normal forces in its slots. A warning of kind i sets bit i of
    ``sim.overflow``, and MuJoCo's count of it is reset. The arguments are those of ``widen``.
    """
    wp.launch(_narrow, dim=rows.state.shape[0], inputs=[rows, sim], device=rows.state.device)


def reset_rows(mask: wp.array, rows: Rows, sim: Simulation) -> None:
    """Set every world of ``mask`` to the model's defaults, its row and its arrays; leave the others alone.

    Args:
        mask: bool, shape (num_envs,).
        rows: As for ``widen``.
        sim: As for ``widen``.
    """
    wp.launch(_reset, dim=mask.shape[0], inputs=[mask, rows, sim], device=rows.state.device)
