"""Legged robots, built in code from published numbers: one file, one robot, which ``--env.robot`` finds by its name.

A robot's file holds ``build(*, stiffness, damping, action_scale) -> Robot``, three numbers that all have defaults. A
robot with an MJCF needs no code: see ``deimos.sim.legged.robot_file``.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

# Time constant [s] and damping ratio of contacts (solref); mjlab's. With MuJoCo's 0.02 s the centre of a landing foot
# goes below the surface of a height field, where float32 sometimes yields a depth of metres.
CONTACT_STIFFNESS = (0.01, 1.0)
VISUAL_GROUP = 2  # geoms of this group are visual: the simulation leaves them out
COLLISION_GROUP = 3  # MuJoCo's viewers hide this group by default
TERRAIN_BIT, ROBOT_BIT = 1, 2  # contype and conaffinity: robots touch the terrain, and themselves only where asked

Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A hinge and its position actuator, of the same name."""

    name: str
    pose: float
    """Angle at an action of zero [rad]."""
    action_scale: float
    """What an action of 1 adds to the target angle [rad]."""
    range: tuple[float, float]
    """Lowest and highest angle [rad]."""
    stiffness: float
    """Position gain [N m/rad]."""
    damping: float
    """Velocity gain [N m s/rad]."""
    max_torque: float
    """[N m]."""

    @property
    def action_range(self) -> tuple[float, float]:
        """The actions that take the target angle to the ends of the range; beyond them actions are clipped."""
        low, high = self.range
        return (low - self.pose) / self.action_scale, (high - self.pose) / self.action_scale


@dataclass(frozen=True, kw_only=True)
class Arm:
    """An arm on the base, for goals of its end effector."""

    offsets: tuple[Vector, ...]
    """Position of every joint, then of the end effector, in the frame before it [m]; the first is in the base's."""
    axes: tuple[Vector, ...]
    """Axis of every joint, in its frame."""
    shoulder: Vector
    """Origin of the goals, in the base's frame [m]."""
    body: tuple[Vector, Vector]
    """Corners of the box that goals stay out of, in the base's frame [m]."""
    radius: float
    """Distance that goals keep from that box and from the ground [m]."""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A robot with a floating base, and what a task and a deployment need to know about it.

    The first twelve joints are those of the four legs, leg by leg in the order front left, front
    right, rear left, rear right, each hip, thigh, calf; an arm adds its joints after them.
    """

    spec: "mujoco.MjSpec"
    """The model: one free joint, then the joints, each with its actuator."""
    joints: tuple[Joint, ...]
    """The joints, in the model's order."""
    parts: tuple[tuple[str, ...], ...]
    """Names of the geoms whose contacts with the terrain are watched: those of the base (touching the
    ground with them is a crash), of each foot, and of each limb that should not touch anything."""
    standing_height: float
    """Height of the base above flat ground in ``pose`` [m]."""
    spawn_height: float
    """Height of the base above the highest ground below it at the start of an episode [m]: no foot is in the ground,
    whatever the joints' angles at a reset."""
    reach: float
    """Largest horizontal distance of a foot from the base's origin at a reset [m]."""
    arm: Arm | None = None
    """Its arm, if it has one."""

    @property
    def pose(self) -> tuple[float, ...]:
        """Angle of every joint at an action of zero [rad]."""
        return tuple(joint.pose for joint in self.joints)
