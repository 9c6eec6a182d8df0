"""The plane through touched points: the place and the normal of a surface. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from companion.config.vehicle import Vehicle
from companion.control.manipulator import Manipulator
from companion.model.algebra import dot
from companion.model.contact import FoundSurface
from companion.model.types import Joints, Vec3

TILT_MAX_RAD = math.radians(30.0)
"""Largest angle between a surface's normal and the direction of the approach. Beyond it a touch is taken for a false one."""
LIMIT_MARGIN_DEG = 5.0
"""Distance of the turned tool from the limits of its joint."""
OUTLIER: Final = 5.0
OUTLIER_POINTS_MIN: Final = 6
ERROR_MIN_M: Final = 0.001
"""Error that a touched point has at least."""
_STEP_RAD = 0.001
_LEVEL = 0.5
"""Horizontal part of a direction from which it has an azimuth to which the vehicle can turn."""


def axes(direction_world: Vec3) -> tuple[Vec3, Vec3]:
    """Return the unit vectors right and up of a surface, world frame, as seen from a vehicle that looks in this direction.

    Up is vertical as far as the surface allows; of a floor it is the world's x.
    """
    nx, ny, nz = direction_world
    level = math.hypot(nx, ny)
    right = (ny / level, -nx / level, 0.0) if level > 1e-6 else (0.0, -1.0, 0.0)
    rx, ry, rz = right
    return right, (ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx)


def plane(tips_m: Sequence[Vec3], direction_world: Vec3, radius_m: float) -> FoundSurface | None:
    """Return the plane through the touched points by least squares, or None if it is steeper than `TILT_MAX_RAD`.

    A gust can feign a touch in front of the surface. Of six points or more, one is left out if it lies in front of
    the plane through the others by more than `OUTLIER` standard errors.

    Args:
        tips_m: positions of the tip's centre, three or more that do not lie on a line, world frame.
        direction_world: direction of the approaches, along which the errors are taken.
        radius_m: radius of the tip.
    """
    right, up = axes(direction_world)
    points = [(dot(tip, right), dot(tip, up), dot(tip, direction_world)) for tip in tips_m]
    fit = _fit(points)
    while len(points) >= OUTLIER_POINTS_MIN:
        share, k = max((_outlying(points, k), k) for k in range(len(points)))
        if share <= OUTLIER:
            break
        del points[k]
        fit = _fit(points)
    if fit is None:
        return None
    r, u, d, b, c = fit
    cx, cy, cz = (r * e + u * f + d * g for e, f, g in zip(right, up, direction_world, strict=True))
    length = math.sqrt(1.0 + b * b + c * c)
    if length * math.cos(TILT_MAX_RAD) > 1.0:
        return None
    into = [(n - b * r - c * u) / length for n, r, u in zip(direction_world, right, up, strict=True)]
    nx, ny, nz = into
    return FoundSurface(
        point_world_m=(cx + radius_m * nx, cy + radius_m * ny, cz + radius_m * nz), normal_world=(-nx, -ny, -nz)
    )


def _fit(points: Sequence[Vec3]) -> tuple[float, float, float, float, float] | None:
    """Return the centre (r, u, d) of the points and the slopes b and c of the plane d + b r + c u through it by least squares; None if
    the points lie on a line.
    """
    count = len(points)
    cr, cu, cd = (sum([point[k] for point in points], 0.0) / count for k in range(3))
    rr = ru = uu = rd = ud = 0.0
    for r, u, d in points:
        r, u, d = r - cr, u - cu, d - cd
        rr, ru, uu, rd, ud = rr + r * r, ru + r * u, uu + u * u, rd + r * d, ud + u * d
    scale = rr * uu - ru * ru
    if scale <= 0.0:
        return None
    return cr, cu, cd, (uu * rd - ru * ud) / scale, (rr * ud - ru * rd) / scale


def _outlying(points: Sequence[Vec3], k: int) -> float:
    """Return how far the point `k` lies in front of the plane through the others, in standard errors; 0 if those lie on a line."""
    others = [point for index, point in enumerate(points) if index != k]
    fit = _fit(others)
    if fit is None:
        return 0.0
    squares = sum([_behind_m(point, fit) ** 2 for point in others], 0.0)
    error_m = max(ERROR_MIN_M, math.sqrt(squares / (len(others) - 3)))
    return -_behind_m(points[k], fit) / error_m


def _behind_m(point: Vec3, fit: tuple[float, float, float, float, float]) -> float:
    r, u, d, b, c = fit
    return point[2] - d - b * (point[0] - r) - c * (point[1] - u)


def turn_to(surface: FoundSurface, yaw_rad: float) -> float:
    """Return the yaw at which the vehicle looks at the surface; the present one if the surface is too nearly horizontal."""
    x, y, _ = surface.normal_world
    return math.atan2(-y, -x) if math.hypot(x, y) > _LEVEL else yaw_rad


def tool_turn_rad(
    vehicle: Vehicle, manipulator: Manipulator, arm_rad: Joints, direction_world: Vec3, into_world: Vec3
) -> float:
    """Return the turn of the last joint by which the tool keeps its angle to the force when that acts along `into_world` instead of
    `direction_world`; 0 if this joint cannot raise and lower the tool.

    A force across the tool is a torque at the sensor, which reads part of it as a force (cross-talk).
    """
    step = (*arm_rad[:-1], arm_rad[-1] + _STEP_RAD)
    slope = (_elevation_rad(manipulator, step) - _elevation_rad(manipulator, arm_rad)) / _STEP_RAD
    if abs(slope) < _LEVEL:
        return 0.0
    turn_rad = (math.asin(into_world[2]) - math.asin(direction_world[2])) / slope
    low, high = vehicle.arm.joints[-1].angle_deg
    least, most = math.radians(low + LIMIT_MARGIN_DEG), math.radians(high - LIMIT_MARGIN_DEG)
    return min(most, max(least, arm_rad[-1] + turn_rad)) - arm_rad[-1]


def _elevation_rad(manipulator: Manipulator, arm_rad: Joints) -> float:
    """Return the angle of the line from the last joint to the tip above the body's horizontal plane."""
    x, y, z = (
        tip - joint
        for tip, joint in zip(manipulator.net_body_m(arm_rad), manipulator.joints_body_m(arm_rad)[-1], strict=True)
    )
    return math.atan2(z, math.hypot(x, y))
