"""Converts a desired force to a saturated force, an attitude and a collective thrust."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.model.frames import quat_from_euler_zyx
from companion.model.types import Quat, Vec3


@dataclass(frozen=True, slots=True)
class ForceLimits:
    """Limits of the rotors' force."""

    vertical_min_n: float
    vertical_max_n: float
    lateral_max_n: float
    tilt_max_tan: float
    """Ratio of lateral to vertical force at the largest tilt."""


def saturate_force(force_world_n: Vec3, limits: ForceLimits) -> tuple[Vec3, bool, bool]:
    """Saturate the vertical force, then the lateral force within the tilt limit and the lateral limit.

    Returns:
        The saturated force, whether the vertical force was saturated, and whether the lateral force was saturated.
    """
    fx, fy, fz = force_world_n
    low, high, allowed = limits.vertical_min_n, limits.vertical_max_n, limits.lateral_max_n
    z = low if fz < low else high if fz > high else fz
    lateral, within_tilt = math.hypot(fx, fy), z * limits.tilt_max_tan
    if within_tilt < allowed:
        allowed = within_tilt
    if lateral > allowed:
        scale = allowed / lateral
        return (fx * scale, fy * scale, z), z != fz, True
    return (fx, fy, z), z != fz, False


class TiltFilter:
    """Second-order low-pass filter of desired roll and pitch, implicit Euler: stable for any step."""

    def __init__(self, bandwidth_rad_s: float, damping: float) -> None:
        self._w = bandwidth_rad_s
        self._d = damping
        self._roll_rad = self._pitch_rad = 0.0
        self._roll_rate_rad_s = self._pitch_rate_rad_s = 0.0

    def step(self, dt_s: float, roll_rad: float, pitch_rad: float) -> tuple[float, float]:
        """Return the filtered roll and pitch, rad."""
        w = self._w
        pull = w * w * dt_s
        denominator = 1.0 + 2.0 * self._d * w * dt_s + pull * dt_s
        roll, pitch = self._roll_rad, self._pitch_rad
        self._roll_rate_rad_s = rate = (self._roll_rate_rad_s + pull * (roll_rad - roll)) / denominator
        self._roll_rad = roll = roll + dt_s * rate
        self._pitch_rate_rad_s = rate = (self._pitch_rate_rad_s + pull * (pitch_rad - pitch)) / denominator
        self._pitch_rad = pitch = pitch + dt_s * rate
        return roll, pitch


def roll_pitch_from_force(force_world_n: Vec3, yaw_rad: float) -> tuple[float, float]:
    """Return the roll and pitch (ZYX, rad) that align body z with the force at the given yaw."""
    fx, fy, fz = force_world_n
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    forward, left = c * fx + s * fy, -s * fx + c * fy
    pitch = math.atan2(forward, fz)
    roll = math.atan2(-left, math.hypot(forward, fz))
    return roll, pitch


def collective_n(force_world_n: Vec3, body_z_world: Vec3) -> float:
    """Return u = F . z_body, N: the thrust along the current body z axis."""
    fx, fy, fz = force_world_n
    zx, zy, zz = body_z_world
    return fx * zx + fy * zy + fz * zz


def attitude_from_roll_pitch_yaw(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quat:
    """Return the attitude setpoint as a quaternion with w >= 0."""
    q = quat_from_euler_zyx(roll_rad, pitch_rad, yaw_rad)
    return q if q[0] >= 0 else (-q[0], -q[1], -q[2], -q[3])
