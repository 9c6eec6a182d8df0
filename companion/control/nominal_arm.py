"""The arm of the vehicle file: J_alpha, which the paper's law knows, and beyond the paper its gravity and inertia."""

from __future__ import annotations

from companion.config.controller import AdaptiveConfig
from companion.config.gains import fitted
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.control.types import PlantState
from companion.model.algebra import cross, mat_vec
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Joints, Mat3, Matrix, Vec3


class NominalArm:
    """Jacobian, gravity and inertia in the pose of a tick; gravity and inertia are 0 if the law does not know them."""

    def __init__(self, config: AdaptiveConfig, vehicle: Vehicle) -> None:
        self.manipulator = manipulator_of(vehicle)
        self._dynamics = dynamics_of(vehicle) if config.arm_inertia_nominal else None
        self._knows_gravity = config.arm_gravity_nominal
        self._M_d = fitted(config.inertia_md, 6 + self.manipulator.joint_count)[6:]
        self._axes_world: Mat3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        """The body's axes: rows of R'."""
        self._J_alpha: Matrix = ((), (), ())
        self.gravity_nm: Joints = (0.0,) * self.manipulator.joint_count
        """Torques that hold the arm against gravity."""
        self.levers_m_s2: Matrix = ()
        """See `Manipulator.gravity_levers_m_s2`."""

    def set_pose(self, angle_rad: Joints, body_x: Vec3, body_z: Vec3) -> None:
        """Set the joint angles, and the x and z axes of the body in the world frame."""
        body_y = cross(body_z, body_x)
        self._axes_world = (body_x, body_y, body_z)
        up_body_m_s2 = (GRAVITY_M_S2 * body_x[2], GRAVITY_M_S2 * body_y[2], GRAVITY_M_S2 * body_z[2])
        self._J_alpha, gravity, self.levers_m_s2 = self.manipulator.joint_terms_and_levers(angle_rad, up_body_m_s2)
        if self._knows_gravity:
            self.gravity_nm = gravity

    def joint_torque_nm(self, force_world_n: Vec3) -> list[float]:
        """Return J_alpha' F for a force F on the tool."""
        x, y, z = mat_vec(self._axes_world, force_world_n)
        rows_x, rows_y, rows_z = self._J_alpha
        return [jx * x + rows_y[joint] * y + rows_z[joint] * z for joint, jx in enumerate(rows_x)]

    def with_inertia(self, tau: Joints, state: PlantState, star_rad_s2: Joints) -> Joints:
        """Return tau + (M_arm - M_d) alpha*'' + C alpha': tau contains M_d alpha*'' already (`Row.chi_star_ddot`)."""
        if self._dynamics is None:
            return tau
        inertial = self._dynamics.arm_torque_nm(state.arm_rad, state.arm_rate_rad_s, star_rad_s2)
        terms = zip(tau, inertial, self._M_d, star_rad_s2, strict=True)
        return tuple([known + (nm - m_d * a) for known, nm, m_d, a in terms])
