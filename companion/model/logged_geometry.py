"""Geometry of a vehicle and its room in a logged configuration, for drawing. World ENU, body FLU, metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from companion.model.arm_skeleton import NO_ARM, ArmSkeleton, logged_skeleton
from companion.model.rotors import RotorLayout, disk_radius_m, logged_layout
from companion.model.types import Vec3


@dataclass(frozen=True, slots=True)
class TetherGeometry:
    """The tether and the thresholds of its colours."""

    anchor_world_m: Vec3
    attachment_body_m: Vec3
    length_m: float
    margin_m: float
    taut_slack_m: float


@dataclass(frozen=True, slots=True)
class Geometry:
    """Geometry of a vehicle and its room."""

    rotors: RotorLayout
    radius_m: float
    """Horizontal reach including the rotor disks."""
    ground_clearance_m: float
    arm: ArmSkeleton
    net_radius_m: float
    """0 without a net."""
    tip_radius_m: float
    """0 without a rod."""
    tether: TetherGeometry | None
    room_min_world_m: Vec3
    room_max_world_m: Vec3

    @property
    def disk_radius_m(self) -> float:
        """Radius of the rotor disks."""
        return disk_radius_m(self.rotors, self.radius_m)


def logged_geometry(vehicle: Any) -> Geometry:
    """Return the geometry in the section `vehicle` of a logged configuration.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the section is not that of a vehicle file.
    """
    airframe, tool, tether, room = (vehicle[key] for key in ("airframe", "tool", "tether", "room"))
    low, high = (_vec3([room[axis][end] for axis in ("x_m", "y_m", "z_m")]) for end in (0, 1))
    return Geometry(
        rotors=logged_layout(airframe),
        radius_m=airframe["radius_m"],
        ground_clearance_m=airframe["ground_clearance_m"],
        arm=logged_skeleton(vehicle) or NO_ARM,
        net_radius_m=(tool or {}).get("net_radius_m") or 0.0,
        tip_radius_m=(tool or {}).get("tip_radius_m") or 0.0,
        tether=None if tether is None else _tether(tether),
        room_min_world_m=low,
        room_max_world_m=high,
    )


def _tether(section: dict[str, Any]) -> TetherGeometry:
    anchor, attachment = _vec3(section["anchor_world_m"]), _vec3(section["attachment_body_m"])
    margin_m, taut_slack_m = section.get("margin_m", 0.0), section.get("taut_slack_m", 0.0)
    return TetherGeometry(anchor, attachment, section["length_m"], margin_m, taut_slack_m)


def _vec3(values: Any) -> Vec3:
    x, y, z = map(float, values)
    return (x, y, z)


def logged_bar_length_m(config: Any) -> float | None:
    """Return the distance between the handles of the bar that the mission of an effective configuration grips, or None."""
    try:
        return next((float(p["bar"]["length_m"]) for p in config["mission"]["phases"] if p["type"] == "grip"), None)
    except (KeyError, TypeError, ValueError):
        return None
