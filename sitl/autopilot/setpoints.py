"""Decoding of the offboard setpoints SET_ATTITUDE_TARGET and SET_POSITION_TARGET_LOCAL_NED, in PX4's frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.model.types import Quat, Vec3
from sitl.autopilot.modes import OffboardKind
from sitl.autopilot.types import AttitudeTarget

Axis3 = tuple[float | None, float | None, float | None]
NOTHING: Axis3 = (None, None, None)


@dataclass(frozen=True, slots=True)
class PositionTarget:
    """Position setpoint (trajectory_setpoint); None means that the quantity is not commanded on that axis."""

    position_ned_m: Axis3 = NOTHING
    velocity_ned_m_s: Axis3 = NOTHING
    acceleration_ned_m_s2: Axis3 = NOTHING
    yaw_rad: float | None = None
    yaw_rate_rad_s: float | None = None

    @property
    def kind(self) -> OffboardKind:
        """Kind of setpoint, as in offboard_control_mode."""
        if any(value is not None for value in self.position_ned_m):
            return OffboardKind.POSITION
        if any(value is not None for value in self.velocity_ned_m_s):
            return OffboardKind.VELOCITY
        return OffboardKind.ACCELERATION

    @property
    def empty(self) -> bool:
        """Whether the setpoint commands no axis."""
        axes = (*self.position_ned_m, *self.velocity_ned_m_s, *self.acceleration_ned_m_s2)
        return all(value is None for value in axes)


OffboardTarget = AttitudeTarget | PositionTarget

_YAW_RATE_IGNORE, _THROTTLE_IGNORE, _ATTITUDE_IGNORE = 4, 64, 128


def decode_attitude_target(type_mask: int, q_wxyz: Quat, rates_frd_rad_s: Vec3, thrust: float) -> AttitudeTarget | None:
    """Decode SET_ATTITUDE_TARGET as PX4 does, with thrust limited to 0 to 1.

    Returns:
        The setpoint, or None if PX4 ignores the message: its thrust is non-finite or masked out, or its quaternion is zero or
        non-finite. A setpoint of body rates, without an attitude, is ignored, too.
    """
    if type_mask & (_THROTTLE_IGNORE | _ATTITUDE_IGNORE) or not math.isfinite(thrust):
        return None
    thrust = min(1.0, max(0.0, thrust))
    norm = math.sqrt(sum(value * value for value in q_wxyz))
    if not norm > 1e-6 or not math.isfinite(norm):
        return None
    yaw_rate = 0.0 if type_mask & _YAW_RATE_IGNORE or not math.isfinite(rates_frd_rad_s[2]) else rates_frd_rad_s[2]
    w, x, y, z = q_wxyz
    return AttitudeTarget((w / norm, x / norm, y / norm, z / norm), thrust, yaw_rate)


MAV_FRAME_LOCAL_NED = 1
MAV_FRAME_BODY_NED = 8
_YAW_IGNORE, _YAW_RATE_IGNORE_POSITION, _FORCE_SET = 1024, 2048, 512


def decode_position_target(
    type_mask: int,
    frame: int,
    position: Vec3,
    velocity: Vec3,
    acceleration: Vec3,
    yaw_rad: float,
    yaw_rate_rad_s: float,
    heading_rad: float,
) -> PositionTarget | None:
    """Decode SET_POSITION_TARGET_LOCAL_NED as PX4 does; return None if it commands nothing.

    In MAV_FRAME_LOCAL_NED PX4 uses every field; in MAV_FRAME_BODY_NED it uses only velocity and acceleration, rotated by the heading.
    """
    if frame not in (MAV_FRAME_LOCAL_NED, MAV_FRAME_BODY_NED) or type_mask & _FORCE_SET:
        return None
    where, speed, push = (
        _axes(type_mask >> 3 * i, values) for i, values in enumerate((position, velocity, acceleration))
    )
    if frame == MAV_FRAME_BODY_NED:
        where, speed, push = NOTHING, _turned(speed, heading_rad), _turned(push, heading_rad)
    target = PositionTarget(
        position_ned_m=where,
        velocity_ned_m_s=speed,
        acceleration_ned_m_s2=push,
        yaw_rad=None if type_mask & _YAW_IGNORE or not math.isfinite(yaw_rad) else yaw_rad,
        yaw_rate_rad_s=None
        if type_mask & _YAW_RATE_IGNORE_POSITION or not math.isfinite(yaw_rate_rad_s)
        else yaw_rate_rad_s,
    )
    return None if target.empty else target


def _axes(ignore_bits: int, values: Vec3) -> Axis3:
    x, y, z = (None if ignore_bits >> i & 1 or not math.isfinite(value) else value for i, value in enumerate(values))
    return (x, y, z)


def _turned(axes: Axis3, heading_rad: float) -> Axis3:
    x, y, z = axes
    if x is None and y is None:
        return axes
    x, y = x or 0.0, y or 0.0
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    return (c * x - s * y, s * x + c * y, z)
