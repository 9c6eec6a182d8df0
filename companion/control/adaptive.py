"""Adaptive impedance control without a model of the coupling (paper, eqs. control_law and adaptive_law_full; corrected, discrete).

Rows are chi = [x y z | roll pitch yaw | alpha_1 alpha_2]. The attitude rows belong to PX4's attitude loop: they are masked out of every
norm and get no torque. Order of the steps as in docs/control-law.md; zero-order hold is exact, so H and zeta stay >= 0 for any input.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.config.controller import AdaptiveConfig
from companion.config.vehicle import Vehicle
from companion.control.common import Actuation, DesiredForce, ForceFilter, tracking_errors, vec8
from companion.control.impedance import Impedance, LowPass
from companion.control.manipulator import GRAVITY_M_S2, Manipulator
from companion.control.types import PlantState, Wrench
from companion.frames import quat_conjugate, quat_rotate
from companion.types import ControlLog, Reference, Vec2, Vec3, Vec4

_ACTIVE_ROWS = (0, 1, 2, 6, 7)


class Adaptation:
    """H_0 .. H_3 and zeta (eq. adaptive_law_full), exact zero-order hold."""

    def __init__(self, config: AdaptiveConfig) -> None:
        self._nu = config.nu
        self._epsilon = config.epsilon
        self._varpi = config.boundary_layer
        self._rho_max = config.rho_max
        self.h: list[float] = list(config.h_initial)
        self.zeta = config.zeta_initial

    def rho(self, regressor: Vec4) -> float:
        """Gain of the robust term: H . b + zeta, capped."""
        return min(self._rho_max, sum(h * b for h, b in zip(self.h, regressor, strict=True)) + self.zeta)

    def advance(self, dt_s: float, norm_s: float, regressor: Vec4, frozen: bool) -> None:
        """One step with ||S s|| and the regressor held; `frozen`: the actuators clipped, so nothing is to be learnt."""
        if norm_s < self._varpi:
            c = 1.0 + sum(h * b for h, b in zip(self.h, regressor, strict=True)) * norm_s
            decay = math.exp(-c * dt_s)
            self.zeta = decay * self.zeta + (1.0 - decay) * self._epsilon / c
        drive = 0.0 if frozen else norm_s
        for i, nu in enumerate(self._nu):
            decay = math.exp(-nu * dt_s)
            self.h[i] = decay * self.h[i] + (1.0 - decay) / nu * drive * regressor[i]


class AdaptiveController:
    """The whole law for vehicle and arm."""

    def __init__(self, config: AdaptiveConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        self._c = config
        self._manipulator = Manipulator(vehicle.arm, vehicle.tool)
        self._impedance = Impedance(config)
        self._adaptation = Adaptation(config)
        self._acceleration_filter = LowPass(config.acceleration_lowpass_hz)
        self._force = ForceFilter(config.force_lowpass_hz)
        self._desired = DesiredForce(config.desired_force_time_s)
        self._arm_acceleration_filter = LowPass(config.acceleration_lowpass_hz)
        self._actuation = Actuation(config, vehicle, hover_thrust)
        self._weight_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        self._hover_thrust = hover_thrust
        self._arm_rate_previous: Vec2 | None = None

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """One tick of `dt_s`; see `companion.control.types.Controller`."""
        c = self._c
        acceleration = self._acceleration(dt_s, state)
        force = self._force.step(dt_s, state.force_ext_world_n)
        error, error_rate = tracking_errors(state, reference)
        e_tau, tau_d = self._torque_error(state, force)
        s = self._impedance.sliding(error, error_rate)
        weights = c.row_weights_s
        norm_s = _weighted_norm(weights, s)
        x = math.hypot(_weighted_norm(weights, error), _weighted_norm(weights, error_rate))
        regressor: Vec4 = (1.0, x, x * x, min(_weighted_norm(weights, acceleration), c.acceleration_cap))
        rho = self._adaptation.rho(regressor)
        tau = self._tau(s, norm_s, rho, error_rate, tau_d, state, reference, force)
        clipped_before = any(self._actuation.clipped)
        sent = self._actuation.step(dt_s, (tau[0], tau[1], tau[2]), (tau[6], tau[7]), state, reference, vertical_scale)
        self._adaptation.advance(dt_s, norm_s, regressor, clipped_before)
        self._impedance.advance(dt_s, e_tau)
        self._desired.advance(dt_s, force)
        log = ControlLog(
            error=vec8(error),
            error_rate=vec8(error_rate),
            sliding=vec8(s),
            gamma=vec8(self._impedance.gamma),
            tau=(*sent.force_world_n, 0.0, 0.0, 0.0, *sent.arm_torque_nm),
            e_tau=vec8(e_tau),
            h_hat=(self._adaptation.h[0], self._adaptation.h[1], self._adaptation.h[2], self._adaptation.h[3]),
            zeta=self._adaptation.zeta,
            rho=rho,
            force_ext_world_n=force,
            attitude_desired_rad=sent.roll_pitch_yaw_rad,
            hover_thrust=self._hover_thrust,
            saturated=sent.clipped,
        )
        return Wrench(sent.attitude_wxyz, sent.collective_n, sent.arm_torque_nm, log)

    def _acceleration(self, dt_s: float, state: PlantState) -> list[float]:
        """chi_dd, low-passed; attitude rows 0 (masked)."""
        linear = self._acceleration_filter.step(dt_s, state.acceleration_world_m_s2)
        before = self._arm_rate_previous or state.arm_rate_rad_s
        rate = [(now - then) / dt_s for now, then in zip(state.arm_rate_rad_s, before, strict=True)]
        self._arm_rate_previous = state.arm_rate_rad_s
        arm = self._arm_acceleration_filter.step(dt_s, rate)
        return [*linear, 0.0, 0.0, 0.0, *arm]

    def _torque_error(self, state: PlantState, force: Vec3) -> tuple[list[float], list[float]]:
        """e_tau = tau_ext - tau_d and tau_d, 8 rows."""
        to_body = quat_conjugate(state.attitude_wxyz)
        ext = self._manipulator.joint_torque_from_force(state.arm_rad, quat_rotate(to_body, force))
        desired = self._manipulator.joint_torque_from_force(state.arm_rad, quat_rotate(to_body, self._desired.world_n))
        base = [share * f for share, f in zip(self._c.base_compliance_xyz, force, strict=True)]
        e_tau = [*base, 0.0, 0.0, 0.0, ext[0] - desired[0], ext[1] - desired[1]]
        return e_tau, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, desired[0], desired[1]]

    def _tau(
        self,
        s: Sequence[float],
        norm_s: float,
        rho: float,
        error_rate: Sequence[float],
        tau_d: Sequence[float],
        state: PlantState,
        reference: Reference,
        force: Vec3,
    ) -> list[float]:
        """Eq. tau with - D gamma and dtau = -rho S^2 s / max(||S s||, varpi), plus hover thrust and arm gravity."""
        c, impedance = self._c, self._impedance
        robust = rho / max(norm_s, c.boundary_layer)
        feed = (*reference.acceleration_world_m_s2, 0.0, 0.0, 0.0, *reference.arm_acceleration_rad_s2)
        tau = [0.0] * 8
        for i in _ACTIVE_ROWS:
            tau[i] = (
                -c.lambda_gain[i] * s[i]
                - tau_d[i]
                - robust * c.row_weights_s[i] ** 2 * s[i]
                + c.inertia_md[i] * (feed[i] - c.phi[i] * error_rate[i])
                - impedance.d[i] * impedance.gamma[i]
            )
        ff = c.force_feedforward_xyz
        tau[0] -= ff[0] * force[0]
        tau[1] -= ff[1] * force[1]
        tau[2] += self._weight_n - ff[2] * force[2]
        gravity = self._manipulator.gravity_torque_nm(state.arm_rad, state.attitude_wxyz)
        tau[6] += gravity[0]
        tau[7] += gravity[1]
        return tau


def _weighted_norm(weights: Sequence[float], vector: Sequence[float]) -> float:
    return math.sqrt(sum((w * v) ** 2 for w, v in zip(weights, vector, strict=True)))
