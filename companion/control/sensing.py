"""Converts raw inputs for the control law: acceleration from the IMU, the tared external force, and the catch."""

from __future__ import annotations

import math

from companion.config.arm import Tool
from companion.control.manipulator import Manipulator
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_conjugate, quat_multiply, quat_rotate
from companion.model.types import ForceSample, Joints, Quat, Vec3, VehicleState


def acceleration_world_m_s2(vehicle: VehicleState) -> Vec3:
    """Return the acceleration of the body in the world frame: specific force rotated, gravity removed."""
    x, y, z = quat_rotate(vehicle.attitude_wxyz, vehicle.specific_force_body_m_s2)
    return (x, y, z - GRAVITY_M_S2)


class MeanAcceleration:
    """Mean acceleration over all IMU samples since the last call. One sample per tick would alias vibration into a constant force."""

    GAP_MAX_S = 0.05
    """Longest interval between two calls over which the mean is taken. Beyond it, or without PX4's timestamps, the newest sample is
    used.
    """

    def __init__(self) -> None:
        self._before: VehicleState | None = None
        self._value_m_s2: Vec3 | None = None

    def update(self, vehicle: VehicleState) -> Vec3:
        """Return the acceleration, world frame, m/s^2, or the last value if no new sample has arrived."""
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
            x, y, z = total
            bx, by, bz = before.delta_velocity_body_m_s
            x, y, z = quat_rotate(vehicle.attitude_wxyz, ((x - bx) / dt_s, (y - by) / dt_s, (z - bz) / dt_s))
            self._value_m_s2 = (x, y, z - GRAVITY_M_S2)
        else:
            self._value_m_s2 = acceleration_world_m_s2(vehicle)
        return self._value_m_s2


class ForceSensing:
    """Tare and gravity compensation of the force-torque sensor."""

    def __init__(self, tool: Tool | None, manipulator: Manipulator) -> None:
        self._net_weight_n = 0.0 if tool is None else tool.beyond_sensor_kg * GRAVITY_M_S2
        self._manipulator = manipulator
        self._sum = [0.0, 0.0, 0.0]
        self._count = 0
        self._last_stamp_s: float | None = None
        self.bias_sensor_n: Vec3 | None = None

    def begin_tare(self) -> None:
        """Discard the collected samples. The bias stays until `finish_tare`."""
        self._sum, self._count = [0.0, 0.0, 0.0], 0

    def collect(self, sample: ForceSample, attitude_wxyz: Quat, arm_rad: Joints) -> None:
        """Add one sample at rest to the tare. A repeated sample is counted once."""
        if sample.stamp_s == self._last_stamp_s:
            return
        self._last_stamp_s = sample.stamp_s
        to_sensor = quat_conjugate(self._to_world(attitude_wxyz, arm_rad))
        weight = quat_rotate(to_sensor, (0.0, 0.0, -self._net_weight_n))
        for i in range(3):
            self._sum[i] += sample.force_sensor_n[i] - weight[i]
        self._count += 1

    def finish_tare(self) -> int:
        """Set the bias from the collected samples and return their number."""
        if self._count:
            self.bias_sensor_n = (
                self._sum[0] / self._count,
                self._sum[1] / self._count,
                self._sum[2] / self._count,
            )
        return self._count

    def external_world_n(self, sample: ForceSample | None, attitude_wxyz: Quat, arm_rad: Joints) -> Vec3 | None:
        """Return the external force on the net, world frame, N, or None without a sample or a tare."""
        if sample is None or self.bias_sensor_n is None:
            return None
        b, f = self.bias_sensor_n, sample.force_sensor_n
        x, y, z = quat_rotate(self._to_world(attitude_wxyz, arm_rad), (f[0] - b[0], f[1] - b[1], f[2] - b[2]))
        return (x, y, z + self._net_weight_n)

    def _to_world(self, attitude_wxyz: Quat, arm_rad: Joints) -> Quat:
        return quat_multiply(attitude_wxyz, self._manipulator.sensor_attitude_body(arm_rad))


class CatchDetector:
    """Detector of a caught payload: an impact on the sensor after which a weight remains. The payload has left when that force ends.

    Forces are relative to the mean force before the impact, because drift and the rotors' wake also act on the empty net.
    """

    BLOW_N = 1.5
    PULL_N = 0.25
    """Weight above which a payload is in the net: more than the sensor resolves, 0.2 N, and half the weight of 0.05 kg."""
    SETTLE_S = 0.5
    """Time after the impact during which the force is not yet a weight: a payload bounces, or falls off the rim."""
    PULL_TIME_S = 1.0
    """Time after the impact at which the mean force since `SETTLE_S` confirms the catch or discards the impact."""
    CALM_S = 0.5
    """Time without a force above `BLOW_N` after which the next impact replaces the earlier one."""
    REST_S = 0.5
    """Time constant of the mean force on the empty net, which is held from the impact on."""
    LEFT_N = 0.2
    """Resolution of the sensor: with a smaller force, the net is empty."""
    LEFT_SHARE = 0.3
    """The net is empty when the force, in any direction, is less than this fraction of the payload's measured weight."""
    LEFT_TIME_S = 0.5
    """Time for which the force must stay below that fraction. A bump from below unloads the net for a shorter time."""
    FALLING_SHARE = 0.6
    """Fraction of gravity. With less specific force the whole vehicle falls, and the force of a payload in the net is small too."""
    LOWPASS_S = 0.05
    WEIGHT_S = 1.0

    def __init__(self) -> None:
        self._blow_s: float | None = None
        self._hit_s = 0.0
        """Time of the last force above `BLOW_N`."""
        self._rest_n: Vec3 = (0.0, 0.0, 0.0)
        """Mean force on the empty net."""
        self._settled = False
        self._pull = 0.0
        self._samples = 0
        self._weight_n = 0.0
        self._carried_n: Vec3 = (0.0, 0.0, 0.0)
        """Low-passed force while a payload is in the net, N."""
        self._acceleration_z_m_s2 = 0.0
        """Low-passed vertical acceleration while a payload is in the net: vibration is not a fall."""
        self._last_s = 0.0
        self._light_since_s: float | None = None
        self.caught_s: float | None = None
        """Time of the impact of the payload in the net, or None if the net is empty."""

    def update(self, t_s: float, force_world_n: Vec3 | None) -> bool:
        """Return True only in the tick that confirms a catch. `caught_s` is then the time of the impact."""
        if self.caught_s is not None or force_world_n is None:
            return False
        dt_s, self._last_s = t_s - self._last_s, t_s
        x, y, z = force_n = self._beyond_rest(force_world_n)
        if x * x + y * y + z * z > self.BLOW_N**2:
            if self._blow_s is None or t_s - self._hit_s > self.CALM_S:
                self._blow_s, self._settled, self._pull, self._samples = t_s, False, 0.0, 0
            self._hit_s = t_s
        if self._blow_s is None:
            k = 1.0 - math.exp(-dt_s / self.REST_S)
            rx, ry, rz = self._rest_n
            self._rest_n = (rx + k * x, ry + k * y, rz + k * z)
            return False
        if not self._settled and t_s - self._blow_s >= self.SETTLE_S:
            self._settled, self._pull, self._samples = True, 0.0, 0
        self._pull += z
        self._samples += 1
        if t_s - self._blow_s < self.PULL_TIME_S:
            return False
        weight_n = -self._pull / self._samples
        if weight_n > self.PULL_N:
            self.caught_s = self._blow_s
            self._weight_n, self._carried_n, self._light_since_s = weight_n, force_n, None
            self._acceleration_z_m_s2 = 0.0
            return True
        self._blow_s = None
        return False

    def _beyond_rest(self, force_world_n: Vec3) -> Vec3:
        x, y, z = force_world_n
        rx, ry, rz = self._rest_n
        return (x - rx, y - ry, z - rz)

    def carries(self, t_s: float) -> bool:
        """Return whether a payload is, or may be, in the net at time `t_s`."""
        return self.caught_s is not None

    def reject(self) -> None:
        """Discard a catch that was just confirmed, because the force has another cause."""
        self.caught_s = self._blow_s = None

    @property
    def unconfirmed_s(self) -> float | None:
        """Return the time of an impact followed by a downward force for less than `PULL_TIME_S` so far, or None."""
        if self.caught_s is not None or not self._samples or self._pull / self._samples >= -self.PULL_N:
            return None
        return self._blow_s

    def left(self, t_s: float, force_world_n: Vec3 | None, acceleration_z_m_s2: float) -> bool:
        """Return True only in the tick that confirms that the payload has left the net. The next catch can then be detected.

        Args:
            t_s: flight clock.
            force_world_n: force on the net, or None if unknown.
            acceleration_z_m_s2: vertical acceleration of the vehicle, upwards.
        """
        if self.caught_s is None:
            return False
        if force_world_n is None:
            self._light_since_s, self._last_s = None, t_s
            return False
        dt_s, self._last_s = t_s - self._last_s, t_s
        k = 1.0 - math.exp(-dt_s / self.LOWPASS_S)
        x, y, z = self._carried_n
        fx, fy, fz = self._beyond_rest(force_world_n)
        x, y, z = self._carried_n = (x + k * (fx - x), y + k * (fy - y), z + k * (fz - z))
        force_n, light_n = math.sqrt(x * x + y * y + z * z), max(self.LEFT_N, self.LEFT_SHARE * self._weight_n)
        self._acceleration_z_m_s2 += k * (acceleration_z_m_s2 - self._acceleration_z_m_s2)
        falling = GRAVITY_M_S2 + self._acceleration_z_m_s2 < self.FALLING_SHARE * GRAVITY_M_S2
        if falling or force_n > light_n:
            self._light_since_s = None
            self._weight_n = max(self.PULL_N, self._weight_n + dt_s / self.WEIGHT_S * (-z - self._weight_n))
        elif self._light_since_s is None:
            self._light_since_s = t_s
        elif t_s - self._light_since_s >= self.LEFT_TIME_S:
            self.caught_s = self._blow_s = self._light_since_s = None
            return True
        return False


class ObservedCatchDetector(CatchDetector):
    """Detector of a caught payload in the force of `ForceObserver`, which contains gusts and smooths the impact.

    In simulated laboratories, gusts and drag reached 1.5 N without a payload; the impact of 0.1 kg reached 2.2 N, and the weight after
    it 0.7 N in the mean (docs/internals/control-law.md).
    """

    BLOW_N = 1.8
    PULL_N = 0.5
    PULL_TIME_S = 0.8
    SETTLE_S = 0.0
    CALM_S = math.inf
    """Its noise makes impacts of its own after the one of the payload."""
    REST_S = math.inf
    """The observer subtracts a mean of its own."""
    LEFT_SHARE = 0.5
    LEFT_TIME_S = 0.8
    LOWPASS_S = 0.3

    def carries(self, t_s: float) -> bool:
        """See `CatchDetector`; also True while an impact is not confirmed yet."""
        if self.caught_s is not None:
            return True
        return self._blow_s is not None and t_s - self._blow_s <= self.PULL_TIME_S

    def left(self, t_s: float, force_world_n: Vec3 | None, acceleration_z_m_s2: float) -> bool:
        """See `CatchDetector`; only the downward force counts, because gusts are mostly horizontal."""
        if force_world_n is not None:
            force_world_n = (0.0, 0.0, min(0.0, force_world_n[2]))
        return super().left(t_s, force_world_n, acceleration_z_m_s2)
