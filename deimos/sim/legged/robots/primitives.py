"""Bodies from numbers, and the shapes that robots are built of: hard ones that collide, and those for the eye alone."""

from typing import TYPE_CHECKING

from deimos.sim.legged.robots import COLLISION_GROUP, CONTACT_STIFFNESS, VISUAL_GROUP

if TYPE_CHECKING:
    import mujoco


def add_inertia(body: "mujoco.MjsBody", mass: float, centre: tuple, inertia: tuple) -> None:
    """Set a body's mass [kg], centre of mass [m] and inertia about it (xx, yy, zz, xy, xz, yz) [kg m^2]."""
    body.mass, body.ipos, body.fullinertia = mass, centre, inertia
    body.explicitinertial = True


def add_actuator(
    spec: "mujoco.MjSpec", joint: str, *, stiffness: float, damping: float, max_torque: float
) -> None:  # fmt: skip
    """Add a position actuator of the joint's name: gains [N m/rad] and [N m s/rad], and the largest torque [N m]."""
    import mujoco

    actuator = spec.add_actuator(name=joint, target=joint)
    actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
    actuator.set_to_position(kp=stiffness, kv=damping)
    actuator.forcerange = (-max_torque, max_torque)
    actuator.forcelimited = True


def add_hard_geom(
    body: "mujoco.MjsBody", name: str, radius: float, start: tuple, end: tuple | None = None,
    *, contype: int, conaffinity: int,
) -> "mujoco.MjsGeom":  # fmt: skip
    """Add a sphere, or a capsule from ``start`` to ``end``, without mass and without friction."""
    import mujoco

    geom = body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_SPHERE if end is None else mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=(radius, 0.0, 0.0),
        group=COLLISION_GROUP,
        contype=contype,
        conaffinity=conaffinity,
        condim=1,
        friction=(1.0, 0.005, 0.0001),
        solref=CONTACT_STIFFNESS,
        mass=0.0,
        rgba=(0.9, 0.3, 0.2, 0.4),
    )
    _place(geom, start, end)
    return geom


def add_look(
    body: "mujoco.MjsBody", shape: str, size: tuple, pos: tuple, rgba: tuple,
    *, quat: tuple = (1.0, 0.0, 0.0, 0.0), end: tuple | None = None,
) -> None:  # fmt: skip
    """Add a shape for the eye alone."""
    import mujoco

    geom = body.add_geom(
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}"),
        size=(*size, 0.0, 0.0)[:3],
        quat=quat,
        group=VISUAL_GROUP,
        contype=0,
        conaffinity=0,
        mass=0.0,
        rgba=rgba,
    )
    _place(geom, pos, end)


def _place(geom: "mujoco.MjsGeom", start: tuple, end: tuple | None) -> None:
    if end is None:
        geom.pos = start
    else:
        geom.fromto = (*start, *end)
