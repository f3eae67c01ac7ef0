"""Which part of a robot pushes how hard on the terrain, from the simulator's own contact arrays.

Every collision geom belongs to a *part* (the base, a foot, a limb) or to the terrain. For every
substep of a control step the normal forces of all contacts between a part and the terrain are summed;
the largest of these sums over the substeps is the part's force.
"""

import warp as wp

from ..check import require, require_axes

wp.set_module_options({"enable_backward": False})

TERRAIN = -1  # part of a geom of the terrain
UNWATCHED = -2  # part of a geom whose contacts do not matter


@wp.struct
class Contacts:
    """The simulator's contacts of one substep, over all worlds; mujoco-warp's layout."""

    count: wp.array[int]  # (1,): contacts found, which may be more than there is room for
    world: wp.array[int]  # (room,)
    geom: wp.array[wp.vec2i]  # (room,): the two geoms
    dim: wp.array[int]  # (room,): 1 without friction, 3 with a pyramidal friction cone
    row: wp.array2d[int]  # (room, any): first row of the contact in ``force``, negative if it is not in the solution
    force: wp.array2d[float]  # (num_envs, rows): constraint forces [N]


@wp.func
def normal_force(dim: int, row: int, force: wp.array2d[float], world: int) -> float:
    """Normal force of a contact [N].

    Every edge of a pyramidal friction cone has a normal component of one, so their forces add up
    (MuJoCo's documentation, *Computation: Constraint model*, contact).
    """
    edges = wp.where(dim == 1, 1, 2 * (dim - 1))
    total = float(0.0)
    for i in range(edges):
        if row + i < force.shape[1]:
            total += force[world, row + i]
    return total


@wp.func
def peak_force(part_force: wp.array3d[float], env: int, part: int) -> float:
    """The largest force of a part over the substeps [N]."""
    peak = part_force[0, env, part]
    for substep in range(1, part_force.shape[0]):
        peak = wp.max(peak, part_force[substep, env, part])
    return peak


@wp.kernel
def _gather_contacts(
    # In
    contacts: Contacts,
    geom_part: wp.array[int],
    substep: int,
    num_threads: int,
    # In and out
    part_force: wp.array3d[float],
    peak: wp.array[int],
):
    first = wp.tid()
    found = contacts.count[0]
    if first == 0:
        wp.atomic_max(peak, 0, found)
    for i in range(first, wp.min(found, contacts.world.shape[0]), num_threads):
        row = contacts.row[i, 0]
        if row < 0:
            continue
        world = contacts.world[i]
        dim = contacts.dim[i]
        rows = row + wp.where(dim == 1, 1, 2 * (dim - 1))
        if rows > peak[1]:  # reading first spares nearly all of the atomics
            wp.atomic_max(peak, 1, rows)
        pair = contacts.geom[i]
        a = geom_part[pair[0]]
        b = geom_part[pair[1]]
        if wp.min(a, b) == wp.static(TERRAIN) and wp.max(a, b) >= 0:
            push = normal_force(dim, row, contacts.force, world)
            wp.atomic_add(part_force, substep, world, wp.max(a, b), push)


def gather_contacts(
    contacts: Contacts,
    geom_part: wp.array,
    part_force: wp.array,
    peak: wp.array,
    *,
    substep: int,
    record: bool = False,
) -> wp.Launch | None:
    """Add the normal forces between each part and the terrain to one substep of ``part_force``.

    Args:
        contacts: The simulator's contacts of this substep.
        geom_part: Part of every geom, or ``TERRAIN`` or ``UNWATCHED``, int32, shape (num_geoms,).
        part_force: Normal forces [N], float32, shape (substeps, num_envs, parts). Added to: zero it
            before the first substep.
        peak: int32, shape (2,). Raised to the number of contacts over all worlds, and to the largest
            number of constraint rows that a world with a contact uses.
        substep: Which substep this is, in [0, substeps).
        record: Return the launch, to be replayed with ``launch()``, instead of making it.

    Raises:
        ValueError: If an array has another shape, dtype or device, or the substep is out of range.
    """
    require("geom_part", geom_part, dtype=wp.int32)
    require_axes("geom_part", geom_part, 1)
    require_axes("part_force", part_force, 3)
    require("part_force", part_force, dtype=wp.float32, shape=part_force.shape, like=geom_part)
    require("peak", peak, dtype=wp.int32, shape=(2,), like=geom_part)
    room = contacts.world.shape
    for name, dtype in (("world", wp.int32), ("geom", wp.vec2i), ("dim", wp.int32)):
        require(f"contacts.{name}", getattr(contacts, name), dtype=dtype, shape=room, like=geom_part)
    require("contacts.count", contacts.count, dtype=wp.int32, shape=(1,), like=geom_part)
    require_axes("contacts.row", contacts.row, 2)
    require("contacts.row", contacts.row, dtype=wp.int32, shape=(*room, contacts.row.shape[1]), like=geom_part)
    require_axes("contacts.force", contacts.force, 2)
    rows = (part_force.shape[1], contacts.force.shape[1])
    require("contacts.force", contacts.force, dtype=wp.float32, shape=rows, like=geom_part)
    if not 0 <= substep < part_force.shape[0]:
        raise ValueError(f"substep must be in [0, {part_force.shape[0]}), got {substep}.")
    num_threads = 1 if geom_part.device.is_cpu else max(1, room[0])
    return wp.launch(
        _gather_contacts,
        dim=num_threads,
        inputs=[contacts, geom_part, substep, num_threads],
        outputs=[part_force, peak],
        device=geom_part.device,
        record_cmd=record,
    )
