"""Section `barometer` of the simulated world: what the autopilot's barometer measures beside the height."""

from __future__ import annotations

from companion.config.base import NonNegative, Positive
from companion.sitl_config.effects import Effect


class Barometer(Effect):
    """Errors of the barometric height. PX4 fuses it beside motion capture if EKF2_BARO_CTRL is 1, with a weight that hardly moves the
    estimate as long as there are poses; without poses it is the only measurement of the height.
    """

    hover_m: float = 0.5
    """Error caused by the rotors' wake in hover, far from the floor, m. (e) ArduPilot, "Ground effect compensation", describes it."""
    floor_m: float = -1.0
    """Further error on the floor with the thrust of hover, m: the pressure of the wake under the vehicle. It falls by e over one
    rotor-arm length of height. (e) the same page: up to several metres."""
    drift_m: NonNegative = 0.5
    """Standard deviation of the drift, m: doors, air conditioning, weather; a first-order Gauss-Markov process. (e) 12 Pa per metre."""
    drift_time_s: Positive = 10.0
    """Time constant of the drift, s. (e)"""
    noise_m: NonNegative = 0.1
    """Standard deviation of the noise of a sample, m. (m) MS5611: 0.012 mbar, 0.1 m."""
