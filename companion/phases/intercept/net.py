"""Where the net of the waiting vehicle is. Pure."""

from __future__ import annotations

import math
from typing import Final

from companion.control.manipulator import Manipulator
from companion.mission.air import Air
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.types import Reference, Vec3

BESIDE_S: Final = 0.5
"""Time constant of the mean distance of the net from its reference, which is what the plan of a meeting adds to it."""
BESIDE_MAX_M: Final = 0.1


def net_m(manipulator: Manipulator, reference: Reference) -> Vec3:
    """Return the net's centre relative to the body's origin of the level vehicle, world frame."""
    return quat_rotate(quat_from_euler_zyx(0.0, 0.0, reference.yaw_rad), manipulator.net_body_m(reference.arm_rad))


def opening(manipulator: Manipulator, reference: Reference) -> Vec3:
    """Return the unit vector out of the net's opening of the level vehicle, world frame: across the last link, upwards if that points
    forwards.
    """
    (x, y, z), (jx, jy, jz) = (
        manipulator.net_body_m(reference.arm_rad),
        manipulator.joints_body_m(reference.arm_rad)[-1],
    )
    lx, ly, lz = x - jx, y - jy, z - jz
    length = math.sqrt(lx * lx + ly * ly + lz * lz)
    lx, ly, lz = lx / length, ly / length, lz / length
    up = math.copysign(math.sqrt(max(1e-9, 1.0 - lz * lz)), lx)
    return quat_rotate(quat_from_euler_zyx(0.0, 0.0, reference.yaw_rad), (-lz * lx / up, -lz * ly / up, up))


def beside_m(air: Air, home: Reference, before_m: Vec3) -> Vec3:
    """Return the mean position of the net minus that of its reference, after one more tick at rest."""
    tip = air.tip_world_m()
    if tip is None:
        return before_m
    (px, py, pz), (x, y, z), share = home.position_world_m, net_m(air.manipulator, home), air.dt_s / BESIDE_S
    found = [
        before + share * (at - p - n - before)
        for before, at, p, n in zip(before_m, tip, (px, py, pz), (x, y, z), strict=True)
    ]
    bx, by, bz = (max(-BESIDE_MAX_M, min(BESIDE_MAX_M, value)) for value in found)
    return (bx, by, bz)
