"""Errors of the person who throws the payload.

Speed and direction scatter as measured for basketball free throws (Slegers et al. 2021, J. Sports Sci. Med. 20: 508). With the default
values and 0.45 s of flight, the payload arrives with a standard deviation of about 4 cm on each axis across its path.
"""

from __future__ import annotations

import math

import numpy as np

from companion.model.types import Vec3
from companion.sitl_config.effects.thrower import Thrower as ThrowerConfig

_STREAM = 17


class Thrower:
    """Draws the errors of each throw."""

    def __init__(self, config: ThrowerConfig, seed: int) -> None:
        self._config = config
        self._rng = np.random.default_rng((seed, _STREAM))

    @classmethod
    def of(cls, config: ThrowerConfig, seed: int) -> Thrower | None:
        """Return the thrower, or None if the effect is off."""
        return cls(config, seed) if config.on else None

    def prediction_error_s(self) -> float:
        """Draw the error in s of the lead time for which the thrower extrapolates the vehicle's motion in this throw."""
        return self._config.scatter * self._config.prediction_error_s * float(self._rng.standard_normal())

    def release(self, point_m: Vec3, velocity_m_s: Vec3, flight_s: float) -> tuple[Vec3, Vec3]:
        """Draw the release of a throw and return its point (m) and velocity (m/s), world frame.

        Args:
            point_m: intended release point.
            velocity_m_s: intended release velocity.
            flight_s: time from the release to the arrival.
        """
        config, factor = self._config, self._config.scatter
        scatter = [factor * config.release_error_m * value for value in self._rng.standard_normal(3).tolist()]
        # From another point, with the same time of flight, to the same point of arrival.
        vx, vy, vz = (v - s / flight_s for v, s in zip(velocity_m_s, scatter, strict=True))
        faster, aside, up = self._rng.standard_normal(3).tolist()
        level = math.hypot(vx, vy)
        speed = math.hypot(level, vz) * (1.0 + factor * config.speed_error * faster)
        error_rad = math.radians(factor * config.direction_error_deg)
        azimuth = math.atan2(vy, vx) + error_rad * aside * math.hypot(level, vz) / max(level, 0.1)
        elevation = math.atan2(vz, level) + error_rad * up
        level = speed * math.cos(elevation)
        x, y, z = (p + s for p, s in zip(point_m, scatter, strict=True))
        return (x, y, z), (level * math.cos(azimuth), level * math.sin(azimuth), speed * math.sin(elevation))
