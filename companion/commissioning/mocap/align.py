"""From a finished hand test to the one setting that is wrong: up axis, the rigid body's yaw, the world's yaw, a mirrored stream. Pure.

Measured by `companion.preflight.hand_test.run`, judged axis by axis by `companion.preflight.hand_test.evaluation`; this says which key
or which setting of Motive explains all of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from companion.config.base import Location
from companion.config.document import Data
from companion.model.frames import quat_rotate, wrap_rad
from companion.model.rows import Row
from companion.model.types import Vec3
from companion.preflight.axes import IDENTITY, Y_UP, AxisMap
from companion.preflight.checks import Check
from companion.preflight.hand_test.evaluation import LEVEL_MAX_DEG, YAW_MAX_DEG, best_axes, yaw_offset_deg
from companion.preflight.hand_test.motion import angle_rad
from companion.preflight.hand_test.run import HandResult

WORLD_YAW = Check(
    "align.world_yaw",
    "world's yaw",
    "the way forward lies in the stream as the mission's `start.yaw_deg` says",
    "room, tether and course are counted in these axes",
)
_UP: Final[Vec3] = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Alignment:
    """What the three moves say about the set-up."""

    axes: AxisMap
    """What the streamed axes of the rigid body truly are."""
    mirrored: bool
    level: bool
    """The stream's attitude turns gravity upright: a whole stream in other axes, or none."""
    up_axis: str
    """What devices.mocap.up_axis should be."""
    body_yaw_deg: float
    """By how much the body's streamed yaw is too large."""
    world_yaw_deg: float | None
    """By how much the way forward is turned against the mission's start, counter-clockwise; None: the axes must be put right first."""


def alignment(result: HandResult, up_axis: str, start_yaw_rad: float) -> Alignment:
    """Judge a finished test.

    Args:
        result: of the test.
        up_axis: devices.mocap.up_axis as it was.
        start_yaw_rad: where the nose truly pointed when it was moved forward: the mission's start.
    """
    axes = best_axes(result)
    level = angle_rad(quat_rotate(result.stood.attitude, result.stood.force_m_s2), _UP) <= math.radians(LEVEL_MAX_DEG)
    proposed = up_axis
    if level and axes == Y_UP and up_axis == "z":
        proposed = "y"
    elif level and axes == Y_UP.inverse and up_axis == "y":
        proposed = "z"
    upright = axes.determinant > 0 and axes.vector(_UP) == _UP
    world_yaw_deg: float | None = None
    if upright:
        x, y, _ = result.forward.seen_world_m
        world_yaw_deg = math.degrees(wrap_rad(math.atan2(y, x) - start_yaw_rad))
    return Alignment(axes, axes.determinant < 0, level, proposed, yaw_offset_deg(result.forward), world_yaw_deg)


def changes(found: Alignment, up_axis: str) -> dict[Location, Data]:
    """Of the vehicle file; everything else is set in Motive."""
    return {("devices", "mocap", "up_axis"): found.up_axis} if found.up_axis != up_axis else {}


def world_row(found: Alignment, tolerance_deg: float) -> Row | None:
    """None: it cannot be told before the axes are right."""
    yaw_deg = found.world_yaw_deg
    if yaw_deg is None:
        return None
    # What a hand calls forward is not exact to the degree.
    limit_deg = max(tolerance_deg, YAW_MAX_DEG)
    read, wanted = f"forward lies {yaw_deg:+.0f} deg from the mission's start yaw", f"within {limit_deg:g} deg"
    if abs(yaw_deg) <= limit_deg:
        return WORLD_YAW.good(read, wanted)
    fix = (
        f"if the machine stood as the mission's start.yaw_deg says, Motive's ground plane is turned by {yaw_deg:+.0f} deg: set it anew "
        "with the calibration square's x along the room's x; if not, put the machine so, and do it again"
    )
    return WORLD_YAW.bad(read, wanted, fix)


def as_json(found: Alignment) -> dict[str, Any]:
    """For scripts; degrees."""
    return {
        "axes": list(found.axes.names),
        "mirrored": found.mirrored,
        "up_axis": found.up_axis,
        "body_yaw_deg": found.body_yaw_deg,
        "world_yaw_deg": found.world_yaw_deg,
        "right": found.axes == IDENTITY and abs(found.body_yaw_deg) <= YAW_MAX_DEG,
    }
