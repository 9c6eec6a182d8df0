"""Estimates the payload's mass for the PSC law, starting at zero; the adaptive law uses `companion.control.load_adaptation`."""

from __future__ import annotations

import math

from companion.config.controller import PscConfig
from companion.model.constants import GRAVITY_M_S2


class PayloadEstimator:
    """Estimates the payload's mass: thrust / specific force along body z, low-passed, minus the vehicle's own mass.

    In the air the rotors' thrust is the only force that an accelerometer on the vehicle measures (drag aside), so their ratio is the
    total mass, whatever the motion. The thrust is the commanded one, delayed like the rotors' response.
    """

    _LIFTING_SHARE = 0.7
    """Fraction of the vehicle's weight; with less thrust than this the ground may carry a part of it."""

    def __init__(self, config: PscConfig, mass_kg: float) -> None:
        self._mass_kg = mass_kg
        self._time_s = config.payload_time_s
        self._max_kg = config.payload_max_kg
        self._lag_s = config.thrust_lag_s
        self._thrust_n: float | None = None
        self.payload_kg = 0.0

    def step(self, dt_s: float, commanded_n: float, specific_force_z_m_s2: float, airborne: bool) -> float:
        """Run one tick with the thrust commanded in the previous one and return the estimate, kg, within [0, payload_max_kg]."""
        if self._thrust_n is None:
            self._thrust_n = commanded_n
        k = 1.0 - math.exp(-dt_s / self._lag_s) if self._lag_s > 0 else 1.0
        self._thrust_n += k * (commanded_n - self._thrust_n)
        least_n = self._LIFTING_SHARE * self._mass_kg * GRAVITY_M_S2
        if airborne and self._thrust_n > least_n and specific_force_z_m_s2 > self._LIFTING_SHARE * GRAVITY_M_S2:
            sample_kg = self._thrust_n / specific_force_z_m_s2 - self._mass_kg
            self.payload_kg += (1.0 - math.exp(-dt_s / self._time_s)) * (sample_kg - self.payload_kg)
            self.payload_kg = max(0.0, min(self._max_kg, self.payload_kg))
        return self.payload_kg
