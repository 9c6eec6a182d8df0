"""Section `air` of the simulated world: gusts in the air that the rotors recirculate in a room."""

from __future__ import annotations

from companion.config.base import NonNegative, Positive
from companion.sitl_config.effects import Effect


class Air(Effect):
    """Gusts on the base. They grow with the rotors' thrust and are zero while the rotors are stopped."""

    force_rms_n: NonNegative = 0.2
    """RMS of the force along each axis in hover far from the floor (e: 0.1 to 0.4)."""
    torque_rms_nm: NonNegative = 0.03
    """RMS of the torque about each horizontal axis in hover far from the floor. Vertical gusts that hit the four rotors independently
    give `force_rms_n` times the rotors' lever arm, 0.23 m; gusts that hit all four equally give 0 (e: between the two)."""
    correlation_time_s: Positive = 0.3
    """Correlation time. The corner frequency of the spectrum is 1 / (2 pi `correlation_time_s`), here 0.5 Hz (e: 0.1 to 0.5 s, which
    corresponds to 2 to 0.3 Hz)."""
    floor_increase: NonNegative = 1.0
    """Relative increase of the gusts on the floor; it falls linearly to zero at `floor_range_m` (e; p: in a hover in ground effect, air
    recirculates between the rotors, Wolf et al., Experiments in Fluids 2024)."""
    floor_range_m: Positive = 0.7
    """Height of the base above the floor at which the increase ends (e: four rotor radii, the reach of the ground effect)."""
