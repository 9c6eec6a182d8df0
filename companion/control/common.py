"""Parts that every control law shares: errors, the filtered external force, the desired force, and the saturation of commands.

Everything here runs in the control tick and is therefore written in plain floats, axis by axis.
"""

from __future__ import annotations

import math
from typing import Final

from companion.config.controller import LawConfig
from companion.config.vehicle import Vehicle
from companion.control.thrust import (
    ForceLimits,
    TiltFilter,
    attitude_from_roll_pitch_yaw,
    collective_n,
    roll_pitch_from_force,
    saturate_force,
)
from companion.control.types import PlantState, Wrench
from companion.model.algebra import minus
from companion.model.constants import GRAVITY_M_S2, PX4_YAW_P
from companion.model.frames import quat_multiply, wrap_rad
from companion.model.outputs import ControlLog
from companion.model.types import IDENTITY_QUAT, Chi, Joints, Quat, Reference, Vec3

YAW_LEAD_MAX_RAD: Final = 0.5
"""Largest lead of the yaw setpoint, that of 80 deg/s: a phase that states its rate in other units does not spin the vehicle."""


def tracking_errors(state: PlantState, reference: Reference, yaw_rad: float) -> tuple[Chi, Chi]:
    """Return e = chi - chi_d and e'. Rows 3 and 4 (roll, pitch) are 0 because their reference is the law's own output; e' of yaw is the
    body's rate r less that of the reference.
    """
    yaw_error = wrap_rad(yaw_rad - reference.yaw_rad)
    yaw_error_rate = state.angular_rate_body_rad_s[2] - reference.yaw_rate_rad_s
    position, velocity = reference.position_world_m, reference.velocity_world_m_s
    error = [*minus(state.position_world_m, position), 0.0, 0.0, yaw_error]
    error_rate = [*minus(state.velocity_world_m_s, velocity), 0.0, 0.0, yaw_error_rate]
    angles_d, rates, rates_d = reference.arm_rad, state.arm_rate_rad_s, reference.arm_rate_rad_s
    for joint, angle in enumerate(state.arm_rad):
        error.append(angle - angles_d[joint])
        error_rate.append(rates[joint] - rates_d[joint])
    return tuple(error), tuple(error_rate)


class AccelerationFilter:
    """First-order low-pass filter of chi'', exact for a held input; it starts at its first sample.

    The acceleration of the base is measured, that of the joints differentiated numerically; the rows of the attitude are 0.
    """

    def __init__(self, cutoff_hz: float) -> None:
        self._w = 2.0 * math.pi * cutoff_hz
        self._rates_before_rad_s: Joints | None = None
        self._filtered: list[float] = []

    def step(self, dt_s: float, state: PlantState) -> list[float]:
        """Return the filtered chi''."""
        rates, before = state.arm_rate_rad_s, self._rates_before_rad_s
        self._rates_before_rad_s = rates
        if before is None:
            self._filtered = [*state.acceleration_world_m_s2, 0.0, 0.0, 0.0, *(0.0,) * len(rates)]
            return self._filtered
        sample = [*state.acceleration_world_m_s2, 0.0, 0.0, 0.0]
        for joint, rate in enumerate(rates):
            sample.append((rate - before[joint]) / dt_s)
        k, filtered = 1.0 - math.exp(-self._w * dt_s), self._filtered
        for i, new in enumerate(sample):
            filtered[i] += k * (new - filtered[i])
        return filtered


class ForceFilter:
    """First-order low-pass filter of the external force, exact for a held input.

    It returns zero while there is no valid sample, and then starts from zero. Only a sample in the first step is returned unfiltered.
    """

    def __init__(self, cutoff_hz: float) -> None:
        self._w = 2.0 * math.pi * cutoff_hz
        self._force_n: Vec3 | None = None

    def step(self, dt_s: float, sample_world_n: Vec3 | None) -> Vec3:
        """Return the filtered force, world frame, N."""
        before = self._force_n
        if sample_world_n is None:
            sample_world_n = (0.0, 0.0, 0.0)
        elif before is not None:
            x, y, z = before
            sx, sy, sz = sample_world_n
            k = 1.0 - math.exp(-self._w * dt_s)
            sample_world_n = (x + k * (sx - x), y + k * (sy - y), z + k * (sz - z))
        self._force_n = sample_world_n
        return sample_world_n


class DesiredForce:
    """Desired force F_d. It follows the external force slowly, so that a carried payload ceases to be a disturbance.

    Args:
        time_s: time constant; with None F_d stays 0.
    """

    def __init__(self, time_s: float | None) -> None:
        self._time_s = time_s
        self.world_n: Vec3 = (0.0, 0.0, 0.0)

    def advance(self, dt_s: float, force_world_n: Vec3) -> None:
        """Integrate one step with the force held."""
        if self._time_s is None:
            return
        k = dt_s / self._time_s
        if k > 1.0:
            k = 1.0
        x, y, z = self.world_n
        fx, fy, fz = force_world_n
        self.world_n = (x + k * (fx - x), y + k * (fy - y), z + k * (fz - z))


class Actuation:
    """Converts force and joint torques to commands: vertical force first, then lateral force within the tilt limit, filtered roll
    and pitch, and joint torques within their limits.

    Results of the last tick are attributes, because a record per tick would cost more than the arithmetic.
    """

    def __init__(self, config: LawConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        weight_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        tilt_max_tan = math.tan(math.radians(vehicle.airframe.tilt_max_deg))
        self._limits = ForceLimits(
            vertical_min_n=0.3 * weight_n,
            vertical_max_n=min(0.9 * vehicle.airframe.thrust_max_n, 0.9 / hover_thrust * weight_n),
            lateral_max_n=config.lateral_force_max_n * max(1.0, tilt_max_tan / math.tan(math.radians(20.0))),
            tilt_max_tan=tilt_max_tan,
        )
        self._torque_max_nm = [(number, joint.torque_max_nm) for number, joint in enumerate(vehicle.arm.joints)]
        """Number and torque limit of each joint."""
        self._tilt = TiltFilter(config.attitude_filter_rad_s, config.attitude_filter_damping)
        self.attitude_wxyz: Quat = IDENTITY_QUAT
        self.roll_pitch_yaw_rad: Vec3 = (0.0, 0.0, 0.0)
        self.collective_n = 0.0
        self.force_world_n: Vec3 = (0.0, 0.0, 0.0)
        """Force after saturation, world frame, N."""
        self.arm_torque_nm: Joints = (0.0,) * len(self._torque_max_nm)
        self.clipped = (False, False, False)
        """Whether vertical force, lateral force and joint torque were saturated."""
        self.any_clipped = False
        self._nothing: Chi = (0.0,) * (6 + len(self._torque_max_nm))
        self._over = self._nothing
        """Command before less after saturation, all rows."""

    def unwinding(self, error: Chi) -> Chi:
        """Return what an integrator may integrate after the last tick: all rows but those whose integral would go further beyond the
        limit. An integrator that waits for the end of a saturation that it has caused itself waits forever.

        Args:
            error: what is integrated, all rows; where it is positive, the command falls.
        """
        if not self.any_clipped:
            return error
        return tuple([row if row * over >= 0.0 else 0.0 for row, over in zip(error, self._over, strict=True)])

    def step(
        self,
        dt_s: float,
        force_world_n: Vec3,
        torque_nm: Joints,
        body_z_world: Vec3,
        yaw_rad: float,
        vertical_scale: float,
        yaw_rate_rad_s: float = 0.0,
    ) -> None:
        """Run one tick.

        Args:
            dt_s: time since the last tick.
            force_world_n: desired force on the base.
            torque_nm: desired joint torques.
            body_z_world: current direction of the body's z axis.
            yaw_rad: desired yaw.
            vertical_scale: as in `companion.control.types.Controller`.
            yaw_rate_rad_s: desired rate of yaw.
        """
        force, clipped_z, clipped_xy = saturate_force(force_world_n, self._limits)
        saturated = force
        if vertical_scale < 1.0:
            force = (0.0, 0.0, force[2] * vertical_scale)
        self.force_world_n = force
        roll, pitch = roll_pitch_from_force(force, yaw_rad)
        roll, pitch = self._tilt.step(dt_s, roll, pitch)
        self.attitude_wxyz = attitude_from_roll_pitch_yaw(roll, pitch, yaw_rad)
        if yaw_rate_rad_s:
            # PX4 turns at a rate proportional to the error of yaw, and would lag: the setpoint leads by as much, about body z, which
            # leaves the direction of thrust.
            lead_rad = yaw_rate_rad_s / PX4_YAW_P
            half_rad = 0.5 * min(max(lead_rad, -YAW_LEAD_MAX_RAD), YAW_LEAD_MAX_RAD)  # in this order NaN stays NaN
            self.attitude_wxyz = quat_multiply(self.attitude_wxyz, (math.cos(half_rad), 0.0, 0.0, math.sin(half_rad)))
        self.roll_pitch_yaw_rad = (roll, pitch, yaw_rad)
        collective = collective_n(force, body_z_world)
        self.collective_n = collective if collective > 0.0 else 0.0
        clipped_arm, asked_nm = False, torque_nm
        for joint, most in self._torque_max_nm:
            if not -most <= torque_nm[joint] <= most:
                clipped_arm = True
        if clipped_arm:
            # In this order NaN stays NaN, which the gate refuses.
            torque_nm = tuple([min(max(torque_nm[joint], -most), most) for joint, most in self._torque_max_nm])
        self.arm_torque_nm = torque_nm
        self.clipped = (clipped_z, clipped_xy, clipped_arm)
        self.any_clipped = clipped_z or clipped_xy or clipped_arm
        if self.any_clipped:
            asked = (*force_world_n, 0.0, 0.0, 0.0, *asked_nm)
            now = (*saturated, 0.0, 0.0, 0.0, *torque_nm)
            self._over = tuple([before - after for before, after in zip(asked, now, strict=True)])


def wrench_of(
    sent: Actuation,
    error: Chi,
    error_rate: Chi,
    e_tau: Chi,
    force_world_n: Vec3,
    hover_thrust: float,
    payload_estimate_kg: float | None = None,
) -> Wrench:
    """Return the command of a tick and its log record. Fields of adaptive laws are 0.

    Args:
        sent: the actuation after its step.
        error, error_rate: results of `tracking_errors`.
        e_tau: external force and torques that the law yields to, less the desired ones.
        force_world_n: filtered external force; the catch is detected from it.
        hover_thrust: normalised thrust that carries the vehicle without payload.
        payload_estimate_kg: estimated mass of the payload; None if the law does not estimate it.
    """
    nothing: Chi = (0.0,) * len(error)
    log = ControlLog(
        error=error,
        error_rate=error_rate,
        sliding=nothing,
        gamma=nothing,
        tau=(*sent.force_world_n, 0.0, 0.0, 0.0, *sent.arm_torque_nm),
        e_tau=e_tau,
        h_hat=(0.0, 0.0, 0.0, 0.0),
        zeta=0.0,
        rho=0.0,
        force_ext_world_n=force_world_n,
        attitude_desired_rad=sent.roll_pitch_yaw_rad,
        hover_thrust=hover_thrust,
        saturated=sent.clipped,
        payload_estimate_kg=payload_estimate_kg,
    )
    return Wrench(
        attitude_wxyz=sent.attitude_wxyz, collective_n=sent.collective_n, arm_torque_nm=sent.arm_torque_nm, log=log
    )
