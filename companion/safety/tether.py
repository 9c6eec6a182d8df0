"""Static geometry of the safety tether: a sphere around its anchor that the attachment point cannot leave."""

from __future__ import annotations

import math

from companion.config.vehicle import Tether
from companion.frames import quat_rotate
from companion.types import Quat, Vec3


def attachment_world_m(tether: Tether, position_world_m: Vec3, attitude_wxyz: Quat) -> Vec3:
    """Where the tether is tied to the vehicle, world frame."""
    x, y, z = quat_rotate(attitude_wxyz, tether.attachment_body_m)
    return (position_world_m[0] + x, position_world_m[1] + y, position_world_m[2] + z)


def distance_m(tether: Tether, position_world_m: Vec3, attitude_wxyz: Quat) -> float:
    """Straight distance from the anchor to the attachment point."""
    return math.dist(attachment_world_m(tether, position_world_m, attitude_wxyz), tether.anchor_world_m)


def slack_m(tether: Tether, position_world_m: Vec3, attitude_wxyz: Quat) -> float:
    """Tether length left; 0 is taut, negative cannot be."""
    return tether.length_m - distance_m(tether, position_world_m, attitude_wxyz)


def allowed_m(tether: Tether) -> float:
    """Largest distance from the anchor that a plan may use."""
    return tether.length_m - tether.margin_m
