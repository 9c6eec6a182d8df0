"""Adaptive impedance control without a model of the coupling (paper, eqs. control_law and adaptive_law_full; corrected, discrete).

The rows are chi = [x y z | roll pitch yaw | joints]. PX4's attitude loop controls the attitude rows: they are masked out of
every norm and get no torque. The order of the steps is that of docs/control-law.md. The zero-order hold is exact, so H and zeta stay >=
0 for any input.

Sums over the active rows are written out for x, y and z and loop over the rows of the joints by index: for two joints this is several
times as fast as `zip`, comprehensions or arrays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

from companion.config.controller import AdaptiveConfig, fitted
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.control.common import Actuation, DesiredForce, ForceFilter, tracking_errors
from companion.control.compensation import Compensation
from companion.control.impedance import Impedance
from companion.control.load_adaptation import LoadAdaptation
from companion.control.types import PlantState, Wrench
from companion.control.zero_order_hold import HoldTable
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import body_x_z_axes_world
from companion.model.types import Chi, ControlLog, Joints, Reference, Vec3, Vec4


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
        self._value: Sequence[float] | None = None

    def step(self, dt_s: float, state: PlantState) -> Sequence[float]:
        """Return the filtered acceleration, m/s^2 and rad/s^2; rows 3 to 5 are 0. The filter starts at its first sample."""
        rates = state.arm_rate_rad_s
        rates_before = self._arm_rate_rad_s or rates
        self._arm_rate_rad_s = rates
        x, y, z = state.acceleration_world_m_s2
        before = self._value
        if before is None:
            value = [x, y, z, 0.0, 0.0, 0.0, *[0.0] * len(rates)]
        else:
            k = 1.0 - math.exp(-self._w * dt_s)
            v0, v1, v2 = before[0], before[1], before[2]
            value = [v0 + k * (x - v0), v1 + k * (y - v1), v2 + k * (z - v2), 0.0, 0.0, 0.0]
            for joint, rate in enumerate(rates):
                v = before[6 + joint]
                value.append(v + k * ((rate - rates_before[joint]) / dt_s - v))
        self._value = value
        return value


class AdaptiveController:
    """The adaptive impedance control law for vehicle and arm."""

    settings: ClassVar = AdaptiveConfig

    def __init__(self, config: AdaptiveConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        self._manipulator = manipulator_of(vehicle)
        joint_count = self._manipulator.joint_count
        self._impedance = Impedance(config, joint_count)
        self._adaptation = Adaptation(config)
        self._load = LoadAdaptation(config, self._manipulator)
        impedance, rows = self._impedance, 6 + joint_count
        weights = [weight**2 for weight in fitted(config.row_weights_s, rows)]
        gains = list(
            zip(impedance.inertia, impedance.phi, fitted(config.lambda_gain, rows), weights, impedance.d, strict=True)
        )
        self._base_gains = gains[:3]
        """M_d, Phi, Lambda, S^2 and D of x, y and z."""
        self._joint_gains = [(joint, 6 + joint, *row) for joint, row in enumerate(gains[6:])]
        """Number of each joint and its row, then as in `_base_gains`."""
        self._weights_squared = (weights[:3], [(row, weights[row]) for row in range(6, rows)])
        self._varpi = config.boundary_layer
        self._acceleration_cap = config.acceleration_cap
        self._acceleration = AccelerationFilter(config.acceleration_lowpass_hz)
        self._force = ForceFilter(config.force_lowpass_hz)
        self._desired = DesiredForce(config.desired_force_time_s)
        self._actuation = Actuation(config, vehicle, hover_thrust)
        self._compliance = config.base_compliance_xyz
        self._compensation = Compensation(
            config, vehicle, self._compliance, (impedance.inertia[0], impedance.inertia[1])
        )
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
        wanted_n = self._base_force(s, robust, error_rate, reference, force)
        wanted_nm = self._arm_torque(s, robust, error_rate, e_tau, tau_d, arm_gravity, state, reference)
        sent.step(dt_s, wanted_n, wanted_nm, body_z, reference.yaw_rad, vertical_scale)
        self._compensation.remember(sent.force_world_n, force)
        adaptation.advance(dt_s, norm_s, regressor, clipped_before)
        load.advance(dt_s, s, learn)
        gamma = impedance.advance(dt_s, e_tau)
        self._desired.advance(dt_s, force)
        log = ControlLog(
            error=error,
            error_rate=error_rate,
            sliding=s,
            gamma=gamma,
            tau=(*sent.force_world_n, 0.0, 0.0, 0.0, *sent.arm_torque_nm),
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

    def _torque_error(
        self, arm_rad: Joints, body_x: Vec3, body_z: Vec3, force: Vec3
    ) -> tuple[Chi, Sequence[float], Joints]:
        """Return e_tau = tau_ext - tau_d, tau_d of the joints, and the joint torques that hold the arm against gravity."""
        (xx, xy, xz), (zx, zy, zz) = body_x, body_z
        up = (GRAVITY_M_S2 * xz, GRAVITY_M_S2 * (zx * xy - zy * xx), GRAVITY_M_S2 * zz)
        self._up_body_m_s2 = up
        (jx, jy, jz), gravity = self._manipulator.joint_terms(arm_rad, up)
        (f0, f1, f2), (d0, d1, d2), (c0, c1, c2) = force, self._desired.world_n, self._compliance
        f_x, f_z = xx * f0 + xy * f1 + xz * f2, zx * f0 + zy * f1 + zz * f2
        d_x, d_z = xx * d0 + xy * d1 + xz * d2, zx * d0 + zy * d1 + zz * d2
        e_tau, tau_d = [c0 * f0, c1 * f1, c2 * f2, 0.0, 0.0, 0.0], []
        if any(jy):
            yx, yy, yz = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
            f_y, d_y = yx * f0 + yy * f1 + yz * f2, yx * d0 + yy * d1 + yz * d2
            for joint, y in enumerate(jy):
                x, z = jx[joint], jz[joint]
                wanted = x * d_x + y * d_y + z * d_z
                tau_d.append(wanted)
                e_tau.append(x * f_x + y * f_y + z * f_z - wanted)
        else:  # an arm that moves in the body's x-z plane only
            for joint, x in enumerate(jx):
                z = jz[joint]
                wanted = x * d_x + z * d_z
                tau_d.append(wanted)
                e_tau.append(x * f_x + z * f_z - wanted)
        return tuple(e_tau), tau_d, gravity

    def _norms(self, s: Chi, error: Chi, error_rate: Chi, acceleration: Sequence[float]) -> Vec3:
        """Return ||S s||, ||S [e; e']|| and ||S chi_dd||."""
        s0, s1, s2 = s[0], s[1], s[2]
        e0, e1, e2 = error[0], error[1], error[2]
        v0, v1, v2 = error_rate[0], error_rate[1], error_rate[2]
        a0, a1, a2 = acceleration[0], acceleration[1], acceleration[2]
        (w0, w1, w2), joint_weights = self._weights_squared
        s_squared = w0 * s0 * s0 + w1 * s1 * s1 + w2 * s2 * s2
        x_squared = w0 * (e0 * e0 + v0 * v0) + w1 * (e1 * e1 + v1 * v1) + w2 * (e2 * e2 + v2 * v2)
        a_squared = w0 * a0 * a0 + w1 * a1 * a1 + w2 * a2 * a2
        for row, w in joint_weights:
            s0, e0, v0, a0 = s[row], error[row], error_rate[row], acceleration[row]
            s_squared += w * s0 * s0
            x_squared += w * (e0 * e0 + v0 * v0)
            a_squared += w * a0 * a0
        return math.sqrt(s_squared), math.sqrt(x_squared), math.sqrt(a_squared)

    def _base_force(self, s: Chi, robust: float, error_rate: Chi, reference: Reference, force: Vec3) -> Vec3:
        """Return the force on the base: tau with the adaptive load and the compensation, plus the weight.

        tau (eq. tau) has - D gamma and dtau = -rho S^2 s / max(||S s||, varpi), where `robust` is rho over that maximum. Row by row:

        tau = M_d (chi''_d - Phi e') - (Lambda + robust S^2) s - D gamma - tau_d, with tau_d = 0 on the base.
        """
        g = self._impedance.gamma
        a0, a1, a2 = reference.acceleration_world_m_s2
        (m0, p0, l0, w0, d0), (m1, p1, l1, w1, d1), (m2, p2, l2, w2, d2) = self._base_gains
        q0, q1, q2 = self._load.force_n
        x, y, z = self._compensation.base_force_n(
            (
                m0 * (a0 - p0 * error_rate[0]) - (l0 + robust * w0) * s[0] - d0 * g[0] + q0,
                m1 * (a1 - p1 * error_rate[1]) - (l1 + robust * w1) * s[1] - d1 * g[1] + q1,
                m2 * (a2 - p2 * error_rate[2]) - (l2 + robust * w2) * s[2] - d2 * g[2] + q2,
            ),
            force,
            reference,
        )
        return (x, y, z + self._weight_n)

    def _arm_torque(
        self,
        s: Chi,
        robust: float,
        error_rate: Chi,
        e_tau: Chi,
        tau_d: Sequence[float],
        gravity: Joints,
        state: PlantState,
        reference: Reference,
    ) -> Joints:
        """Return the joint torques: tau as in `_base_force` and gravity, plus the configured (M_arm - M_d) alpha''* + C alpha' and
        friction at alpha'*.

        The star marks what the target impedance requests at this instant: alpha''* = alpha''_d - Phi e' + gamma' and alpha'* = alpha'_d
        - Phi e + gamma = alpha' - s.
        """
        gamma, feed, rates = self._impedance.gamma, reference.arm_acceleration_rad_s2, state.arm_rate_rad_s
        torque, wanted_rate = [], []
        for joint, row, m, p, lam, w, d in self._joint_gains:
            s_row = s[row]
            tau = m * (feed[joint] - p * error_rate[row]) - (lam + robust * w) * s_row - d * gamma[row] - tau_d[joint]
            torque.append(tau + gravity[joint] if self._gravity_nominal else tau)
            wanted_rate.append(rates[joint] - s_row)
        if self._load.on:
            levers = self._manipulator.gravity_levers_m_s2(state.arm_rad, self._up_body_m_s2)
            for joint, load in enumerate(self._load.joint_torque_nm(levers, wanted_rate)):
                torque[joint] += load
        if self._arm_dynamics is not None:
            wanted = tuple(
                [
                    feed[joint] - p * error_rate[row] + (e_tau[row] - d * gamma[row]) / m
                    for joint, row, m, p, _, _, d in self._joint_gains
                ]
            )
            inertial = self._arm_dynamics.arm_torque_nm(state.arm_rad, rates, wanted)
            for joint, _, m, *_ in self._joint_gains:
                torque[joint] += inertial[joint] - m * wanted[joint]
        return self._compensation.joint_torque_nm(torque, wanted_rate)
