"""A Unitree Go1 with Interbotix's ReactorX-150, an arm with five joints, on its trunk.

Where the numbers come from:

* Offsets, ranges, masses, centres of mass and inertias: ``rx150.urdf.xacro`` of Interbotix's
  ``interbotix_ros_manipulators``, each link's inertia rotated into the link's own axes; 1.772 kg in all.
  Its three frame-only links have a dummy inertia of 0.001 kg m^2 each, dozens of times the gripper's:
  they are left out. The gripper is one body, its fingers fixed half-way.
* Torque limits: what the servos can give (an XM430-W350 4.1 N m, an XL430-W250 1.4 N m), where the URDF
  claims up to 18 N m; 1 N m for the last joint, as in the URDF.
* Gains, armature and drag: between what others use for servos of this kind (MuJoCo Menagerie's Robotis OP3 has
  21 N m/rad, 1.1 N m s/rad and 0.045 kg m^2) and the 5 N m/rad of *Deep Whole-Body Control*. Most of the damping is
  drag that the torque limit does not clip, since a motor's back-EMF limits its speed. The URDF's dry friction of
  0.1 N m is left out: five more constraint rows in every world cost a tenth of the speed.
* The position on the trunk: Fu, Cheng and Pathak, *Deep Whole-Body Control* (CoRL 2022), put the base of a WidowX
  on the top of a Go1's trunk there.
"""

import dataclasses
import math
from typing import TYPE_CHECKING

from deimos.sim.legged.robots import ROBOT_BIT, TERRAIN_BIT, VISUAL_GROUP, Arm, Joint, Robot, Vector, go1
from deimos.sim.legged.robots._primitives import add_actuators, add_collision, add_inertia, add_visual

if TYPE_CHECKING:
    import mujoco

MOUNT = (0.03, 0.0, 0.057)  # [m], of the arm's base in the trunk
JOINTS = ("waist", "shoulder", "elbow", "wrist_angle", "wrist_rotate")
AXES = ("z", "y", "y", "y", "x")
OFFSETS = (
    (0.0, 0.0, 0.06566),
    (0.0, 0.0, 0.03891),
    (0.05, 0.0, 0.15),
    (0.15, 0.0, 0.0),
    (0.065, 0.0, 0.0),
    (0.093575, 0.0, 0.0),
)  # [m]: of every joint from the frame before it, then of the end effector
SHOULDER = (0.03, 0.0, 0.16157)  # [m], of the shoulder's axis in the trunk
GRIPPER_RADIUS = 0.035  # [m], of the part that must not touch anything, also around the end effector
# Corners of a Go1's trunk with head and hips [m], in the trunk: goals stay out of it, and of the space below it.
BODY = ((-0.24, -0.15, -math.inf), (0.30, 0.15, 0.06))
MASS = 1.772  # [kg]

# Each is mass [kg], centre of mass [m], inertia about it (xx, yy, zz, xy, xz, yz) [kg m^2]: of the base, and of the
# link that each joint moves.
BASE = (0.766135, (-0.03545, -0.00336, 0.02534), (1.357e-3, 3.354e-3, 4.111e-3, 1.247e-4, -2.102e-4, 1.105e-5))
LINKS = (
    (0.257774, (-0.00013, -0.00018, 0.00795), (2.226e-4, 2.195e-4, 2.898e-4, 0.0, 0.0, 0.0)),
    (0.283759, (0.01256, -0.00012, 0.10676), (7.957e-4, 8.609e-4, 1.568e-4, 9.8e-7, -1.518e-4, 1.5e-6)),
    (0.235680, (0.08509, 0.00040, 0.0), (6.242e-5, 4.693e-4, 4.895e-4, 1.4e-6, 0.0, 0.0)),
    (0.084957, (0.04236, 0.0, 0.01058), (2.822e-5, 3.082e-5, 3.152e-5, 0.0, -2.55e-6, 0.0)),
    (0.143916, (0.04298, 0.0, 0.00696), (7.633e-5, 1.269e-4, 1.561e-4, 9e-7, 1.706e-5, 3e-7)),
)
BODIES = ("arm_shoulder", "arm_upper", "arm_forearm", "arm_wrist", "arm_gripper")

RANGE = ((-180, 180), (-106, 100), (-102, 95), (-100, 123), (-180, 180))  # [degrees]
MAX_TORQUE = (4.1, 4.1, 4.1, 1.4, 1.0)  # [N m]
STIFFNESS = (15.0, 15.0, 15.0, 5.0, 5.0)  # [N m/rad]
DAMPING = (0.25, 0.25, 0.25, 0.18, 0.24)  # [N m s/rad], within the torque limit
ARMATURE = (0.02, 0.02, 0.02, 0.005, 0.005)  # [kg m^2]
# [N m s/rad], of every joint, whatever the torque: at full torque a servo turns at its no-load speed, about 4.8 rad/s
# (XM430) and 6.4 rad/s (XL430). Below the limit the two dampings add up.
DRAG = (0.85, 0.85, 0.85, 0.22, 0.16)
POSE = (0.0, -0.9, 0.9, 0.3, 0.0)  # [rad], half folded
ACTION_SCALE = 0.5  # [rad]

# The arm's collision shapes, capsules along x in their frames: body, radius, from, to [m].
CAPSULES = {"forearm": ("arm_forearm", 0.025, 0.0, 0.15), "gripper": ("arm_gripper", GRIPPER_RADIUS, -0.045, 0.09)}
# What only these touch: two capsules that fill trunk, head and hip motors, and a sphere within the arm's base: radius,
# from, to [m], in the trunk.
GUARDS = {
    "guard_left": (0.05, (-0.18, 0.04, 0.0), (0.24, 0.04, 0.0)),
    "guard_right": (0.05, (-0.18, -0.04, 0.0), (0.24, -0.04, 0.0)),
    "guard_base": (0.05, (0.02, 0.0, 0.107), None),
}
GUARD_BIT = 4  # in the contype of guards and in the conaffinity of the arm

BLACK, GREY, STEEL = (0.08, 0.08, 0.09, 1.0), (0.22, 0.23, 0.25, 1.0), (0.62, 0.64, 0.67, 1.0)
ALONG_Z, ALONG_Y, ALONG_X = (1.0, 0.0, 0.0, 0.0), (0.70711, 0.70711, 0.0, 0.0), (0.70711, 0.0, 0.70711, 0.0)
# Visual shapes of every body, servos in black between brackets in grey: shape, half sizes (for a cylinder radius and
# half length) [m], position [m], orientation, colour.
LOOK = {
    "arm_base": (
        ("box", (0.085, 0.05, 0.004), (-0.035, 0.0, 0.0), ALONG_Z, GREY),
        ("box", (0.05, 0.034, 0.017), (-0.06, 0.0, 0.021), ALONG_Z, BLACK),
        ("box", (0.024, 0.018, 0.026), (0.0, 0.0, 0.03), ALONG_Z, BLACK),
        ("cylinder", (0.043, 0.004), (0.0, 0.0, 0.06), ALONG_Z, GREY),
    ),
    "arm_shoulder": (
        ("cylinder", (0.04, 0.004), (0.0, 0.0, 0.003), ALONG_Z, BLACK),
        ("box", (0.017, 0.024, 0.023), (0.0, 0.0, 0.03), ALONG_Z, BLACK),
        ("box", (0.02, 0.003, 0.027), (0.0, 0.031, 0.028), ALONG_Z, GREY),
        ("box", (0.02, 0.003, 0.027), (0.0, -0.031, 0.028), ALONG_Z, GREY),
        ("cylinder", (0.012, 0.037), (0.0, 0.0, 0.03891), ALONG_Y, STEEL),
    ),
    "arm_upper": (
        ("box", (0.014, 0.003, 0.078), (0.0, 0.024, 0.072), ALONG_Z, GREY),
        ("box", (0.014, 0.003, 0.078), (0.0, -0.024, 0.072), ALONG_Z, GREY),
        ("box", (0.012, 0.022, 0.022), (0.0, 0.0, 0.075), ALONG_Z, BLACK),
        ("box", (0.038, 0.003, 0.014), (0.026, 0.024, 0.15), ALONG_Z, GREY),
        ("box", (0.038, 0.003, 0.014), (0.026, -0.024, 0.15), ALONG_Z, GREY),
        ("box", (0.023, 0.02, 0.017), (0.04, 0.0, 0.15), ALONG_Z, BLACK),
        ("cylinder", (0.01, 0.03), (0.05, 0.0, 0.15), ALONG_Y, STEEL),
    ),
    "arm_forearm": (
        ("box", (0.068, 0.003, 0.013), (0.056, 0.021, 0.0), ALONG_Z, GREY),
        ("box", (0.068, 0.003, 0.013), (0.056, -0.021, 0.0), ALONG_Z, GREY),
        ("box", (0.04, 0.018, 0.009), (0.068, 0.0, 0.0), ALONG_Z, BLACK),
        ("box", (0.02, 0.018, 0.015), (0.137, 0.0, 0.0), ALONG_Z, BLACK),
        ("cylinder", (0.009, 0.026), (0.15, 0.0, 0.0), ALONG_Y, STEEL),
    ),
    "arm_wrist": (
        ("box", (0.019, 0.003, 0.012), (0.014, 0.022, 0.0), ALONG_Z, GREY),
        ("box", (0.019, 0.003, 0.012), (0.014, -0.022, 0.0), ALONG_Z, GREY),
        ("box", (0.017, 0.021, 0.016), (0.042, 0.0, 0.004), ALONG_Z, BLACK),
        ("cylinder", (0.014, 0.006), (0.061, 0.0, 0.0), ALONG_X, STEEL),
    ),
    "arm_gripper": (
        ("box", (0.016, 0.022, 0.017), (0.022, 0.0, 0.004), ALONG_Z, BLACK),
        ("box", (0.004, 0.05, 0.012), (0.043, 0.0, 0.0), ALONG_Z, GREY),
        ("box", (0.012, 0.006, 0.009), (0.055, 0.036, 0.0), ALONG_Z, BLACK),
        ("box", (0.012, 0.006, 0.009), (0.055, -0.036, 0.0), ALONG_Z, BLACK),
        ("box", (0.03, 0.004, 0.008), (0.091, 0.03, 0.0), (0.996, 0.0, 0.0, -0.087), BLACK),
        ("box", (0.03, 0.004, 0.008), (0.091, -0.03, 0.0), (0.996, 0.0, 0.0, 0.087), BLACK),
    ),
}


def build(
    *, stiffness: float = go1.STIFFNESS, damping: float = go1.DAMPING, action_scale: float = go1.ACTION_SCALE
) -> Robot:  # fmt: skip
    """A Go1 with the arm in free space; the arguments are those of ``go1.build``, for the legs."""
    return mount(go1.build(stiffness=stiffness, damping=damping, action_scale=action_scale))


def mount(robot: Robot) -> Robot:
    """The robot with the arm on its trunk; joints and actuators of the arm come after its own.

    Forearm and gripper touch the trunk and the terrain; touching the terrain is a crash, as for the base. Shoulder and
    upper arm touch nothing: a robot that falls on them also falls on the forearm or the trunk.

    Args:
        robot: The Go1 to mount the arm on. Its ``spec`` is changed in place.
    """
    spec = robot.spec
    trunk = spec.worldbody.first_body()
    _add_links(trunk)
    _add_collisions(spec, trunk)
    joints = tuple(
        Joint(
            name=name, pose=POSE[i], range=_limits(i), action_scale=ACTION_SCALE,
            stiffness=STIFFNESS[i], damping=DAMPING[i], max_torque=MAX_TORQUE[i],
        )
        for i, name in enumerate(JOINTS)
    )  # fmt: skip
    add_actuators(spec, joints)
    mounted = (MOUNT[0] + OFFSETS[0][0], MOUNT[1] + OFFSETS[0][1], MOUNT[2] + OFFSETS[0][2])
    axes = tuple(_axis(i) for i in range(len(JOINTS)))
    arm = Arm(offsets=(mounted, *OFFSETS[1:]), axes=axes, shoulder=SHOULDER, body=BODY, radius=GRIPPER_RADIUS)
    parts = ((*robot.parts[0], *CAPSULES), *robot.parts[1:])
    return dataclasses.replace(robot, joints=robot.joints + joints, parts=parts, arm=arm)


def _limits(i: int) -> tuple[float, float]:
    """Range of a joint [rad]."""
    return math.radians(RANGE[i][0]), math.radians(RANGE[i][1])


def _axis(i: int) -> Vector:
    """Axis of a joint."""
    return {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}[AXES[i]]


def _add_links(trunk: "mujoco.MjsBody") -> None:
    """Add the base, the chain of bodies and joints, their visual shapes, and the end effector's site."""
    body = trunk.add_body(name="arm_base", pos=MOUNT)
    add_inertia(body, *BASE)
    _dress(body)
    for i, joint in enumerate(JOINTS):
        body = body.add_body(name=BODIES[i], pos=OFFSETS[i])
        add_inertia(body, *LINKS[i])
        body.add_joint(
            name=joint, axis=_axis(i), range=_limits(i), limited=True, armature=ARMATURE[i], damping=(DRAG[i], 0.0, 0.0)
        )
        _dress(body)
    body.add_site(name="end_effector", pos=OFFSETS[-1], group=VISUAL_GROUP)


def _add_collisions(spec: "mujoco.MjSpec", trunk: "mujoco.MjsBody") -> None:
    """Add the arm's two capsules, and the guards in the trunk that they touch."""
    for name, (body, radius, rear, front) in CAPSULES.items():
        ends = (rear, 0.0, 0.0), (front, 0.0, 0.0)
        add_collision(
            spec.body(body), name, radius, *ends, contype=ROBOT_BIT, conaffinity=TERRAIN_BIT | GUARD_BIT
        )  # fmt: skip
    for name, (radius, start, end) in GUARDS.items():
        add_collision(trunk, name, radius, start, end, contype=GUARD_BIT, conaffinity=0)


def _dress(body: "mujoco.MjsBody") -> None:
    """Add the visual shapes of a body."""
    for shape, size, pos, quat, rgba in LOOK[body.name]:
        add_visual(body, shape, size, pos, rgba, quat=quat)
