"""Adaptive impedance control without a model of the coupling: section III of the paper, corrected, in discrete time.

All matrices of the paper are diagonal, so that each row of chi = [x y z | roll pitch yaw | joints] is a scalar impedance: a `Row`.

| label in the paper                        | here |
|-------------------------------------------|------|
| `err`                                     | `tracking_errors` in `common` |
| `Simplified_Impedance_Dynamics`           | e of a row at s = 0; e_tau, tau_ext and tau_d in `AdaptiveController.step` |
| `s_general`                               | `Row.set_error` |
| `gain_new`, `gain_cond`                   | `AdaptiveConfig`, which refuses other gains; D in `Row` |
| `adaptive_1`                              | `Row.advance` |
| `tau`, `del_tau`                          | `Row.tau` |
| `up_bound_E` and the equation of rho      | `Adaptation.rho` |
| `adaptive_law_full`, `zeta`               | `Adaptation.advance` |
| `control_law` and its order in a tick     | `AdaptiveController.step` |
| `tab:control_parameters`                  | configs/controllers/adaptive_paper.yaml |
| `General_EL_dynamics`, `deviation_error`, `step1` to `boundness` | derivation, not computed; tests/control/test_errata.py |
| `bound_zeta` to `final`                   | proof (appendix), not computed; tests/control/test_errata.py |

"printed:" is followed by the paper's form of a term that is corrected here. The sections Errata and Options beyond the paper of
docs/internals/control-law.md list what is corrected and what is added. A diagonal S, which the paper does not have, weights all norms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Final

from companion.config.controller import AdaptiveConfig
from companion.config.gains import fitted
from companion.config.vehicle import Vehicle
from companion.control.common import AccelerationFilter, Actuation, DesiredForce, ForceFilter, tracking_errors
from companion.control.compensation import Compensation
from companion.control.load_adaptation import LoadAdaptation
from companion.control.nominal_arm import NominalArm
from companion.control.online import OnlineImpedance
from companion.control.scaled_gains import for_vehicle
from companion.control.types import PlantState, Wrench
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import body_x_z_axes_world
from companion.model.outputs import ControlLog
from companion.model.types import Reference, Vec4


class Row:
    """The target impedance M_d e'' + K_d e' + K_p e = e_tau of one row: its gains, its state gamma, and its part of tau.

    Args:
        M_d: desired inertia, kg or kg m^2.
        K_d: desired damping, N s/m or N m s/rad. K_p = D Phi (`gain_cond`) and does not appear.
        Phi: 1/s.
        Lambda: gain of s, N s/m or N m s/rad.
        S: weight of the row in the norms and in dtau; 0 takes it out of both.
        robust_scale: factor on dtau: 1 on the machine for which the gains were found; `for_vehicle` sets it on another.
    """

    def __init__(self, M_d: float, K_d: float, Phi: float, Lambda: float, S: float, robust_scale: float) -> None:
        self.M_d: Final = M_d
        self.D: Final = K_d - M_d * Phi
        """The paper's K_d - M_d Phi, positive (`gain_new`). `scale` changes Phi and leaves D, so that K_d and K_p change."""
        self.Phi, self.Lambda = Phi, Lambda
        self._mission_Phi: Final = Phi
        self._mission_Lambda: Final = Lambda
        self.S_squared: Final = S**2
        self._S_squared_scaled: Final = S**2 * robust_scale
        self._dt_s, self._decay, self._growth = -1.0, 0.0, 0.0
        self.gamma = 0.0
        self.e = self.e_dot = self.s = self.e_tau = self.tau_d = 0.0

    def set_error(self, e: float, e_dot: float, tau_ext: float, tau_d: float) -> None:
        """Set e, e', s, tau_d and e_tau = tau_ext - tau_d."""
        self.e, self.e_dot = e, e_dot
        self.s = e_dot + self.Phi * e - self.gamma  # s_general
        self.e_tau, self.tau_d = tau_ext - tau_d, tau_d

    def tau(self, chi_d_ddot: float, rho_over_norm: float) -> float:
        """Return -Lambda s - tau_d + dtau + M_d (chi_d'' - Phi e') - D gamma (`tau`; printed: - D).

        Args:
            chi_d_ddot: acceleration of the reference.
            rho_over_norm: rho / max(||S s||, varpi), so that dtau = -rho_over_norm S^2 s: both cases of `del_tau` (printed: + rho).
        """
        gain_of_dtau = rho_over_norm * self._S_squared_scaled  # dtau = -gain_of_dtau s
        return (
            -(self.Lambda + gain_of_dtau) * self.s
            + self.M_d * (chi_d_ddot - self.Phi * self.e_dot)
            - self.D * self.gamma
            - self.tau_d
        )

    def chi_star_ddot(self, chi_d_ddot: float) -> float:
        """Return chi*'' = chi_d'' - Phi e' + gamma', at which s' = 0; if s = 0 as well, the row moves as its target impedance."""
        return chi_d_ddot - self.Phi * self.e_dot + (self.e_tau - self.D * self.gamma) / self.M_d

    def advance(self, dt_s: float) -> None:
        """Integrate gamma' = M_d^-1 (e_tau - D gamma) exactly over one step with e_tau held (`adaptive_1`;
        printed: (e_tau + D) gamma).
        """
        if dt_s != self._dt_s:  # most ticks have the same
            self._dt_s, self._decay = dt_s, math.exp(-self.D / self.M_d * dt_s)
            self._growth = (1.0 - self._decay) / self.D
        self.gamma = self._decay * self.gamma + self._growth * self.e_tau

    def scale(self, k: float) -> None:
        """Set Phi and Lambda to k times those of the mission."""
        self.Phi, self.Lambda = k * self._mission_Phi, k * self._mission_Lambda


def rows_of(config: AdaptiveConfig, joint_count: int) -> list[Row]:
    """Return x, y, z, roll, pitch, yaw and one row for each joint."""
    lists = (
        *(config.inertia_md, config.damping_kd, config.phi, config.lambda_gain),
        *(config.row_weights_s, config.robust_scale),
    )
    return [Row(*gains) for gains in zip(*(fitted(gains, 6 + joint_count) for gains in lists), strict=True)]


class Adaptation:
    """H_0 to H_3 and zeta (`adaptive_law_full`). They bound everything that the law does not know: coupling, payload, disturbance.

    An exact zero-order hold keeps them >= 0 for any input. The regressor of H is b = [1, ||xi||, ||xi||^2, ||chi''||].
    """

    def __init__(self, config: AdaptiveConfig) -> None:
        self._nu = config.nu
        self._epsilon = config.epsilon
        self.varpi = config.boundary_layer
        self._rho_max = config.rho_max
        self._H_max = config.h_max
        self.H: Vec4 = config.h_initial
        self.zeta = config.zeta_initial

    def rho(self, b: Vec4) -> float:
        """Return rho = H_0 + H_1 ||xi|| + H_2 ||xi||^2 + H_3 ||chi''|| + zeta, at most `rho_max`."""
        return min(self._bound(b) + self.zeta, self._rho_max)

    def advance(self, dt_s: float, norm_s: float, b: Vec4, held: bool) -> None:
        """Integrate H_i' = ||s|| b_i - nu_i H_i and zeta' = -(1 + H . b ||s||) zeta + epsilon (outside the boundary layer zeta' = 0)
        over one step with ||s|| and b held.

        Args:
            dt_s: step.
            norm_s: ||S s||.
            b: regressor.
            held: without its input, H only leaks. Set after a tick with saturated actuators, because this tick's s is its effect.
        """
        if norm_s < self.varpi:
            c = 1.0 + self._bound(b) * norm_s
            decay = math.exp(-c * dt_s)
            self.zeta = decay * self.zeta + (1.0 - decay) * self._epsilon / c
        drive = 0.0 if held else norm_s
        H = []
        for i, nu in enumerate(self._nu):
            decay = math.exp(-nu * dt_s)
            H.append(decay * self.H[i] + (1.0 - decay) / nu * drive * b[i])
        if self._H_max is not None:
            H = [min(grown, most) for grown, most in zip(H, self._H_max, strict=True)]
        self.H = (H[0], H[1], H[2], H[3])

    def _bound(self, b: Vec4) -> float:
        """Return H . b, the estimated bound of ||E|| (`up_bound_E`)."""
        (H_0, H_1, H_2, H_3), (b_0, b_1, b_2, b_3) = self.H, b
        return H_0 * b_0 + H_1 * b_1 + H_2 * b_2 + H_3 * b_3


class AdaptiveController:
    """The adaptive impedance control law for vehicle and arm."""

    settings: ClassVar = AdaptiveConfig
    for_vehicle: ClassVar = staticmethod(for_vehicle)

    def __init__(self, config: AdaptiveConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        self._rows = rows = rows_of(config, len(vehicle.arm.joints))
        self._controlled = [(i, row) for i, row in enumerate(rows) if i < 3 or i > 5]
        """All rows but those of the attitude, which PX4 controls, with their numbers."""
        self._adaptation = Adaptation(config)
        self._compliance = config.base_compliance_xyz
        self._acceleration_cap = config.acceleration_cap
        self._acceleration = AccelerationFilter(config.acceleration_lowpass_hz)
        self._force = ForceFilter(config.force_lowpass_hz)
        self._desired = DesiredForce(config.desired_force_time_s)
        self._actuation = Actuation(config, vehicle, hover_thrust)
        # Beyond the paper
        self._weight_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        self._arm = NominalArm(config, vehicle)
        self._load = LoadAdaptation(config, self._arm.manipulator)
        self._compensation = Compensation(config, vehicle, self._compliance, config.inertia_md[:2])
        self.online = (
            None
            if config.online is None
            else OnlineImpedance(config.online, config.inertia_md[:3], config.lambda_gain[:3], config.phi[:3])
        )
        """Optimisation of the target impedance in flight; None if it is off."""
        self.hover_thrust = hover_thrust
        """Normalised hover thrust, for the log. The hover-thrust estimator sets it before every step."""

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick of `dt_s`; see `companion.control.types.Controller`. The numbered comments are the steps of the section One tick
        in docs/internals/control-law.md. F_d, H, zeta and gamma are those of the last tick until step 9.
        """
        rows, adaptation, arm, load = self._rows, self._adaptation, self._arm, self._load
        compensation, sent = self._compensation, self._actuation
        saturated_before = sent.any_clipped
        learn = state.airborne and not saturated_before
        body_x, body_z = body_x_z_axes_world(state.attitude_wxyz)

        # 1: chi'' and F_ext, which the paper takes as measured
        chi_ddot = self._acceleration.step(dt_s, state)
        F_ext, F_d = self._force.step(dt_s, state.force_ext_world_n), self._desired.world_n
        # 2: err
        e, e_dot = tracking_errors(state, reference, math.atan2(body_x[1], body_x[0]))
        # 3: tau_ext = [0; 0; J' F_ext] and tau_d = [0; 0; J' F_d], plus the share of F_ext that the base is to comply with
        arm.set_pose(state.arm_rad, body_x, body_z)
        (x, y, z), (share_x, share_y, share_z) = F_ext, self._compliance
        tau_ext = (share_x * x, share_y * y, share_z * z, 0.0, 0.0, 0.0, *arm.joint_torque_nm(F_ext))
        tau_d = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *arm.joint_torque_nm(F_d))
        # 4: s_general
        for i, row in enumerate(rows):
            row.set_error(e[i], e_dot[i], tau_ext[i], tau_d[i])
        s = tuple([row.s for row in rows])
        learned = sent.unwinding(s)
        # 5 and 6: rho
        norm_s, norm_xi, norm_chi_ddot = self._norms(chi_ddot)
        b: Vec4 = (1.0, norm_xi, norm_xi * norm_xi, min(norm_chi_ddot, self._acceleration_cap))
        rho = adaptation.rho(b)
        # 7: tau and del_tau; PX4 controls the attitude
        chi_d_ddot = (*reference.acceleration_world_m_s2, 0.0, 0.0, 0.0, *reference.arm_acceleration_rad_s2)
        rho_over_norm = rho / max(norm_s, adaptation.varpi)
        tau = [0.0] * len(rows)
        for i, row in self._controlled:
            tau[i] = row.tau(chi_d_ddot[i], rho_over_norm)

        # Beyond the paper: loads Y theta, disturbance and feed-forward, weight; gravity, inertia and friction of the joints, for the
        # motion with s = 0: alpha*' = alpha' - s and alpha*''
        compensation.observe(dt_s, state, learn)
        star_rate = tuple([rate - s[6 + joint] for joint, rate in enumerate(state.arm_rate_rad_s)])
        loads = load.tau(arm.levers_m_s2, star_rate)
        x, y, z = compensation.base_force_n((tau[0] + loads[0], tau[1] + loads[1], tau[2] + loads[2]), F_ext, reference)
        joints = tuple([tau[6 + joint] + gravity + loads[6 + joint] for joint, gravity in enumerate(arm.gravity_nm)])
        star_ddot = tuple([row.chi_star_ddot(chi_d_ddot[6 + joint]) for joint, row in enumerate(rows[6:])])
        joints = arm.with_inertia(joints, state, star_ddot)
        joints = compensation.joint_torque_nm(joints, star_rate)
        # 8: saturation, attitude and thrust
        yaw_rad, yaw_rate_rad_s = reference.yaw_rad, reference.yaw_rate_rad_s
        sent.step(dt_s, (x, y, z + self._weight_n), joints, body_z, yaw_rad, vertical_scale, yaw_rate_rad_s)
        compensation.remember(sent.force_world_n, F_ext)

        # 9: adaptive_law_full, adaptive_1; beyond the paper F_d and the loads
        adaptation.advance(dt_s, norm_s, b, saturated_before)
        for _, row in self._controlled:
            row.advance(dt_s)
        self._desired.advance(dt_s, F_ext)
        if state.airborne:
            load.advance(dt_s, learned, state.arm_rate_rad_s)
        log = ControlLog(
            error=e,
            error_rate=e_dot,
            sliding=s,
            gamma=tuple([row.gamma for row in rows]),
            tau=(*sent.force_world_n, 0.0, 0.0, 0.0, *sent.arm_torque_nm),
            e_tau=tuple([row.e_tau for row in rows]),
            h_hat=adaptation.H,
            zeta=adaptation.zeta,
            rho=rho,
            force_ext_world_n=F_ext,
            attitude_desired_rad=sent.roll_pitch_yaw_rad,
            hover_thrust=self.hover_thrust,
            saturated=sent.clipped,
            load_estimate_n=load.force_n if load.on else None,
            moment_estimate_kg_m=load.moments_kg_m if load.on else None,
            friction_estimate_nm=load.friction_nm if load.on else None,
            impedance_scale=None if self.online is None else self.online.scale,
        )
        # The gains of the next tick
        if self.online is not None and self.online.step(
            dt_s, e, e_dot, state.angular_rate_body_rad_s, F_ext, sent.any_clipped, state.tuning
        ):
            self.scale_gains(self.online.scale)
        return Wrench(
            attitude_wxyz=sent.attitude_wxyz, collective_n=sent.collective_n, arm_torque_nm=sent.arm_torque_nm, log=log
        )

    def _norms(self, chi_ddot: Sequence[float]) -> tuple[float, float, float]:
        """Return ||S s||, ||S xi|| with xi = [e; e'], and ||S chi''||, all without the rows of the attitude."""
        s_squared = xi_squared = a_squared = 0.0
        for i, row in self._controlled:
            weight, a = row.S_squared, chi_ddot[i]
            s_squared += weight * row.s * row.s
            xi_squared += weight * (row.e * row.e + row.e_dot * row.e_dot)
            a_squared += weight * a * a
        return math.sqrt(s_squared), math.sqrt(xi_squared), math.sqrt(a_squared)

    def scale_gains(self, k: float) -> None:
        """Set Phi and Lambda of x, y and z to k times those of the mission."""
        for row in self._rows[:3]:
            row.scale(k)
