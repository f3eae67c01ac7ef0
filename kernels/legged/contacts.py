"""How hard each part of a robot pushes on the terrain, from the simulator's own contact arrays.

Every collision geom belongs to a *part* (the base, a foot, a limb) or to the terrain. For every
substep of a control step the normal forces of all contacts between a part and the terrain are summed;
the largest of these sums over the substeps is the part's force.
"""

import warp as wp

from ..lanes import split
from ..structs import StructTable

wp.set_module_options({"enable_backward": False})

TERRAIN = -1  # part of a geom of the terrain
UNWATCHED = -2  # part of a geom whose contacts do not matter


@wp.struct
class Contacts:
    """The simulator's contacts of one substep, over all worlds, in mujoco-warp's layout, and the forces that result."""

    count: wp.array[int]  # contacts found, which may be more than the buffer holds
    world: wp.array[int]
    geom: wp.array[wp.vec2i]  # the two geoms
    dim: wp.array[int]  # 1 without friction, 3 with a pyramidal friction cone
    row: wp.array2d[int]  # first row of the contact in ``force``, negative if it is not in the solution
    force: wp.array2d[float]  # constraint forces [N]
    geom_part: wp.array[int]  # part of every geom, or ``TERRAIN`` or ``UNWATCHED``
    part_force: wp.array3d[float]  # normal forces of every substep [N]; zero it before the first
    peak: wp.array[int]  # most contacts over all worlds, and most constraint rows of a world with a contact, so far


CONTACTS = StructTable(Contacts, {
    "count": (1,), "world": ("buffer",), "geom": ("buffer",), "dim": ("buffer",), "row": ("buffer", "edges"),
    "force": ("num_envs", "rows"), "geom_part": ("num_geoms",), "part_force": ("substeps", "num_envs", "parts"),
    "peak": (2,),
})  # fmt: skip


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
    substep: int,
    num_threads: int,
    # In and out
    contacts: Contacts,
):
    first = wp.tid()
    peak = contacts.peak
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
        a = contacts.geom_part[pair[0]]
        b = contacts.geom_part[pair[1]]
        if wp.min(a, b) == wp.static(TERRAIN) and wp.max(a, b) >= 0:
            push = normal_force(dim, row, contacts.force, world)
            wp.atomic_add(contacts.part_force, substep, world, wp.max(a, b), push)


def gather_contacts(contacts: Contacts, *, substep: int) -> None:
    """Add the normal forces between each part and the terrain to one substep of ``part_force``; raise ``peak``.

    Args:
        contacts: The contacts of this substep, checked by ``CONTACTS`` before; only the substep is checked here.
        substep: Which substep this is, in [0, substeps).

    Raises:
        ValueError: If the substep is out of range.
    """
    substeps = contacts.part_force.shape[0]
    if not 0 <= substep < substeps:
        raise ValueError(f"substep must be in [0, {substeps}), got {substep}.")
    device = contacts.world.device
    num_threads = split(max(1, contacts.world.shape[0]), device)
    wp.launch(_gather_contacts, dim=num_threads, inputs=[substep, num_threads], outputs=[contacts], device=device)
