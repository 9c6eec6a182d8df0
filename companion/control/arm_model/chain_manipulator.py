"""Kinematics and nominal gravity torques of an arm of revolute joints with any axes."""

from __future__ import annotations

import math

from companion.control.arm_model.chain_kinematics import ChainKinematics
from companion.control.manipulator import Manipulator
from companion.model.algebra import cross, dot, mat_vec
from companion.model.arm_chain import ArmChain
from companion.model.frames import quat_multiply
from companion.model.types import IDENTITY_QUAT, Joints, Matrix, Quat, Vec3


class ChainManipulator(Manipulator):
    """Manipulator of any chain."""

    def __init__(self, chain: ArmChain) -> None:
        self.joint_count = len(chain.links)
        self._kinematics = ChainKinematics(chain)
        self._half_axes = tuple([(link.attitude_wxyz, link.axis) for link in chain.links])
        self._sensor_in_last: Quat = chain.sensor_wxyz
        self._masses = masses_with_tool(chain)
        ends = [*(link.position_m for link in chain.links[1:]), chain.tip_m]
        self._directions = tuple(
            [
                _direction(end) or _direction(link.com_m) or (0.0, 0.0, 0.0)
                for end, link in zip(ends, chain.links, strict=False)
            ]
        )

    def net_body_m(self, angle_rad: Joints) -> Vec3:
        """See `Manipulator`."""
        return self._kinematics.tip_m(self._kinematics.frames(angle_rad))

    def joints_body_m(self, angle_rad: Joints) -> tuple[Vec3, ...]:
        """See `Manipulator`."""
        return tuple([position for _, position, _ in self._kinematics.frames(angle_rad)])

    def jacobian_body_m(self, angle_rad: Joints) -> Matrix:
        """See `Manipulator`."""
        frames = self._kinematics.frames(angle_rad)
        tx, ty, tz = self._kinematics.tip_m(frames)
        row_x, row_y, row_z = [], [], []
        for _, (px, py, pz), (ax, ay, az) in frames:
            x, y, z = tx - px, ty - py, tz - pz
            row_x.append(ay * z - az * y)
            row_y.append(az * x - ax * z)
            row_z.append(ax * y - ay * x)
        return (tuple(row_x), tuple(row_y), tuple(row_z))

    def joint_terms(self, angle_rad: Joints, up_body_m_s2: Vec3) -> tuple[Matrix, Joints]:
        """See `Manipulator`."""
        torques: list[float] = []
        mass = hx = hy = hz = 0.0  # mass and first moment of everything that the joint carries
        frames = self._kinematics.frames(angle_rad)
        for number in range(len(frames) - 1, -1, -1):
            rotation, (px, py, pz), axis = frames[number]
            link_kg, moment = self._masses[number]
            mx, my, mz = mat_vec(rotation, moment)
            mass += link_kg
            hx, hy, hz = hx + mx + link_kg * px, hy + my + link_kg * py, hz + mz + link_kg * pz
            torques.append(dot(axis, cross((hx - mass * px, hy - mass * py, hz - mass * pz), up_body_m_s2)))
        torques.reverse()
        return self.jacobian_body_m(angle_rad), tuple(torques)

    def gravity_levers_m_s2(self, angle_rad: Joints, up_body_m_s2: Vec3) -> Matrix:
        """See `Manipulator`."""
        frames = self._kinematics.frames(angle_rad)
        levers = [
            cross(mat_vec(rotation, direction), up_body_m_s2)
            for (rotation, _, _), direction in zip(frames, self._directions, strict=True)
        ]
        return tuple(
            [
                tuple([dot(axis, lever) if link >= joint else 0.0 for link, lever in enumerate(levers)])
                for joint, (_, _, axis) in enumerate(frames)
            ]
        )

    def moment_torque_nm(self, levers_m_s2: Matrix, moment_kg_m: Joints) -> Joints:
        """See `Manipulator`."""
        torques: list[float] = []
        for row in levers_m_s2:
            total = 0.0
            for lever, moment in zip(row, moment_kg_m, strict=True):
                total += lever * moment
            torques.append(total)
        return tuple(torques)

    def projected_on_moments(self, levers_m_s2: Matrix, joint_values: Joints) -> Joints:
        """See `Manipulator`."""
        totals = [0.0] * len(levers_m_s2)
        for row, value in zip(levers_m_s2, joint_values, strict=True):
            for link, lever in enumerate(row):
                totals[link] += lever * value
        return tuple(totals)

    def sensor_attitude_body(self, angle_rad: Joints) -> Quat:
        """See `Manipulator`."""
        attitude = IDENTITY_QUAT
        for (at_zero, (x, y, z)), angle in zip(self._half_axes, angle_rad, strict=True):
            s, c = math.sin(0.5 * angle), math.cos(0.5 * angle)
            attitude = quat_multiply(quat_multiply(attitude, at_zero), (c, s * x, s * y, s * z))
        return quat_multiply(attitude, self._sensor_in_last)


def masses_with_tool(chain: ArmChain) -> tuple[tuple[float, Vec3], ...]:
    """Return mass (kg) and first moment (kg m, in the link's frame) of every link; those of the last one include the tool."""
    masses = [
        (link.mass_kg, (link.mass_kg * link.com_m[0], link.mass_kg * link.com_m[1], link.mass_kg * link.com_m[2]))
        for link in chain.links
    ]
    if masses:
        kg, (x, y, z) = masses[-1]
        tool = chain.tool_mass_kg
        tx, ty, tz = chain.tip_m
        masses[-1] = (kg + tool, (x + tool * tx, y + tool * ty, z + tool * tz))
    return tuple(masses)


def _direction(v: Vec3) -> Vec3 | None:
    """Return the unit vector along v, or None if v is zero."""
    norm = math.sqrt(dot(v, v))
    return (v[0] / norm, v[1] / norm, v[2] / norm) if norm > 0.0 else None
