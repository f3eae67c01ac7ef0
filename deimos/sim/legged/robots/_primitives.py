"""Building blocks of robots: bodies from numbers, actuators, shapes that collide and visual shapes."""

import dataclasses
from typing import TYPE_CHECKING

from deimos.sim.legged.robots import COLLISION_GROUP, CONTACT_STIFFNESS, VISUAL_GROUP, Joint, Robot

if TYPE_CHECKING:
    import mujoco

HOLD = 1e7  # [N s/m] and [N m s/rad]; under the robot's whole weight a base moves 0.3 mm in 20 s


def add_inertia(body: "mujoco.MjsBody", mass: float, centre: tuple, inertia: tuple) -> None:
    """Set a body's mass [kg], centre of mass [m] and inertia about it (xx, yy, zz, xy, xz, yz) [kg m^2]."""
    body.mass, body.ipos, body.fullinertia = mass, centre, inertia
    body.explicitinertial = True


def add_actuators(spec: "mujoco.MjSpec", joints: tuple[Joint, ...]) -> None:
    """Add the position actuator of every joint."""
    import mujoco

    for joint in joints:
        actuator = spec.add_actuator(name=joint.name, target=joint.name)
        actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
        actuator.set_to_position(kp=joint.stiffness, kv=joint.damping)
        actuator.forcerange = (-joint.max_torque, joint.max_torque)
        actuator.forcelimited = True


def add_collision(
    body: "mujoco.MjsBody", name: str, radius: float, start: tuple, end: tuple | None = None,
    *, contype: int, conaffinity: int,
) -> "mujoco.MjsGeom":  # fmt: skip
    """Add a sphere, or a capsule from ``start`` to ``end``, without mass and without friction."""
    import mujoco

    geom = body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE if end is None else mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=(radius, 0.0, 0.0), group=COLLISION_GROUP, contype=contype, conaffinity=conaffinity, condim=1,
        friction=(1.0, 0.005, 0.0001), solref=CONTACT_STIFFNESS, mass=0.0, rgba=(0.9, 0.3, 0.2, 0.4),
    )  # fmt: skip
    _place(geom, start, end)
    return geom


def add_visual(
    body: "mujoco.MjsBody", shape: str, size: tuple, pos: tuple, rgba: tuple,
    *, quat: tuple = (1.0, 0.0, 0.0, 0.0), end: tuple | None = None,
) -> None:  # fmt: skip
    """Add a shape that is visible and touches nothing."""
    import mujoco

    geom = body.add_geom(
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}"), size=(*size, 0.0, 0.0)[:3], quat=quat,
        group=VISUAL_GROUP, contype=0, conaffinity=0, mass=0.0, rgba=rgba,
    )  # fmt: skip
    _place(geom, pos, end)


def hold_base(robot: Robot) -> Robot:
    """The robot with its base held where it is put, and legs that touch nothing; its ``spec`` is changed in place.

    The free joint is damped to a standstill, which unlike a weld holds each world's base where it was put. For tests of
    an arm alone.
    """
    robot.spec.worldbody.first_body().first_joint().damping = (HOLD, 0.0, 0.0)
    for part in robot.parts[1:]:
        for name in part:
            geom = robot.spec.geom(name)
            geom.contype = geom.conaffinity = 0
    return dataclasses.replace(robot, spawn_height=robot.standing_height)


def _place(geom: "mujoco.MjsGeom", start: tuple, end: tuple | None) -> None:
    if end is None:
        geom.pos = start
    else:
        geom.fromto = (*start, *end)
