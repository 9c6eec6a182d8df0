"""From a desired force to a saturated force, an attitude and a collective thrust."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.frames import quat_from_euler_zyx
from companion.types import Quat, Vec3


@dataclass(frozen=True, slots=True)
class ForceLimits:
    """What the rotors may be asked for."""

    vertical_min_n: float
    vertical_max_n: float
    lateral_max_n: float
    tilt_max_rad: float


def saturate_force(force_world_n: Vec3, limits: ForceLimits) -> tuple[Vec3, bool, bool]:
    """Vertical first, then lateral within tilt limit and lateral limit.

    Returns:
        The force that may be asked for, whether the vertical was clipped, whether the lateral was clipped.
    """
    fx, fy, fz = force_world_n
    z = min(limits.vertical_max_n, max(limits.vertical_min_n, fz))
    lateral = math.hypot(fx, fy)
    allowed = min(limits.lateral_max_n, z * math.tan(limits.tilt_max_rad))
    if lateral > allowed:
        scale = allowed / lateral
        return (fx * scale, fy * scale, z), z != fz, True
    return (fx, fy, z), z != fz, False


class TiltFilter:
    """Second-order low-pass of the desired roll and pitch, implicit Euler: stable for any step."""

    def __init__(self, bandwidth_rad_s: float, damping: float) -> None:
        self._w = bandwidth_rad_s
        self._d = damping
        self._angle = [0.0, 0.0]
        self._rate = [0.0, 0.0]

    def step(self, dt_s: float, roll_rad: float, pitch_rad: float) -> tuple[float, float]:
        """Filtered roll and pitch, rad."""
        w, d = self._w, self._d
        denominator = 1.0 + 2.0 * d * w * dt_s + w * w * dt_s * dt_s
        for i, target in enumerate((roll_rad, pitch_rad)):
            self._rate[i] = (self._rate[i] + w * w * dt_s * (target - self._angle[i])) / denominator
            self._angle[i] += dt_s * self._rate[i]
        return self._angle[0], self._angle[1]


def roll_pitch_from_force(force_world_n: Vec3, yaw_rad: float) -> tuple[float, float]:
    """Roll and pitch (ZYX, rad) that point body z along the force at the yaw given."""
    fx, fy, fz = force_world_n
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    forward, left = c * fx + s * fy, -s * fx + c * fy
    pitch = math.atan2(forward, fz)
    roll = math.atan2(-left, math.hypot(forward, fz))
    return roll, pitch


def collective_n(force_world_n: Vec3, attitude_wxyz: Quat) -> float:
    """u = F . z_body, N: what the rotors must give in the attitude that the body really has."""
    w, x, y, z = attitude_wxyz
    zx, zy, zz = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
    return force_world_n[0] * zx + force_world_n[1] * zy + force_world_n[2] * zz


def attitude_from_roll_pitch_yaw(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quat:
    """Attitude setpoint, w >= 0."""
    q = quat_from_euler_zyx(roll_rad, pitch_rad, yaw_rad)
    return q if q[0] >= 0 else (-q[0], -q[1], -q[2], -q[3])
