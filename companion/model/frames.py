"""Rotations, and conversions between the companion's frames (world ENU-like, body FLU) and PX4's (NED, FRD).

The companion's world frame shares its origin with PX4's local frame: x_enu = y_ned, y_enu = x_ned, z_enu = -z_ned. All quaternions are
``(w, x, y, z)``. The functions work on tuples of floats and use only `math`, because they run in the control tick.
"""

from __future__ import annotations

import math
from typing import Final

from companion.model.types import Mat3, Quat, Vec3

_SQRT_HALF: Final = math.sqrt(0.5)


def quat_multiply(a: Quat, b: Quat) -> Quat:
    """Return the Hamilton product a * b."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def quat_conjugate(q: Quat) -> Quat:
    """Return the inverse of a unit quaternion."""
    return (q[0], -q[1], -q[2], -q[3])


def quat_normalize(q: Quat) -> Quat:
    """Return the unit quaternion in the direction of q.

    Raises:
        ValueError: the norm is zero or not finite.
    """
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if not norm > 1e-9 or not math.isfinite(norm):
        raise ValueError(f"quaternion {q} has no direction")
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


def quat_rotate(q: Quat, v: Vec3) -> Vec3:
    """Return v rotated by q; if q is an attitude, this converts a body vector to the world frame."""
    w, x, y, z = q
    vx, vy, vz = v
    tx = 2.0 * (y * vz - z * vy)
    ty = 2.0 * (z * vx - x * vz)
    tz = 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


def body_z_component(q: Quat, v: Vec3) -> float:
    """Return the z component of a world vector in the body frame; bit-identical to `quat_rotate(quat_conjugate(q), v)[2]`."""
    w, x, y, z = q
    vx, vy, vz = v
    tx = 2.0 * (z * vy - y * vz)
    ty = 2.0 * (x * vz - z * vx)
    tz = 2.0 * (y * vx - x * vy)
    return vz + w * tz - x * ty + y * tx


def body_x_z_axes_world(q: Quat) -> tuple[Vec3, Vec3]:
    """Return the body's x and z axes in the world frame: the first and third columns of the rotation matrix."""
    w, x, y, z = q
    yy = y * y
    return (
        (1.0 - 2.0 * (yy + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + yy)),
    )


def rotation_matrix(attitude_wxyz: Quat) -> Mat3:
    """Return the body-to-world rotation matrix of a unit quaternion."""
    w, x, y, z = attitude_wxyz
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def quat_from_euler_zyx(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quat:
    """Return the attitude for ZYX Euler angles (q = [roll, pitch, yaw] in the paper)."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def euler_zyx_from_quat(q: Quat) -> Vec3:
    """Return the ZYX Euler angles (roll, pitch, yaw) in rad, with pitch in [-pi/2, pi/2]."""
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return (roll, pitch, yaw)


def yaw_from_quat(q: Quat) -> float:
    """Return the yaw in rad, as `euler_zyx_from_quat` does."""
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def wrap_rad(angle_rad: float) -> float:
    """Return the equivalent angle in [-pi, pi)."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


def tilt_rad(q: Quat) -> float:
    """Return the angle in rad between the body z axis and the vertical."""
    return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]))))


def ned_from_enu(v: Vec3) -> Vec3:
    """Convert a world vector from ENU to NED."""
    return (v[1], v[0], -v[2])


def enu_from_ned(v: Vec3) -> Vec3:
    """Convert a world vector from NED to ENU."""
    return (v[1], v[0], -v[2])


def flu_from_frd(v: Vec3) -> Vec3:
    """Convert a body vector from FRD to FLU; the same conversion works from FLU to FRD."""
    return (v[0], -v[1], -v[2])


def attitude_ned_frd_from_enu_flu(q: Quat) -> Quat:
    """Convert an attitude from FLU->ENU to FRD->NED; the result has w >= 0."""
    # (0, s, s, 0) * q * (0, 1, 0, 0) with s = sqrt(1/2), up to the sign: rotation by pi about (1, 1, 0), then by pi about x.
    w, x, y, z = _SQRT_HALF * q[0], _SQRT_HALF * q[1], _SQRT_HALF * q[2], _SQRT_HALF * q[3]
    w, x, y, z = w + z, x + y, x - y, w - z
    return (w, x, y, z) if w >= 0.0 else (-w, -x, -y, -z)


def attitude_enu_flu_from_ned_frd(q: Quat) -> Quat:
    """Convert an attitude from FRD->NED to FLU->ENU; the result has w >= 0."""
    return attitude_ned_frd_from_enu_flu(q)
