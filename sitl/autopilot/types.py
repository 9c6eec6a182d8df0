"""Records used inside the PX4 stub; the frames are PX4's: local NED, body FRD.

The records are named tuples: they are created at 250 Hz, and a named tuple costs a quarter of a frozen dataclass.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from companion.model.types import Quat, Vec3
from sitl.autopilot.modes import NavState


class ImuSample(NamedTuple):
    """One IMU sample, with noise and bias."""

    t_s: float
    gyro_frd_rad_s: Vec3
    accel_frd_m_s2: Vec3
    """Specific force; (0, 0, -9.81) for a level vehicle at rest."""
    baro_m: float | None = None
    """Barometric height above the floor; None between the samples of the barometer."""


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
    """Whether vision was fused within the last 0.55 s (like PX4's EV flags)."""
    position_valid: bool
    """xy_valid of vehicle_local_position: true until EKF2_NOAID_TOUT less 0.58 s after vision was last fused."""
    height_valid: bool
    """z_valid: as long, and longer with a barometer."""
    attitude_valid: bool
    height_aided: bool
    """Whether a measurement supports the height: vision or the barometer."""


class Fusion(NamedTuple):
    """Innovation test ratios of vision as in ESTIMATOR_STATUS (roots of filtered test ratios), and accuracies (one sigma)."""

    horizontal_ratio: float
    """Test ratio of the horizontal position; NaN while vision is not fused."""
    vertical_ratio: float
    horizontal_accuracy_m: float
    vertical_accuracy_m: float


class AttitudeTarget(NamedTuple):
    """Setpoint of the attitude loop."""

    attitude_ned_frd: Quat
    thrust: float
    """Collective thrust, 0 to 1."""
    yaw_rate_rad_s: float = 0.0


class Battery(NamedTuple):
    """Measurement of the power module."""

    voltage_v: float = 16.2
    current_a: float = 0.5
    remaining: float = 1.0
    """State of charge, 0 to 1."""
    consumed_mah: float = 0.0


Command7 = tuple[float, float, float, float, float, float, float]
"""param1 to param7 of a MAV_CMD."""
RotorCommands = tuple[float, ...]
"""Normalised rotor commands in PX4's order."""


class FaultTarget(Protocol):
    """An autopilot on which faults act (`sitl.autopilot.autopilot.Px4Stub`)."""

    refuses_offboard: bool
    refuses_arming: bool
    kill_switch: bool

    def reboot(self, for_s: float) -> None:
        """Restart the autopilot; it runs again after `for_s`."""

    def pilot_sets_mode(self, state: NavState) -> None:
        """Change the mode as a pilot does by radio control."""
