"""Complete-system compliance: one impedance for vehicle and arm, realised by inverting the nominal model.

After Cataldi et al., "Impedance control of an aerial-manipulator: preliminary results", IROS 2016: everything that moves is one system
with a known model. On every row

    M_d e'' + K_d e' + K_p e = tau_ext - tau_d,        chi''_cmd = chi''_d - M_d^-1 (K_d e' + K_p e - (tau_ext - tau_d)),
    tau = M(chi) chi''_cmd + C(chi, chi') chi' + g(chi) - tau_ext,

with the measured tau_ext = [F; 0; J'F]. The model contains no payload and nothing adapts, so a payload is a constant external force
that displaces the whole system by F / K_p. PX4 controls the attitude rows: their chi'' is the expected response of PX4's loop to the
last attitude setpoint and enters through the coupling only.
"""

from __future__ import annotations

from typing import ClassVar

from companion.config.controller import CscConfig, fitted
from companion.config.vehicle import Vehicle
from companion.control.common import tracking_errors
from companion.control.dynamics import chi_rate_from_body_rate
from companion.control.model_based import ModelBasedLaw
from companion.control.scaled_gains import for_vehicle
from companion.control.types import PlantState, Wrench
from companion.model.frames import euler_zyx_from_quat, rotation_matrix, yaw_from_quat
from companion.model.types import Chi, Reference, Vec3


class CscController(ModelBasedLaw):
    """The CSC law for vehicle and arm."""

    settings: ClassVar = CscConfig
    for_vehicle: ClassVar = staticmethod(for_vehicle)

    def __init__(self, config: CscConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        super().__init__(config, vehicle, hover_thrust, config.external_xyz, config.model_mass_scale)
        self._c = config
        rows = 6 + len(vehicle.arm.joints)
        gains = (fitted(values, rows) for values in (config.inertia_md, config.damping_kd, config.stiffness_kp))
        self._gains = tuple(zip(*gains, strict=True))
        """M_d, K_d and K_p of each row."""

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick of `dt_s`; see `companion.control.types.Controller`."""
        force = self._force.step(dt_s, state.force_ext_world_n)
        error, error_rate = tracking_errors(state, reference, yaw_from_quat(state.attitude_wxyz))
        tau_ext, e_tau = self._external(state, force)
        tau = self._tau(state, reference, error, error_rate, e_tau)
        self._send(
            dt_s,
            state,
            reference,
            (tau[0] - tau_ext[0], tau[1] - tau_ext[1], tau[2] - tau_ext[2]),
            tuple([torque - external for torque, external in zip(tau[6:], tau_ext[6:], strict=True)]),
            force,
            vertical_scale,
        )
        return self._end(dt_s, error, error_rate, e_tau, force)

    def _external(self, state: PlantState, force: Vec3) -> tuple[Chi, Chi]:
        """Return tau_ext and tau_ext - tau_d. The configuration sets which fraction acts on the base."""
        ext, desired = self._joint_torques_nm(state, force)
        x, y, z = (share * f for share, f in zip(self._c.external_xyz, force, strict=True))
        dx, dy, dz = (share * f for share, f in zip(self._c.desired_force_xyz, self._desired.world_n, strict=True))
        return (
            (x, y, z, 0.0, 0.0, 0.0, *ext),
            (x - dx, y - dy, z - dz, 0.0, 0.0, 0.0, *[t - t_d for t, t_d in zip(ext, desired, strict=True)]),
        )

    def _tau(self, state: PlantState, reference: Reference, error: Chi, error_rate: Chi, e_tau: Chi) -> list[float]:
        """Return M chi''_cmd + C chi' + g."""
        rpy = euler_zyx_from_quat(state.attitude_wxyz)
        q_rate = chi_rate_from_body_rate(rpy, state.angular_rate_body_rad_s)
        roll_d, pitch_d, _ = self._actuation.roll_pitch_yaw_rad
        e = [*error[0:3], rpy[0] - roll_d, rpy[1] - pitch_d, *error[5:]]
        e_rate = [*error_rate[0:3], q_rate[0], q_rate[1], q_rate[2] - reference.yaw_rate_rad_s, *error_rate[6:]]
        feed = (*reference.acceleration_world_m_s2, 0.0, 0.0, 0.0, *reference.arm_acceleration_rad_s2)
        chi_dd = [
            feed[i] - (k_d * e_rate[i] + k_p * e[i] - e_tau[i]) / m_d for i, (m_d, k_d, k_p) in enumerate(self._gains)
        ]
        chi_rate: Chi = (*state.velocity_world_m_s, *q_rate, *state.arm_rate_rad_s)
        terms = self._dynamics.terms(rotation_matrix(state.attitude_wxyz), rpy, state.arm_rad, chi_rate)
        return [
            sum(m * a for m, a in zip(row, chi_dd, strict=True)) + coriolis + gravity
            for row, coriolis, gravity in zip(terms.mass, terms.coriolis, terms.gravity, strict=True)
        ]
