"""Ornstein-Uhlenbeck processes: noise with unit RMS and exponential autocorrelation."""

from __future__ import annotations

import math

from companion.model.types import Vec3
from sitl.world.noise import noise


class OrnsteinUhlenbeck:
    """Independent triples of stationary Ornstein-Uhlenbeck processes with unit RMS, sampled exactly.

    Args:
        correlation_time_s: time after which the autocorrelation has fallen to 1/e.
        source: number of the noise sequence.
    """

    def __init__(self, count: int, correlation_time_s: float, period_s: float, seed: int, source: int) -> None:
        self._keep = math.exp(-period_s / correlation_time_s)
        self._new = math.sqrt(1.0 - self._keep * self._keep)
        self._noise = noise(seed, source)
        self._values = [next(self._noise) for _ in range(count)]

    def step(self) -> list[Vec3]:
        """Advance by one period and return one 3-vector per triple of processes."""
        keep, new, draw = self._keep, self._new, self._noise
        values: list[Vec3] = []
        for x, y, z in self._values:
            nx, ny, nz = next(draw)
            values.append((keep * x + new * nx, keep * y + new * ny, keep * z + new * nz))
        self._values = values
        return values
