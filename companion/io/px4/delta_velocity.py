"""Sum of an IMU's samples: the change of velocity, with no sample skipped or counted twice. Pure."""

from __future__ import annotations

import math
from typing import Final

from companion.model.types import Vec3

GAP_MAX_S: Final = 0.05
"""Longest gap that the sum bridges. A longer one adds nothing, because the motion during it was not measured."""
_REORDERED_MAX_S: Final = 1.0
_LOST_INTERVALS: Final = 1.5
"""After a gap of more than this many usual intervals at least one sample was lost."""
_SMOOTHING: Final = 1.0 / 16.0
"""Weight of a new sample in the means."""


class DeltaVelocity:
    """Sum of specific force times the sample's interval.

    PX4's HIGHRES_IMU carries `vehicle_imu.delta_velocity` divided by its interval, minus EKF2's estimate of the accelerometer bias:
    the mean over the interval that ends at `time_usec`, with every raw sample in it. The sum over consecutive messages is therefore
    the integral of the specific force and contains no alias of vibration. PX4 skips a sample when its MAVLink task is late (1 in 28
    with PX4 1.16 in SITL). The mean of the preceding samples replaces a lost one, so that only the vibration in that interval is
    aliased.
    """

    __slots__ = ("_interval_s", "_mean_m_s2", "boot_s", "gaps", "sum_m_s")

    def __init__(self) -> None:
        self.boot_s: float | None = None
        """End of the newest sample's interval on PX4's clock; None before the first sample."""
        self.sum_m_s: Vec3 = (0.0, 0.0, 0.0)
        """Integral of the specific force since the first sample, in the axes of the samples."""
        self.gaps = 0
        """Number of gaps that the sum does not bridge."""
        self._interval_s = math.inf
        self._mean_m_s2: Vec3 = (0.0, 0.0, 0.0)

    def add(self, boot_s: float, specific_force_m_s2: Vec3) -> None:
        """Add a sample. A repeated, late or non-finite one is ignored.

        Args:
            boot_s: end of the sample's interval on PX4's clock.
            specific_force_m_s2: mean over the interval, in body axes.
        """
        x, y, z = specific_force_m_s2
        if not math.isfinite(boot_s + x + y + z):
            return
        mx, my, mz = self._mean_m_s2
        if self.boot_s is None:
            mx, my, mz = x, y, z
        else:
            dt_s = boot_s - self.boot_s
            if -_REORDERED_MAX_S < dt_s <= 0.0:
                return
            if 0.0 < dt_s <= GAP_MAX_S:
                own_s = dt_s if dt_s <= _LOST_INTERVALS * self._interval_s else self._interval_s
                lost_s = dt_s - own_s
                sx, sy, sz = self.sum_m_s
                self.sum_m_s = (
                    sx + x * own_s + mx * lost_s,
                    sy + y * own_s + my * lost_s,
                    sz + z * own_s + mz * lost_s,
                )
                if math.isinf(self._interval_s):
                    self._interval_s = dt_s
                self._interval_s += _SMOOTHING * (min(dt_s, 2.0 * self._interval_s) - self._interval_s)
            else:
                self.gaps += 1
        self.boot_s = boot_s
        self._mean_m_s2 = (mx + _SMOOTHING * (x - mx), my + _SMOOTHING * (y - my), mz + _SMOOTHING * (z - mz))
