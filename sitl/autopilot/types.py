"""Records inside the PX4 stub; frames are PX4's own: local NED, body FRD.

They are named tuples because they are created at 250 Hz, at a quarter of the cost of a frozen dataclass.
"""

from __future__ import annotations

from typing import NamedTuple

from companion.model.types import Quat, Vec3, Vec4


class ImuSample(NamedTuple):
    """One IMU sample, with noise and bias."""

    t_s: float
    gyro_frd_rad_s: Vec3
    accel_frd_m_s2: Vec3
    """Specific force: (0, 0, -9.81) at rest, level."""


class LearnedBias(NamedTuple):
    """Biases that PX4 has learned at rest and subtracts from every IMU sample."""

    gyro_frd_rad_s: Vec3
    accel_down_m_s2: float


class Estimate(NamedTuple):
    """Output of the estimator."""

    t_s: float
    position_ned_m: Vec3
    velocity_ned_m_s: Vec3
    attitude_ned_frd: Quat
    rates_frd_rad_s: Vec3
    accel_frd_m_s2: Vec3
    vision_fused: bool
    """Whether vision was fused within the last 0.55 s (as PX4's EV flags)."""
    position_valid: bool
    """xy_valid and z_valid of VEHICLE_LOCAL_POSITION: true up to 4.5 s after vision was last fused."""
    attitude_valid: bool


class Fusion(NamedTuple):
    """Vision innovation test ratios as in ESTIMATOR_STATUS (square roots of filtered test ratios), and accuracy (one sigma)."""

    horizontal_ratio: float
    """NaN if vision is not fused."""
    vertical_ratio: float
    horizontal_accuracy_m: float
    vertical_accuracy_m: float


class AttitudeTarget(NamedTuple):
    """Setpoint of the attitude loop."""

    attitude_ned_frd: Quat
    thrust: float
    """Collective thrust, 0 to 1."""
    yaw_rate_rad_s: float = 0.0


RotorCommands = Vec4
"""Normalised rotor commands in PX4's quad-x order: front right, rear left, front left, rear right."""
