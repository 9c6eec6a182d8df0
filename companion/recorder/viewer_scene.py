"""Scene of a 3D viewer: geometry from the configuration, shapes of the vehicle and its room, the slack tether. No I/O.

World ENU, body FLU, metres. Each link of the arm has a frame at its joint, ``link1`` at the shoulder, which is parallel to the frame
before at joint angle 0; ``net`` is at the end of the last link.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
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

from companion.model.arm_skeleton import ArmSkeleton, logged_skeleton
from companion.model.rotors import RotorLayout, disk_radius_m, logged_layout
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

_DOWN = Quaternion(w=0.0, x=1.0, y=0.0, z=0.0)
_UPRIGHT = Quaternion(w=1.0, x=0.0, y=0.0, z=0.0)


@dataclass(frozen=True, slots=True)
class ArmShape:
    """The arm and its tool."""

    skeleton: ArmSkeleton
    net_radius_m: float | None
    """Radius of the net or of the rod's tip."""


@dataclass(frozen=True, slots=True)
class TetherShape:
    """The tether and the thresholds of its colours."""

    anchor_world_m: Vec3
    attachment_body_m: Vec3
    length_m: float
    margin_m: float
    taut_slack_m: float


@dataclass(frozen=True, slots=True)
class Machine:
    """Geometry of the vehicle; None where the configuration has no valid value."""

    arm: ArmShape | None
    tether: TetherShape | None
    radius_m: float | None
    """Horizontal reach including the rotor disks."""
    rotors: RotorLayout | None
    ground_clearance_m: float | None
    room_min_world_m: Vec3 | None
    room_max_world_m: Vec3 | None

    @property
    def floor_m(self) -> float | None:
        """Height of the room's floor."""
        return self.room_min_world_m[2] if self.room_min_world_m is not None else None


def machine_of(config: Any) -> Machine:
    """Return the geometry of an effective configuration (nested dicts); missing and invalid values become None."""
    skeleton, arm = logged_skeleton(_at(config, ("vehicle",))), None
    if skeleton is not None and skeleton.links_body_m:
        radius_m = _number(config, "vehicle", "tool", "net_radius_m")
        arm = ArmShape(skeleton, radius_m or _number(config, "vehicle", "tool", "tip_radius_m"))
    anchor = _numbers(config, 3, "vehicle", "tether", "anchor_world_m")
    length_m = _number(config, "vehicle", "tether", "length_m")
    tether = None
    if anchor is not None and length_m is not None and length_m > 0.0:
        tether = TetherShape(
            anchor_world_m=_vec3(anchor),
            attachment_body_m=_vec3(_numbers(config, 3, "vehicle", "tether", "attachment_body_m") or (0.0, 0.0, 0.0)),
            length_m=length_m,
            margin_m=_number(config, "vehicle", "tether", "margin_m") or 0.0,
            taut_slack_m=_number(config, "vehicle", "tether", "taut_slack_m") or 0.0,
        )
    spans = [_numbers(config, 2, "vehicle", "room", axis) for axis in ("x_m", "y_m", "z_m")]
    known = [span for span in spans if span is not None]
    whole = len(known) == len(spans)
    return Machine(
        arm=arm,
        tether=tether,
        radius_m=_number(config, "vehicle", "airframe", "radius_m"),
        rotors=_rotors(config),
        ground_clearance_m=_number(config, "vehicle", "airframe", "ground_clearance_m"),
        room_min_world_m=_vec3([span[0] for span in known]) if whole else None,
        room_max_world_m=_vec3([span[1] for span in known]) if whole else None,
    )


def _rotors(config: Any) -> RotorLayout | None:
    try:
        rotors = logged_layout(config["vehicle"]["airframe"])
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
    return rotors if all(map(math.isfinite, sum(rotors.positions_body_m, ()))) else None


def path_of(data: Any, most: int = 1000) -> tuple[Vec3, ...]:
    """Return the points of a path [[x, y, z], ...]; empty if the data is not a path."""
    if not isinstance(data, list) or len(data) > most:
        return ()
    points = [_numbers(point, 3) for point in data]
    return tuple(_vec3(point) for point in points if point is not None) if None not in points else ()


def static_entities(machine: Machine, path_world_m: tuple[Vec3, ...], timestamp: Timestamp) -> list[SceneEntity]:
    """Return the entities of constant shape, each locked to the frame that it moves with."""
    entities: list[SceneEntity] = []

    def add(name: str, frame: str, **shapes: Any) -> None:
        entities.append(SceneEntity(timestamp=timestamp, frame_id=frame, id=name, frame_locked=True, **shapes))

    if machine.room_min_world_m is not None and machine.room_max_world_m is not None:
        add("room", "world", lines=[_box(machine.room_min_world_m, machine.room_max_world_m)])
    if machine.tether is not None:
        add("anchor", "world", spheres=[_ball(machine.tether.anchor_world_m, 0.05, _DARK)])
    if len(path_world_m) > 1:
        add("planned path", "world", lines=[trail([point3(p) for p in path_world_m], _PLANNED)])
    if machine.radius_m is not None and machine.rotors is not None:
        add("vehicle", "body", **_airframe(machine.radius_m, machine.rotors, machine.ground_clearance_m))
    if machine.arm is not None:
        for number, link in enumerate(machine.arm.skeleton.links_body_m, start=1):
            add(f"link{number}", f"link{number}", cylinders=[_rod(link)])
        if machine.arm.net_radius_m is not None:
            add("net", "net", spheres=[_ball((0.0, 0.0, 0.0), machine.arm.net_radius_m, _NET)])
    return entities


def tether_colour(tether: TetherShape, slack_m: float, *, held: bool) -> Color:
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


def _airframe(radius_m: float, rotors: RotorLayout, clearance_m: float | None) -> dict[str, Any]:
    """Return hub, booms, rotor disks within the reach, and feet."""
    rotor_m = max(0.0, disk_radius_m(rotors, radius_m))
    offset_m = rotors.arm_m * math.sqrt(0.5) / 2.0
    corners = [(x * offset_m, y * offset_m) for x, y in ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))]
    flat = Vector3(x=2.0 * rotor_m, y=2.0 * rotor_m, z=0.01)
    disks = [
        CylinderPrimitive(
            pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=_UPRIGHT),
            size=flat,
            bottom_scale=1.0,
            top_scale=1.0,
            color=_ROTOR,
        )
        for x, y, z in rotors.positions_body_m
    ]
    hub = CubePrimitive(
        pose=Pose(position=Vector3(x=0.0, y=0.0, z=0.0), orientation=_UPRIGHT),
        size=Vector3(x=0.16, y=0.12, z=0.06),
        color=_DARK,
    )
    booms = [end for x, y, z in rotors.positions_body_m for end in ((0.0, 0.0, z - 0.01), (x, y, z - 0.01))]
    if clearance_m is not None:
        booms += [end for x, y in corners for end in ((x, y, 0.0), (x, y, -clearance_m))]
    nose = _segments([(0.08, 0.0, 0.0), (radius_m, 0.0, 0.0)], _NOSE, 4.0)
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
    """Return a cylinder from the frame's origin to a point of the frame."""
    x, y, z = end
    length_m = math.hypot(x, y, z)
    # The rotation that turns z to the direction of the end.
    w, qx, qy = length_m + z, -y, x
    norm = math.hypot(w, qx, qy)
    along = Quaternion(w=w / norm, x=qx / norm, y=qy / norm, z=0.0) if norm > 0.0 else _DOWN
    return CylinderPrimitive(
        pose=Pose(position=Vector3(x=x / 2, y=y / 2, z=z / 2), orientation=along),
        size=Vector3(x=0.025, y=0.025, z=length_m),
        bottom_scale=1.0,
        top_scale=1.0,
        color=_LINK,
    )


def _ball(centre: Vec3, radius_m: float, colour: Color) -> SpherePrimitive:
    wide = 2.0 * radius_m
    return SpherePrimitive(
        pose=Pose(position=Vector3(x=centre[0], y=centre[1], z=centre[2]), orientation=_UPRIGHT),
        size=Vector3(x=wide, y=wide, z=wide),
        color=colour,
    )


def _at(config: Any, path: tuple[str, ...]) -> Any:
    for key in path:
        if not isinstance(config, dict):
            return None
        config = config.get(key)
    return config


def _number(config: Any, *path: str) -> float | None:
    value = _at(config, path)
    return float(value) if type(value) in (int, float) and math.isfinite(value) else None


def _numbers(config: Any, size: int | None, *path: str) -> tuple[float, ...] | None:
    """Return the numbers of a list, or None if it is not a list of `size` finite numbers; None accepts any size."""
    values = _at(config, path)
    if not isinstance(values, (list, tuple)) or size not in (None, len(values)):
        return None
    numbers = [_number(value) for value in values]
    return tuple(n for n in numbers if n is not None) if None not in numbers else None


def _vec3(values: Any) -> Vec3:
    return (values[0], values[1], values[2])
