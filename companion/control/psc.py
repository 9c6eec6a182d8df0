"""Partitioned compliance: the arm alone is compliant, the vehicle holds its position, and each ignores the other.

After Wang et al., "Impact absorbing and compensation for heavy object catching with an unmanned aerial manipulator", RA-L 2024. The arm
has a joint impedance on a fixed base,

    tau = M_arm (alpha''_d - M_d^-1 (K_d e' + K_p e - (tau_ext - tau_d))) + C_arm alpha' + g_arm - tau_ext,    tau_ext = J'F.

The vehicle has a PID controller with the mass of vehicle and payload, (m + m_hat) (p''_d - K_d e' - K_p e - K_i int e + g e_z). m_hat
is estimated from the commanded thrust and the acceleration measured by the IMU.
"""

from __future__ import annotations

from typing import ClassVar

from companion.config.controller import PscConfig
from companion.config.vehicle import Vehicle
from companion.control.model_based import ModelBasedLaw, TargetImpedance
from companion.control.payload_mass import PayloadEstimator
from companion.control.scaled_gains import for_vehicle
from companion.control.thrust import collective_n
from companion.control.types import PlantState, Wrench
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import body_x_z_axes_world
from companion.model.types import Chi, Joints, Reference, Vec3


class PscController(ModelBasedLaw):
    """The PSC law: the arm's impedance and the vehicle's PID."""

    settings: ClassVar = PscConfig
    for_vehicle: ClassVar = staticmethod(for_vehicle)

    def __init__(self, config: PscConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        super().__init__(config, vehicle, hover_thrust)
        self._c = config
        self._mass_kg = vehicle.airframe.mass_kg
        self._estimator = PayloadEstimator(config, self._mass_kg)
        self._integral_m_s2 = [0.0, 0.0, 0.0]
        self._target = TargetImpedance(
            config.arm_inertia_md, config.arm_damping_kd, config.arm_stiffness_kp, len(vehicle.arm.joints)
        )

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick of `dt_s`; the position error is integrated except on the ground and further into saturation."""
        wrench = super().step(dt_s, state, reference, vertical_scale)
        limit, e = self._c.integral_max_m_s2, self._actuation.unwinding(wrench.log.error)
        for i in range(3 if state.airborne else 0):
            grown = self._integral_m_s2[i] + dt_s * self._c.position_ki_xyz[i] * e[i]
            self._integral_m_s2[i] = max(-limit, min(limit, grown))
        return wrench

    def _tau(
        self, dt_s: float, state: PlantState, reference: Reference, e: Chi, e_dot: Chi, F_ext: Vec3
    ) -> tuple[Vec3, Joints, Chi]:
        """Return the force of the PID, the torques of the arm, and tau_ext - tau_d."""
        ax, ay, az = state.acceleration_world_m_s2
        felt_z = collective_n((ax, ay, az + GRAVITY_M_S2), body_x_z_axes_world(state.attitude_wxyz)[1])
        self._payload_kg = payload_kg = self._estimator.step(dt_s, self._actuation.collective_n, felt_z, state.airborne)
        base_n = self._vehicle(reference, e, e_dot, self._mass_kg + payload_kg)
        arm_nm, e_tau = self._arm(state, reference, e[6:], e_dot[6:], F_ext)
        return base_n, arm_nm, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *e_tau)

    def _vehicle(self, reference: Reference, e: Chi, e_dot: Chi, mass_kg: float) -> Vec3:
        """Return the force on the vehicle, world frame, N."""
        k_d, k_p, integral = self._c.position_kd_xyz, self._c.position_kp_xyz, self._integral_m_s2
        x, y, z = [
            mass_kg * (feed - k_d[i] * e_dot[i] - k_p[i] * e[i] - integral[i])
            for i, feed in enumerate(reference.acceleration_world_m_s2)
        ]
        return (x, y, z + mass_kg * GRAVITY_M_S2)

    def _arm(
        self, state: PlantState, reference: Reference, e: Joints, e_dot: Joints, F_ext: Vec3
    ) -> tuple[Joints, Joints]:
        """Return the motor torques and tau_ext - tau_d, N m."""
        tau_ext, tau_d = self._joint_torques_nm(state, F_ext)
        e_tau = tuple([ext - desired for ext, desired in zip(tau_ext, tau_d, strict=True)])
        alpha_ddot = self._target.acceleration(reference.arm_acceleration_rad_s2, e, e_dot, e_tau)
        terms = self._dynamics.arm_terms(state.arm_rad, state.arm_rate_rad_s)
        gravity = self._manipulator.gravity_torque_nm(state.arm_rad, state.attitude_wxyz)
        torque = []
        for joint, row in enumerate(terms.mass):
            inertial = 0.0
            for other, a in enumerate(alpha_ddot):
                inertial += row[other] * a
            torque.append(inertial + terms.coriolis[joint] + gravity[joint] - tau_ext[joint])
        return tuple(torque), e_tau
