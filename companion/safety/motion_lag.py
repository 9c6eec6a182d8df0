"""Measures the delay of the link to PX4 from the vehicle's motion, without its clock. Pure.

PX4's position arrives late by the way there and back: its estimate lags because the poses reach it late, and it is sent late itself.
It is therefore behind motion capture by velocity times delay. A regression of this offset on the velocity gives the delay, also of a
link that was slow from the start, which no comparison of time stamps shows. An offset that does not change with the velocity, such as
a wrong pivot, has no effect.
"""

from __future__ import annotations

from typing import Final

from companion.model.algebra import dot, minus, plus, scaled
from companion.model.types import Vec3

WINDOW_S: Final = 3.0
"""Time constant of the means."""
SPREAD_M2_S2: Final = 0.02
"""Variance of the velocity from which the regression is evaluated: a take-off by 1 m in 3 s reaches it after 1 s."""
LEAST_S: Final = 0.01
"""Delay that is measured without a delay of the link: 0 to 12 ms in 60 simulated laboratories."""
_NO_MOTION: Vec3 = (0.0, 0.0, 0.0)


class MotionLag:
    """Regression of the offset between PX4's position and motion capture on the velocity."""

    __slots__ = ("_covariance", "_mean_m", "_mean_m_s", "_since_s", "_variance", "one_way_s")

    def __init__(self) -> None:
        self._mean_m, self._mean_m_s = _NO_MOTION, _NO_MOTION
        self._covariance = self._variance = self._since_s = 0.0
        self.one_way_s = 0.0
        """Delay in one direction, half of the measured one; 0 before it is known."""

    def update(self, dt_s: float, offset_m: Vec3, velocity_m_s: Vec3) -> None:
        """Update with a new position and a new pose.

        Args:
            dt_s: time since the last update, more than 0.
            offset_m: PX4's position minus that of motion capture.
            velocity_m_s: PX4's velocity, same frame.
        """
        self._since_s = min(WINDOW_S, self._since_s + dt_s)
        gain = dt_s / self._since_s
        d_m, d_m_s = minus(offset_m, self._mean_m), minus(velocity_m_s, self._mean_m_s)
        self._mean_m, self._mean_m_s = plus(self._mean_m, scaled(d_m, gain)), plus(self._mean_m_s, scaled(d_m_s, gain))
        keep = 1.0 - gain
        self._covariance = keep * (self._covariance + gain * dot(d_m, d_m_s))
        self._variance = keep * (self._variance + gain * dot(d_m_s, d_m_s))
        if self._variance > SPREAD_M2_S2:
            self.one_way_s = max(0.0, 0.5 * (-self._covariance / self._variance - LEAST_S))
