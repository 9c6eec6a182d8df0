"""Surfaces that a tool can push against: their true place, and their bodies in MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco

from companion.config.vehicle import Vehicle
from companion.model.algebra import cross, dot
from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_rotate
from companion.model.types import IDENTITY_QUAT, Mat3, Quat, Vec3
from companion.sitl_config.surfaces import Surface
from companion.sitl_config.world import World as WorldConfig

THICKNESS_M = 0.2
FRICTION_RATIO = 1e4
OPTIONS = f'cone="elliptic" impratio="{FRICTION_RATIO:g}"'
"""MuJoCo's options in a world with surfaces: a round friction cone, and friction that is stiffer than the normal direction."""


@dataclass(frozen=True, slots=True)
class Placed:
    """A surface where it truly is."""

    config: Surface
    point_m: Vec3
    axes: Mat3
    """Unit vectors along width, height and normal, world frame."""

    @classmethod
    def of(cls, config: Surface) -> Placed:
        """Return the surface with the errors of place and tilt."""
        normal = _unit(config.normal)
        up = (0.0, 0.0, 1.0) if abs(normal[2]) < 0.99 else (1.0, 0.0, 0.0)
        width = _unit(cross(up, normal))
        height = cross(normal, width)
        x, y, z = config.point_m
        error_m = config.place_error_m
        point = (x + error_m * normal[0], y + error_m * normal[1], z + error_m * normal[2])
        about_height, about_width = map(math.radians, config.tilt_error_deg)
        width, normal = _turned(width, normal, -about_height)
        normal, height = _turned(normal, height, -about_width)
        return cls(config, point, (width, height, normal))

    @property
    def normal(self) -> Vec3:
        """Unit vector to the free side, world frame."""
        return self.axes[2]

    def local_m(self, point_m: Vec3) -> Vec3:
        """Return a point of the world along width, height and normal, from the surface's centre."""
        away = (point_m[0] - self.point_m[0], point_m[1] - self.point_m[1], point_m[2] - self.point_m[2])
        return (dot(self.axes[0], away), dot(self.axes[1], away), dot(self.axes[2], away))


def tip_offset_m(vehicle: Vehicle) -> Vec3:
    """Return the tip in the frame of the force-torque sensor; the net's centre is at the sensor."""
    tool = vehicle.tool
    if tool is None:
        return (0.0, 0.0, 0.0)
    return quat_rotate(quat_conjugate(sensor_turn(vehicle)), (tool.beyond_sensor_m, 0.0, 0.0))


def sensor_turn(vehicle: Vehicle) -> Quat:
    """Return the attitude of the sensor frame in the tip's frame."""
    if vehicle.tool is None:
        return IDENTITY_QUAT
    roll, pitch, yaw = (math.radians(angle) for angle in vehicle.tool.sensor_rpy_deg)
    return quat_from_euler_zyx(roll, pitch, yaw)


def geoms(config: WorldConfig) -> str:
    """Return the MJCF of the surfaces: boxes that touch nothing but the tip."""
    text = ""
    for number, surface in enumerate(config.surfaces):
        placed = Placed.of(surface)
        width, height, normal = placed.axes
        x, y, z = (p - 0.5 * THICKNESS_M * n for p, n in zip(placed.point_m, normal, strict=True))
        size = f"{0.5 * surface.size_m[0]} {0.5 * surface.size_m[1]} {0.5 * THICKNESS_M}"
        text += (
            f'\n    <geom name="surface{number}" type="box" size="{size}" pos="{x} {y} {z}" contype="0" conaffinity="0" '
            f'xyaxes="{" ".join(map(str, (*width, *height)))}"/>'
        )
    return text


def pairs(config: WorldConfig, prefix: str) -> str:
    """Return the MJCF of the contacts between a machine's tip and the surfaces, whose stiffness `ToolContact` sets."""
    return "".join(
        f'\n    <pair name="{prefix}surface{number}" geom1="surface{number}" geom2="{prefix}tip" condim="3" '
        f'friction="{surface.friction} {surface.friction} 0 0 0"/>'
        for number, surface in enumerate(config.surfaces)
    )


class Surfaces:
    """The surfaces of a scene, which every tip can touch.

    Args:
        config: configuration of the world; `surfaces` is used.
        model: MuJoCo model with `geoms` and, for each machine, `pairs`.
    """

    def __init__(self, config: WorldConfig, model: mujoco.MjModel) -> None:
        self.placed = tuple(map(Placed.of, config.surfaces))
        self._model = model
        self._geoms = [model.geom(f"surface{number}").id for number in range(len(self.placed))]
        self.gone = [False] * len(self.placed)
        """Whether each surface has given way."""

    def set_friction(self, number: int, friction: float) -> None:
        """Change a surface's coefficient of friction."""
        model = self._model
        for pair in range(model.npair):
            if self._geoms[number] in (model.pair_geom1[pair], model.pair_geom2[pair]):
                model.pair_friction[pair, 0:2] = friction

    def give_way(self, number: int) -> None:
        """Remove a surface."""
        self.gone[number] = True
        self._model.geom_pos[self._geoms[number]] = (0.0, 0.0, -100.0)

    def touched(self, tip_m: Vec3) -> int:
        """Return the index of the surface in which the tip is deepest, of those that have not given way."""
        there = [number for number, gone in enumerate(self.gone) if not gone]
        return min(there or [0], key=lambda number: self.placed[number].local_m(tip_m)[2])

    def report(self) -> list[dict[str, Any]]:
        """Return the truth about each surface for `summary.json`."""
        return [
            {
                "name": placed.config.name,
                "point_m": placed.point_m,
                "normal": placed.normal,
                "stiffness_n_m": placed.config.stiffness_n_m,
                "friction": placed.config.friction,
                "gave_way": gone,
            }
            for placed, gone in zip(self.placed, self.gone, strict=True)
        ]


def _unit(v: Sequence[float]) -> Vec3:
    x, y, z = v
    length = math.hypot(x, y, z)
    return (x / length, y / length, z / length)


def _turned(a: Vec3, b: Vec3, angle_rad: float) -> tuple[Vec3, Vec3]:
    """Return two orthogonal unit vectors, turned in their plane from the first towards the second."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    (ax, ay, az), (bx, by, bz) = a, b
    return (c * ax + s * bx, c * ay + s * by, c * az + s * bz), (c * bx - s * ax, c * by - s * ay, c * bz - s * az)
