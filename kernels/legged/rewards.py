"""The legged robots' reward: one ``@wp.func`` per term and one weight per term.

To add a term, write its function and give it a weight of the same name in ``RewardWeights``: kernels, command line
and log find it by that name.

The terms and their weights are those of Legged Gym's A1 (Rudin et al., *Learning to Walk in Minutes Using
Massively Parallel Deep Reinforcement Learning*, CoRL 2021, table 2, with the A1's configuration), plus
``tilt``. Every term is multiplied by its weight and by the step's duration, and their sum is clipped at
0 from below, so that a longer life is never worse, as the thesis assumes (3.1).
"""

from dataclasses import dataclass, fields

import warp as wp

from .terms import functions_of

wp.set_module_options({"enable_backward": False})

LEG_JOINTS = 12
TRACKING_VARIANCE = 0.25  # [m^2/s^2] and [rad^2/s^2]
MOVING = 0.1  # [m/s]; a goal that asks for less needs no steps


@dataclass(frozen=True, kw_only=True)
class RewardWeights:
    """Weight of every term of the reward, per second. Rewards are positive, penalties negative."""

    linear_tracking: float = 1.0
    """exp(-|v_xy - goal_xy|^2 / 0.25)."""
    yaw_tracking: float = 0.5
    """exp(-(w_z - goal_yaw)^2 / 0.25)."""
    vertical_speed: float = -2.0
    """v_z^2 [m^2/s^2]."""
    roll_pitch_rate: float = -0.05
    """w_x^2 + w_y^2 [rad^2/s^2]."""
    tilt: float = -1.0
    """Squared horizontal part of gravity's direction in the body frame; 0 when upright. Not in Legged Gym's A1."""
    torque: float = -2e-4
    """Sum of the legs' squared torques [N^2 m^2]."""
    joint_acceleration: float = -2.5e-7
    """Sum of the legs' squared joint accelerations [rad^2/s^4], from the velocities of two steps."""
    action_rate: float = -0.01
    """Sum of the squared changes of the legs' actions between two steps."""
    joint_limit: float = -10.0
    """Sum of the angles by which the legs' joints are beyond 0.9 of their range [rad]."""
    collision: float = -1.0
    """Number of thighs and calves that push on the terrain with more than 0.1 N."""
    air_time: float = 1.0
    """Sum over the feet that touch down of (time in the air - air_time_target) [s], if the goal asks for motion."""


TERMS = tuple(field.name for field in fields(RewardWeights))


class vec12(wp.types.vector(length=LEG_JOINTS, dtype=wp.float32)):
    """A number for every joint of the legs."""


class vecT(wp.types.vector(length=len(TERMS), dtype=wp.float32)):
    """A number for every term, in the order of ``TERMS``."""


@wp.struct
class LegMotion:
    """What the terms are made of, for one robot after one step."""

    velocity: wp.vec3  # of the base, in its own frame [m/s]
    rate: wp.vec3  # angular velocity of the base, in its own frame [rad/s]
    down: wp.vec3  # direction of gravity in the base's frame
    goal: wp.vec3  # wanted v_x, v_y [m/s] and yaw rate [rad/s]
    angle: vec12  # [rad]
    speed: vec12  # [rad/s]
    last_speed: vec12  # one step ago [rad/s]
    torque: vec12  # [N m]
    action: vec12
    last_action: vec12  # one step ago
    soft_low: vec12  # [rad]
    soft_high: vec12  # [rad]
    collisions: int  # limbs that touch the terrain
    landed_air_time: float  # sum over the feet that touch down of (air time - target) [s]
    dt: float  # duration of a step [s]


@wp.func
def tracking(error_squared: float) -> float:
    """1 at the goal, 1/e at an error of 0.5 m/s or rad/s."""
    return wp.exp(-error_squared / wp.static(TRACKING_VARIANCE))


@wp.func
def linear_tracking(m: LegMotion) -> float:
    """How well the base's horizontal velocity follows the goal, in (0, 1]."""
    x = m.velocity[0] - m.goal[0]
    y = m.velocity[1] - m.goal[1]
    return tracking(x * x + y * y)


@wp.func
def yaw_tracking(m: LegMotion) -> float:
    """How well the yaw rate follows the goal, in (0, 1]."""
    error = m.rate[2] - m.goal[2]
    return tracking(error * error)


@wp.func
def vertical_speed(m: LegMotion) -> float:
    """Squared vertical speed of the base, in its own frame."""
    return m.velocity[2] * m.velocity[2]


@wp.func
def roll_pitch_rate(m: LegMotion) -> float:
    """Squared angular velocity of the base about its horizontal axes."""
    return m.rate[0] * m.rate[0] + m.rate[1] * m.rate[1]


@wp.func
def tilt(m: LegMotion) -> float:
    """Squared sine of the angle between the base's vertical axis and the world's."""
    return m.down[0] * m.down[0] + m.down[1] * m.down[1]


@wp.func
def torque(m: LegMotion) -> float:
    """Sum of squared torques."""
    return wp.dot(m.torque, m.torque)


@wp.func
def joint_acceleration(m: LegMotion) -> float:
    """Sum of squared joint accelerations."""
    change = m.speed - m.last_speed
    return wp.dot(change, change) / (m.dt * m.dt)


@wp.func
def action_rate(m: LegMotion) -> float:
    """Sum of squared changes of the action."""
    change = m.action - m.last_action
    return wp.dot(change, change)


@wp.func
def joint_limit(m: LegMotion) -> float:
    """Sum of the angles beyond the soft limits."""
    total = float(0.0)
    for j in range(wp.static(LEG_JOINTS)):
        total += wp.max(m.soft_low[j] - m.angle[j], 0.0) + wp.max(m.angle[j] - m.soft_high[j], 0.0)
    return total


@wp.func
def collision(m: LegMotion) -> float:
    """Number of limbs that touch the terrain."""
    return float(m.collisions)


@wp.func
def air_time(m: LegMotion) -> float:
    """Air time beyond the target of the feet that touch down, if the goal asks for motion."""
    if m.goal[0] * m.goal[0] + m.goal[1] * m.goal[1] > wp.static(MOVING * MOVING):
        return m.landed_air_time
    return 0.0


_FUNCTIONS = functions_of(RewardWeights, globals())


@wp.func
def weighted_terms(m: LegMotion, weight: vecT) -> vecT:
    """All terms, each times its weight and the step's duration; in the order of ``TERMS``."""
    terms = vecT()
    for k in range(wp.static(len(_FUNCTIONS))):
        terms[k] = wp.static(_FUNCTIONS[k])(m) * weight[k] * m.dt
    return terms
