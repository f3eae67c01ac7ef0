"""Robots, built in code from published numbers: one file, one robot or one part that can be mounted on one."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

# Time constant [s] and damping ratio of contacts (solref); mjlab's. With MuJoCo's 0.02 s the centre of a landing foot
# gets below the surface of a height field, where float32 sometimes finds a depth of metres.
CONTACT_STIFFNESS = (0.01, 1.0)
VISUAL_GROUP = 2  # geoms of this group are for the eye alone: the simulation leaves them out
COLLISION_GROUP = 3  # MuJoCo's viewers hide this group by default
TERRAIN_BIT, ROBOT_BIT = (
    1,
    2,
)  # contype and conaffinity: robots touch the terrain, and of themselves only what asks for it


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A robot with a floating base, and what a task has to know about it.

    The first twelve joints are those of the four legs, leg by leg in the order front left, front
    right, rear left, rear right, each hip, thigh, calf; a mounted arm adds its joints after them.
    """

    spec: "mujoco.MjSpec"
    """The model: one free joint, then one hinge and one position actuator for every joint."""
    pose: tuple[float, ...]
    """Angle of every joint at an action of zero [rad]."""
    action_scale: tuple[float, ...]
    """What an action of one adds to the target angle of every joint [rad]."""
    parts: tuple[tuple[str, ...], ...]
    """Names of the geoms whose contacts with the terrain are watched: those of the base (touching the
    ground with them is a crash), of each foot, and of each limb that should not touch anything."""
    standing_height: float
    """Height of the base above flat ground in ``pose`` [m]."""
    spawn_height: float
    """Height of the base above the highest ground below it where an episode starts [m]: whatever the joints' angles at
    a reset, no foot is in the ground."""
    reach: float
    """Largest horizontal distance of a foot from the base's origin at a reset [m]."""
