"""The arm of a vehicle file as a chain of links."""

from __future__ import annotations

import math
from collections.abc import Iterator

from companion.config.arm import Arm
from companion.config.vehicle import Vehicle
from companion.model.arm_chain import TOOL_PART_INERTIA_KG_M2, ArmChain, ChainLink, rod_inertia_kg_m2
from companion.model.frames import quat_from_euler_zyx, quat_multiply
from companion.model.types import IDENTITY_QUAT, Quat, Vec3


def chain_of(vehicle: Vehicle) -> ArmChain:
    """Return the chain of the vehicle's arm and tool, payload excluded."""
    arm, tool = vehicle.arm, vehicle.tool
    if not arm.joints:
        return ArmChain(())
    sensor = _attitude(tool.sensor_rpy_deg) if tool is not None else IDENTITY_QUAT
    tip = _attitude(arm.tip_rpy_deg) if arm.links else IDENTITY_QUAT
    return ArmChain(
        links=tuple(_bodies(arm) if arm.links else _rods(arm)),
        tip_m=arm.tip_m if arm.links else (arm.link_lengths_m[-1], 0.0, 0.0),
        tip_wxyz=tip,
        sensor_wxyz=quat_multiply(tip, sensor),
        tool_mass_kg=vehicle.tool_mass_kg,
        tool_inertia_kg_m2=2.0 * TOOL_PART_INERTIA_KG_M2 if tool is not None else 0.0,
    )


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
    """Yield rods along x, in line with each other at angle 0. Unless an axis is given, the first joint turns about +y, and the others
    turn about -y.
    """
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
