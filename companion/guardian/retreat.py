"""The way back from a surface that the tool may touch, before a landing by PX4: PX4 follows position setpoints in OFFBOARD. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.model.frames import euler_zyx_from_quat
from companion.model.types import Vec3, VehicleState

ACCELERATION_M_S2 = 0.5
"""Largest acceleration of the motion."""
_PEAK = 10.0 / math.sqrt(3.0)
"""Largest acceleration of a minimum-jerk motion over 1 m in 1 s."""


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Position setpoint, world frame."""

    position_world_m: Vec3
    velocity_world_m_s: Vec3
    acceleration_world_m_s2: Vec3
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class Retreat:
    """A minimum-jerk motion from rest to rest with constant yaw."""

    start_s: float
    duration_s: float
    from_world_m: Vec3
    way_world_m: Vec3
    yaw_rad: float

    @classmethod
    def begin(cls, t_s: float, vehicle: VehicleState, way_world_m: Vec3) -> Retreat:
        """Return the motion that begins where the vehicle is."""
        yaw_rad = euler_zyx_from_quat(vehicle.attitude_wxyz)[2]
        duration_s = math.sqrt(_PEAK * math.hypot(*way_world_m) / ACCELERATION_M_S2)
        return cls(t_s, duration_s, vehicle.position_world_m, way_world_m, yaw_rad)

    def setpoint(self, t_s: float) -> Setpoint | None:
        """Return the setpoint at a time; None when the motion has ended."""
        if t_s - self.start_s >= self.duration_s:
            return None
        u = (t_s - self.start_s) / self.duration_s
        share = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)
        rate_per_s = 30.0 * u * u * (1.0 - u) ** 2 / self.duration_s
        change_per_s2 = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / self.duration_s**2
        (x, y, z), (dx, dy, dz) = self.from_world_m, self.way_world_m
        return Setpoint(
            (x + share * dx, y + share * dy, z + share * dz),
            (rate_per_s * dx, rate_per_s * dy, rate_per_s * dz),
            (change_per_s2 * dx, change_per_s2 * dy, change_per_s2 * dz),
            self.yaw_rad,
        )
