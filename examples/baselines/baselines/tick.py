"""What the baselines share: the soft arm, the force that is known, and the tick around a position controller."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import exp
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from companion.api.laws import (
    GRAVITY_M_S2,
    Actuation,
    Compensation,
    DesiredForce,
    ForceFilter,
    Joints,
    LawConfig,
    Manipulator,
    NonNegative,
    PlantState,
    PositiveJoints,
    Reference,
    Vec3,
    Vehicle,
    Wrench,
    body_x_z_axes_world,
    fitted,
    manipulator_of,
    quat_conjugate,
    quat_rotate,
    tracking_errors,
    wrench_of,
    yaw_from_quat,
)

Array: TypeAlias = NDArray[np.float64]
"""Three numbers, for x, y and z."""


class BaselineConfig(LawConfig):
    """Settings of the arm and of the thrust, which all baselines have."""

    gain_lists = ("arm_inertia_md", "arm_damping_kd", "arm_phi", "arm_lambda")
    arm_inertia_md: PositiveJoints
    """M_d, kg m^2."""
    arm_damping_kd: PositiveJoints
    """K_d, N m s/rad."""
    arm_phi: PositiveJoints
    """Phi, 1/s; K_p = (K_d - M_d Phi) Phi."""
    arm_lambda: PositiveJoints
    """Lambda, N m s/rad."""
    thrust_lag_s: NonNegative = 0.04
    """Lag between commanded and actual thrust."""


class SoftArm:
    """The arm of `adaptive/recommended` with its adaptation off, and so of the same target impedance M_d, K_d, K_p:

        s = e' + Phi e - gamma,    gamma' = (J'(F - F_d) - D gamma) / M_d,    D = K_d - M_d Phi,
        tau = -Lambda s + M_d (alpha''_d - Phi e') - D gamma - J'F_d + g(alpha).

    For F = 0 it is a PD controller of stiffness Lambda Phi and damping Lambda + M_d Phi with gravity feed-forward.
    """

    def __init__(self, config: BaselineConfig, manipulator: Manipulator) -> None:
        lists = (config.arm_inertia_md, config.arm_damping_kd, config.arm_phi, config.arm_lambda)
        self._gains = [*zip(*(fitted(gains, manipulator.joint_count) for gains in lists), strict=True)]
        self._manipulator = manipulator
        self._desired = DesiredForce(config.desired_force_time_s)
        self._gamma = [0.0] * manipulator.joint_count

    def step(
        self, dt_s: float, state: PlantState, reference: Reference, e: Joints, e_dot: Joints, force: Vec3
    ) -> tuple[Joints, Joints, Joints]:
        """Return the torques, the joint rates at which s = 0, and J'(F - F_d), N m."""
        ext, desired = (self._joint_torque_nm(state, one) for one in (force, self._desired.world_n))
        self._desired.advance(dt_s, force)
        gravity = self._manipulator.gravity_torque_nm(state.arm_rad, state.attitude_wxyz)
        torques, rates, e_tau = [], [], []
        for i, (M_d, K_d, phi, lambda_) in enumerate(self._gains):
            D, gamma = K_d - M_d * phi, self._gamma[i]
            s = e_dot[i] + phi * e[i] - gamma
            inertial = M_d * (reference.arm_acceleration_rad_s2[i] - phi * e_dot[i])
            torques.append(-lambda_ * s + inertial - D * gamma - desired[i] + gravity[i])
            rates.append(state.arm_rate_rad_s[i] - s)
            e_tau.append(ext[i] - desired[i])
            decay = exp(-D / M_d * dt_s)
            self._gamma[i] = decay * gamma + (1.0 - decay) / D * e_tau[i]
        return tuple(torques), tuple(rates), tuple(e_tau)

    def _joint_torque_nm(self, state: PlantState, force: Vec3) -> Joints:
        in_body = quat_rotate(quat_conjugate(state.attitude_wxyz), force)
        return self._manipulator.joint_torque_from_force(state.arm_rad, in_body)


@dataclass(frozen=True, slots=True)
class Tick:
    """What a position controller is given, world frame."""

    dt_s: float
    e: Array
    """Position error, m."""
    e_dot: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    """Measured by the IMU."""
    wanted_m_s2: Array
    """Acceleration of the reference."""
    known_n: Array
    """Sum of the known forces: thrust along the measured body z, weight, and the measured force that is fed forward."""
    learn: bool
    """False on the ground and in saturation: estimates must not change."""
    unwinding_e: Array
    """The position error as an integrator may integrate it: 0 on the ground, and where the command would go further beyond a limit."""


class Baseline(ABC):
    """A position controller, the soft arm, and the extras of the companion's own laws."""

    def __init__(self, config: BaselineConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        self.hover_thrust = hover_thrust
        self.mass_kg = vehicle.airframe.mass_kg
        self._arm = SoftArm(config, manipulator_of(vehicle))
        self._force = ForceFilter(config.force_lowpass_hz)
        self._compensation = Compensation(config, vehicle, (0.0, 0.0, 0.0), (self.mass_kg, self.mass_kg))
        self._actuation = Actuation(config, vehicle, hover_thrust)
        self._fed_forward = np.array(config.force_feedforward_xyz)
        self._lag_s, self._thrust_n = config.thrust_lag_s, self.mass_kg * GRAVITY_M_S2

    @abstractmethod
    def acceleration(self, tick: Tick) -> Array:
        """Return the acceleration that the force of the rotors is to produce in addition to carrying the vehicle, m/s^2."""

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick; see `companion.control.types.Controller`."""
        sent, compensation = self._actuation, self._compensation
        force = self._force.step(dt_s, state.force_ext_world_n)
        e, e_dot = tracking_errors(state, reference, yaw_from_quat(state.attitude_wxyz))
        body_z = body_x_z_axes_world(state.attitude_wxyz)[1]
        weight = np.array((0.0, 0.0, self.mass_kg * GRAVITY_M_S2))
        tick = Tick(
            dt_s,
            np.array(e[:3]),
            np.array(e_dot[:3]),
            np.array(state.velocity_world_m_s),
            np.array(state.acceleration_world_m_s2),
            np.array(reference.acceleration_world_m_s2),
            self._thrust_n * np.array(body_z) + self._fed_forward * force - weight,
            state.airborne and not sent.any_clipped,
            np.array(sent.unwinding(e)[:3]) if state.airborne else np.zeros(3),
        )
        x, y, z = (self.mass_kg * self.acceleration(tick) + weight).tolist()
        torque, rate, e_tau = self._arm.step(dt_s, state, reference, e[6:], e_dot[6:], force)
        sent.step(
            dt_s,
            compensation.base_force_n((x, y, z), force, reference),
            compensation.joint_torque_nm(torque, rate),
            body_z,
            reference.yaw_rad,
            vertical_scale,
            reference.yaw_rate_rad_s,
        )
        thrust_n = sent.collective_n if state.airborne else self.mass_kg * GRAVITY_M_S2
        share = 1.0 - exp(-dt_s / self._lag_s) if self._lag_s > 0.0 else 1.0
        self._thrust_n += share * (thrust_n - self._thrust_n)
        return wrench_of(sent, e, e_dot, (0.0,) * 6 + e_tau, force, self.hover_thrust)
