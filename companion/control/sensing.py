"""From raw inputs to what the law needs: acceleration from the IMU, the tared external force, the catch."""

from __future__ import annotations

import math

from companion.config.vehicle import Tool
from companion.control.manipulator import GRAVITY_M_S2, Manipulator
from companion.model.frames import quat_conjugate, quat_multiply, quat_rotate
from companion.model.types import ForceSample, Quat, Vec2, Vec3, VehicleState


def acceleration_world_m_s2(vehicle: VehicleState) -> Vec3:
    """Coordinate acceleration of the body: specific force turned into the world, gravity taken off."""
    x, y, z = quat_rotate(vehicle.attitude_wxyz, vehicle.specific_force_body_m_s2)
    return (x, y, z - GRAVITY_M_S2)


class MeanAcceleration:
    """Coordinate acceleration over all IMU samples since the last call: one for each tick would alias vibration to a steady pull."""

    GAP_MAX_S = 0.05
    """Over a longer interval between two calls, or without PX4's times, the newest sample stands for itself."""

    def __init__(self) -> None:
        self._before: VehicleState | None = None
        self._value_m_s2: Vec3 | None = None

    def update(self, vehicle: VehicleState) -> Vec3:
        """Return the acceleration, m/s2, world frame; the last one while no new sample has come."""
        before, boot_s, total = self._before, vehicle.imu_boot_s, vehicle.delta_velocity_body_m_s
        if before is None or boot_s is None or total is None:
            self._before = vehicle
            return acceleration_world_m_s2(vehicle)
        if before.imu_boot_s is None or before.delta_velocity_body_m_s is None:
            self._before = vehicle
            return acceleration_world_m_s2(vehicle)
        dt_s = boot_s - before.imu_boot_s
        if dt_s == 0.0 and self._value_m_s2 is not None:
            return self._value_m_s2
        self._before = vehicle
        if 0.0 < dt_s <= self.GAP_MAX_S:
            (x, y, z), (bx, by, bz) = total, before.delta_velocity_body_m_s
            x, y, z = quat_rotate(vehicle.attitude_wxyz, ((x - bx) / dt_s, (y - by) / dt_s, (z - bz) / dt_s))
            self._value_m_s2 = (x, y, z - GRAVITY_M_S2)
        else:
            self._value_m_s2 = acceleration_world_m_s2(vehicle)
        return self._value_m_s2


class ForceSensing:
    """Tare and gravity compensation of the force-torque sensor."""

    def __init__(self, tool: Tool, manipulator: Manipulator) -> None:
        self._net_weight_n = tool.net_mass_kg * GRAVITY_M_S2
        self._manipulator = manipulator
        self._sum = [0.0, 0.0, 0.0]
        self._count = 0
        self._last_stamp_s: float | None = None
        self.bias_sensor_n: Vec3 | None = None

    def begin_tare(self) -> None:
        """What was collected counts no more; the bias stays until it is fixed again."""
        self._sum, self._count = [0.0, 0.0, 0.0], 0

    def collect(self, sample: ForceSample, attitude_wxyz: Quat, arm_rad: Vec2) -> None:
        """Add one sample at rest to the tare; a sample seen before is not counted twice."""
        if sample.stamp_s == self._last_stamp_s:
            return
        self._last_stamp_s = sample.stamp_s
        to_sensor = quat_conjugate(self._to_world(attitude_wxyz, arm_rad))
        weight = quat_rotate(to_sensor, (0.0, 0.0, -self._net_weight_n))
        for i in range(3):
            self._sum[i] += sample.force_sensor_n[i] - weight[i]
        self._count += 1

    def finish_tare(self) -> int:
        """Fix the bias from what was collected; returns the number of samples."""
        if self._count:
            self.bias_sensor_n = (
                self._sum[0] / self._count,
                self._sum[1] / self._count,
                self._sum[2] / self._count,
            )
        return self._count

    def external_world_n(self, sample: ForceSample | None, attitude_wxyz: Quat, arm_rad: Vec2) -> Vec3 | None:
        """External force on the net; None without sample or tare."""
        if sample is None or self.bias_sensor_n is None:
            return None
        b, f = self.bias_sensor_n, sample.force_sensor_n
        x, y, z = quat_rotate(self._to_world(attitude_wxyz, arm_rad), (f[0] - b[0], f[1] - b[1], f[2] - b[2]))
        return (x, y, z + self._net_weight_n)

    def _to_world(self, attitude_wxyz: Quat, arm_rad: Vec2) -> Quat:
        return quat_multiply(attitude_wxyz, self._manipulator.sensor_attitude_body(arm_rad))


class CatchDetector:
    """A caught payload: a blow on the sensor, followed by a lasting pull downwards. It has left the net when the pull has ended."""

    BLOW_N = 1.5
    PULL_N = 0.3
    PULL_TIME_S = 0.25
    LEFT_SHARE = 0.3
    """Of the payload's weight as it was felt so far: less force than that, in any direction, is an empty net."""
    LEFT_TIME_S = 0.5
    """A bump from below takes the weight off for less."""
    FALLING_SHARE = 0.6
    """Of gravity: with less specific force than that the whole machine falls, and what is in the net weighs little, too."""
    LOWPASS_S, WEIGHT_S = 0.05, 1.0

    def __init__(self) -> None:
        self._blow_s: float | None = None
        self._pull = 0.0
        self._samples = 0
        self._weight_n = 0.0
        self._carried_n: Vec3 = (0.0, 0.0, 0.0)
        """Low-passed, while a payload is in the net."""
        self._last_s = 0.0
        self._light_since_s: float | None = None
        self.caught_s: float | None = None
        """Time of the blow of the payload that is in the net; None: it is empty."""

    def update(self, t_s: float, force_world_n: Vec3 | None) -> bool:
        """True in the one tick in which a catch becomes certain; `caught_s` is then the time of the blow."""
        if self.caught_s is not None or force_world_n is None:
            return False
        x, y, z = force_world_n
        if self._blow_s is None:
            if x * x + y * y + z * z > self.BLOW_N**2:
                self._blow_s, self._pull, self._samples = t_s, 0.0, 0
            return False
        self._pull += z
        self._samples += 1
        if t_s - self._blow_s < self.PULL_TIME_S:
            return False
        if self._pull / self._samples < -self.PULL_N:
            self.caught_s = self._blow_s
            self._weight_n = self.PULL_N  # the mean has the blow in it
            self._carried_n, self._last_s, self._light_since_s = force_world_n, t_s, None
            return True
        self._blow_s = None
        return False

    @property
    def unconfirmed_s(self) -> float | None:
        """Time of a blow that is followed by a downward pull so far, but not yet for `PULL_TIME_S`; None if there is none."""
        if self.caught_s is not None or not self._samples or self._pull / self._samples >= -self.PULL_N:
            return None
        return self._blow_s

    def left(self, t_s: float, force_world_n: Vec3 | None, acceleration_z_m_s2: float) -> bool:
        """True in the one tick in which it becomes certain that the payload has left the net; the next catch may come.

        Args:
            t_s: flight clock.
            force_world_n: on the net; None: unknown.
            acceleration_z_m_s2: of the vehicle, upwards.
        """
        if self.caught_s is None:
            return False
        if force_world_n is None:
            self._light_since_s, self._last_s = None, t_s
            return False
        dt_s, self._last_s = t_s - self._last_s, t_s
        k = 1.0 - math.exp(-dt_s / self.LOWPASS_S)
        (x, y, z), (fx, fy, fz) = self._carried_n, force_world_n
        x, y, z = self._carried_n = (x + k * (fx - x), y + k * (fy - y), z + k * (fz - z))
        force_n, light_n = math.sqrt(x * x + y * y + z * z), self.LEFT_SHARE * self._weight_n
        falling = GRAVITY_M_S2 + acceleration_z_m_s2 < self.FALLING_SHARE * GRAVITY_M_S2
        if falling or force_n > light_n:
            self._light_since_s = None
            self._weight_n = max(self.PULL_N, self._weight_n + dt_s / self.WEIGHT_S * (-z - self._weight_n))
        elif self._light_since_s is None:
            self._light_since_s = t_s
        elif t_s - self._light_since_s >= self.LEFT_TIME_S:
            self.caught_s = self._blow_s = self._light_since_s = None
            return True
        return False
