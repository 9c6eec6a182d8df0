"""Partitioned compliance: the arm alone is compliant, the vehicle holds its position, and each ignores the other.

After Wang et al., "Impact absorbing and compensation for heavy object catching with an unmanned aerial manipulator", RA-L 2024. The arm
has a joint impedance on a fixed base,

    tau = M_arm (alpha''_d - M_d^-1 (K_d e' + K_p e - (tau_ext - tau_d))) + C_arm alpha' + g_arm - tau_ext,    tau_ext = J'F.

The vehicle has a PID controller with the mass of vehicle and payload, (m + m_hat) (p''_d - K_d e' - K_p e - K_i int e + g e_z). m_hat
is estimated from the commanded thrust and the acceleration measured by the IMU.
"""

from __future__ import annotations

import math
from typing import ClassVar

from companion.config.controller import PscConfig, fitted
from companion.config.vehicle import Vehicle
from companion.control.common import tracking_errors
from companion.control.model_based import ModelBasedLaw
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
        self._commanded_n = 0.0
        lists = (config.arm_inertia_md, config.arm_damping_kd, config.arm_stiffness_kp)
        joints = len(vehicle.arm.joints)
        self._arm_gains = list(zip(range(joints), *(fitted(gains, joints) for gains in lists), strict=True))
        """Number, M_d, K_d and K_p of each joint."""

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick of `dt_s`; see `companion.control.types.Controller`."""
        airborne = state.airborne
        felt = state.acceleration_world_m_s2
        body_x, body_z = body_x_z_axes_world(state.attitude_wxyz)
        specific_z = collective_n((felt[0], felt[1], felt[2] + GRAVITY_M_S2), body_z)
        payload_kg = self._estimator.step(dt_s, self._commanded_n, specific_z, airborne)

        force = self._force.step(dt_s, state.force_ext_world_n)
        error, error_rate = tracking_errors(state, reference, math.atan2(body_x[1], body_x[0]))
        e_tau, torque = self._arm(state, reference, error, error_rate, force)
        wanted = self._vehicle(reference, error, error_rate, self._mass_kg + payload_kg)
        self._send(dt_s, state, reference, wanted, torque, force, vertical_scale)
        sent = self._actuation
        self._commanded_n = sent.collective_n
        self._integrate(dt_s, error, airborne, sent.clipped)
        rows = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *e_tau)
        return self._end(dt_s, error, error_rate, rows, force, payload_kg)

    def _vehicle(self, reference: Reference, error: Chi, error_rate: Chi, mass_kg: float) -> Vec3:
        """Return the force on the vehicle, world frame, N."""
        c = self._c
        x, y, z = (
            mass_kg * (feed - c.position_kd_xyz[i] * error_rate[i] - c.position_kp_xyz[i] * error[i] - integral)
            for i, (feed, integral) in enumerate(
                zip(reference.acceleration_world_m_s2, self._integral_m_s2, strict=True)
            )
        )
        return (x, y, z + mass_kg * GRAVITY_M_S2)

    def _integrate(self, dt_s: float, error: Chi, airborne: bool, clipped: tuple[bool, bool, bool]) -> None:
        """Integrate the position error, except on the ground and while the actuators are saturated."""
        limit = self._c.integral_max_m_s2
        for i, held in enumerate((clipped[1], clipped[1], clipped[0])):
            if airborne and not held:
                grown = self._integral_m_s2[i] + dt_s * self._c.position_ki_xyz[i] * error[i]
                self._integral_m_s2[i] = max(-limit, min(limit, grown))

    def _arm(
        self, state: PlantState, reference: Reference, error: Chi, error_rate: Chi, force: Vec3
    ) -> tuple[Joints, Joints]:
        """Return tau_ext - tau_d and the motor torques, N m."""
        ext, desired = self._joint_torques_nm(state, force)
        feed = reference.arm_acceleration_rad_s2
        e_tau, acceleration = [], []
        for joint, m_d, k_d, k_p in self._arm_gains:
            e_tau.append(t := ext[joint] - desired[joint])
            acceleration.append(feed[joint] - (k_d * error_rate[6 + joint] + k_p * error[6 + joint] - t) / m_d)
        terms = self._dynamics.arm_terms(state.arm_rad, state.arm_rate_rad_s)
        gravity = self._manipulator.gravity_torque_nm(state.arm_rad, state.attitude_wxyz)
        torque = []
        for joint, row in enumerate(terms.mass):
            inertial = 0.0
            for other, a in enumerate(acceleration):
                inertial += row[other] * a
            torque.append(inertial + terms.coriolis[joint] + gravity[joint] - ext[joint])
        return tuple(e_tau), tuple(torque)
