"""Errors of the autopilot's accelerometers and gyroscopes.

Sources: (m) data sheets of the ICM-20602 and the ICM-42688-P, the sensors of most PX4 boards; (p) published; (e) estimate.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.base import NonNegative, Positive, Vector3
from companion.sitl_config.effects import Effect


class Imu(Effect):
    """Errors of the IMU, in the axes of the autopilot board: forward, left, up."""

    accel_bias_m_s2: Vector3 = (0.1, -0.08, 0.1)
    """Remaining bias of each accelerometer after calibration. (m) 0.5 mg/K and 1 mg/K for the vertical axis (ICM-20602), or 0.15 mg/K
    (ICM-42688-P), at 10 to 20 K from the calibration temperature."""
    accel_drift_m_s2: NonNegative = 0.02
    """Standard deviation of the drift of this bias after arming. (m) the same coefficients with a warm-up of 3 to 10 K."""
    gyro_bias_deg_s: Vector3 = (0.3, -0.3, 0.2)
    """Bias of each gyroscope at power-on; PX4 removes it while the vehicle is at rest. (m) 0.5 to 1 deg/s."""
    gyro_drift_deg_s: NonNegative = 0.03
    """Standard deviation of the drift of this bias after arming. (m) 0.005 to 0.01 deg/s per K, with a warm-up of 3 to 10 K."""
    drift_time_s: Positive = 60.0
    """Time constant of both drifts, which are first-order Gauss-Markov processes. (e)"""
    mount_rpy_deg: Vector3 = (0.4, -0.3, 0.5)
    """Attitude of the board relative to the body. PX4 estimates the attitude of the board, so this is the error of the estimate
    relative
    to the rotors. (e) residual of a level calibration on the landing gear."""
    vibration_m_s2: NonNegative = 5.0
    """Amplitude of the rotors' vibration in hover on each accelerometer, before any filter. Each of the four rotors contributes half
    this amplitude; together they have the RMS value of one sine with the full amplitude. (p) ArduPilot, "Measuring Vibration": normal
    below 15 m/s^2 RMS, acceptable below 30.
    """
    gyro_vibration_deg_s: NonNegative = 4.0
    """Amplitude of the vibration in hover on each gyroscope. (e)"""
    vibration_hz: Positive = 80.0
    """Rotor speed in hover, in revolutions per second; each rotor's speed is proportional to the square root of its thrust. (e)
    13-inch to 15-inch propellers.
    """
    rotor_spread: Annotated[float, Field(ge=0, le=0.1)] = 0.01
    """Largest relative difference of a rotor's speed from the mean at the same thrust, which makes the rotors' vibrations beat. (e)"""
    rectification_m_s2: Vector3 = (0.05, -0.05, 0.1)
    """Shift of each accelerometer's mean caused by the vibration in hover, which a calibration at rest cannot remove. (p) its
    existence: ArduPilot, pull request 32041; (e) its size.
    """
