"""A machine in the air, level, as a law may find it, and references that stay."""

from __future__ import annotations

import math

from msgspec.structs import replace

from companion.control.trial import hover
from companion.control.types import PlantState
from companion.model.types import IDENTITY_QUAT, Joints, Quat, Reference, Vec3

POSE: Joints = (math.radians(100), math.radians(60))
ZERO: Vec3 = (0.0, 0.0, 0.0)


def at(
    position: Vec3 = (0.0, 0.0, 1.0),
    velocity: Vec3 = ZERO,
    arm: Joints = POSE,
    arm_rate: Joints = (0.0, 0.0),
    force: Vec3 | None = ZERO,
    acceleration: Vec3 = ZERO,
    attitude: Quat = IDENTITY_QUAT,
) -> PlantState:
    return PlantState(
        position_world_m=position,
        velocity_world_m_s=velocity,
        acceleration_world_m_s2=acceleration,
        attitude_wxyz=attitude,
        angular_rate_body_rad_s=ZERO,
        arm_rad=arm,
        arm_rate_rad_s=arm_rate,
        force_ext_world_n=force,
    )


def at_rest(position_world_m: Vec3, yaw_rad: float, arm_rad: Joints) -> Reference:
    return replace(hover(arm_rad), position_world_m=position_world_m, yaw_rad=yaw_rad)
