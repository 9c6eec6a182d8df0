"""Adaptive impedance control without a model of the coupling (paper, eqs. control_law and adaptive_law_full; corrected, discrete).

The rows are chi = [x y z | roll pitch yaw | alpha_1 alpha_2]. PX4's attitude loop controls the attitude rows: they are masked out of
every norm and get no torque. The order of the steps is that of docs/control-law.md. The zero-order hold is exact, so H and zeta stay >=
0 for any input.

Sums over the five active rows are written out, with the row in every name (`s0` to `s2` for x y z, `s6` and `s7` for the joints),
because this is several times as fast as loops or arrays.
"""

from __future__ import annotations

import math
from typing import ClassVar

from companion.config.controller import AdaptiveConfig
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.control.common import Actuation, DesiredForce, ForceFilter, tracking_errors
from companion.control.compensation import Compensation
from companion.control.impedance import Impedance
from companion.control.load_adaptation import LoadAdaptation, Rows
from companion.control.types import PlantState, Wrench
from companion.control.zero_order_hold import HoldTable
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import body_x_z_axes_world
from companion.model.types import Chi, ControlLog, Joints, Reference, Vec3, Vec4


def active(rows: tuple[float, ...]) -> Rows:
    """Return the five active rows out of all eight."""
    x, y, z, _, _, _, a1, a2 = rows
    return (x, y, z, a1, a2)


class Adaptation:
    """Adaptive gains H_0 to H_3 and zeta (eq. adaptive_law_full), integrated with an exact zero-order hold."""

    def __init__(self, config: AdaptiveConfig) -> None:
        self._epsilon = config.epsilon
        self._varpi = config.boundary_layer
        self._rho_max = config.rho_max
        nu = config.nu

        def held(dt_s: float) -> tuple[float, ...]:
            decays = [math.exp(-leakage * dt_s) for leakage in nu]
            return (*decays, *((1.0 - decay) / leakage for decay, leakage in zip(decays, nu, strict=True)))

        self._held = HoldTable(held)
        """e^{-nu T} for H_0 to H_3, then (1 - e^{-nu T}) / nu."""
        self._h_max = config.h_max
        self.h: Vec4 = config.h_initial
        self.zeta = config.zeta_initial

    def rho(self, regressor: Vec4) -> float:
        """Return the gain of the robust term: H . b + zeta, capped."""
        (h0, h1, h2, h3), (b0, b1, b2, b3) = self.h, regressor
        rho = h0 * b0 + h1 * b1 + h2 * b2 + h3 * b3 + self.zeta
        return rho if rho < self._rho_max else self._rho_max

    def advance(self, dt_s: float, norm_s: float, regressor: Vec4, frozen: bool) -> None:
        """Integrate one step with ||S s|| and the regressor held. With `frozen` the gains do not change, because the actuators are
        saturated.
        """
        (h0, h1, h2, h3), (b0, b1, b2, b3) = self.h, regressor
        if norm_s < self._varpi:
            c = 1.0 + (h0 * b0 + h1 * b1 + h2 * b2 + h3 * b3) * norm_s
            decay = math.exp(-c * dt_s)
            self.zeta = decay * self.zeta + (1.0 - decay) * self._epsilon / c
        drive = 0.0 if frozen else norm_s
        k0, k1, k2, k3, g0, g1, g2, g3 = self._held[dt_s]
        self.h = (
            k0 * h0 + g0 * drive * b0,
            k1 * h1 + g1 * drive * b1,
            k2 * h2 + g2 * drive * b2,
            k3 * h3 + g3 * drive * b3,
        )
        if self._h_max is not None:
            h0, h1, h2, h3 = map(min, self.h, self._h_max)
            self.h = (h0, h1, h2, h3)


class AccelerationFilter:
    """Low-pass filter of the acceleration chi'' of the active rows, exact for a held input. The acceleration of the base is
    measured, that of the joints differentiated numerically.
    """

    def __init__(self, cutoff_hz: float) -> None:
        self._w = 2.0 * math.pi * cutoff_hz
        self._arm_rate_rad_s: Joints | None = None
        self._value: Rows | None = None

    def step(self, dt_s: float, state: PlantState) -> Rows:
        """Return the filtered acceleration, m/s^2 and rad/s^2. The filter starts at its first sample."""
        w6, w7 = rate = state.arm_rate_rad_s
        w6_before, w7_before = self._arm_rate_rad_s or rate
        self._arm_rate_rad_s = rate
        x, y, z = state.acceleration_world_m_s2
        a6, a7 = (w6 - w6_before) / dt_s, (w7 - w7_before) / dt_s
        if self._value is None:
            value: Rows = (x, y, z, a6, a7)
        else:
            k = 1.0 - math.exp(-self._w * dt_s)
            v0, v1, v2, v6, v7 = self._value
            value = (v0 + k * (x - v0), v1 + k * (y - v1), v2 + k * (z - v2), v6 + k * (a6 - v6), v7 + k * (a7 - v7))
        self._value = value
        return value


class AdaptiveController:
    """The adaptive impedance control law for vehicle and arm."""

    settings: ClassVar = AdaptiveConfig

    def __init__(self, config: AdaptiveConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        self._manipulator = manipulator_of(vehicle)
        self._impedance = Impedance(config)
        self._adaptation = Adaptation(config)
        self._load = LoadAdaptation(config, self._manipulator)
        weights = active(config.row_weights_s)
        self._weights_squared: Rows = (
            weights[0] ** 2,
            weights[1] ** 2,
            weights[2] ** 2,
            weights[3] ** 2,
            weights[4] ** 2,
        )
        self._inertia, self._lambda, self._phi, self._d = (
            active(gain) for gain in (config.inertia_md, config.lambda_gain, config.phi, self._impedance.d)
        )
        self._varpi = config.boundary_layer
        self._acceleration_cap = config.acceleration_cap
        self._acceleration = AccelerationFilter(config.acceleration_lowpass_hz)
        self._force = ForceFilter(config.force_lowpass_hz)
        self._desired = DesiredForce(config.desired_force_time_s)
        self._actuation = Actuation(config, vehicle, hover_thrust)
        self._compliance = config.base_compliance_xyz
        self._compensation = Compensation(config, vehicle, self._compliance, self._inertia[:2])
        self._arm_dynamics = dynamics_of(vehicle) if config.arm_inertia_nominal else None
        self._gravity_nominal = config.arm_gravity_nominal
        self._up_body_m_s2: Vec3 = (0.0, 0.0, GRAVITY_M_S2)
        self._weight_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        self.hover_thrust = hover_thrust
        """Normalised hover thrust, for the log. The hover-thrust estimator sets it before every step."""

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick of `dt_s`; see `companion.control.types.Controller`."""
        adaptation, impedance, sent, load = self._adaptation, self._impedance, self._actuation, self._load
        clipped_before = sent.any_clipped
        acceleration = self._acceleration.step(dt_s, state)
        force = self._force.step(dt_s, state.force_ext_world_n)
        learn = state.airborne and not clipped_before
        self._compensation.observe(dt_s, state, learn)
        body_x, body_z = body_x_z_axes_world(state.attitude_wxyz)
        error, error_rate = tracking_errors(state, reference, math.atan2(body_x[1], body_x[0]))
        e_tau, tau_d, arm_gravity = self._torque_error(state.arm_rad, body_x, body_z, force)
        s = impedance.sliding(error, error_rate)
        norm_s, x, norm_a = self._norms(s, error, error_rate, acceleration)
        cap = self._acceleration_cap
        regressor: Vec4 = (1.0, x, x * x, cap if norm_a > cap else norm_a)
        rho = adaptation.rho(regressor)
        varpi = self._varpi
        robust = rho / (varpi if varpi > norm_s else norm_s)
        tau = self._tau(s, robust, error_rate, tau_d, reference)
        wanted_n = self._base_force(tau, reference, force)
        wanted_nm = self._arm_torque(tau, arm_gravity, s, e_tau, error_rate, state, reference)
        sent.step(dt_s, wanted_n, wanted_nm, body_z, reference.yaw_rad, vertical_scale)
        (f0, f1, f2), (t6, t7) = sent.force_world_n, sent.arm_torque_nm
        self._compensation.remember(sent.force_world_n, force)
        adaptation.advance(dt_s, norm_s, regressor, clipped_before)
        load.advance(dt_s, active(s), learn)
        gamma = impedance.advance(dt_s, e_tau)
        self._desired.advance(dt_s, force)
        log = ControlLog(
            error=error,
            error_rate=error_rate,
            sliding=s,
            gamma=gamma,
            tau=(f0, f1, f2, 0.0, 0.0, 0.0, t6, t7),
            e_tau=e_tau,
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
        )
        return Wrench(
            attitude_wxyz=sent.attitude_wxyz, collective_n=sent.collective_n, arm_torque_nm=sent.arm_torque_nm, log=log
        )

    def _torque_error(self, arm_rad: Joints, body_x: Vec3, body_z: Vec3, force: Vec3) -> tuple[Chi, Joints, Joints]:
        """Return e_tau = tau_ext - tau_d (8 rows), tau_d of the joints, and the joint torques that hold the arm against gravity."""
        (xx, xy, xz), (zx, zy, zz) = body_x, body_z
        up = (GRAVITY_M_S2 * xz, GRAVITY_M_S2 * (zx * xy - zy * xx), GRAVITY_M_S2 * zz)
        self._up_body_m_s2 = up
        ((jx6, jx7), _, (jz6, jz7)), gravity = self._manipulator.joint_terms(arm_rad, up)
        (f0, f1, f2), (d0, d1, d2), (c0, c1, c2) = force, self._desired.world_n, self._compliance
        f_x, f_z = xx * f0 + xy * f1 + xz * f2, zx * f0 + zy * f1 + zz * f2
        d_x, d_z = xx * d0 + xy * d1 + xz * d2, zx * d0 + zy * d1 + zz * d2
        tau_d6, tau_d7 = jx6 * d_x + jz6 * d_z, jx7 * d_x + jz7 * d_z
        return (
            (
                c0 * f0,
                c1 * f1,
                c2 * f2,
                0.0,
                0.0,
                0.0,
                jx6 * f_x + jz6 * f_z - tau_d6,
                jx7 * f_x + jz7 * f_z - tau_d7,
            ),
            (tau_d6, tau_d7),
            gravity,
        )

    def _norms(self, s: Chi, error: Chi, error_rate: Chi, acceleration: Rows) -> Vec3:
        """Return ||S s||, ||S [e; e']|| and ||S chi_dd||."""
        s0, s1, s2, _, _, _, s6, s7 = s
        e0, e1, e2, _, _, _, e6, e7 = error
        v0, v1, v2, _, _, _, v6, v7 = error_rate
        a0, a1, a2, a6, a7 = acceleration
        w0, w1, w2, w6, w7 = self._weights_squared
        return (
            math.sqrt(w0 * s0 * s0 + w1 * s1 * s1 + w2 * s2 * s2 + w6 * s6 * s6 + w7 * s7 * s7),
            math.sqrt(
                w0 * (e0 * e0 + v0 * v0)
                + w1 * (e1 * e1 + v1 * v1)
                + w2 * (e2 * e2 + v2 * v2)
                + w6 * (e6 * e6 + v6 * v6)
                + w7 * (e7 * e7 + v7 * v7)
            ),
            math.sqrt(w0 * a0 * a0 + w1 * a1 * a1 + w2 * a2 * a2 + w6 * a6 * a6 + w7 * a7 * a7),
        )

    def _tau(self, s: Chi, robust: float, error_rate: Chi, tau_d: Joints, reference: Reference) -> Rows:
        """Return tau (eq. tau) with - D gamma and dtau = -rho S^2 s / max(||S s||, varpi). `robust` is rho over that maximum. Row by
        row:

        tau = M_d (chi''_d - Phi e') - (Lambda + robust S^2) s - D gamma - tau_d.
        """
        s0, s1, s2, _, _, _, s6, s7 = s
        v0, v1, v2, _, _, _, v6, v7 = error_rate
        g0, g1, g2, _, _, _, g6, g7 = self._impedance.gamma
        a0, a1, a2 = reference.acceleration_world_m_s2
        a6, a7 = reference.arm_acceleration_rad_s2
        m0, m1, m2, m6, m7 = self._inertia
        p0, p1, p2, p6, p7 = self._phi
        l0, l1, l2, l6, l7 = self._lambda
        w0, w1, w2, w6, w7 = self._weights_squared
        d0, d1, d2, d6, d7 = self._d
        return (
            m0 * (a0 - p0 * v0) - (l0 + robust * w0) * s0 - d0 * g0,
            m1 * (a1 - p1 * v1) - (l1 + robust * w1) * s1 - d1 * g1,
            m2 * (a2 - p2 * v2) - (l2 + robust * w2) * s2 - d2 * g2,
            m6 * (a6 - p6 * v6) - (l6 + robust * w6) * s6 - d6 * g6 - tau_d[0],
            m7 * (a7 - p7 * v7) - (l7 + robust * w7) * s7 - d7 * g7 - tau_d[1],
        )

    def _base_force(self, tau: Rows, reference: Reference, force: Vec3) -> Vec3:
        """Return the force on the base: tau with the adaptive load and the compensation, plus the weight."""
        (x, y, z, _, _), (q0, q1, q2) = tau, self._load.force_n
        x, y, z = self._compensation.base_force_n((x + q0, y + q1, z + q2), force, reference)
        return (x, y, z + self._weight_n)

    def _arm_torque(
        self,
        tau: Rows,
        gravity: Joints,
        s: Chi,
        e_tau: Chi,
        error_rate: Chi,
        state: PlantState,
        reference: Reference,
    ) -> Joints:
        """Return the joint torques: tau and gravity, plus the configured (M_arm - M_d) alpha''* + C alpha' and friction at alpha'*.

        The star marks what the target impedance requests at this instant: alpha''* = alpha''_d - Phi e' + gamma' and alpha'* = alpha'_d
        - Phi e + gamma = alpha' - s.
        """
        t6, t7 = tau[3], tau[4]
        rates = state.arm_rate_rad_s
        if self._gravity_nominal:
            t6, t7 = t6 + gravity[0], t7 + gravity[1]
        wanted_rate = (rates[0] - s[6], rates[1] - s[7])
        if self._load.on:
            levers = self._manipulator.gravity_levers_m_s2(state.arm_rad, self._up_body_m_s2)
            first, second = self._load.joint_torque_nm(levers, wanted_rate)
            t6, t7 = t6 + first, t7 + second
        if self._arm_dynamics is not None:
            _, _, _, m6, m7 = self._inertia
            _, _, _, p6, p7 = self._phi
            _, _, _, d6, d7 = self._d
            gamma, feed = self._impedance.gamma, reference.arm_acceleration_rad_s2
            a6 = feed[0] - p6 * error_rate[6] + (e_tau[6] - d6 * gamma[6]) / m6
            a7 = feed[1] - p7 * error_rate[7] + (e_tau[7] - d7 * gamma[7]) / m7
            first, second = self._arm_dynamics.arm_torque_nm(state.arm_rad, rates, (a6, a7))
            t6 += first - m6 * a6
            t7 += second - m7 * a7
        return self._compensation.joint_torque_nm((t6, t7), wanted_rate)
