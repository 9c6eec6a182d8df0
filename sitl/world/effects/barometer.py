"""The autopilot's barometer: height, the pressure of the rotors' wake, drift of the room's pressure, and noise."""

from __future__ import annotations

import math
from typing import Final

from companion.sitl_config.effects.barometer import Barometer as BarometerConfig
from sitl.world.noise import noise

PERIOD_S: Final = 0.02
"""Time between two samples."""
_STREAM: Final = 29


class Barometer:
    """Measures the height above the floor; call `measure` every `PERIOD_S`.

    Args:
        hover_n: thrust of all rotors in hover.
        rest_m: height of the body's origin on the floor.
        fade_m: height over which the error near the floor falls by e.
    """

    def __init__(self, config: BarometerConfig, hover_n: float, rest_m: float, fade_m: float, seed: int) -> None:
        self._config, self._hover_n, self._rest_m, self._fade_m, self._seed = config, hover_n, rest_m, fade_m, seed
        self._keep = math.exp(-PERIOD_S / config.drift_time_s)
        self._new_m = math.sqrt(1.0 - self._keep * self._keep) * config.drift_m
        self.restart()

    def restart(self) -> None:
        """Start the drift at zero, and the noise again."""
        self._noise, self._drift_m = noise(self._seed, _STREAM), 0.0

    def measure(self, height_m: float, thrust_n: float) -> float:
        """Return the measured height above the floor, m.

        Args:
            height_m: true height of the body's origin.
            thrust_n: thrust of all rotors.
        """
        config = self._config
        if not config.on:
            return height_m
        fresh, sample, _ = next(self._noise)
        self._drift_m = self._keep * self._drift_m + self._new_m * fresh
        share, above_m = thrust_n / self._hover_n, max(0.0, height_m - self._rest_m)
        wake_m = share * (config.hover_m + config.floor_m * math.exp(-above_m / self._fade_m))
        return height_m + wake_m + self._drift_m + config.noise_m * sample
