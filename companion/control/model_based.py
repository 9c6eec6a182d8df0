"""Parts that the model-based control laws share: model, external joint torque, and the end of a tick."""

from __future__ import annotations

from companion.config.controller import LawConfig
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.control.common import Actuation, DesiredForce, ForceFilter, wrench_of
from companion.control.compensation import Compensation
from companion.control.types import PlantState, Wrench
from companion.model.frames import body_x_z_axes_world, quat_conjugate, quat_rotate
from companion.model.types import Chi, Joints, Reference, Vec3


class ModelBasedLaw:
    """Base class of the model-based control laws.

    Args:
        config: configuration of the law.
        vehicle: the nominal vehicle without payload.
        hover_thrust: normalised thrust that carries the vehicle, 0 to 1.
        answered_xyz: fraction of the measured force, per world axis, that the law itself compensates.
        model_mass_scale: ratio of the model's masses to the nominal ones.
    """

    def __init__(
        self,
        config: LawConfig,
        vehicle: Vehicle,
        hover_thrust: float,
        answered_xyz: Vec3 = (0.0, 0.0, 0.0),
        model_mass_scale: float = 1.0,
    ) -> None:
        self._dynamics = dynamics_of(vehicle, model_mass_scale)
        self._manipulator = manipulator_of(vehicle)
        self._force = ForceFilter(config.force_lowpass_hz)
        self._desired = DesiredForce(config.desired_force_time_s)
        self._actuation = Actuation(config, vehicle, hover_thrust)
        mass_kg = vehicle.airframe.mass_kg
        self._compensation = Compensation(config, vehicle, answered_xyz, (mass_kg, mass_kg))
        self.hover_thrust = hover_thrust
        """Normalised hover thrust, for the log. The hover-thrust estimator sets it before every step."""

    def _send(
        self,
        dt_s: float,
        state: PlantState,
        reference: Reference,
        wanted_n: Vec3,
        torque_nm: Joints,
        force_world_n: Vec3,
        vertical_scale: float,
    ) -> None:
        """Compensate force and torques, and convert them to commands."""
        compensation, sent = self._compensation, self._actuation
        compensation.observe(dt_s, state, state.airborne and not sent.any_clipped)
        sent.step(
            dt_s,
            compensation.base_force_n(wanted_n, force_world_n, reference),
            compensation.joint_torque_nm(torque_nm, reference.arm_rate_rad_s),
            body_x_z_axes_world(state.attitude_wxyz)[1],
            reference.yaw_rad,
            vertical_scale,
        )
        compensation.remember(sent.force_world_n, force_world_n)

    def _joint_torques_nm(self, state: PlantState, force_world_n: Vec3) -> tuple[Joints, Joints]:
        """Return J'F and J'F_d, N m."""
        to_body = quat_conjugate(state.attitude_wxyz)
        ext = self._manipulator.joint_torque_from_force(state.arm_rad, quat_rotate(to_body, force_world_n))
        desired = self._manipulator.joint_torque_from_force(state.arm_rad, quat_rotate(to_body, self._desired.world_n))
        return ext, desired

    def _end(
        self,
        dt_s: float,
        error: Chi,
        error_rate: Chi,
        e_tau: Chi,
        force_world_n: Vec3,
        payload_estimate_kg: float | None = None,
    ) -> Wrench:
        """Advance F_d and return the tick's log record. Fields that only adaptive laws use are 0."""
        self._desired.advance(dt_s, force_world_n)
        return wrench_of(
            self._actuation, error, error_rate, e_tau, force_world_n, self.hover_thrust, payload_estimate_kg
        )
