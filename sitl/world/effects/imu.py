"""Errors of the autopilot's IMU: bias, drift, mounting, and the rotors' vibration averaged over a sample.

One of PX4's samples is the mean of the raw samples since the previous one (delta velocity and delta angle of vehicle_imu). The
vibration is averaged exactly over the interval of each sample, so that the samples contain its remainder and its alias. An unbalanced
rotor shakes the body in the rotor's plane at the rotor's frequency, with a force proportional to the square of its speed and thus to
its thrust. A rotor with two blades shakes the body along the rotor's axis at twice that frequency and thereby also rotates it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_rotate
from companion.model.rotors import RotorLayout
from companion.model.types import Vec3
from companion.sitl_config.effects.imu import Imu

_DRIFT_EVERY = 25
"""Number of samples between two updates of the drifts."""
_STANDS = 0.01
"""Fraction of the hover thrust below which a rotor does not vibrate."""


class ImuErrors:
    """Converts true samples to measured ones.

    Args:
        interval_s: time from one sample to the next.
        hover_n: thrust of one rotor in hover.
    """

    def __init__(self, config: Imu, interval_s: float, hover_n: float, layout: RotorLayout) -> None:
        self._interval_s, self._hover_n = interval_s, hover_n
        roll, pitch, yaw = (math.radians(angle) for angle in config.mount_rpy_deg)
        to_board = quat_conjugate(quat_from_euler_zyx(roll, pitch, yaw))
        self._columns = tuple(
            quat_rotate(to_board, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        )
        self._accel_bias = config.accel_bias_m_s2
        x, y, z = config.gyro_bias_deg_s
        self._gyro_bias = (math.radians(x), math.radians(y), math.radians(z))
        self._keep = math.exp(-_DRIFT_EVERY * interval_s / config.drift_time_s)
        fresh = math.sqrt(1.0 - self._keep**2)
        self._accel_step, self._gyro_step = (
            fresh * config.accel_drift_m_s2,
            fresh * math.radians(config.gyro_drift_deg_s),
        )
        each = 1.0 / math.sqrt(layout.count)
        self._accel_shake, self._gyro_shake = (
            each * config.vibration_m_s2,
            each * math.radians(config.gyro_vibration_deg_s),
        )
        self._mean = 1.0 / layout.count
        self._rectification = config.rectification_m_s2
        self._rotors = tuple(
            (math.tau * config.vibration_hz * (1.0 + config.rotor_spread * apart), x, y, -spin)
            for apart, (x, y), spin in zip(_apart(layout.count), _levers(layout), layout.spins, strict=True)
        )
        self._phases = [float(i) for i in range(layout.count)]
        self._noise: Iterator[Vec3] | None = None
        self._tick = 0
        self._accel_drift: Vec3 = (0.0, 0.0, 0.0)
        self._gyro_drift: Vec3 = (0.0, 0.0, 0.0)

    def drift(self, noise: Iterator[Vec3]) -> None:
        """Start the drift of the biases at zero; `noise` yields triples of standard normal numbers."""
        self._noise, self._tick = noise, 0
        self._accel_drift = self._gyro_drift = (0.0, 0.0, 0.0)

    def measure(self, thrust_n: Sequence[float], gyro_rad_s: Vec3, accel_m_s2: Vec3) -> tuple[Vec3, Vec3]:
        """Return the measured angular rate (rad/s) and specific force (m/s^2) in the axes of the autopilot board.

        Args:
            thrust_n: thrust of each rotor, in PX4's order.
            gyro_rad_s: angular rate, body frame (FLU).
            accel_m_s2: specific force, body frame (FLU).
        """
        if self._noise is not None:
            if self._tick % _DRIFT_EVERY == 0:
                self._accel_drift = self._drifted(self._accel_drift, self._accel_step, next(self._noise))
                self._gyro_drift = self._drifted(self._gyro_drift, self._gyro_step, next(self._noise))
            self._tick += 1
        (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = self._columns
        x, y, z = gyro_rad_s
        bx, by, bz = self._gyro_bias
        dx, dy, dz = self._gyro_drift
        p = xx * x + xy * y + xz * z + bx + dx
        q = yx * x + yy * y + yz * z + by + dy
        r = zx * x + zy * y + zz * z + bz + dz
        x, y, z = accel_m_s2
        bx, by, bz = self._accel_bias
        dx, dy, dz = self._accel_drift
        ax = xx * x + xy * y + xz * z + bx + dx
        ay = yx * x + yy * y + yz * z + by + dy
        az = zx * x + zy * y + zz * z + bz + dz
        hover_n, interval_s, phases = self._hover_n, self._interval_s, self._phases
        accel_shake, gyro_shake, squares = self._accel_shake, self._gyro_shake, 0.0
        for i, (hover_rad_s, side_x, side_y, turn) in enumerate(self._rotors):
            share = thrust_n[i] / hover_n
            if share < _STANDS:
                continue
            begin = phases[i]
            end = begin + hover_rad_s * math.sqrt(share) * interval_s
            phases[i] = end if end < 1e6 else math.fmod(end, math.tau)
            sin0, cos0, sin1, cos1 = math.sin(begin), math.cos(begin), math.sin(end), math.cos(end)
            k = share / (end - begin)
            # Means over the interval of the cosine and the sine of the phase, and of the cosine of twice the phase.
            forward, left, along = k * (sin1 - sin0), k * turn * (cos0 - cos1), k * (sin1 * cos1 - sin0 * cos0)
            ax += accel_shake * forward
            ay += accel_shake * left
            az += accel_shake * along
            p += gyro_shake * side_y * along
            q -= gyro_shake * side_x * along
            r += gyro_shake * left
            squares += share * share
        if squares:
            squares *= self._mean
            bx, by, bz = self._rectification
            ax, ay, az = ax + bx * squares, ay + by * squares, az + bz * squares
        return (p, q, r), (ax, ay, az)

    def _drifted(self, drift: Vec3, step: float, normal: Vec3) -> Vec3:
        keep = self._keep
        return (
            keep * drift[0] + step * normal[0],
            keep * drift[1] + step * normal[1],
            keep * drift[2] + step * normal[2],
        )


def _apart(count: int) -> list[float]:
    """Return the relative speed difference of each rotor in units of `rotor_spread`: evenly spaced, neighbours far apart."""
    steps = [*range(0, count, 2), *range(1, count, 2)]
    return [(2 * step - (count - 1)) / (count - 1) for step in steps]


def _levers(layout: RotorLayout) -> list[tuple[float, float]]:
    """Return the rotors' positions along x and y in units of their root mean square, so that those of a quad-x are 1 and -1."""
    squares = sum(x * x + y * y for x, y, _ in layout.positions_body_m)
    unit_m = math.sqrt(squares / (2.0 * layout.count))
    return [(round(x / unit_m, 12), round(y / unit_m, 12)) for x, y, _ in layout.positions_body_m]
