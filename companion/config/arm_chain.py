"""The arm of a vehicle file as a chain of links."""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.model.arm_chain import TOOL_PART_INERTIA_KG_M2, ArmChain, ChainLink, rod_inertia_kg_m2
from companion.model.frames import quat_from_euler_zyx
from companion.model.types import IDENTITY_QUAT, Quat, Vec3


def chain_of(vehicle: Vehicle) -> ArmChain:
    """Return the chain of the vehicle's arm and tool, payload excluded.

    Every link is a rod along the x axis of its frame, at angle 0 in line with the link before. The first joint turns about +y and the
    others about -y.
    """
    arm, tool = vehicle.arm, vehicle.tool
    links: list[ChainLink] = []
    position: Vec3 = arm.shoulder_body_m
    for length_m, mass_kg, com_m in zip(arm.link_lengths_m, arm.link_masses_kg, arm.link_com_m, strict=True):
        xx, yy, zz = rod_inertia_kg_m2(mass_kg, length_m)
        links.append(
            ChainLink(
                position_m=position,
                attitude_wxyz=IDENTITY_QUAT,
                axis=(0.0, -1.0 if links else 1.0, 0.0),
                mass_kg=mass_kg,
                com_m=(com_m, 0.0, 0.0),
                inertia_kg_m2=((xx, 0.0, 0.0), (0.0, yy, 0.0), (0.0, 0.0, zz)),
                armature_kg_m2=arm.joint_armature_kg_m2,
            )
        )
        position = (length_m, 0.0, 0.0)
    if not links:
        return ArmChain(())
    return ArmChain(
        links=tuple(links),
        tip_m=position,
        sensor_wxyz=_attitude(tool.sensor_rpy_deg) if tool is not None else IDENTITY_QUAT,
        tool_mass_kg=vehicle.tool_mass_kg,
        tool_inertia_kg_m2=2.0 * TOOL_PART_INERTIA_KG_M2 if tool is not None else 0.0,
    )


def _attitude(rpy_deg: Vec3) -> Quat:
    roll, pitch, yaw = (math.radians(angle) for angle in rpy_deg)
    return quat_from_euler_zyx(roll, pitch, yaw)
