"""The global position of the local origin."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.model.types import Vec3

_EARTH_RADIUS_M = 6371000.0


@dataclass(frozen=True, slots=True)
class Origin:
    """Global position of the local origin (SET_GPS_GLOBAL_ORIGIN)."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def local_ned_m(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vec3:
        """Return the local NED position of a nearby point in m (equirectangular projection)."""
        north = math.radians(latitude_deg - self.latitude_deg) * _EARTH_RADIUS_M
        east = math.radians(longitude_deg - self.longitude_deg) * _EARTH_RADIUS_M * self._shrink()
        return (north, east, self.altitude_m - altitude_m)

    def global_deg_m(self, position_ned_m: Vec3) -> Vec3:
        """Return the latitude and longitude in degrees and the altitude in m of a local position."""
        north, east, down = position_ned_m
        latitude = self.latitude_deg + math.degrees(north / _EARTH_RADIUS_M)
        longitude = self.longitude_deg + math.degrees(east / (_EARTH_RADIUS_M * self._shrink()))
        return (latitude, longitude, self.altitude_m - down)

    def _shrink(self) -> float:
        return max(math.cos(math.radians(self.latitude_deg)), 1e-6)
