"""The contents of a scene: its machines and their start poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from companion.config.vehicle import Vehicle
from companion.model.types import Joints, Vec2
from companion.sitl_config.world import World as WorldConfig


@dataclass(frozen=True, slots=True)
class Start:
    """Pose of a vehicle at the start, on the floor."""

    position_m: Vec2
    yaw_rad: float
    arm_rad: Joints


class MachineSpec(NamedTuple):
    """A machine of a scene."""

    vehicle: Vehicle
    config: WorldConfig
    """Its errors, effects and seed; the configuration of the first machine also has the objects of the scene."""
    start: Start


def start_of(position_m: Vec2, yaw_deg: float, arm_deg: Joints) -> Start:
    """Return a start pose, given a mission's angles in degrees."""
    return Start(position_m, math.radians(yaw_deg), tuple(map(math.radians, arm_deg)))
