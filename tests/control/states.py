"""A machine in the air, level, as a law may find it."""

from __future__ import annotations

import math

from companion.control.types import PlantState
from companion.model.types import IDENTITY_QUAT, Vec2, Vec3

POSE: Vec2 = (math.radians(100), math.radians(60))
ZERO: Vec3 = (0.0, 0.0, 0.0)


def at(
    position: Vec3 = (0.0, 0.0, 1.0),
    velocity: Vec3 = ZERO,
    arm: Vec2 = POSE,
    arm_rate: Vec2 = (0.0, 0.0),
    force: Vec3 | None = ZERO,
) -> PlantState:
    return PlantState(position, velocity, ZERO, IDENTITY_QUAT, ZERO, arm, arm_rate, force)
