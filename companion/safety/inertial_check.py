"""Checks that motion-capture poses move as the IMU measures. Pure.

PX4 fuses the poses of motion capture, so its position agrees with them even when an attacker drags them away. The accelerometer then
disagrees. An observer of position, velocity and accelerometer bias integrates its readings, and each pose corrects the observer. The
innovation, pose minus predicted position, stays near zero while both measure the same motion. A drag that begins at v m/s raises it to
0.08 s x v after 0.2 s; then the observer follows the drag, as it follows a constant acceleration error. A drag that begins slowly is
not detected.

PX4's attitude transforms the specific force to the world frame. PX4 corrects its tilt with the same poses, but slowly (0.4 rad/s).

The observer gets the integral of the specific force over every sample that PX4 sent (`companion.io.px4.delta_velocity`). One sample for
each tick would alias vibration of 5 to 10 m/s2 into the velocity. Times are those of exposure and sample, on the clocks of motion
capture and PX4 (`RemoteClock`), not of arrival, because transport delays vary.
"""

from __future__ import annotations

import math
from typing import Final

from companion.model.types import Vec3

POLE_RAD_S: Final = 3.0
"""All three poles of the observer."""
SETTLE_S: Final = 9.0 / POLE_RAD_S
"""The innovation is not judged for this time after a start: velocity and bias are unknown then."""
IMU_LATE_MAX_S: Final = 0.05
"""A pose that comes longer than this after the newest IMU sample is not compared."""


CLOCK_GROWTH: Final = 1e-3
"""Largest drift between two clocks, s/s."""
CLOCK_RESTART_S: Final = 0.5
"""A message that is later than this shows that the device has restarted and its clock with it."""


class RemoteClock:
    """Maps a device's clock to the flight clock. The offset comes from the message with the smallest delay; larger offsets are treated
    as transport delay.

    Args:
        growth: largest drift between the clocks, s/s: a delay that lasts is forgotten this fast.
    """

    def __init__(self, growth: float = CLOCK_GROWTH) -> None:
        self._growth = growth
        self._offset_s = math.inf
        self._arrived_s = 0.0

    def local_s(self, remote_s: float, arrived_s: float) -> float:
        """Convert `remote_s` to the flight clock. The result is late by the smallest transport delay seen.

        Args:
            remote_s: time on the device's clock at which it sent a message.
            arrived_s: arrival of that message on the flight clock.
        """
        self._offset_s, self._arrived_s = self._new_offset_s(remote_s, arrived_s), arrived_s
        return remote_s + self._offset_s

    def would_be_s(self, remote_s: float, arrived_s: float) -> float:
        """Convert `remote_s` as `local_s` does. Changes nothing."""
        return remote_s + self._new_offset_s(remote_s, arrived_s)

    def _new_offset_s(self, remote_s: float, arrived_s: float) -> float:
        offset_s = arrived_s - remote_s
        grown_s = self._offset_s + self._growth * max(0.0, arrived_s - self._arrived_s)
        return offset_s if offset_s > grown_s + CLOCK_RESTART_S else min(grown_s, offset_s)


class InertialCheck:
    """Observer of the vehicle's position, velocity and acceleration error in the world frame.

    Args:
        limit_m: threshold of the innovation's length.
        hold_s: hold time: the innovation must exceed the threshold at every pose for this long.
        gap_max_s: the observer starts again after a longer gap between poses, or between two calls of `imu`.
    """

    def __init__(self, limit_m: float, hold_s: float, gap_max_s: float) -> None:
        self._limit_m, self._hold_s, self._gap_max_s = limit_m, hold_s, gap_max_s
        self._position = self._velocity = self._bias = (0.0, 0.0, 0.0)
        self._imu_s: float | None = None
        self._pose_s: float | None = None
        self._started_s = 0.0
        self._above_since_s: float | None = None
        self.innovation_m = 0.0
        """Length of the newest innovation; 0 while the observer settles."""

    def imu(self, stamp_s: float, dt_s: float, delta_velocity_world_m_s: Vec3) -> None:
        """Predict up to the newest IMU sample.

        Args:
            stamp_s: arrival of that sample.
            dt_s: interval since the last call on the clock of the samples; infinite if a sample of it is missing. Unless it is
                positive and short, the observer starts again. A late tick brings all samples of its interval and does no harm.
            delta_velocity_world_m_s: change of the velocity in that interval: specific force turned into the world, gravity removed.
        """
        self._imu_s = stamp_s
        if not 0.0 < dt_s <= self._gap_max_s:
            self._pose_s = None
            return
        dx, dy, dz = delta_velocity_world_m_s
        bx, by, bz = self._bias
        vx, vy, vz = self._velocity
        px, py, pz = self._position
        dx, dy, dz, half_s = dx + bx * dt_s, dy + by * dt_s, dz + bz * dt_s, 0.5 * dt_s
        self._position = (px + vx * dt_s + dx * half_s, py + vy * dt_s + dy * half_s, pz + vz * dt_s + dz * half_s)
        self._velocity = (vx + dx, vy + dy, vz + dz)

    def pose(self, stamp_s: float, position_world_m: Vec3, age_s: float) -> bool:
        """Compare a new pose with the prediction and correct the observer.

        Args:
            stamp_s: time of arrival.
            position_world_m: measured position.
            age_s: time from the exposure to the newest IMU sample; the prediction is moved back by this time, or forward if it is
                negative.

        Returns:
            True if the innovation has exceeded the threshold for the hold time.
        """
        if self._imu_s is not None and stamp_s - self._imu_s > IMU_LATE_MAX_S:
            return False
        before_s, self._pose_s = self._pose_s, stamp_s
        dt_s = stamp_s - before_s if before_s is not None else math.inf
        if self._imu_s is None or not 0.0 < dt_s <= self._gap_max_s:
            self._position, self._velocity, self._bias = position_world_m, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
            self._started_s, self._above_since_s, self.innovation_m = stamp_s, None, 0.0
            return False
        px, py, pz = self._position
        vx, vy, vz = self._velocity
        bx, by, bz = self._bias
        x, y, z = position_world_m
        x, y, z = x - px + vx * age_s, y - py + vy * age_s, z - pz + vz * age_s
        # Gains that put three discrete poles at exp(-POLE_RAD_S dt) (fading-memory filter of second order), so any rate is stable.
        pole = math.exp(-POLE_RAD_S * dt_s)
        less = 1.0 - pole
        kp, kv, kb = 1.0 - pole**3, 1.5 * less * less * (1.0 + pole) / dt_s, less**3 / (dt_s * dt_s)
        self._position = (px + kp * x, py + kp * y, pz + kp * z)
        self._velocity = (vx + kv * x, vy + kv * y, vz + kv * z)
        self._bias = (bx + kb * x, by + kb * y, bz + kb * z)
        if stamp_s - self._started_s < SETTLE_S:
            return False
        self.innovation_m = math.sqrt(x * x + y * y + z * z)
        if self.innovation_m <= self._limit_m:
            self._above_since_s = None
            return False
        if self._above_since_s is None:
            self._above_since_s = stamp_s
        return stamp_s - self._above_since_s >= self._hold_s
