"""Adaptive impedance control without a model of the coupling (paper, eqs. control_law and adaptive_law_full; corrected, discrete).

The rows are chi = [x y z | roll pitch yaw | joints]. PX4's attitude loop controls the attitude rows: they are masked out of
every norm and get no torque. The order of the steps is that of docs/control-law.md. The zero-order hold is exact, so H and zeta stay >=
0 for any input.

Sums over the active rows are written out for x, y and z and loop over the rows of the joints by index: for two joints such a loop is
twice as fast as one with `zip` or a comprehension.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

from companion.config.controller import AdaptiveConfig, fitted
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.control.common import Actuation, DesiredForce, ForceFilter, base_errors
from companion.control.compensation import FRICTION_RATE_RAD_S, Compensation
from companion.control.impedance import Impedance
from companion.control.load_adaptation import LoadAdaptation
from companion.control.online import OnlineImpedance
from companion.control.scaled_gains import for_vehicle
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
            n0, n1, n2, n3 = nu
            exp = math.exp
            k0, k1, k2, k3 = exp(-n0 * dt_s), exp(-n1 * dt_s), exp(-n2 * dt_s), exp(-n3 * dt_s)
            return (k0, k1, k2, k3, (1.0 - k0) / n0, (1.0 - k1) / n1, (1.0 - k2) / n2, (1.0 - k3) / n3)

        self._held = HoldTable(held)
        """e^{-nu T} for H_0 to H_3, then (1 - e^{-nu T}) / nu."""
        self._h_max = config.h_max
        self.h: Vec4 = config.h_initial
        self.zeta = config.zeta_initial

    def rho(self, regressor: Vec4) -> float:
        """Return the gain of the robust term: H . b + zeta, capped."""
        h0, h1, h2, h3 = self.h
        b0, b1, b2, b3 = regressor
        rho = h0 * b0 + h1 * b1 + h2 * b2 + h3 * b3 + self.zeta
        return rho if rho < self._rho_max else self._rho_max

    def advance(self, dt_s: float, norm_s: float, regressor: Vec4, frozen: bool) -> None:
        """Integrate one step with ||S s|| and the regressor held. With `frozen` the gains do not change, because the actuators are
        saturated.
        """
        h0, h1, h2, h3 = self.h
        b0, b1, b2, b3 = regressor
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


class AdaptiveController:
    """The adaptive impedance control law for vehicle and arm."""

    settings: ClassVar = AdaptiveConfig
    for_vehicle: ClassVar = staticmethod(for_vehicle)

    def __init__(self, config: AdaptiveConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        self._manipulator = manipulator_of(vehicle)
        joint_count = self._manipulator.joint_count
        self._impedance = Impedance(config, joint_count)
        self._adaptation = Adaptation(config)
        self._load = LoadAdaptation(config, self._manipulator)
        impedance, rows = self._impedance, 6 + joint_count
        weights = [weight**2 for weight in fitted(config.row_weights_s, rows)]
        robust = [w * scale for w, scale in zip(weights, fitted(config.robust_scale, rows), strict=True)]
        gains = list(
            zip(impedance.inertia, impedance.phi, fitted(config.lambda_gain, rows), robust, impedance.d, strict=True)
        )
        self._base_gains = self._mission_gains = gains[:3]
        """M_d, Phi, Lambda, S^2 times `robust_scale`, and D of x, y and z."""
        self._joint_gains = [(joint, 6 + joint, *row) for joint, row in enumerate(gains[6:])]
        """Number of each joint and its row, then as in `_base_gains`."""
        self._base_phi, self._base_weights = (*impedance.phi[:3], impedance.phi[5]), weights[:3]
        self._joint_weights = [(joint, row, phi, weights[row]) for joint, row, _, phi, *_ in self._joint_gains]
        """Number of each joint, its row, Phi and S^2."""
        self.online = (
            None
            if config.online is None
            else OnlineImpedance(config.online, impedance.inertia[:3], config.lambda_gain[:3], impedance.phi[:3])
        )
        """Optimisation of the target impedance in flight; None if it is off."""
        self._varpi = config.boundary_layer
        self._acceleration_cap = config.acceleration_cap
        self._acceleration_cutoff_rad_s = 2.0 * math.pi * config.acceleration_lowpass_hz
        self._acceleration: Sequence[float] | None = None
        """Filtered acceleration of x, y, z and the joints."""
        self._arm_rate_rad_s: Joints = ()
        self._force = ForceFilter(config.force_lowpass_hz)
        self._desired = DesiredForce(config.desired_force_time_s)
        self._actuation = Actuation(config, vehicle, hover_thrust)
        self._compliance = config.base_compliance_xyz
        self._compensation = Compensation(
            config, vehicle, self._compliance, (impedance.inertia[0], impedance.inertia[1])
        )
        self._arm_dynamics = dynamics_of(vehicle) if config.arm_inertia_nominal else None
        self._gravity_nominal = config.arm_gravity_nominal
        self._weight_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        self.hover_thrust = hover_thrust
        """Normalised hover thrust, for the log. The hover-thrust estimator sets it before every step."""

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick of `dt_s`; see `companion.control.types.Controller`."""
        adaptation, impedance, sent, load = self._adaptation, self._impedance, self._actuation, self._load
        clipped_before = sent.any_clipped
        force = self._force.step(dt_s, state.force_ext_world_n)
        learn = state.airborne and not clipped_before
        self._compensation.observe(dt_s, state, learn)
        body_x, body_z = body_x_z_axes_world(state.attitude_wxyz)
        yaw_rad = math.atan2(body_x[1], body_x[0])
        error, error_rate, s, norm_s, x, norm_a = self._sliding(dt_s, state, reference, yaw_rad)
        cap = self._acceleration_cap
        regressor: Vec4 = (1.0, x, x * x, cap if norm_a > cap else norm_a)
        rho = adaptation.rho(regressor)
        varpi = self._varpi
        robust = rho / (varpi if varpi > norm_s else norm_s)
        wanted_n = self._base_force(s, robust, error_rate, reference, force)
        wanted_nm, e_tau = self._joints(s, robust, error_rate, body_x, body_z, force, state, reference)
        sent.step(dt_s, wanted_n, wanted_nm, body_z, reference.yaw_rad, vertical_scale)
        self._compensation.remember(sent.force_world_n, force)
        adaptation.advance(dt_s, norm_s, regressor, clipped_before)
        load.advance(dt_s, s, learn)
        gamma = impedance.advance(dt_s, e_tau)
        self._desired.advance(dt_s, force)
        online, scale = self.online, None
        if online is not None:
            scale = online.scale
            rate = state.angular_rate_body_rad_s
            if online.step(dt_s, error, error_rate, rate, force, sent.any_clipped, state.tuning):
                self._scale_gains(online.scale)
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
            impedance_scale=scale,
        )
        return Wrench(
            attitude_wxyz=sent.attitude_wxyz, collective_n=sent.collective_n, arm_torque_nm=sent.arm_torque_nm, log=log
        )

    def _scale_gains(self, k: float) -> None:
        """Set Phi and Lambda of x, y and z to k times those of the mission."""
        self._base_gains = [(m, k * phi, k * lam, weight, d) for m, phi, lam, weight, d in self._mission_gains]
        (_, p0, *_), (_, p1, *_), (_, p2, *_) = self._base_gains
        self._base_phi = (p0, p1, p2, self._base_phi[3])

    def _sliding(
        self, dt_s: float, state: PlantState, reference: Reference, yaw_rad: float
    ) -> tuple[Chi, Chi, Chi, float, float, float]:
        """Return e and e' as `tracking_errors`, s = e' + Phi e - gamma (eq. s_general), ||S s||, ||S [e; e']|| and ||S chi_dd||.

        chi_dd is low-pass filtered, exactly for a held input; the filter starts at its first sample. The acceleration of the base is
        measured, that of the joints differentiated numerically.
        """
        k = 1.0 - math.exp(-self._acceleration_cutoff_rad_s * dt_s)
        x, y, z = state.acceleration_world_m_s2
        rates, before = state.arm_rate_rad_s, self._acceleration
        if before is None:
            before, self._arm_rate_rad_s = (x, y, z, *(0.0,) * len(rates)), rates
        rates_before, self._arm_rate_rad_s = self._arm_rate_rad_s, rates
        a0, a1, a2 = before[0], before[1], before[2]
        a0, a1, a2 = a0 + k * (x - a0), a1 + k * (y - a1), a2 + k * (z - a2)
        error, error_rate = base_errors(state, reference, yaw_rad)
        angles, angles_d, rates_d = state.arm_rad, reference.arm_rad, reference.arm_rate_rad_s
        e0, e1, e2, _, _, e5 = error
        v0, v1, v2, _, _, v5 = error_rate
        p0, p1, p2, p5 = self._base_phi
        gamma = self._impedance.gamma
        s0, s1, s2 = v0 + p0 * e0 - gamma[0], v1 + p1 * e1 - gamma[1], v2 + p2 * e2 - gamma[2]
        s = [s0, s1, s2, 0.0, 0.0, v5 + p5 * e5]  # of roll, pitch and yaw, gamma is 0, and e too but for yaw
        w0, w1, w2 = self._base_weights
        s_squared = w0 * s0 * s0 + w1 * s1 * s1 + w2 * s2 * s2
        x_squared = w0 * (e0 * e0 + v0 * v0) + w1 * (e1 * e1 + v1 * v1) + w2 * (e2 * e2 + v2 * v2)
        a_squared = w0 * a0 * a0 + w1 * a1 * a1 + w2 * a2 * a2
        acceleration = [a0, a1, a2]
        for joint, row, p0, w in self._joint_weights:
            rate = rates[joint]
            e0, v0, a0 = angles[joint] - angles_d[joint], rate - rates_d[joint], before[3 + joint]
            error.append(e0)
            error_rate.append(v0)
            s0 = v0 + p0 * e0 - gamma[row]
            s.append(s0)
            a0 += k * ((rate - rates_before[joint]) / dt_s - a0)
            acceleration.append(a0)
            s_squared += w * s0 * s0
            x_squared += w * (e0 * e0 + v0 * v0)
            a_squared += w * a0 * a0
        self._acceleration = acceleration
        norms = (math.sqrt(s_squared), math.sqrt(x_squared), math.sqrt(a_squared))
        return tuple(error), tuple(error_rate), tuple(s), *norms

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

    def _joints(
        self,
        s: Chi,
        robust: float,
        error_rate: Chi,
        body_x: Vec3,
        body_z: Vec3,
        force: Vec3,
        state: PlantState,
        reference: Reference,
    ) -> tuple[Joints, Chi]:
        """Return the joint torques, and e_tau = tau_ext - tau_d of all rows.

        The torques are tau as in `_base_force` and gravity, plus the configured adaptive load, (M_arm - M_d) alpha''* + C alpha', and
        friction at alpha'*. The star marks what the target impedance requests at this instant: alpha''* = alpha''_d - Phi e' + gamma'
        and alpha'* = alpha'_d - Phi e + gamma = alpha' - s.
        """
        xx, xy, xz = body_x
        zx, zy, zz = body_z
        yz, arm_rad = zx * xy - zy * xx, state.arm_rad
        up = (GRAVITY_M_S2 * xz, GRAVITY_M_S2 * yz, GRAVITY_M_S2 * zz)
        (jx, jy, jz), gravity, levers = self._manipulator.joint_terms_and_levers(arm_rad, up)
        f0, f1, f2 = force
        d0, d1, d2 = self._desired.world_n
        c0, c1, c2 = self._compliance
        f_x, f_z = xx * f0 + xy * f1 + xz * f2, zx * f0 + zy * f1 + zz * f2
        d_x, d_z = xx * d0 + xy * d1 + xz * d2, zx * d0 + zy * d1 + zz * d2
        f_y = d_y = 0.0
        if any(jy):
            yx, yy = zy * xz - zz * xy, zz * xx - zx * xz
            f_y, d_y = yx * f0 + yy * f1 + yz * f2, yx * d0 + yy * d1 + yz * d2
        gamma, feed, rates = self._impedance.gamma, reference.arm_acceleration_rad_s2, state.arm_rate_rad_s
        load, loaded, gravity_nominal = self._load, self._load.on, self._gravity_nominal
        dynamics, fed_nm = self._arm_dynamics, self._compensation.friction_nm
        if loaded:
            load_gravity, friction = load.gravity_torque_nm(levers), load.friction_nm
        e_tau, torque, wanted_rate, turning = [c0 * f0, c1 * f1, c2 * f2, 0.0, 0.0, 0.0], [], [], []
        for joint, row, m, p, lam, w, d in self._joint_gains:
            x, y, z = jx[joint], jy[joint], jz[joint]
            s_row = s[row]
            tau_d = x * d_x + y * d_y + z * d_z
            e_tau.append(x * f_x + y * f_y + z * f_z - tau_d)
            t = m * (feed[joint] - p * error_rate[row]) - (lam + robust * w) * s_row - d * gamma[row] - tau_d
            if gravity_nominal:
                t += gravity[joint]
            rate = rates[joint] - s_row
            direction = math.tanh(rate / FRICTION_RATE_RAD_S)
            if loaded:
                t += load_gravity[joint] + friction[joint] * direction
            if dynamics is None and fed_nm:
                t += fed_nm * direction
            torque.append(t)
            wanted_rate.append(rate)
            turning.append(direction)
        load.wanted_rate_rad_s, load.direction = wanted_rate, turning
        if dynamics is not None:
            wanted = []
            for joint, row, m, p, _, _, d in self._joint_gains:
                wanted.append(feed[joint] - p * error_rate[row] + (e_tau[row] - d * gamma[row]) / m)
            inertial = dynamics.arm_torque_nm(arm_rad, rates, tuple(wanted))
            for joint, _, m, *_ in self._joint_gains:
                torque[joint] += inertial[joint] - m * wanted[joint]
                torque[joint] += fed_nm * turning[joint]
        return tuple(torque), tuple(e_tau)
