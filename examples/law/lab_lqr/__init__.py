"""A control law in a package of its own: LQR with integral for the vehicle, PD with gravity compensation for the arm."""

from typing import ClassVar, Literal

import numpy as np

from companion.api.laws import (
    GRAVITY_M_S2,
    Actuation,
    ForceFilter,
    Joints,
    LawConfig,
    PlantState,
    Positive3,
    PositiveJoints,
    Reference,
    TunedGain,
    Vec3,
    Vehicle,
    Wrench,
    body_x_z_axes_world,
    fitted,
    manipulator_of,
    tracking_errors,
    wrench_of,
    yaw_from_quat,
)


class LqrConfig(LawConfig):
    """LQR with integral for the vehicle, PD with gravity compensation for the arm."""

    presets = ("tuned",)
    gain_lists = ("arm_kp_nm_rad", "arm_kd_nms_rad")
    tuned_gains = (
        *(TunedGain("cost_xy", 0.5, 500.0, (row, row + 1)) for row in range(3)),
        *(TunedGain("cost_z", 0.5, 500.0, (row, row + 1)) for row in range(3)),
        TunedGain("arm_kp_nm_rad", 2.0, 50.0),
        TunedGain("arm_kd_nms_rad", 0.1, 3.0),
    )
    law: Literal["lqr"]
    cost_xy: Positive3
    """Cost of the integral of the horizontal error (m s), the error (m) and its rate (m/s); that of the acceleration (m/s^2) is 1."""
    cost_z: Positive3
    arm_kp_nm_rad: PositiveJoints
    arm_kd_nms_rad: PositiveJoints


def lqr_gains(cost: Vec3) -> list[float]:
    """Return K = B'P of the chain integral, position, velocity; P solves 0 = A'P + PA - PBB'P + diag(cost)."""
    a, b = np.eye(3, k=1), np.array([[0.0], [0.0], [1.0]])
    values, vectors = np.linalg.eig(np.block([[a, -b @ b.T], [-np.diag(cost), -a.T]]))
    stable = vectors[:, values.real < 0.0]
    gains: list[float] = (stable[3:] @ np.linalg.inv(stable[:3])).real[2].tolist()
    return gains


class LqrLaw:
    """The law; each flight makes one."""

    settings: ClassVar = LqrConfig

    def __init__(self, config: LqrConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        self.hover_thrust = hover_thrust
        self._mass_kg = vehicle.airframe.mass_kg
        self._gains = [lqr_gains(cost) for cost in (config.cost_xy, config.cost_xy, config.cost_z)]
        self._manipulator = manipulator_of(vehicle)
        count = self._manipulator.joint_count
        self._arm_gains = [*zip(fitted(config.arm_kp_nm_rad, count), fitted(config.arm_kd_nms_rad, count), strict=True)]
        self._force = ForceFilter(config.force_lowpass_hz)
        self._actuation = Actuation(config, vehicle, hover_thrust)
        self._integral_m_s = [0.0, 0.0, 0.0]

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick; see `companion.control.types.Controller`."""
        force = self._force.step(dt_s, state.force_ext_world_n)
        error, rate = tracking_errors(state, reference, yaw_from_quat(state.attitude_wxyz))
        x, y, z = (
            self._mass_kg * (feed - ki * self._integral_m_s[i] - kp * error[i] - kd * rate[i])
            for i, (feed, (ki, kp, kd)) in enumerate(zip(reference.acceleration_world_m_s2, self._gains, strict=True))
        )
        sent, body_z = self._actuation, body_x_z_axes_world(state.attitude_wxyz)[1]
        wanted = (x, y, z + self._mass_kg * GRAVITY_M_S2)
        joints = self._arm(state, error[6:], rate[6:])
        sent.step(dt_s, wanted, joints, body_z, reference.yaw_rad, vertical_scale, reference.yaw_rate_rad_s)
        clipped_z, clipped_xy, _ = sent.clipped
        for i, clipped in enumerate((clipped_xy, clipped_xy, clipped_z)):
            if state.airborne and not clipped:
                self._integral_m_s[i] += dt_s * error[i]
        return wrench_of(sent, error, rate, (0.0,) * len(error), force, self.hover_thrust)

    def _arm(self, state: PlantState, error_rad: Joints, rate_rad_s: Joints) -> Joints:
        gravity_nm = self._manipulator.gravity_torque_nm(state.arm_rad, state.attitude_wxyz)
        rows = zip(gravity_nm, self._arm_gains, error_rad, rate_rad_s, strict=True)
        return tuple([gravity - kp * error - kd * rate for gravity, (kp, kd), error, rate in rows])
