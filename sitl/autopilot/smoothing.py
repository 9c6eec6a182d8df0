"""Jerk-limited motion to a point in the horizontal plane, after PX4's PositionSmoothing and VelocitySmoothing.

The speed towards the point is the speed that TrajMath's computeMaxSpeedFromDistance allows, but at most MPC_XY_CRUISE. The velocity
follows it within the limits MPC_ACC_HOR and MPC_JERK_AUTO. Near the point the approach is exponential, with a time constant of 2
MPC_ACC_HOR / MPC_JERK_AUTO.
"""

from __future__ import annotations

import math

from companion.model.types import Vec2
from sitl.autopilot.params import Params

_SETTLE_S = 0.1
"""Time constant with which the velocity approaches a commanded velocity close to it, so that the acceleration does not chatter."""


class Smoothing:
    """Position, velocity and acceleration of the trajectory in the horizontal plane, local NED.

    Args:
        velocity_ned_m_s: horizontal velocity at the start.
        acceleration_ned_m_s2: horizontal acceleration at the start.
    """

    __slots__ = ("acceleration_m_s2", "position_m", "velocity_m_s")

    def __init__(self, position_ned_m: Vec2, velocity_ned_m_s: Vec2, acceleration_ned_m_s2: Vec2 = (0.0, 0.0)) -> None:
        self.position_m = position_ned_m
        self.velocity_m_s = velocity_ned_m_s
        self.acceleration_m_s2 = acceleration_ned_m_s2

    def step(self, dt_s: float, to_ned_m: Vec2, params: Params) -> None:
        """Advance the trajectory towards the point by one period of the position loop."""
        jerk, acceleration = params.real("MPC_JERK_AUTO"), params.real("MPC_ACC_HOR")
        away = (to_ned_m[0] - self.position_m[0], to_ned_m[1] - self.position_m[1])
        distance_m = math.hypot(*away)
        speed = min(params.real("MPC_XY_CRUISE"), max_speed_m_s(distance_m, acceleration, jerk))
        scale = speed / distance_m if distance_m > 1e-6 else 0.0
        missing = (away[0] * scale - self.velocity_m_s[0], away[1] * scale - self.velocity_m_s[1])
        size = math.hypot(*missing)
        wanted = min(acceleration, math.sqrt(2.0 * jerk * size), size / _SETTLE_S) / size if size > 1e-9 else 0.0
        change = (
            missing[0] * wanted - self.acceleration_m_s2[0],
            missing[1] * wanted - self.acceleration_m_s2[1],
        )
        most = jerk * dt_s
        share = min(1.0, most / max(math.hypot(*change), 1e-9))
        ax, ay = self.acceleration_m_s2[0] + share * change[0], self.acceleration_m_s2[1] + share * change[1]
        vx, vy = self.velocity_m_s[0] + ax * dt_s, self.velocity_m_s[1] + ay * dt_s
        self.position_m = (self.position_m[0] + vx * dt_s, self.position_m[1] + vy * dt_s)
        self.velocity_m_s, self.acceleration_m_s2 = (vx, vy), (ax, ay)


def max_speed_m_s(distance_m: float, acceleration_m_s2: float, jerk_m_s3: float) -> float:
    """Return the largest speed from which the vehicle can stop within a distance (TrajMath: computeMaxSpeedFromDistance)."""
    b = 4.0 * acceleration_m_s2 * acceleration_m_s2 / jerk_m_s3
    return 0.5 * (math.sqrt(b * b + 8.0 * acceleration_m_s2 * distance_m) - b)
