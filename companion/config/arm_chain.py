"""The arm of a vehicle file as a chain of links."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from companion.config.arm import Arm, Tool
from companion.config.vehicle import Vehicle
from companion.model.algebra import dot, mat_mat, transpose
from companion.model.arm_chain import TOOL_PART_INERTIA_KG_M2, ArmChain, ChainLink, rod_inertia_kg_m2
from companion.model.frames import quat_from_euler_zyx, quat_multiply, quat_rotate, rotation_matrix
from companion.model.types import IDENTITY_QUAT, Mat3, Quat, Vec3


def chain_of(vehicle: Vehicle) -> ArmChain:
    """Return the chain of the vehicle's arm and tool, payload excluded."""
    arm, tool = vehicle.arm, vehicle.tool
    if not arm.joints:
        return ArmChain(())
    sensor = _attitude(tool.sensor_rpy_deg) if tool is not None else IDENTITY_QUAT
    tip = _attitude(arm.tip_rpy_deg) if arm.links else IDENTITY_QUAT
    links = tuple(_bodies(arm) if arm.links else _rods(arm))
    end_m: Vec3 = arm.tip_m if arm.links else (arm.link_lengths_m[-1], 0.0, 0.0)
    if tool is not None and not tool.is_net:
        return ArmChain(
            links=(*links[:-1], _with_rod(links[-1], tool, end_m, tip)),
            tip_m=_along(end_m, tip, tool.beyond_sensor_m),
            tip_wxyz=tip,
            sensor_wxyz=quat_multiply(tip, sensor),
        )
    return ArmChain(
        links=links,
        tip_m=end_m,
        tip_wxyz=tip,
        sensor_wxyz=quat_multiply(tip, sensor),
        tool_mass_kg=vehicle.tool_mass_kg,
        tool_inertia_kg_m2=2.0 * TOOL_PART_INERTIA_KG_M2 if tool is not None else 0.0,
    )


def without_tool(vehicle: Vehicle) -> Vehicle:
    """Return the vehicle whose arm ends at the force-torque sensor."""
    return vehicle.model_copy(update={"tool": None})


def rod_of(tool: Tool) -> tuple[float, Vec3]:
    """Return the distance of a rod's centre of mass from the sensor, and its moments of inertia about its own axis, which is x, and
    across it. The mass is spread evenly over the length.
    """
    return 0.5 * tool.beyond_sensor_m, rod_inertia_kg_m2(tool.beyond_sensor_kg, tool.beyond_sensor_m)


def _with_rod(link: ChainLink, tool: Tool, end_m: Vec3, tip: Quat) -> ChainLink:
    """Return the last link together with the sensor at its end and a rod beyond it, as one rigid body."""
    half_m, moments = rod_of(tool)
    ball = TOOL_PART_INERTIA_KG_M2
    parts: list[tuple[float, Vec3, Mat3]] = [
        (link.mass_kg, link.com_m, link.inertia_kg_m2),
        (tool.sensor_mass_kg, end_m, _diagonal((ball, ball, ball))),
        (tool.beyond_sensor_kg, _along(end_m, tip, half_m), _turned(tip, moments)),
    ]
    mass_kg = sum(mass for mass, _, _ in parts)
    cx, cy, cz = (sum(mass * at[axis] for mass, at, _ in parts) / mass_kg for axis in range(3))
    rows = [[0.0] * 3 for _ in range(3)]
    for mass, (px, py, pz), own in parts:
        at = (px - cx, py - cy, pz - cz)
        square = dot(at, at)
        for i in range(3):
            for j in range(3):
                rows[i][j] += own[i][j] + mass * ((square if i == j else 0.0) - at[i] * at[j])
    inertia: Mat3 = (
        (rows[0][0], rows[0][1], rows[0][2]),
        (rows[1][0], rows[1][1], rows[1][2]),
        (rows[2][0], rows[2][1], rows[2][2]),
    )
    return replace(link, mass_kg=mass_kg, com_m=(cx, cy, cz), inertia_kg_m2=inertia)


def _along(start_m: Vec3, attitude: Quat, length_m: float) -> Vec3:
    x, y, z = quat_rotate(attitude, (length_m, 0.0, 0.0))
    return (start_m[0] + x, start_m[1] + y, start_m[2] + z)


def _diagonal(moments: Vec3) -> Mat3:
    return ((moments[0], 0.0, 0.0), (0.0, moments[1], 0.0), (0.0, 0.0, moments[2]))


def _turned(attitude: Quat, moments: Vec3) -> Mat3:
    if attitude == IDENTITY_QUAT:
        return _diagonal(moments)
    rotation = rotation_matrix(attitude)
    return mat_mat(mat_mat(rotation, _diagonal(moments)), transpose(rotation))


def _bodies(arm: Arm) -> Iterator[ChainLink]:
    for link, armature_kg_m2 in zip(arm.links, arm.armatures_kg_m2, strict=True):
        xx, yy, zz, xy, xz, yz = link.inertia_kg_m2
        yield ChainLink(
            position_m=link.origin_m,
            attitude_wxyz=_attitude(link.origin_rpy_deg),
            axis=_unit(link.axis),
            mass_kg=link.mass_kg,
            com_m=link.com_m,
            inertia_kg_m2=((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)),
            armature_kg_m2=armature_kg_m2,
        )


def _rods(arm: Arm) -> Iterator[ChainLink]:
    """Yield rods along x, in line at angle 0. Unless an axis is given, the first joint turns about +y and the others about -y."""
    position: Vec3 = arm.shoulder_body_m
    usual: Vec3 = (0.0, 1.0, 0.0)
    lists = (arm.armatures_kg_m2, arm.link_lengths_m, arm.link_masses_kg, arm.link_com_m)
    for joint, armature_kg_m2, length_m, mass_kg, com_m in zip(arm.joints, *lists, strict=True):
        xx, yy, zz = rod_inertia_kg_m2(mass_kg, length_m)
        yield ChainLink(
            position_m=position,
            attitude_wxyz=IDENTITY_QUAT,
            axis=usual if joint.axis is None else _unit(joint.axis),
            mass_kg=mass_kg,
            com_m=(com_m, 0.0, 0.0),
            inertia_kg_m2=((xx, 0.0, 0.0), (0.0, yy, 0.0), (0.0, 0.0, zz)),
            armature_kg_m2=armature_kg_m2,
        )
        position, usual = (length_m, 0.0, 0.0), (0.0, -1.0, 0.0)


def _unit(axis: Vec3) -> Vec3:
    norm = math.hypot(*axis)
    return (axis[0] / norm, axis[1] / norm, axis[2] / norm)


def _attitude(rpy_deg: Vec3) -> Quat:
    roll, pitch, yaw = (math.radians(angle) for angle in rpy_deg)
    return quat_from_euler_zyx(roll, pitch, yaw)
