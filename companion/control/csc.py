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

from companion.config.controller import CscConfig
from companion.config.vehicle import Vehicle
from companion.control.dynamics import chi_rate_from_body_rate
from companion.control.model_based import ModelBasedLaw, TargetImpedance
from companion.control.scaled_gains import for_vehicle
from companion.control.types import PlantState
from companion.model.frames import euler_zyx_from_quat, rotation_matrix
from companion.model.types import Chi, Joints, Reference, Vec3


class CscController(ModelBasedLaw):
    """The CSC law for vehicle and arm."""

    settings: ClassVar = CscConfig
    for_vehicle: ClassVar = staticmethod(for_vehicle)

    def __init__(self, config: CscConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        super().__init__(config, vehicle, hover_thrust, config.external_xyz, config.model_mass_scale)
        self._c = config
        rows = 6 + len(vehicle.arm.joints)
        self._target = TargetImpedance(config.inertia_md, config.damping_kd, config.stiffness_kp, rows)

    def _tau(
        self, dt_s: float, state: PlantState, reference: Reference, e: Chi, e_dot: Chi, F_ext: Vec3
    ) -> tuple[Vec3, Joints, Chi]:
        """Return tau of the base and of the joints, and tau_ext - tau_d."""
        # chi and chi' with the attitude, which PX4 controls
        rpy = euler_zyx_from_quat(state.attitude_wxyz)
        q_rate = chi_rate_from_body_rate(rpy, state.angular_rate_body_rad_s)
        chi_rate: Chi = (*state.velocity_world_m_s, *q_rate, *state.arm_rate_rad_s)
        roll_d, pitch_d, _ = self._actuation.roll_pitch_yaw_rad
        e = (*e[0:3], rpy[0] - roll_d, rpy[1] - pitch_d, *e[5:])
        e_dot = (*e_dot[0:3], q_rate[0], q_rate[1], q_rate[2] - reference.yaw_rate_rad_s, *e_dot[6:])
        chi_d_ddot = (*reference.acceleration_world_m_s2, 0.0, 0.0, 0.0, *reference.arm_acceleration_rad_s2)

        tau_ext, e_tau = self._external(state, F_ext)
        chi_ddot = self._target.acceleration(chi_d_ddot, e, e_dot, e_tau)
        terms = self._dynamics.terms(rotation_matrix(state.attitude_wxyz), rpy, state.arm_rad, chi_rate)
        tau = [
            sum(m * a for m, a in zip(row, chi_ddot, strict=True)) + coriolis + gravity - external
            for row, coriolis, gravity, external in zip(terms.mass, terms.coriolis, terms.gravity, tau_ext, strict=True)
        ]
        return (tau[0], tau[1], tau[2]), tuple(tau[6:]), e_tau

    def _external(self, state: PlantState, F_ext: Vec3) -> tuple[Chi, Chi]:
        """Return tau_ext and tau_ext - tau_d. The configuration sets which fraction acts on the base."""
        ext, desired = self._joint_torques_nm(state, F_ext)
        base = [share * f for share, f in zip(self._c.external_xyz, F_ext, strict=True)]
        base_d = [share * f for share, f in zip(self._c.desired_force_xyz, self._desired.world_n, strict=True)]
        tau_ext = (*base, 0.0, 0.0, 0.0, *ext)
        tau_d = (*base_d, 0.0, 0.0, 0.0, *desired)
        return tau_ext, tuple([t - t_d for t, t_d in zip(tau_ext, tau_d, strict=True)])
