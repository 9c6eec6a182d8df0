"""Section `force_sensor` of the simulated world: errors of the force-torque sensor."""

from __future__ import annotations

from companion.config.base import Fraction, Model, NonNegative, Positive, Vector3


class ForceSensor(Model):
    """Errors of the sensor. `world.force_noise_n`, `world.force_bias_n` and `world.force_scale` act without this section."""

    on: bool = False
    """Whether this effect acts."""
    resolution_n: NonNegative = 0.2
    """Smallest step of a force reading; 0 for the step on the wire. (m) 0.2 for the RFT40-SA01, (e) the same for this sensor."""
    resolution_nm: NonNegative = 0.008
    """Smallest step of a torque reading; 0 for the step on the wire. (m) 0.008 for the RFT40-SA01, (e) the same for this sensor."""
    cross_talk: Fraction = 0.02
    """Largest fraction of one axis's load that another axis reads, each relative to its capacity (200 N, 4 N m). The seed draws each of
    the 30 fractions between minus and plus this. (e) 0.02-0.03.
    """
    mounting_rpy_deg: Vector3 = (1.0, -1.0, 1.0)
    """True attitude of the sensor in the sensor frame of the vehicle file, ZYX roll, pitch, yaw. (e) within 2."""
    drift_n_per_min: Vector3 = (0.05, -0.04, 0.08)
    """Constant drift of the force zero; torques drift by 0.02 m times this, the ratio of the capacities. (e) 0.02-0.05 % of the
    capacity per minute."""
    temperature_drift_n_per_k: Vector3 = (0.05, 0.03, -0.08)
    """Drift of the force zero with temperature; torques drift by 0.02 m times this. (e) 0.02-0.05 % of the capacity per kelvin, as in
    data sheets of capacitive and strain-gauge sensors without compensation."""
    warm_up_k: float = 8.0
    """Rise of the sensor's temperature after it is switched on at the world's start. (e)"""
    warm_up_s: Positive = 300.0
    """Time constant of that rise. (e)"""
    filter_hz: Positive = 100.0
    """Cut-off frequency of the sensor's first-order low-pass. (m) The sensor offers 1 to 500 Hz, or no filter. (e) The
    choice of 100 Hz."""
