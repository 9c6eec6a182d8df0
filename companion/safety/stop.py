"""Stopping distance of the vehicle after a fault, stopped by PX4 or by the governor. Pure.

PX4's LAND, requested by the flight process or by the guardian, first sets a stop point `v (0.6 s + v / (2 MPC_ACC_HOR))` ahead
(Navigator::preproject_stop_point and computeBrakingDistanceFromVelocity of PX4 1.16; the 0.6 s is a constant there) and flies to
it. The governor brakes the reference at `safety.stop_deceleration_m_s2`. At every speed the model assumes the slower of the two
decelerations: its stopping distance D(v) is never shorter than that of either, and because dD/dv >= v / a, braking at
`stop_deceleration_m_s2` never moves the predicted stop outward. Mission check, governor, tether watch and geofence monitor use it.
"""

from __future__ import annotations

import math
from typing import Final

from companion.config.safety import Safety

LAND_AHEAD_S: Final = 0.6
"""PX4 sets the stop point of LAND this far ahead, in addition to the braking distance. Measured: docs/internals/px4.md."""
LAND_DECELERATION_M_S2 = 8.0
"""MPC_ACC_HOR of configs/px4/indoor_mocap.params; enters only the distance of LAND's stop point."""


class StopModel:
    """Stopping distance as a function of speed.

    Args:
        safety: provides `react_time_s` (time from a fault to LAND mode) and `stop_deceleration_m_s2` (braking deceleration of the
            governor).
    """

    __slots__ = ("_half_per_a", "_half_per_land", "_knee_ahead_m", "_knee_m_s", "_react_s", "deceleration_m_s2")

    def __init__(self, safety: Safety) -> None:
        self._react_s = safety.react_time_s
        self.deceleration_m_s2 = safety.stop_deceleration_m_s2
        """Deceleration with which the governor brakes the reference."""
        self._half_per_a = 0.5 / self.deceleration_m_s2
        self._half_per_land = 0.5 / LAND_DECELERATION_M_S2
        slower = self._half_per_a - self._half_per_land
        self._knee_m_s = 0.5 * LAND_AHEAD_S / slower if slower > 0.0 else math.inf
        """Above this speed the governor's braking adds more distance per m/s than LAND's stop point does."""
        self._knee_ahead_m = 0.5 * LAND_AHEAD_S * self._knee_m_s if slower > 0.0 else 0.0

    def time_s(self, speed_m_s: float) -> float:
        """Return the stopping distance divided by the speed: velocity times this is the displacement to the predicted stop.

        Args:
            speed_m_s: not negative.
        """
        if speed_m_s <= self._knee_m_s:
            return self._react_s + LAND_AHEAD_S + speed_m_s * self._half_per_land
        return self._react_s + self._knee_ahead_m / speed_m_s + speed_m_s * self._half_per_a

    def distance_m(self, speed_m_s: float) -> float:
        """Return the stopping distance; 0 for a speed that is not positive."""
        return speed_m_s * self.time_s(speed_m_s) if speed_m_s > 0.0 else 0.0
