"""Kinematics and nominal gravity torques of the 2R arm.

Angles are those of the paper: alpha_1 is the angle of link 1 from body +x, positive downwards (about body +y); alpha_2 rotates link 2
in the opposite direction, so that link 2 points along alpha_1 - alpha_2. The arm moves in the body's x-z plane. The module uses floats
and tuples only, because it runs in the control tick.
"""

from __future__ import annotations

import math

from companion.config.vehicle import Arm, Tool
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import Joints, Quat, Vec3


class Manipulator:
    """Geometry and nominal masses of arm and tool, payload excluded."""

    def __init__(self, arm: Arm, tool: Tool | None) -> None:
        self._shoulder = arm.shoulder_body_m
        self._l1, self._l2 = arm.link_lengths_m
        m1, m2 = arm.link_masses_kg
        c1, c2 = arm.link_com_m
        tool_mass = 0.0 if tool is None else tool.sensor_mass_kg + tool.net_mass_kg
        # First moments about each joint's axis, kg m.
        self._moment_1 = m1 * c1 + (m2 + tool_mass) * self._l1
        self._moment_2 = m2 * c2 + tool_mass * self._l2
        roll, pitch, yaw = (
            math.radians(angle) for angle in (tool.sensor_rpy_deg if tool is not None else (0.0, 0.0, 0.0))
        )
        self._sensor_in_link2: Quat = quat_from_euler_zyx(roll, pitch, yaw)

    def net_body_m(self, angle_rad: Joints) -> Vec3:
        """Return the centre of the net in the body frame, m."""
        a1 = angle_rad[0]
        b = a1 - angle_rad[1]
        sx, sy, sz = self._shoulder
        return (
            sx + self._l1 * math.cos(a1) + self._l2 * math.cos(b),
            sy,
            sz - self._l1 * math.sin(a1) - self._l2 * math.sin(b),
        )

    def elbow_body_m(self, angle_rad: Joints) -> Vec3:
        """Return the elbow joint in the body frame, m."""
        sx, sy, sz = self._shoulder
        return (sx + self._l1 * math.cos(angle_rad[0]), sy, sz - self._l1 * math.sin(angle_rad[0]))

    def jacobian_body_m(self, angle_rad: Joints) -> tuple[Joints, Joints]:
        """Return rows x and z of d net_body / d alpha, m/rad (the y row is zero): the paper's J_alpha."""
        a1 = angle_rad[0]
        b = a1 - angle_rad[1]
        s1, c1 = self._l1 * math.sin(a1), self._l1 * math.cos(a1)
        s2, c2 = self._l2 * math.sin(b), self._l2 * math.cos(b)
        return ((-s1 - s2, s2), (-c1 - c2, c2))

    def joint_torque_from_force(self, angle_rad: Joints, force_body_n: Vec3) -> Joints:
        """Return J' F: the joint torques of a force on the net, N m."""
        (jx1, jx2), (jz1, jz2) = self.jacobian_body_m(angle_rad)
        fx, _, fz = force_body_n
        return (jx1 * fx + jz1 * fz, jx2 * fx + jz2 * fz)

    def gravity_torque_nm(
        self, angle_rad: Joints, attitude_wxyz: Quat, specific_force_m_s2: float = GRAVITY_M_S2
    ) -> Joints:
        """Return the motor torques that hold the arm against gravity at the given attitude, N m, payload excluded."""
        # Upward direction in the body frame: the arm must push that way.
        up_x, _, up_z = quat_rotate(
            (attitude_wxyz[0], -attitude_wxyz[1], -attitude_wxyz[2], -attitude_wxyz[3]), (0.0, 0.0, specific_force_m_s2)
        )
        a1 = angle_rad[0]
        b = a1 - angle_rad[1]
        about_1 = self._moment_1 * (-math.sin(a1) * up_x - math.cos(a1) * up_z)
        about_2 = self._moment_2 * (-math.sin(b) * up_x - math.cos(b) * up_z)
        return (about_1 + about_2, -about_2)

    def joint_terms(
        self, angle_rad: Joints, up_x_m_s2: float, up_z_m_s2: float
    ) -> tuple[float, float, float, float, float, float]:
        """Return rows x and z of the Jacobian (m/rad) and the gravity torques (N m): `jacobian_body_m` and `gravity_torque_nm` in
        one call.

        Args:
            angle_rad: both joint angles.
            up_x_m_s2: body x component of the reaction to gravity, which is 9.81 m/s^2 upwards.
            up_z_m_s2: body z component of that reaction.
        """
        a1, a2 = angle_rad
        b = a1 - a2
        s1, c1, s2, c2 = math.sin(a1), math.cos(a1), math.sin(b), math.cos(b)
        about_1 = self._moment_1 * (-s1 * up_x_m_s2 - c1 * up_z_m_s2)
        about_2 = self._moment_2 * (-s2 * up_x_m_s2 - c2 * up_z_m_s2)
        l1, l2 = self._l1, self._l2
        s2 *= l2
        c2 *= l2
        return -l1 * s1 - s2, s2, -l1 * c1 - c2, c2, about_1 + about_2, -about_2

    def gravity_levers_m_s2(self, angle_rad: Joints, up_x_m_s2: float, up_z_m_s2: float) -> Joints:
        """Return, for each link, the torque about its own joint that holds a first moment of 1 kg m against gravity; arguments as for
        `joint_terms`.
        """
        a1, a2 = angle_rad
        b = a1 - a2
        return (
            -math.sin(a1) * up_x_m_s2 - math.cos(a1) * up_z_m_s2,
            -math.sin(b) * up_x_m_s2 - math.cos(b) * up_z_m_s2,
        )

    def sensor_attitude_body(self, angle_rad: Joints) -> Quat:
        """Return the rotation from the force-torque sensor's frame to the body frame."""
        half = 0.5 * (angle_rad[0] - angle_rad[1])
        return quat_multiply((math.cos(half), 0.0, math.sin(half), 0.0), self._sensor_in_link2)
