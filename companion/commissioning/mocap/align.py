"""Finds from a hand test what is wrong with the axes of motion capture: the up axis, the yaw of the rigid body, the yaw of the world,
or a mirrored stream. Pure functions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from companion.config.base import Location
from companion.config.document import Data
from companion.model.check_row import Row
from companion.model.frames import wrap_rad
from companion.model.types import Vec3
from companion.preflight.axes import IDENTITY, AxisMap
from companion.preflight.checks import Check
from companion.preflight.hand_test.evaluation import (
    LEVEL_MAX_DEG,
    YAW_MAX_DEG,
    best_axes,
    gravity_off_deg,
    proposed_up_axis,
    yaw_offset_deg,
)
from companion.preflight.hand_test.steps import HandResult

WORLD_YAW = Check("align.world_yaw", "world's yaw", why="the room, the tether and the mission are given in these axes")
_UP: Final[Vec3] = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Alignment:
    """Axes of the set-up, found from the three motions."""

    axes: AxisMap
    """The true directions of the rigid body's streamed axes."""
    mirrored: bool
    up_axis: str
    """Proposed `devices.mocap.up_axis`."""
    body_yaw_deg: float
    """Error of the body's streamed yaw."""
    world_yaw_deg: float | None
    """Angle from the mission's start yaw to forward, counter-clockwise; None until the axes are right."""


def alignment(result: HandResult, up_axis: str, start_yaw_rad: float) -> Alignment:
    """Find the axes from a finished test.

    Args:
        up_axis: `devices.mocap.up_axis` during the test.
        start_yaw_rad: true yaw of the nose during the forward motion: the mission's start yaw.
    """
    axes = best_axes(result)
    level = gravity_off_deg(result) <= LEVEL_MAX_DEG
    upright = axes.determinant > 0 and axes.vector(_UP) == _UP
    world_yaw_deg: float | None = None
    if upright:
        x, y, _ = result.forward.seen_world_m
        world_yaw_deg = math.degrees(wrap_rad(math.atan2(y, x) - start_yaw_rad))
    return Alignment(
        axes=axes,
        mirrored=axes.determinant < 0,
        up_axis=proposed_up_axis(level, axes, up_axis),
        body_yaw_deg=yaw_offset_deg(result.forward),
        world_yaw_deg=world_yaw_deg,
    )


def changes(found: Alignment, up_axis: str) -> dict[Location, Data]:
    """Return the values to change in the vehicle file; everything else is set in Motive."""
    return {("devices", "mocap", "up_axis"): found.up_axis} if found.up_axis != up_axis else {}


def world_row(found: Alignment, tolerance_deg: float) -> Row | None:
    """Return the row on the world's yaw, or None if the axes must be corrected first."""
    yaw_deg = found.world_yaw_deg
    if yaw_deg is None:
        return None
    limit_deg = max(tolerance_deg, YAW_MAX_DEG)  # a hand-held direction is not exact to the degree
    read = f"forward is {yaw_deg:+.0f} deg off the mission's start yaw"
    fix = (
        f"if the vehicle was placed at the mission's start.yaw_deg, Motive's ground plane is turned by {yaw_deg:+.0f} deg: set "
        "it again with the calibration square's x along the room's x; if not, place the vehicle at that yaw and repeat"
    )
    return WORLD_YAW.row(abs(yaw_deg) <= limit_deg, read, f"within {limit_deg:g} deg", fix)


def as_json(found: Alignment) -> dict[str, Any]:
    """Return the alignment's part of the JSON document; degrees."""
    return {
        "axes": list(found.axes.names),
        "mirrored": found.mirrored,
        "up_axis": found.up_axis,
        "body_yaw_deg": found.body_yaw_deg,
        "world_yaw_deg": found.world_yaw_deg,
        "right": found.axes == IDENTITY and abs(found.body_yaw_deg) <= YAW_MAX_DEG,
    }
