"""Section `force_sensor` of the simulated world: errors of the force-torque sensor."""

from __future__ import annotations

from companion.config.base import Fraction, NonNegative, Positive, Vector3
from companion.sitl_config.effects import Effect


class ForceSensor(Effect):
    """Errors of the force-torque sensor. `world.force_noise_n`, `world.force_bias_n` and `world.force_scale` also act without this
    effect.
    """

    resolution_n: NonNegative = 0.2
    """Smallest step of a force reading; 0 for the step of the serial protocol. (m) 0.2 for the RFT40-SA01, (e) the same for this
    sensor.
    """
    resolution_nm: NonNegative = 0.008
    """Smallest step of a torque reading; 0 for the step of the serial protocol. (m) 0.008 for the RFT40-SA01, (e) the same for this
    sensor.
    """
    cross_talk: Fraction = 0.02
    """Largest fraction of one axis's load that another axis reads, each relative to its capacity (200 N, 4 N m). Each of the 30
    fractions is drawn from the seed between minus and plus this value. (e) 0.02 to 0.03.
    """
    mounting_rpy_deg: Vector3 = (1.0, -1.0, 1.0)
    """True attitude of the sensor relative to the sensor frame of the vehicle file: roll, pitch and yaw (ZYX). (e) within 2."""
    drift_n_per_min: Vector3 = (0.05, -0.04, 0.08)
    """Constant drift of the force zero; the torque zero drifts by 0.02 m, the ratio of the capacities, times this value. (e) 0.02 to
    0.05 % of the capacity per minute."""
    temperature_drift_n_per_k: Vector3 = (0.05, 0.03, -0.08)
    """Drift of the force zero with temperature; the torque zero drifts by 0.02 m times this value. (e) 0.02 to 0.05 % of the capacity
    per kelvin, as in data sheets of capacitive and strain-gauge sensors without compensation."""
    warm_up_k: float = 8.0
    """Final rise of the sensor's temperature after it is switched on at the start of the world. (e)"""
    warm_up_s: Positive = 300.0
    """Time constant of that rise. (e)"""
    filter_hz: Positive = 100.0
    """Cut-off frequency of the sensor's first-order low-pass filter. (m) The sensor offers 1 to 500 Hz, or no filter. (e) The choice of
    100 Hz."""
