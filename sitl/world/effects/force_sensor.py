"""Errors of the force-torque sensor: mounting, cross-talk, drift, internal low-pass filter and resolution.

Mounting and cross-talk (one 6x6 matrix), zero drift and the low-pass filter act on the readings in this order. `Plant` then applies
noise, bias, faults and scale error, and `rounded` is applied last.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.types import Vec3
from companion.sitl_config.effects.force_sensor import ForceSensor as Config
from sitl.force_torque import FORCE_CAPACITY_N, TORQUE_CAPACITY_NM

Vec6 = tuple[float, float, float, float, float, float]
"""Force and torque, or a row of a 6x6 matrix."""
_STREAM = 19
"""Number of this effect's random sequence."""
_TORQUE_PER_FORCE_M: Final = TORQUE_CAPACITY_NM / FORCE_CAPACITY_N


class ForceSensor:
    """Errors of the force-torque sensor.

    Args:
        seed: seed of the world; determines the cross-talk.
    """

    def __init__(self, config: Config, seed: int) -> None:
        share = np.random.default_rng((seed, _STREAM)).uniform(-config.cross_talk, config.cross_talk, (6, 6))
        np.fill_diagonal(share, 1.0)
        capacity = np.repeat((FORCE_CAPACITY_N, TORQUE_CAPACITY_NM), 3)
        roll, pitch, yaw = config.mounting_rpy_deg
        mounted = quat_from_euler_zyx(math.radians(roll), math.radians(pitch), math.radians(yaw))
        axes = [quat_rotate(mounted, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
        to_sensor = np.kron(np.eye(2), np.array(axes))
        a, b, c, d, e, f = [tuple(row) for row in (share * capacity[:, None] / capacity @ to_sensor).tolist()]
        self._rows: tuple[Vec6, Vec6, Vec6, Vec6, Vec6, Vec6] = (a, b, c, d, e, f)
        self._config = config
        self._turns = math.tau * config.filter_hz
        self._t_s = -math.inf
        self._filtered: Vec6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._rates, self._warm = config.drift_n_per_min, (config.warm_up_k, config.warm_up_s)
        self._per_k = config.temperature_drift_n_per_k

    def measure(self, t_s: float, force_n: Vec3, torque_nm: Vec3) -> tuple[Vec3, Vec3]:
        """Return the reading before noise, bias and rounding, in the sensor frame.

        Args:
            t_s: world time; must not decrease from call to call.
            force_n: true force, in the sensor frame of the vehicle file.
            torque_nm: true torque, same frame.
        """
        a, b, c = force_n
        d, e, f = torque_nm
        wrench: Vec6 = (a, b, c, d, e, f)
        warm_up_k, warm_up_s = self._warm
        minutes, warm_k = t_s / 60.0, warm_up_k * (1.0 - math.exp(-t_s / warm_up_s))
        rate_x, rate_y, rate_z = self._rates
        per_k_x, per_k_y, per_k_z = self._per_k
        x, y, z = (
            rate_x * minutes + per_k_x * warm_k,
            rate_y * minutes + per_k_y * warm_k,
            rate_z * minutes + per_k_z * warm_k,
        )
        share = 1.0 - math.exp(self._turns * (self._t_s - t_s))
        self._t_s = t_s
        k = _TORQUE_PER_FORCE_M
        row_fx, row_fy, row_fz, row_tx, row_ty, row_tz = self._rows
        fx, fy, fz, tx, ty, tz = self._filtered
        fx += share * (_product(row_fx, wrench) + x - fx)
        fy += share * (_product(row_fy, wrench) + y - fy)
        fz += share * (_product(row_fz, wrench) + z - fz)
        tx += share * (_product(row_tx, wrench) + k * x - tx)
        ty += share * (_product(row_ty, wrench) + k * y - ty)
        tz += share * (_product(row_tz, wrench) + k * z - tz)
        self._filtered = (fx, fy, fz, tx, ty, tz)
        return (fx, fy, fz), (tx, ty, tz)

    def rounded(self, force_n: Vec3, torque_nm: Vec3) -> tuple[Vec3, Vec3]:
        """Return the reading rounded to the sensor's resolution."""
        return _rounded(force_n, self._config.resolution_n), _rounded(torque_nm, self._config.resolution_nm)


def _product(row: Vec6, v: Vec6) -> float:
    return row[0] * v[0] + row[1] * v[1] + row[2] * v[2] + row[3] * v[3] + row[4] * v[4] + row[5] * v[5]


def _rounded(v: Vec3, step: float) -> Vec3:
    if step == 0.0:
        return v
    return (step * round(v[0] / step), step * round(v[1] / step), step * round(v[2] / step))
