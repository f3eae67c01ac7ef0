"""The Unitree Go1, from primitives.

Where the numbers come from:

* Lengths, masses, centres of mass, inertias, joint ranges, torque limits and rotor inertias:
  ``unitree_go1/go1.xml`` of MuJoCo Menagerie, as mjlab 1.6 ships it; 12.743 kg in all. (Unitree's
  ``go1_description`` says 12.013 kg and has other inertias.)
* Collision: the feet's radius is Menagerie's and the limbs' capsules are its own, thickened. The
  trunk is two capsules that fill mjlab's box of (0.26, 0.18, 0.1) m: mujoco-warp keeps at most 50 contacts of a
  geom with the prisms of a height field, and on cells of 0.05 m a box, or longer capsules, have more.
* The hips are spheres of mjlab's radius, where they stick out of the trunk: a Go1 that lies on its side touches the
  ground with them. They are watched as parts of the base, since the thesis counts "any part of the robot's base"
  as a crash and a hip holds the trunk's motors; without them a robot on its side rested on thighs and calves and
  did not crash.
* Gains: those of the Unitree A1 in Legged Gym (20 N m/rad, 0.5 N m s/rad) raised by half, since a Go1
  is heavier; the default pose is the A1's, with the rear thighs like the front ones so that it stands level.
"""

from typing import TYPE_CHECKING

from deimos.sim.legged.robots import ROBOT_BIT, TERRAIN_BIT, Joint, Robot
from deimos.sim.legged.robots._primitives import add_actuators, add_collision, add_inertia, add_visual

if TYPE_CHECKING:
    import mujoco

LEGS = ("FL", "FR", "RL", "RR")  # the order of Legged Gym
JOINTS = ("hip", "thigh", "calf")
MASS = 12.743  # [kg]

HIP_X, HIP_Y = 0.1881, 0.04675  # [m], in the trunk
THIGH_Y = 0.08  # [m], in the hip
LINK = 0.213  # [m], length of thigh and of calf
FOOT_RADIUS = 0.023  # [m]
HIP_RADIUS = 0.05  # [m], mjlab's

# Each is mass [kg], centre of mass [m], inertia about it (xx, yy, zz, xy, xz, yz) [kg m^2].
TRUNK = (5.204, (0.0223, 0.002, -0.0005), (0.0168128, 0.0630095, 0.0716547, -2.297e-4, -2.946e-4, -4.19e-5))
HIP = (0.680, (-0.0049166, 0.00762615, -8.865e-5), (3.9938e-4, 7.33419e-4, 4.68422e-4, 1.459e-5, 1.246e-6, -1.575e-6))
THIGH = (
    1.009, (-0.00304722, 0.019315, -0.0305004), (0.0045988, 0.00468922, 8.17448e-4, -6.137e-5, -2.2753e-4, -6.108e-4),
)  # fmt: skip
CALF = (
    0.195862,
    (0.00429862, 0.000976676, -0.146197),
    (0.00148449, 0.00149764, 3.60682e-5, -6.19e-7, -1.772e-5, -3.57e-6),
)

RANGE = {"hip": (-0.863, 0.863), "thigh": (-0.686, 4.501), "calf": (-2.818, -0.888)}  # [rad]
MAX_TORQUE = {"hip": 23.7, "thigh": 23.7, "calf": 35.55}  # [N m]
ARMATURE = {"hip": 1.11842e-4 * 6**2, "thigh": 1.11842e-4 * 6**2, "calf": 1.11842e-4 * 9**2}  # [kg m^2], rotor x gear^2
POSE = {"hip": 0.1, "thigh": 0.8, "calf": -1.5}  # [rad]; the hip outward
STIFFNESS, DAMPING = 30.0, 0.8  # [N m/rad], [N m s/rad]
ACTION_SCALE = 0.25  # [rad]; Legged Gym's A1

ALONG_Y = (0.70711, 0.70711, 0.0, 0.0)  # the orientation of a cylinder
DARK, LIGHT, BLUE = (0.13, 0.14, 0.16, 1.0), (0.78, 0.8, 0.83, 1.0), (0.1, 0.45, 0.85, 1.0)


def build(*, stiffness: float = STIFFNESS, damping: float = DAMPING, action_scale: float = ACTION_SCALE) -> Robot:
    """A Go1 in free space.

    Args:
        stiffness: Position gain of every joint [N m/rad].
        damping: Velocity gain of every joint [N m s/rad].
        action_scale: What an action of 1 adds to a target angle [rad].
    """
    import mujoco

    joints = tuple(
        Joint(
            name=f"{leg}_{joint}", pose=(_left(leg) if joint == "hip" else 1) * POSE[joint], range=RANGE[joint],
            action_scale=action_scale, stiffness=stiffness, damping=damping, max_torque=MAX_TORQUE[joint],
        )
        for leg in LEGS for joint in JOINTS
    )  # fmt: skip
    spec = mujoco.MjSpec()
    spec.modelname = "go1"
    spec.compiler.degree = False
    trunk = spec.worldbody.add_body(name="trunk", pos=(0.0, 0.0, 0.325))
    trunk.add_freejoint(name="base")
    _add_mirrored(trunk, TRUNK, 1, 1)
    _add_trunk_geoms(trunk)
    for leg in LEGS:
        _add_leg(trunk, leg)
    add_actuators(spec, joints)
    return Robot(
        spec=spec,
        joints=joints,
        parts=(
            ("trunk_left", "trunk_right", "head", *(f"{leg}_hip" for leg in LEGS)),
            *((f"{leg}_foot",) for leg in LEGS),
            *((f"{leg}_{link}",) for leg in LEGS for link in ("thigh", "calf")),
        ),
        standing_height=0.325,
        spawn_height=0.42,
        reach=0.5,
    )


def _left(leg: str) -> int:
    return 1 if leg[1] == "L" else -1


def _front(leg: str) -> int:
    return 1 if leg[0] == "F" else -1


def _add_mirrored(body: "mujoco.MjsBody", numbers: tuple, front: int, right: int) -> None:
    """Set mass, centre and inertia, mirrored to the rear (front = -1) and to the left (right = -1)."""
    mass, (x, y, z), (xx, yy, zz, xy, xz, yz) = numbers
    inertia = (xx, yy, zz, front * right * xy, front * xz, right * yz)
    add_inertia(body, mass, (front * x, right * y, z), inertia)


def _add_leg(trunk: "mujoco.MjsBody", leg: str) -> None:
    """Add hip, thigh and calf; the inertias above are those of a front right leg."""
    front, left = _front(leg), _left(leg)
    hip = trunk.add_body(name=f"{leg}_hip", pos=(front * HIP_X, left * HIP_Y, 0.0))
    thigh = hip.add_body(name=f"{leg}_thigh", pos=(0.0, left * THIGH_Y, 0.0))
    calf = thigh.add_body(name=f"{leg}_calf", pos=(0.0, 0.0, -LINK))
    for body, joint, axis, numbers, turned in (
        (hip, "hip", (1, 0, 0), HIP, (front, -left)),
        (thigh, "thigh", (0, 1, 0), THIGH, (1, -left)),
        (calf, "calf", (0, 1, 0), CALF, (1, 1)),
    ):
        body.add_joint(name=f"{leg}_{joint}", axis=axis, range=RANGE[joint], limited=True, armature=ARMATURE[joint])
        _add_mirrored(body, numbers, *turned)
    _collide(hip, f"{leg}_hip", HIP_RADIUS, (0.0, left * 0.053, 0.0))
    _collide(thigh, f"{leg}_thigh", 0.015, (-0.02, 0, -0.02), (-0.01, 0, -0.19))
    _collide(calf, f"{leg}_calf", 0.012, (0.01, 0, -0.03), (0.004, 0, -0.17))
    _collide(calf, f"{leg}_foot", FOOT_RADIUS, (0, 0, -LINK))
    _add_leg_visuals(hip, thigh, calf, left)


def _add_trunk_geoms(trunk: "mujoco.MjsBody") -> None:
    """Add the trunk's two capsules and the head's sphere, and their visual shapes."""
    for name, y in (("trunk_left", 0.04), ("trunk_right", -0.04)):
        _collide(trunk, name, 0.05, (-0.08, y, 0.0), (0.08, y, 0.0))
    _collide(trunk, "head", 0.06, (0.24, 0.0, 0.0))

    add_visual(trunk, "box", (0.185, 0.05, 0.05), (0.0, 0.0, 0.0), LIGHT)
    add_visual(trunk, "box", (0.13, 0.08, 0.035), (0.0, 0.0, 0.005), DARK)
    add_visual(trunk, "box", (0.15, 0.035, 0.012), (-0.01, 0.0, 0.055), DARK)
    add_visual(trunk, "box", (0.045, 0.04, 0.035), (0.225, 0.0, 0.015), LIGHT)
    add_visual(trunk, "ellipsoid", (0.035, 0.048, 0.042), (0.262, 0.0, 0.012), DARK)
    add_visual(trunk, "ellipsoid", (0.006, 0.03, 0.008), (0.295, 0.0, 0.014), BLUE)


def _add_leg_visuals(hip: "mujoco.MjsBody", thigh: "mujoco.MjsBody", calf: "mujoco.MjsBody", left: int) -> None:
    """Add the visual shapes of a leg: two motor discs, a tapering thigh, a thin calf and a rubber foot."""
    add_visual(hip, "cylinder", (0.046, 0.03, 0.0), (0.0, 0.0, 0.0), DARK, quat=(0.70711, 0.0, 0.70711, 0.0))
    add_visual(hip, "cylinder", (0.046, 0.02, 0.0), (0.0, left * 0.035, 0.0), LIGHT, quat=ALONG_Y)
    add_visual(
        thigh, "cylinder", (0.045, 0.022, 0.0), (0.0, -left * 0.005, 0.0), DARK, quat=(0.70711, 0.70711, 0.0, 0.0)
    )
    add_visual(thigh, "capsule", (0.026,), (-0.012, 0, -0.02), LIGHT, end=(-0.018, 0, -0.10))
    add_visual(thigh, "capsule", (0.018,), (-0.018, 0, -0.10), LIGHT, end=(0.0, 0, -LINK))
    add_visual(thigh, "cylinder", (0.022, 0.018, 0.0), (0.0, 0.0, -LINK), DARK, quat=ALONG_Y)
    add_visual(calf, "capsule", (0.013,), (0.0, 0, 0.0), DARK, end=(0.012, 0, -0.10))
    add_visual(calf, "capsule", (0.011,), (0.012, 0, -0.10), DARK, end=(0.0, 0, -LINK))
    add_visual(calf, "sphere", (FOOT_RADIUS,), (0.0, 0.0, -LINK), (0.05, 0.05, 0.05, 1.0))


def _collide(body: "mujoco.MjsBody", name: str, radius: float, start: tuple, end: tuple | None = None) -> None:
    """Add a sphere, or a capsule from ``start`` to ``end``, that touches the terrain but not the robot itself."""
    geom = add_collision(body, name, radius, start, end, contype=ROBOT_BIT, conaffinity=TERRAIN_BIT)
    if name.endswith("foot"):
        geom.condim = 3
        geom.priority = 1  # so that the foot's own friction counts, not the larger of the two
