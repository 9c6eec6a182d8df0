"""Kinematics and nominal gravity torques of the arm, for an arm of any number of joints.

`companion.control.arm_model.manipulator_of` builds the implementation that fits the arm. Joint angles are ordered from the shoulder
outwards; the signs of the planar arm's angles are those of the paper (`companion.control.arm_model.planar_manipulator`). Everything
here runs in the control tick and uses floats and tuples only.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_rotate
from companion.model.types import Joints, Matrix, Quat, Vec3


class Manipulator(ABC):
    """Geometry and nominal masses of arm and tool, payload excluded. Without an arm, tuples are empty and the tip is the origin."""

    joint_count: int
    """Number of joints, 0 to 7."""

    @abstractmethod
    def net_body_m(self, angle_rad: Joints) -> Vec3:
        """Return the tip in the body frame, m: the centre of the net or, without a tool, the end of the arm."""

    @abstractmethod
    def joints_body_m(self, angle_rad: Joints) -> tuple[Vec3, ...]:
        """Return the position of every joint in the body frame, m."""

    @abstractmethod
    def jacobian_body_m(self, angle_rad: Joints) -> Matrix:
        """Return rows x, y and z of d net_body / d alpha, m/rad: the paper's J_alpha."""

    @abstractmethod
    def joint_terms(self, angle_rad: Joints, up_body_m_s2: Vec3) -> tuple[Matrix, Joints]:
        """Return the Jacobian (m/rad) and the gravity torques (N m): `jacobian_body_m` and `gravity_torque_nm` in one call.

        Args:
            angle_rad: joint angles.
            up_body_m_s2: reaction to gravity, which is 9.81 m/s^2 upwards, in the body frame.
        """

    @abstractmethod
    def gravity_levers_m_s2(self, angle_rad: Joints, up_body_m_s2: Vec3) -> Matrix:
        """Return a row for each joint with an element for each link: the joint torque that holds a first moment of 1 kg m of that link,
        which points from the link's joint to the next one, against gravity. Arguments as for `joint_terms`.
        """

    def joint_terms_and_levers(self, angle_rad: Joints, up_body_m_s2: Vec3) -> tuple[Matrix, Joints, Matrix]:
        """Return the results of `joint_terms` and of `gravity_levers_m_s2`, in one call."""
        return (*self.joint_terms(angle_rad, up_body_m_s2), self.gravity_levers_m_s2(angle_rad, up_body_m_s2))

    @abstractmethod
    def moment_torque_nm(self, levers_m_s2: Matrix, moment_kg_m: Joints) -> Joints:
        """Return the joint torques that hold one first moment per link against gravity: levers times moments."""

    @abstractmethod
    def projected_on_moments(self, levers_m_s2: Matrix, joint_values: Joints) -> Joints:
        """Return the transposed levers times one value per joint: the direction in which each link's moment acts on that value."""

    @abstractmethod
    def sensor_attitude_body(self, angle_rad: Joints) -> Quat:
        """Return the rotation from the force-torque sensor's frame to the body frame."""

    def joint_torque_from_force(self, angle_rad: Joints, force_body_n: Vec3) -> Joints:
        """Return J' F: the joint torques of a force on the tip, N m."""
        jx, jy, jz = self.jacobian_body_m(angle_rad)
        fx, fy, fz = force_body_n
        return tuple([x * fx + y * fy + z * fz for x, y, z in zip(jx, jy, jz, strict=True)])

    def gravity_torque_nm(self, angle_rad: Joints, attitude_wxyz: Quat) -> Joints:
        """Return the motor torques that hold the arm against gravity at the given attitude, N m, payload excluded."""
        w, x, y, z = attitude_wxyz
        return self.joint_terms(angle_rad, quat_rotate((w, -x, -y, -z), (0.0, 0.0, GRAVITY_M_S2)))[1]
