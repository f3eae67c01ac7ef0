"""Rotations by MuJoCo's unit quaternions (w, x, y, z), which map the body frame to the world frame.

Warp's own quaternions are (x, y, z, w), so a MuJoCo quaternion is a ``wp.vec4`` here, and only this
file rotates with one.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def rotate(quat: wp.vec4, v: wp.vec3) -> wp.vec3:
    """The body-frame vector ``v`` in the world frame: v + 2 w (u x v) + 2 u x (u x v), with quat = (w, u)."""
    u = wp.vec3(quat[1], quat[2], quat[3])
    t = 2.0 * wp.cross(u, v)
    return v + quat[0] * t + wp.cross(u, t)


@wp.func
def rotate_inverse(quat: wp.vec4, v: wp.vec3) -> wp.vec3:
    """The world-frame vector ``v`` in the body frame."""
    return rotate(wp.vec4(quat[0], -quat[1], -quat[2], -quat[3]), v)


@wp.func
def down_in_body(quat: wp.vec4) -> wp.vec3:
    """The direction of gravity, (0, 0, -1) in the world, in the body frame."""
    return wp.vec3(
        2.0 * (quat[0] * quat[2] - quat[1] * quat[3]),
        -2.0 * (quat[2] * quat[3] + quat[0] * quat[1]),
        2.0 * (quat[1] * quat[1] + quat[2] * quat[2]) - 1.0,
    )


@wp.func
def heading(quat: wp.vec4) -> wp.vec2:
    """(cos, sin) of the yaw: the direction of the body's x axis seen from above.

    A body whose x axis points straight up or down has no yaw; it counts as 0.
    """
    x = 1.0 - 2.0 * (quat[2] * quat[2] + quat[3] * quat[3])
    y = 2.0 * (quat[1] * quat[2] + quat[0] * quat[3])
    norm = wp.sqrt(x * x + y * y)
    if norm < 1.0e-6:
        return wp.vec2(1.0, 0.0)
    return wp.vec2(x / norm, y / norm)


@wp.func
def rotate_by_heading(direction: wp.vec2, x: float, y: float) -> wp.vec2:
    """The horizontal vector (x, y) turned by the angle whose (cos, sin) is ``direction``."""
    return wp.vec2(direction[0] * x - direction[1] * y, direction[1] * x + direction[0] * y)


@wp.func
def from_yaw(angle: float) -> wp.vec4:
    """The quaternion of a turn by ``angle`` [rad] about the vertical."""
    return wp.vec4(wp.cos(0.5 * angle), 0.0, 0.0, wp.sin(0.5 * angle))


@wp.func
def rotate_about(v: wp.vec3, axis: wp.vec3, angle: float) -> wp.vec3:
    """``v`` rotated by ``angle`` [rad] about the unit vector ``axis`` (Rodrigues's formula)."""
    c = wp.cos(angle)
    return c * v + wp.sin(angle) * wp.cross(axis, v) + (1.0 - c) * wp.dot(axis, v) * axis
