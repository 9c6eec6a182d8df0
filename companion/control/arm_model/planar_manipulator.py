"""Kinematics and nominal gravity torques of a planar 2R arm, written out.

Angles are those of the paper: alpha_1 is the angle of link 1 from body +x, positive downwards (about body +y); alpha_2 rotates link 2
in the opposite direction, so that link 2 points along alpha_1 - alpha_2. The arm moves in the body's x-z plane.
"""

from __future__ import annotations

import math

from companion.control.manipulator import Manipulator
from companion.model.arm_chain import ArmChain, rod_inertia_kg_m2
from companion.model.frames import quat_multiply
from companion.model.types import IDENTITY_QUAT, Joints, Matrix, Quat, Vec3

_ROW_Y: Joints = (0.0, 0.0)


def is_planar_2r(chain: ArmChain) -> bool:
    """Return whether a chain is a planar 2R arm: two rods along x, the first turning about +y and the second about -y."""
    if len(chain.links) != 2:
        return False
    first, second = chain.links
    for link, end, axis in ((first, second.position_m, (0.0, 1.0, 0.0)), (second, chain.tip_m, (0.0, -1.0, 0.0))):
        xx, yy, zz = rod_inertia_kg_m2(link.mass_kg, end[0])
        rod = ((xx, 0.0, 0.0), (0.0, yy, 0.0), (0.0, 0.0, zz))
        along_x = end[0] > 0.0 and end[1:] == link.com_m[1:] == (0.0, 0.0)
        if not along_x or (link.attitude_wxyz, link.axis, link.inertia_kg_m2) != (IDENTITY_QUAT, axis, rod):
            return False
    return True


class PlanarManipulator(Manipulator):
    """Manipulator of a planar 2R arm."""

    joint_count = 2

    def __init__(self, chain: ArmChain) -> None:
        first, second = chain.links
        self._shoulder = first.position_m
        self._l1, self._l2 = second.position_m[0], chain.tip_m[0]
        m1, m2 = first.mass_kg, second.mass_kg
        c1, c2 = first.com_m[0], second.com_m[0]
        tool_mass = chain.tool_mass_kg
        # First moments about each joint's axis, kg m.
        self._moment_1 = m1 * c1 + (m2 + tool_mass) * self._l1
        self._moment_2 = m2 * c2 + tool_mass * self._l2
        self._sensor_in_link2: Quat = chain.sensor_wxyz

    def net_body_m(self, angle_rad: Joints) -> Vec3:
        """See `Manipulator`."""
        a1 = angle_rad[0]
        b = a1 - angle_rad[1]
        sx, sy, sz = self._shoulder
        return (
            sx + self._l1 * math.cos(a1) + self._l2 * math.cos(b),
            sy,
            sz - self._l1 * math.sin(a1) - self._l2 * math.sin(b),
        )

    def joints_body_m(self, angle_rad: Joints) -> tuple[Vec3, ...]:
        """Return shoulder and elbow in the body frame, m."""
        sx, sy, sz = self._shoulder
        return (
            self._shoulder,
            (sx + self._l1 * math.cos(angle_rad[0]), sy, sz - self._l1 * math.sin(angle_rad[0])),
        )

    def jacobian_body_m(self, angle_rad: Joints) -> Matrix:
        """See `Manipulator`; row y is zero."""
        a1 = angle_rad[0]
        b = a1 - angle_rad[1]
        s1, c1 = self._l1 * math.sin(a1), self._l1 * math.cos(a1)
        s2, c2 = self._l2 * math.sin(b), self._l2 * math.cos(b)
        return ((-s1 - s2, s2), _ROW_Y, (-c1 - c2, c2))

    def joint_torque_from_force(self, angle_rad: Joints, force_body_n: Vec3) -> Joints:
        """See `Manipulator`."""
        (jx1, jx2), _, (jz1, jz2) = self.jacobian_body_m(angle_rad)
        fx, _, fz = force_body_n
        return (jx1 * fx + jz1 * fz, jx2 * fx + jz2 * fz)

    def joint_terms(self, angle_rad: Joints, up_body_m_s2: Vec3) -> tuple[Matrix, Joints]:
        """See `Manipulator`."""
        jacobian, gravity, _ = self.joint_terms_and_levers(angle_rad, up_body_m_s2)
        return jacobian, gravity

    def joint_terms_and_levers(self, angle_rad: Joints, up_body_m_s2: Vec3) -> tuple[Matrix, Joints, Matrix]:
        """See `Manipulator`."""
        a1, a2 = angle_rad
        up_x, _, up_z = up_body_m_s2
        b = a1 - a2
        s1, c1, s2, c2 = math.sin(a1), math.cos(a1), math.sin(b), math.cos(b)
        first, second = -s1 * up_x - c1 * up_z, -s2 * up_x - c2 * up_z
        about_1, about_2 = self._moment_1 * first, self._moment_2 * second
        l1, l2 = self._l1, self._l2
        s2 *= l2
        c2 *= l2
        return (
            ((-l1 * s1 - s2, s2), _ROW_Y, (-l1 * c1 - c2, c2)),
            (about_1 + about_2, -about_2),
            ((first, second), (0.0, -second)),
        )

    def gravity_levers_m_s2(self, angle_rad: Joints, up_body_m_s2: Vec3) -> Matrix:
        """See `Manipulator`."""
        a1, a2 = angle_rad
        up_x, _, up_z = up_body_m_s2
        b = a1 - a2
        first = -math.sin(a1) * up_x - math.cos(a1) * up_z
        second = -math.sin(b) * up_x - math.cos(b) * up_z
        return ((first, second), (0.0, -second))

    def moment_torque_nm(self, levers_m_s2: Matrix, moment_kg_m: Joints) -> Joints:
        """See `Manipulator`."""
        u1, u2 = levers_m_s2[0]
        m1, m2 = moment_kg_m
        return (m1 * u1 + m2 * u2, -m2 * u2)

    def projected_on_moments(self, levers_m_s2: Matrix, joint_values: Joints) -> Joints:
        """See `Manipulator`."""
        u1, u2 = levers_m_s2[0]
        v1, v2 = joint_values
        return (v1 * u1, (v1 - v2) * u2)

    def sensor_attitude_body(self, angle_rad: Joints) -> Quat:
        """See `Manipulator`."""
        half = 0.5 * (angle_rad[0] - angle_rad[1])
        return quat_multiply((math.cos(half), 0.0, math.sin(half), 0.0), self._sensor_in_link2)
