"""The joints' rows of the adaptive law: external torque, tau, and what is known of the arm."""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.config.controller import AdaptiveConfig
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.control.compensation import FRICTION_RATE_RAD_S
from companion.control.impedance import Row
from companion.control.load_adaptation import LoadAdaptation
from companion.control.types import PlantState
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Joints, Matrix, Reference, Vec3


class AdaptiveArm:
    """tau of the joints. e_tau, directions and levers of a tick are kept until `advance` ends it.

    Args:
        config: configuration of the law.
        vehicle: the nominal vehicle.
        rows: one for each joint.
        load: estimated loads.
        friction_nm: friction of each joint that is fed forward.
    """

    def __init__(
        self, config: AdaptiveConfig, vehicle: Vehicle, rows: Sequence[Row], load: LoadAdaptation, friction_nm: float
    ) -> None:
        self._manipulator = manipulator_of(vehicle)
        self._dynamics = dynamics_of(vehicle) if config.arm_inertia_nominal else None
        self._gravity_nominal = config.arm_gravity_nominal
        self._friction_nm = friction_nm
        self._load = load
        self.rows = rows
        self.e_tau: Joints = (0.0,) * len(rows)
        """tau_ext - tau_d of this tick."""
        self._directions: Joints = (0.0,) * len(rows)
        self._levers_m_s2: Matrix = ()

    def torque_nm(
        self,
        robust_gain: float,
        axes_world: tuple[Vec3, Vec3],
        force_n: Vec3,
        desired_force_n: Vec3,
        state: PlantState,
        reference: Reference,
    ) -> Joints:
        """Return tau with its -tau_d and nominal gravity, plus the configured adaptive load, (M_arm - M_d) alpha*'' + C alpha', and
        friction in the direction of alpha*'.

        The star marks the motion with s = 0: alpha*'' of `Row.chi_star_ddot`, and alpha*' = alpha'_d - Phi e + gamma = alpha' - s.

        Args:
            robust_gain: as for `Row.tau`.
            axes_world: x and z axis of the body.
            force_n: filtered external force on the tool, world frame.
            desired_force_n: F_d, world frame.
            state: of this tick.
            reference: of this tick.
        """
        # The columns of R; then g, F and F_d in body axes.
        (xx, xy, xz), (zx, zy, zz) = axes_world
        yx, yy, yz = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
        up_body_m_s2 = (GRAVITY_M_S2 * xz, GRAVITY_M_S2 * yz, GRAVITY_M_S2 * zz)
        jacobian, gravity, levers = self._manipulator.joint_terms_and_levers(state.arm_rad, up_body_m_s2)
        (fx, fy, fz), (dx, dy, dz) = force_n, desired_force_n
        external = _transposed_times(
            jacobian, xx * fx + xy * fy + xz * fz, yx * fx + yy * fy + yz * fz, zx * fx + zy * fy + zz * fz
        )
        desired = _transposed_times(
            jacobian, xx * dx + xy * dy + xz * dz, yx * dx + yy * dy + yz * dz, zx * dx + zy * dy + zz * dz
        )
        alpha_d_ddot, rates = reference.arm_acceleration_rad_s2, state.arm_rate_rad_s
        torque, e_tau, directions = [], [], []
        for joint, row in enumerate(self.rows):
            tau_d = desired[joint]
            e_tau.append(external[joint] - tau_d)
            tau = row.tau(alpha_d_ddot[joint], robust_gain) - tau_d
            torque.append(tau + gravity[joint] if self._gravity_nominal else tau)
            directions.append(math.tanh((rates[joint] - row.s) / FRICTION_RATE_RAD_S))
        if self._load.on:
            for joint, load_nm in enumerate(self._load.joint_torque_nm(levers, tuple(directions))):
                torque[joint] += load_nm
        if self._dynamics is not None:
            star = [row.chi_star_ddot(alpha_d_ddot[joint], e_tau[joint]) for joint, row in enumerate(self.rows)]
            # tau contains M_d alpha*'' already: M_arm takes the place of M_d.
            inertial = self._dynamics.arm_torque_nm(state.arm_rad, rates, tuple(star))
            for joint, row in enumerate(self.rows):
                torque[joint] += inertial[joint] - row.M_d * star[joint]
        if self._friction_nm:
            for joint, direction in enumerate(directions):
                torque[joint] += self._friction_nm * direction
        self.e_tau, self._directions, self._levers_m_s2 = tuple(e_tau), tuple(directions), levers
        return tuple(torque)

    def advance(self, dt_s: float, rates_rad_s: Joints, learn: bool) -> None:
        """Integrate loads and gamma over one step; without `learn` the loads do not change."""
        if learn and self._load.on:
            s = tuple([row.s for row in self.rows])
            self._load.advance_joints(dt_s, s, rates_rad_s, self._levers_m_s2, self._directions)
        for joint, row in enumerate(self.rows):
            row.advance(dt_s, self.e_tau[joint])


def _transposed_times(jacobian: Matrix, x: float, y: float, z: float) -> list[float]:
    """Return J' [x y z]."""
    jx, jy, jz = jacobian
    found = []
    for joint, j in enumerate(jx):
        found.append(j * x + jy[joint] * y + jz[joint] * z)
    return found
