"""What the model-based control laws share: the target impedance, the model, and the tick around their equation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from companion.config.controller import LawConfig
from companion.config.gains import fitted
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.control.common import Actuation, DesiredForce, ForceFilter, tracking_errors, wrench_of
from companion.control.compensation import Compensation
from companion.control.types import PlantState, Wrench
from companion.model.frames import body_x_z_axes_world, quat_conjugate, quat_rotate, yaw_from_quat
from companion.model.types import Chi, Joints, Reference, Vec3


class TargetImpedance:
    """M_d e'' + K_d e' + K_p e = tau_ext - tau_d, with one gain for each row."""

    def __init__(self, M_d: Joints, K_d: Joints, K_p: Joints, count: int) -> None:
        self._gains = list(zip(*(fitted(gains, count) for gains in (M_d, K_d, K_p)), strict=True))

    def acceleration(self, chi_d_ddot: Chi, e: Sequence[float], e_dot: Sequence[float], e_tau: Chi) -> list[float]:
        """Return chi''_cmd = chi''_d - M_d^-1 (K_d e' + K_p e - e_tau)."""
        return [
            chi_d_ddot[i] - (K_d * e_dot[i] + K_p * e[i] - e_tau[i]) / M_d
            for i, (M_d, K_d, K_p) in enumerate(self._gains)
        ]


class ModelBasedLaw(ABC):
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
        self._payload_kg: float | None = None
        """Estimated mass of the payload, for the log; None if the law does not estimate it."""

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick of `dt_s`; see `companion.control.types.Controller`."""
        compensation, sent = self._compensation, self._actuation
        F_ext = self._force.step(dt_s, state.force_ext_world_n)
        e, e_dot = tracking_errors(state, reference, yaw_from_quat(state.attitude_wxyz))
        base_n, arm_nm, e_tau = self._tau(dt_s, state, reference, e, e_dot, F_ext)
        compensation.observe(dt_s, state, state.airborne and not sent.any_clipped)
        sent.step(
            dt_s,
            compensation.base_force_n(base_n, F_ext, reference),
            compensation.joint_torque_nm(arm_nm, reference.arm_rate_rad_s),
            body_x_z_axes_world(state.attitude_wxyz)[1],
            reference.yaw_rad,
            vertical_scale,
            reference.yaw_rate_rad_s,
        )
        compensation.remember(sent.force_world_n, F_ext)
        self._desired.advance(dt_s, F_ext)
        return wrench_of(sent, e, e_dot, e_tau, F_ext, self.hover_thrust, self._payload_kg)

    @abstractmethod
    def _tau(
        self, dt_s: float, state: PlantState, reference: Reference, e: Chi, e_dot: Chi, F_ext: Vec3
    ) -> tuple[Vec3, Joints, Chi]:
        """Return the force on the base (world frame, N), the joint torques (N m), and tau_ext - tau_d of all rows."""

    def _joint_torques_nm(self, state: PlantState, F_ext: Vec3) -> tuple[Joints, Joints]:
        """Return J'F and J'F_d, N m."""
        to_body = quat_conjugate(state.attitude_wxyz)
        ext = self._manipulator.joint_torque_from_force(state.arm_rad, quat_rotate(to_body, F_ext))
        desired = self._manipulator.joint_torque_from_force(state.arm_rad, quat_rotate(to_body, self._desired.world_n))
        return ext, desired
