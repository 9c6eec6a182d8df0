"""Nominal rigid-body dynamics of vehicle and arm, payload excluded: M(chi) chi'' + C(chi, chi') chi' + g(chi) = tau.

chi = [p (world, m); roll, pitch, yaw (ZYX, rad); joint angles (rad)]; tau = [force on the body origin, world, N; generalised torques of
roll, pitch, yaw, N m; joint torques, N m]. `companion.control.arm_model.dynamics_of` builds the implementation that fits the arm.

The implementations build the terms in the coordinates (origin velocity in body axes, body rate, joint rates) and then transform them to
chi by the Euler-rate matrix W: omega_body = W(roll, pitch) q'. They use floats and tuples only: they run in the control tick, and a
replay on another computer must not depend on the summation order of a linear-algebra library.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

from companion.model.types import Chi, Joints, Mat3, Matrix, Vec3


@dataclass(frozen=True, slots=True)
class DynamicsTerms:
    """The terms M, C chi' and g of the equation of motion at one state. `mass` is M as a tuple of rows."""

    mass: Matrix
    coriolis: Chi
    """C(chi, chi') chi'."""
    gravity: Chi


@dataclass(frozen=True, slots=True)
class ArmTerms:
    """M and C alpha' of the arm on a fixed base, without gravity (see `Manipulator.gravity_torque_nm`)."""

    mass: Matrix
    coriolis: Joints


class Dynamics(ABC):
    """The nominal model of the vehicle file."""

    @abstractmethod
    def arm_terms(self, angle_rad: Joints, rate_rad_s: Joints) -> ArmTerms:
        """Return M (kg m^2) and C alpha' (N m) of the arm alone, on a fixed base."""

    @abstractmethod
    def arm_torque_nm(self, angle_rad: Joints, rate_rad_s: Joints, acceleration_rad_s2: Joints) -> Joints:
        """Return M alpha'' + C alpha' of the arm alone, N m, without gravity."""

    @abstractmethod
    def terms(self, rotation: Mat3, roll_pitch_yaw_rad: Vec3, angle_rad: Joints, chi_rate: Chi) -> DynamicsTerms:
        """Return M, C chi' and g at a state. They do not depend on the position.

        Args:
            rotation: rotation matrix from body to world that corresponds to the three angles.
            roll_pitch_yaw_rad: ZYX; |pitch| < 90 deg.
            angle_rad: joint angles.
            chi_rate: chi'; rows 3-5 are the rates of roll, pitch, yaw.
        """


def chi_rate_from_body_rate(roll_pitch_yaw_rad: Vec3, rate_body_rad_s: Vec3) -> Vec3:
    """Return q' = W^-1 omega: rates of roll, pitch, yaw, rad/s. |pitch| must be less than 90 deg."""
    roll, pitch, _ = roll_pitch_yaw_rad
    x, y, z = rate_body_rad_s
    s, c = math.sin(roll), math.cos(roll)
    yaw_rate = (s * y + c * z) / math.cos(pitch)
    return (x + math.sin(pitch) * yaw_rate, c * y - s * z, yaw_rate)


def euler_rate_matrices(rpy: Vec3, chi_rate: Chi) -> tuple[Mat3, Mat3]:
    """Return W, with omega_body = W q', and dW/dt."""
    roll, pitch, _ = rpy
    sr, cr, sp, cp = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
    dr, dp = chi_rate[3], chi_rate[4]
    w: Mat3 = ((1.0, 0.0, -sp), (0.0, cr, cp * sr), (0.0, -sr, cp * cr))
    rate: Mat3 = (
        (0.0, 0.0, -cp * dp),
        (0.0, -sr * dr, cp * cr * dr - sp * sr * dp),
        (0.0, -cr * dr, -cp * sr * dr - sp * cr * dp),
    )
    return w, rate
