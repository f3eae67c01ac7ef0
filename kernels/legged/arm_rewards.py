"""The arm's part of a legged robot's reward: one ``@wp.func`` per term and one weight per term.

To add a term, write its function and give it a weight of the same name in ``ArmWeights``: kernels, command line and
log find it by that name. Every term is multiplied by its weight and the step's duration, and added to those of the
legs (``deimos.kernels.legged.rewards``) before their sum is clipped at 0.
"""

from dataclasses import dataclass, fields

import warp as wp

from .terms import functions_of

wp.set_module_options({"enable_backward": False})

PRECISION_DISTANCE = 0.05  # [m]; a goal missed by this much is worth half


@dataclass(frozen=True, kw_only=True)
class ArmWeights:
    """Weight of every term of the arm's reward, per second. Rewards are positive, penalties negative."""

    reach: float = 0.5
    """exp(-L1 error), each component as a share of its range; Deep Whole-Body Control's (Fu et al. 2022)."""
    precision: float = 0.5
    """1 / (1 + d / 0.05 m), d being the distance from the goal: steep where ``reach`` is flat."""
    arm_energy: float = -0.004
    """Sum of the arm's joints' |torque x speed| [W]."""
    arm_action_rate: float = -0.01
    """Sum of the squared changes of the arm's actions between two steps."""


ARM_TERMS = tuple(field.name for field in fields(ArmWeights))


class vecA(wp.types.vector(length=len(ARM_TERMS), dtype=wp.float32)):
    """A number for every term, in the order of ``ARM_TERMS``."""


@wp.struct
class ArmMotion:
    """What the terms are made of, for one arm after one step."""

    error: wp.vec3  # of the end effector, in units of the goal
    distance: float  # from the end effector to the goal [m]
    power: float  # sum over the joints of |torque x speed| [W]
    action_change: float  # sum of squared changes of the action
    dt: float  # duration of a step [s]


@wp.func
def reach(m: ArmMotion) -> float:
    """How well the arm follows its goal, in (0, 1]; a component of a goal has a range of 2."""
    return wp.exp(-0.5 * (wp.abs(m.error[0]) + wp.abs(m.error[1]) + wp.abs(m.error[2])))


@wp.func
def precision(m: ArmMotion) -> float:
    """How close the end effector is, in (0, 1]."""
    return 1.0 / (1.0 + m.distance / wp.static(PRECISION_DISTANCE))


@wp.func
def arm_energy(m: ArmMotion) -> float:
    """Power that the joints take or give."""
    return m.power


@wp.func
def arm_action_rate(m: ArmMotion) -> float:
    """Sum of squared changes of the action."""
    return m.action_change


_FUNCTIONS = functions_of(ArmWeights, globals())


@wp.func
def weighted_arm_terms(m: ArmMotion, weight: vecA) -> vecA:
    """All terms, each times its weight and the step's duration; in the order of ``ARM_TERMS``."""
    terms = vecA()
    for k in range(wp.static(len(_FUNCTIONS))):
        terms[k] = wp.static(_FUNCTIONS[k])(m) * weight[k] * m.dt
    return terms
