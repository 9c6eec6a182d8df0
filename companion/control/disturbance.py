"""Disturbance observer: estimates the unknown force on the base from Newton's law, first order.

    d' = (m a - F - d) / T, F = the known force, low-passed like the response of rotors and attitude loop

The estimate contains any unknown force: wind, a payload, the arm's reaction, the tether, a wrong hover thrust.
"""

from __future__ import annotations

import math

from companion.model.types import Vec3


class DisturbanceObserver:
    """Estimate of the unknown force on the base, world frame, N.

    Args:
        mass_kg: mass of the whole vehicle.
        time_xyz_s: time constant per axis; 0 disables the estimate of that axis.
        lag_s: time constant of the lag between commanded and actual force.
        max_n: bound of the estimate per axis.
    """

    def __init__(self, mass_kg: float, time_xyz_s: Vec3, lag_s: float, max_n: float) -> None:
        self._mass_kg = mass_kg
        self._times_s = time_xyz_s
        self.on = any(time_s > 0.0 for time_s in time_xyz_s)
        """Whether an axis has a time constant. Without one the estimate stays 0."""
        self._lag_s = lag_s
        self._max_n = max_n
        self._lagged: Vec3 | None = None
        self.force_n: Vec3 = (0.0, 0.0, 0.0)
        """The estimate, world frame, N."""

    def step(self, dt_s: float, known_n: Vec3, acceleration_world_m_s2: Vec3, learn: bool) -> Vec3:
        """Run one tick and return the estimate, world frame, N. Values that are not finite leave it unchanged.

        Args:
            dt_s: time since the last tick.
            known_n: sum of all known forces commanded in the last tick, weight included.
            acceleration_world_m_s2: measured acceleration.
            learn: if False, the estimate does not change (on the ground, or while the actuators are saturated).
        """
        if not self.on or not math.isfinite(sum((*known_n, *acceleration_world_m_s2))):
            return self.force_n
        k = 1.0 - math.exp(-dt_s / self._lag_s) if self._lag_s > 0 else 1.0
        x, y, z = [lagged + k * (known_n[i] - lagged) for i, lagged in enumerate(self._lagged or known_n)]
        self._lagged = lagged_n = (x, y, z)
        if learn:
            # d' = (m a - F - d) / T, implicit Euler; an axis without time constant stays 0.
            force, most = [*self.force_n], self._max_n
            for i, time_s in enumerate(self._times_s):
                if time_s > 0.0:
                    rate = self._mass_kg * acceleration_world_m_s2[i] - lagged_n[i] - force[i]
                    force[i] = max(-most, min(most, force[i] + dt_s / (dt_s + time_s) * rate))
            self.force_n = (force[0], force[1], force[2])
        return self.force_n

    def reset(self) -> None:
        """Reset the estimate to zero."""
        self._lagged = None
        self.force_n = (0.0, 0.0, 0.0)
