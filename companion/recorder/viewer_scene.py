"""Scene of a 3D viewer: shapes of the vehicle and its room, the slack tether. No I/O.

World ENU, body FLU, metres. Each link of the arm has a frame at its joint, ``link1`` at the shoulder, which is parallel to the frame
before at joint angle 0; ``net`` is at the end of the last link.
"""

from __future__ import annotations

import math
from typing import Any

from foxglove.messages import (
    Color,
    CubePrimitive,
    CylinderPrimitive,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SpherePrimitive,
    Timestamp,
    Vector3,
)

from companion.model.logged_geometry import Geometry, TetherGeometry
from companion.model.types import Vec3

_GREY = Color(r=0.55, g=0.60, b=0.65, a=0.8)
_DARK = Color(r=0.20, g=0.24, b=0.28, a=1.0)
_ROTOR = Color(r=0.15, g=0.45, b=0.70, a=0.35)
_NOSE = Color(r=0.85, g=0.25, b=0.20, a=1.0)
_LINK = Color(r=0.90, g=0.55, b=0.15, a=1.0)
_NET = Color(r=0.95, g=0.85, b=0.45, a=0.45)
_PLANNED = Color(r=0.45, g=0.45, b=0.75, a=0.9)
SLACK = Color(r=0.18, g=0.62, b=0.42, a=1.0)
NEARLY_TAUT = Color(r=0.93, g=0.62, b=0.10, a=1.0)
TAUT = Color(r=0.85, g=0.15, b=0.15, a=1.0)
BALL = Color(r=0.76, g=0.15, b=0.36, a=1.0)
MEETING = Color(r=0.76, g=0.15, b=0.36, a=0.25)
BALL_M = 0.035
BAR = Color(r=0.75, g=0.78, b=0.82, a=1.0)
HANDLE_M = 0.02

_DOWN = Quaternion(w=0.0, x=1.0, y=0.0, z=0.0)
_UPRIGHT = Quaternion(w=1.0, x=0.0, y=0.0, z=0.0)


def path_of(data: Any) -> tuple[Vec3, ...]:
    """Return the points of a path [[x, y, z], ...]; empty if the data is not a path."""
    try:
        return tuple((float(x), float(y), float(z)) for x, y, z in data)
    except (TypeError, ValueError):
        return ()


def static_entities(
    geometry: Geometry | None, path_world_m: tuple[Vec3, ...], timestamp: Timestamp, prefix: str = ""
) -> list[SceneEntity]:
    """Return the entities of constant shape, each locked to the frame that it moves with.

    Args:
        prefix: beginning of the names of the vehicle's frames.
    """
    entities: list[SceneEntity] = []

    def add(name: str, frame: str, **shapes: Any) -> None:
        frame = frame if frame == "world" else prefix + frame
        entities.append(SceneEntity(timestamp=timestamp, frame_id=frame, id=name, frame_locked=True, **shapes))

    if len(path_world_m) > 1:
        add("planned path", "world", lines=[trail([point3(p) for p in path_world_m], _PLANNED)])
    if geometry is None:
        return entities
    add("room", "world", lines=[_box(geometry.room_min_world_m, geometry.room_max_world_m)])
    if geometry.tether is not None:
        add("anchor", "world", spheres=[sphere(geometry.tether.anchor_world_m, 0.05, _DARK)])
    add("vehicle", "body", **_airframe(geometry))
    for number, link in enumerate(geometry.arm.links_body_m, start=1):
        add(f"link{number}", f"link{number}", cylinders=[_rod(link)])
    if geometry.arm.links_body_m and (radius_m := geometry.net_radius_m or geometry.tip_radius_m):
        add("net", "net", spheres=[sphere((0.0, 0.0, 0.0), radius_m, _NET)])
    return entities


def tether_colour(tether: TetherGeometry, slack_m: float, *, held: bool) -> Color:
    """Return green for more slack than the margin, amber for less, red if taut or `held` (taut or snagged by the tether monitor)."""
    if held or slack_m <= tether.taut_slack_m:
        return TAUT
    return NEARLY_TAUT if slack_m < tether.margin_m else SLACK


def trail(points: list[Point3], colour: Color, thickness_px: float = 2.0) -> LinePrimitive:
    """Return a line through points whose thickness on the screen does not depend on the distance."""
    return LinePrimitive(
        type=LinePrimitiveLineType.LineStrip, thickness=thickness_px, scale_invariant=True, points=points, color=colour
    )


def point3(p: Vec3) -> Point3:
    """Return a point as a Foxglove message."""
    return Point3(x=p[0], y=p[1], z=p[2])


def _airframe(geometry: Geometry) -> dict[str, Any]:
    """Return hub, booms, rotor disks within the reach, and feet."""
    rotors, clearance_m = geometry.rotors, geometry.ground_clearance_m
    rotor_m = max(0.0, geometry.disk_radius_m)
    offset_m = rotors.arm_m * math.sqrt(0.5) / 2.0
    corners = [(x * offset_m, y * offset_m) for x, y in ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))]
    disks = [rotor_disk(centre, rotor_m, 0.01) for centre in rotors.positions_body_m]
    hub = CubePrimitive(pose=_pose((0.0, 0.0, 0.0)), size=Vector3(x=0.16, y=0.12, z=0.06), color=_DARK)
    booms = [end for x, y, z in rotors.positions_body_m for end in ((0.0, 0.0, z - 0.01), (x, y, z - 0.01))]
    booms += [end for x, y in corners for end in ((x, y, 0.0), (x, y, -clearance_m))]
    nose = _segments([(0.08, 0.0, 0.0), (geometry.radius_m, 0.0, 0.0)], _NOSE, 4.0)
    return {"cubes": [hub], "cylinders": disks, "lines": [_segments(booms, _DARK, 3.0), nose]}


def _box(low: Vec3, high: Vec3) -> LinePrimitive:
    x, y, z = zip(low, high, strict=True)
    along_x = [(x[i], y[j], z[k]) for j in (0, 1) for k in (0, 1) for i in (0, 1)]
    along_y = [(x[i], y[j], z[k]) for i in (0, 1) for k in (0, 1) for j in (0, 1)]
    along_z = [(x[i], y[j], z[k]) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    return _segments([*along_x, *along_y, *along_z], _GREY, 1.0)


def _segments(ends: list[Vec3], colour: Color, thickness_px: float) -> LinePrimitive:
    return LinePrimitive(
        type=LinePrimitiveLineType.LineList,
        thickness=thickness_px,
        scale_invariant=True,
        points=[point3(end) for end in ends],
        color=colour,
    )


def _rod(end: Vec3) -> CylinderPrimitive:
    x, y, z = end
    length_m = math.hypot(x, y, z)
    # The rotation that turns z to the direction of the end.
    w, qx, qy = length_m + z, -y, x
    norm = math.hypot(w, qx, qy)
    along = Quaternion(w=w / norm, x=qx / norm, y=qy / norm, z=0.0) if norm > 0.0 else _DOWN
    return _cylinder(_pose((x / 2, y / 2, z / 2), along), Vector3(x=0.025, y=0.025, z=length_m), _LINK)


def rotor_disk(centre: Vec3, radius_m: float, height_m: float) -> CylinderPrimitive:
    """Return a flat disk that covers a rotor, or all rotors of a vehicle."""
    return _cylinder(_pose(centre), Vector3(x=2.0 * radius_m, y=2.0 * radius_m, z=height_m), _ROTOR)


def sphere(centre: Vec3, radius_m: float, colour: Color) -> SpherePrimitive:
    """Return a sphere."""
    wide = 2.0 * radius_m
    return SpherePrimitive(pose=_pose(centre), size=Vector3(x=wide, y=wide, z=wide), color=colour)


def _pose(position: Vec3, attitude: Quaternion = _UPRIGHT) -> Pose:
    x, y, z = position
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=attitude)


def _cylinder(pose: Pose, size: Vector3, colour: Color) -> CylinderPrimitive:
    return CylinderPrimitive(pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=colour)
