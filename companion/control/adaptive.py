"""Adaptive impedance control without a model of the coupling (paper, eqs. control_law and adaptive_law_full; corrected, discrete).

The rows are chi = [x y z | roll pitch yaw | joints]. PX4's attitude loop controls the attitude rows: they are masked out of every norm
and get no torque. The numbered steps are those of docs/internals/control-law.md.
"""

from __future__ import annotations

import math
from typing import ClassVar

from companion.config.controller import AdaptiveConfig
from companion.config.vehicle import Vehicle
from companion.control.adaptation import Adaptation
from companion.control.adaptive_arm import AdaptiveArm
from companion.control.arm_model import manipulator_of
from companion.control.common import Actuation, DesiredForce, ForceFilter
from companion.control.compensation import Compensation
from companion.control.impedance import rows_of
from companion.control.load_adaptation import LoadAdaptation
from companion.control.online import OnlineImpedance
from companion.control.scaled_gains import for_vehicle
from companion.control.types import PlantState, Wrench
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import body_x_z_axes_world, wrap_rad
from companion.model.types import ControlLog, Joints, Reference, Vec3, Vec4


class AdaptiveController:
    """The adaptive impedance control law for vehicle and arm."""

    settings: ClassVar = AdaptiveConfig
    for_vehicle: ClassVar = staticmethod(for_vehicle)

    def __init__(self, config: AdaptiveConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        manipulator = manipulator_of(vehicle)
        self._rows = rows = rows_of(config, manipulator.joint_count)
        self._base, self._yaw = rows[:3], rows[5]
        self._controlled = [*rows[:3], *rows[6:]]
        """All rows but those of the attitude: yaw's e, e' and s are logged only."""
        self._adaptation = Adaptation(config)
        self._load = LoadAdaptation(config, manipulator)
        self._compliance = config.base_compliance_xyz
        self._compensation = Compensation(config, vehicle, self._compliance, (rows[0].M_d, rows[1].M_d))
        self._arm = AdaptiveArm(config, vehicle, rows[6:], self._load, self._compensation.friction_nm)
        self._mission_gains = [(row.Phi, row.Lambda) for row in self._base]
        """Phi and Lambda of x, y and z that `online` scales."""
        self.online = (
            None
            if config.online is None
            else OnlineImpedance(config.online, config.inertia_md[:3], config.lambda_gain[:3], config.phi[:3])
        )
        """Optimisation of the target impedance in flight; None if it is off."""
        self._acceleration_cap = config.acceleration_cap
        self._acceleration_cutoff_rad_s = 2.0 * math.pi * config.acceleration_lowpass_hz
        self._acceleration: list[float] | None = None
        """Filtered chi'' of the controlled rows."""
        self._arm_rate_before_rad_s: Joints = ()
        self._force = ForceFilter(config.force_lowpass_hz)
        self._desired = DesiredForce(config.desired_force_time_s)
        self._actuation = Actuation(config, vehicle, hover_thrust)
        self._weight_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        self.hover_thrust = hover_thrust
        """Normalised hover thrust, for the log. The hover-thrust estimator sets it before every step."""

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick of `dt_s`; see `companion.control.types.Controller`."""
        adaptation, sent, arm = self._adaptation, self._actuation, self._arm
        clipped_before = sent.any_clipped
        learn = state.airborne and not clipped_before
        body_x, body_z = axes = body_x_z_axes_world(state.attitude_wxyz)
        # 1: chi'' and F
        chi_ddot = self._filtered_acceleration(dt_s, state)
        force = self._force.step(dt_s, state.force_ext_world_n)
        self._compensation.observe(dt_s, state, learn)  # beyond the paper: disturbance observer
        # 2 and 4: e, e' and s. 3: e_tau of the base here, of the joints with their torque.
        yaw_rad = math.atan2(body_x[1], body_x[0])
        self._set_errors(state, reference, yaw_rad)
        base_e_tau = self._external_force(force)
        # 5 and 6: norms, regressor and rho
        norm_s, norm_xi, norm_a = self._norms(chi_ddot)
        b: Vec4 = (1.0, norm_xi, norm_xi * norm_xi, min(norm_a, self._acceleration_cap))
        rho = adaptation.rho(b)
        robust_gain = rho / max(norm_s, adaptation.varpi)  # both cases of del_tau: dtau = -robust_gain S^2 s
        # 7: tau
        base_n = self._base_force(robust_gain, reference, force)
        arm_nm = arm.torque_nm(robust_gain, axes, force, self._desired.world_n, state, reference)
        # 8: saturation, attitude and thrust
        sent.step(dt_s, base_n, arm_nm, body_z, reference.yaw_rad, vertical_scale)
        self._compensation.remember(sent.force_world_n, force)
        # 9: H, zeta, loads, gamma and F_d
        adaptation.advance(dt_s, norm_s, b, clipped_before)
        self._advance(dt_s, base_e_tau, force, state, learn)
        # The scale of this tick; the new one counts in the next.
        scale = None if self.online is None else self.online.scale
        if self.online is not None:
            self._optimise(self.online, dt_s, state, force)
        rows, load = self._rows, self._load
        log = ControlLog(
            error=tuple([row.e for row in rows]),
            error_rate=tuple([row.e_dot for row in rows]),
            sliding=tuple([row.s for row in rows]),
            gamma=tuple([row.gamma for row in rows]),
            tau=(*sent.force_world_n, 0.0, 0.0, 0.0, *sent.arm_torque_nm),
            e_tau=(*base_e_tau, 0.0, 0.0, 0.0, *arm.e_tau),
            h_hat=adaptation.h,
            zeta=adaptation.zeta,
            rho=rho,
            force_ext_world_n=force,
            attitude_desired_rad=sent.roll_pitch_yaw_rad,
            hover_thrust=self.hover_thrust,
            saturated=sent.clipped,
            load_estimate_n=load.force_n if load.on else None,
            moment_estimate_kg_m=load.moments_kg_m if load.on else None,
            friction_estimate_nm=load.friction_nm if load.on else None,
            impedance_scale=scale,
        )
        return Wrench(
            attitude_wxyz=sent.attitude_wxyz, collective_n=sent.collective_n, arm_torque_nm=sent.arm_torque_nm, log=log
        )

    def _filtered_acceleration(self, dt_s: float, state: PlantState) -> list[float]:
        """Return chi'' of the controlled rows, low-pass filtered, exactly for a held input; the filter starts at its first sample.

        The acceleration of the base is measured, that of the joints differentiated numerically.
        """
        k = 1.0 - math.exp(-self._acceleration_cutoff_rad_s * dt_s)
        rates, filtered = state.arm_rate_rad_s, self._acceleration
        if filtered is None:
            filtered = self._acceleration = [*state.acceleration_world_m_s2, *(0.0,) * len(rates)]
            self._arm_rate_before_rad_s = rates
        before = self._arm_rate_before_rad_s
        for row, sample in enumerate(state.acceleration_world_m_s2):
            filtered[row] += k * (sample - filtered[row])
        for joint, rate in enumerate(rates):
            filtered[3 + joint] += k * ((rate - before[joint]) / dt_s - filtered[3 + joint])
        self._arm_rate_before_rad_s = rates
        return filtered

    def _set_errors(self, state: PlantState, reference: Reference, yaw_rad: float) -> None:
        """Set e, e' and s of all rows; those of roll and pitch stay 0, because their reference is the law's own output. e' of yaw is
        the body's rate r less that of the reference.
        """
        p, p_d = state.position_world_m, reference.position_world_m
        v, v_d = state.velocity_world_m_s, reference.velocity_world_m_s
        for i, row in enumerate(self._base):
            row.set_error(p[i] - p_d[i], v[i] - v_d[i])
        yaw_rate_rad_s = state.angular_rate_body_rad_s[2] - reference.yaw_rate_rad_s
        self._yaw.set_error(wrap_rad(yaw_rad - reference.yaw_rad), yaw_rate_rad_s)
        angles, angles_d = state.arm_rad, reference.arm_rad
        rates, rates_d = state.arm_rate_rad_s, reference.arm_rate_rad_s
        for joint, row in enumerate(self._arm.rows):
            row.set_error(angles[joint] - angles_d[joint], rates[joint] - rates_d[joint])

    def _norms(self, chi_ddot: list[float]) -> tuple[float, float, float]:
        """Return ||S s||, ||S [e; e']|| and ||S chi''||."""
        s_squared = xi_squared = a_squared = 0.0
        for i, row in enumerate(self._controlled):
            weight, e, e_dot, a = row.S_squared, row.e, row.e_dot, chi_ddot[i]
            s_squared += weight * row.s * row.s
            xi_squared += weight * (e * e + e_dot * e_dot)
            a_squared += weight * a * a
        return math.sqrt(s_squared), math.sqrt(xi_squared), math.sqrt(a_squared)

    def _base_force(self, robust_gain: float, reference: Reference, force: Vec3) -> Vec3:
        """Return the force on the base: tau with the adaptive load and the compensation, plus the weight; tau_d of the base is 0."""
        row_x, row_y, row_z = self._base
        x_ddot, y_ddot, z_ddot = reference.acceleration_world_m_s2
        load_x, load_y, load_z = self._load.force_n
        tau = (
            row_x.tau(x_ddot, robust_gain) + load_x,
            row_y.tau(y_ddot, robust_gain) + load_y,
            row_z.tau(z_ddot, robust_gain) + load_z,
        )
        x, y, z = self._compensation.base_force_n(tau, force, reference)
        return (x, y, z + self._weight_n)

    def _external_force(self, force: Vec3) -> Vec3:
        """Return e_tau of the base: the share of F that it complies with."""
        (share_x, share_y, share_z), (x, y, z) = self._compliance, force
        return (share_x * x, share_y * y, share_z * z)

    def _advance(self, dt_s: float, e_tau: Vec3, force: Vec3, state: PlantState, learn: bool) -> None:
        """Integrate the loads, gamma and F_d over one step."""
        row_x, row_y, row_z = self._base
        if learn and self._load.on:
            self._load.advance_base(dt_s, (row_x.s, row_y.s, row_z.s))
        row_x.advance(dt_s, e_tau[0])
        row_y.advance(dt_s, e_tau[1])
        row_z.advance(dt_s, e_tau[2])
        self._arm.advance(dt_s, state.arm_rate_rad_s, learn)
        self._desired.advance(dt_s, force)

    def _optimise(self, online: OnlineImpedance, dt_s: float, state: PlantState, force: Vec3) -> None:
        """Run one tick of the online optimisation, and give the rows of x, y and z the gains that it has found."""
        error, error_rate = tuple([row.e for row in self._base]), tuple([row.e_dot for row in self._base])
        rate, clipped = state.angular_rate_body_rad_s, self._actuation.any_clipped
        if online.step(dt_s, error, error_rate, rate, force, clipped, state.tuning):
            self.scale_gains(online.scale)

    def scale_gains(self, k: float) -> None:
        """Set Phi and Lambda of x, y and z to k times those of the mission; D stays."""
        for row, (phi, gain) in zip(self._base, self._mission_gains, strict=True):
            row.Phi, row.Lambda = k * phi, k * gain
