"""What every law shares: errors, the filtered external force, the force that is taken for granted, and the way to the actuators."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from companion.config.vehicle import Vehicle
from companion.control.impedance import LowPass
from companion.control.manipulator import GRAVITY_M_S2
from companion.control.thrust import (
    ForceLimits,
    TiltFilter,
    attitude_from_roll_pitch_yaw,
    collective_n,
    roll_pitch_from_force,
    saturate_force,
)
from companion.control.types import PlantState
from companion.frames import euler_zyx_from_quat, wrap_rad
from companion.types import Quat, Reference, Vec2, Vec3, Vec8


def tracking_errors(state: PlantState, reference: Reference) -> tuple[list[float], list[float]]:
    """e = chi - chi_d and e', 8 rows; rows 3 and 4 (roll, pitch) are 0: their reference is the law's own."""
    p, v, r = state.position_world_m, state.velocity_world_m_s, reference
    yaw = euler_zyx_from_quat(state.attitude_wxyz)[2]
    yaw_rate = state.angular_rate_body_rad_s[2]
    error = [
        p[0] - r.position_world_m[0],
        p[1] - r.position_world_m[1],
        p[2] - r.position_world_m[2],
        0.0,
        0.0,
        wrap_rad(yaw - r.yaw_rad),
        state.arm_rad[0] - r.arm_rad[0],
        state.arm_rad[1] - r.arm_rad[1],
    ]
    rate = [
        v[0] - r.velocity_world_m_s[0],
        v[1] - r.velocity_world_m_s[1],
        v[2] - r.velocity_world_m_s[2],
        0.0,
        0.0,
        yaw_rate - r.yaw_rate_rad_s,
        state.arm_rate_rad_s[0] - r.arm_rate_rad_s[0],
        state.arm_rate_rad_s[1] - r.arm_rate_rad_s[1],
    ]
    return error, rate


class ForceFilter:
    """The external force, low-passed; zero while there is no sample to be trusted, and it starts again from there."""

    def __init__(self, cutoff_hz: float) -> None:
        self._filter = LowPass(cutoff_hz)

    def step(self, dt_s: float, sample_world_n: Vec3 | None) -> Vec3:
        """Filtered force, world, N."""
        if sample_world_n is None:
            self._filter.reset((0.0, 0.0, 0.0))
            return (0.0, 0.0, 0.0)
        x, y, z = self._filter.step(dt_s, sample_world_n)
        return (x, y, z)


class DesiredForce:
    """F_d: follows the external force slowly, so that a carried payload is no disturbance for ever.

    Args:
        time_s: time constant; None: F_d stays 0.
    """

    def __init__(self, time_s: float | None) -> None:
        self._time_s = time_s
        self.world_n: Vec3 = (0.0, 0.0, 0.0)

    def advance(self, dt_s: float, force_world_n: Vec3) -> None:
        """One step with the force held."""
        if self._time_s is None:
            return
        k = min(1.0, dt_s / self._time_s)
        d, f = self.world_n, force_world_n
        self.world_n = (d[0] + k * (f[0] - d[0]), d[1] + k * (f[1] - d[1]), d[2] + k * (f[2] - d[2]))


class ActuationConfig(Protocol):
    """The part of a law's configuration that limits what it asks for."""

    @property
    def lateral_force_max_n(self) -> float:
        """Largest horizontal force."""

    @property
    def attitude_filter_rad_s(self) -> float:
        """Bandwidth of the desired roll and pitch."""

    @property
    def attitude_filter_damping(self) -> float:
        """Damping of the same filter."""


@dataclass(frozen=True, slots=True)
class Actuated:
    """What may be asked of rotors and servos."""

    attitude_wxyz: Quat
    collective_n: float
    arm_torque_nm: Vec2
    force_world_n: Vec3
    roll_pitch_yaw_rad: Vec3
    clipped: tuple[bool, bool, bool]
    """Vertical force, lateral force, joint torque."""


class Actuation:
    """From force and joint torques to what is sent: vertical first, then lateral within tilt; smooth roll and pitch; torque limits."""

    def __init__(self, config: ActuationConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        weight_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        self._limits = ForceLimits(
            vertical_min_n=0.3 * weight_n,
            vertical_max_n=min(0.9 * vehicle.airframe.thrust_max_n, 0.9 / hover_thrust * weight_n),
            lateral_max_n=config.lateral_force_max_n,
            tilt_max_rad=math.radians(vehicle.airframe.tilt_max_deg),
        )
        first, second = vehicle.arm.joints
        self._torque_max_nm = (first.torque_max_nm, second.torque_max_nm)
        self._tilt = TiltFilter(config.attitude_filter_rad_s, config.attitude_filter_damping)
        self.roll_pitch_rad: Vec2 = (0.0, 0.0)
        """As last asked for."""
        self.clipped = (False, False, False)
        """As in the last tick."""

    def step(
        self,
        dt_s: float,
        force_world_n: Vec3,
        torque_nm: Vec2,
        state: PlantState,
        reference: Reference,
        vertical_scale: float,
    ) -> Actuated:
        """One tick; `vertical_scale` as in `companion.control.types.Controller`."""
        force, clipped_z, clipped_xy = saturate_force(force_world_n, self._limits)
        if vertical_scale < 1.0:
            force = (0.0, 0.0, force[2] * vertical_scale)
        roll, pitch = self._tilt.step(dt_s, *roll_pitch_from_force(force, reference.yaw_rad))
        collective = max(0.0, collective_n(force, state.attitude_wxyz))
        limit = self._torque_max_nm
        torque: Vec2 = (
            max(-limit[0], min(limit[0], torque_nm[0])),
            max(-limit[1], min(limit[1], torque_nm[1])),
        )
        self.clipped = (clipped_z, clipped_xy, torque != torque_nm)
        self.roll_pitch_rad = (roll, pitch)
        attitude = attitude_from_roll_pitch_yaw(roll, pitch, reference.yaw_rad)
        return Actuated(attitude, collective, torque, force, (roll, pitch, reference.yaw_rad), self.clipped)


def vec8(values: Sequence[float]) -> Vec8:
    """Eight values as a tuple.

    Raises:
        ValueError: another number of values.
    """
    a, b, c, d, e, f, g, h = values
    return (a, b, c, d, e, f, g, h)


ZERO8: Vec8 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
