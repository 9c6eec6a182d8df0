"""Surfaces that the tool can push against: their true place, their contact in MuJoCo, and their distance from the rotors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from companion.config.vehicle import Vehicle
from companion.model.algebra import cross, dot
from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_rotate
from companion.model.types import IDENTITY_QUAT, Mat3, Quat, Vec3
from companion.sitl_config.surfaces import Surface
from companion.sitl_config.world import World as WorldConfig

if TYPE_CHECKING:
    from sitl.world.world import World

THICKNESS_M = 0.2
_FRICTION_RATIO = 1e4
OPTIONS = f'cone="elliptic" impratio="{_FRICTION_RATIO:g}"'
"""MuJoCo's options in a world with surfaces: a round friction cone, and friction that is stiffer than the normal direction."""
_CREEP_NS_M = 1e4
"""Friction force that is not enough to slide, divided by the speed with which the tip creeps. A large value lifts a sliding tip."""
APART_S = 0.05
"""Shortest time without contact after which a contact is a new touch."""
PRESSED_S, SAME_S = 2.5, 0.5
_DAMPED_KG = 1.0
"""Mass to which `damping_ratio` refers."""
_WATCH_STEPS = 5
"""Physics steps between two measurements of the rotors' distance, and between two samples of the contact force."""
_RIM_POINTS = 36
_NO_MASS_KG = 1e-4


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


def pairs(config: WorldConfig) -> str:
    """Return the MJCF of the contacts between tip and surfaces, whose stiffness `Surfaces` sets."""
    rows = "".join(
        f'\n    <pair name="surface{number}" geom1="surface{number}" geom2="tip" condim="3" '
        f'friction="{surface.friction} {surface.friction} 0 0 0"/>'
        for number, surface in enumerate(config.surfaces)
    )
    return f"<contact>{rows}\n  </contact>" if rows else ""


class Surfaces:
    """The surfaces of a world; call `step` after each physics step.

    A contact is a spring and a damper whose force MuJoCo evaluates at the end of the step (implicit Euler), which is stable at any
    stiffness. With f = -K (r + dt v + dt^2 a) - C (v + dt a) and MuJoCo's f = (-b v - k d r - a) / R follow R = 1 / (K dt^2 + C dt),
    k d = K R and b = (C + K dt) R. MuJoCo computes R = A (1 - d) / d from the impedance d and the inverse weight A of the tip's body.
    """

    def __init__(self, vehicle: Vehicle, config: WorldConfig, model: mujoco.MjModel) -> None:
        self.placed = tuple(map(Placed.of, config.surfaces))
        self._model = model
        self._geoms = [model.geom(f"surface{number}").id for number in range(len(self.placed))]
        tip = model.body("tip").id
        self._inverse_kg = float(model.body_invweight0[tip, 0])
        tool = vehicle.tool
        tip_n_m = tool.stiffness_n_m if tool is not None else None
        for number, surface in enumerate(config.surfaces):
            own = surface.stiffness_n_m
            self._set_contact(
                number, own if tip_n_m is None else own * tip_n_m / (own + tip_n_m), surface.damping_ratio
            )
        layout = vehicle.airframe.rotor_layout
        angles = np.linspace(0.0, 2.0 * math.pi, _RIM_POINTS, endpoint=False)
        rim = vehicle.airframe.disk_radius_m * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
        self._disks_body_m = (np.array(layout.positions_body_m)[:, None, :] + rim[None]).reshape(-1, 3)
        self.gone = [False] * len(self.placed)
        """Whether each surface has given way."""
        self.touches = 0
        """Number of touches of any surface by the tip."""
        self.touched_s: float | None = None
        """World time of the first touch; None before it."""
        self.pressed_s: float | None = None
        """World time at which the first touch that lasted for `PRESSED_S` began; None before. Interruptions of up to `SAME_S` count."""
        self._run_begin_s = -math.inf
        self.force_max_n = 0.0
        """Largest contact force."""
        self._forces_n: list[Vec3] = []
        self.rotor_distance_m = self.rotor_distance_min_m = math.inf
        """Smallest distance of a rotor's disk from a surface, now and so far."""
        self._last_touch_s = -math.inf
        self._step = 0

    @classmethod
    def of(cls, vehicle: Vehicle, config: WorldConfig, model: mujoco.MjModel) -> Surfaces | None:
        """Return the surfaces, or None if the world has none."""
        return cls(vehicle, config, model) if config.surfaces else None

    def _set_contact(self, number: int, stiffness_n_m: float, damping_ratio: float) -> None:
        model, dt_s, inverse_kg = self._model, float(self._model.opt.timestep), self._inverse_kg
        damping_ns_m = 2.0 * damping_ratio * math.sqrt(stiffness_n_m * _DAMPED_KG)
        r = 1.0 / (stiffness_n_m * dt_s * dt_s + damping_ns_m * dt_s)
        d = inverse_kg / (inverse_kg + r)
        model.pair_solimp[number] = (d, d, 1.0, 0.5, 1.0)
        model.pair_solref[number] = (-stiffness_n_m * r * d, -(damping_ns_m + stiffness_n_m * dt_s) * r * d)
        model.pair_solreffriction[number] = (-1.0, -min(_CREEP_NS_M * r / _FRICTION_RATIO, 1.0 / dt_s) * d)

    def set_friction(self, number: int, friction: float) -> None:
        """Change a surface's coefficient of friction."""
        self._model.pair_friction[number, 0:2] = friction

    def give_way(self, number: int) -> None:
        """Remove a surface."""
        self.gone[number] = True
        self._model.geom_pos[self._geoms[number]] = (0.0, 0.0, -100.0)

    def break_tool(self) -> None:
        """Remove the rod or brush: its mass, and its tip, which touches the surfaces."""
        model = self._model
        tip = model.geom("tip").id
        model.geom_pos[tip] = (0.0, 0.0, -100.0)
        model.geom_sameframe[tip] = (
            mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        )  # or MuJoCo takes the body's place for the geom's
        rod = model.body("net").id
        model.body_mass[rod] = _NO_MASS_KG
        model.body_inertia[rod] *= 0.0

    def step(self, world: World) -> None:
        """Watch the contact and the rotors."""
        tip_m, force_n = world.layout.contact(world.sensors())
        size_n = math.sqrt(dot(force_n, force_n))
        if size_n > 0.0:
            if world.t_s - self._last_touch_s > APART_S:
                self.touches += 1
                self.touched_s = world.t_s if self.touched_s is None else self.touched_s
                world.report("touched")
            if world.t_s - self._last_touch_s > SAME_S:
                self._run_begin_s = world.t_s
            if self.pressed_s is None and world.t_s - self._run_begin_s > PRESSED_S:
                self.pressed_s = self._run_begin_s
            self._last_touch_s = world.t_s
            self.force_max_n = max(self.force_max_n, size_n)
            number = self.touched(tip_m)
            surface = self.placed[number]
            if 0.0 < surface.config.gives_way_n < dot(force_n, surface.normal):
                self.give_way(number)
                world.report("gave_way")
            if self._step % _WATCH_STEPS == 0:
                self._forces_n.append(force_n)
        if self._step % _WATCH_STEPS == 0:
            self._watch_rotors(world)
        self._step += 1

    def touched(self, tip_m: Vec3) -> int:
        """Return the index of the surface in which the tip is deepest, of those that have not given way."""
        there = [number for number, gone in enumerate(self.gone) if not gone]
        return min(there or [0], key=lambda number: self.placed[number].local_m(tip_m)[2])

    def _watch_rotors(self, world: World) -> None:
        q = world.q
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, np.array(q[3:7]))
        points = self._disks_body_m @ rotation.reshape(3, 3).T + np.array(q[0:3])
        nearest_m = math.inf
        for placed, gone in zip(self.placed, self.gone, strict=True):
            if gone:
                continue
            local = (points - np.array(placed.point_m)) @ np.array(placed.axes).T
            width_m, height_m = placed.config.size_m
            half = np.array([0.5 * width_m, 0.5 * height_m, 0.5 * THICKNESS_M])
            beyond = np.abs(local + np.array([0.0, 0.0, 0.5 * THICKNESS_M])) - half
            outside_m = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=1))
            nearest_m = min(nearest_m, float((outside_m + np.minimum(beyond.max(axis=1), 0.0)).min()))
        self.rotor_distance_m = nearest_m
        self.rotor_distance_min_m = min(self.rotor_distance_min_m, nearest_m)
        if nearest_m <= 0.0:
            world.crash("rotor_touched")

    def _force_held_n(self) -> list[float] | None:
        """Return the median of the contact forces of more than half the largest one: without touch and release."""
        held = [force_n for force_n in self._forces_n if 2.0 * math.hypot(*force_n) > self.force_max_n]
        return np.median(held, axis=0).tolist() if held else None

    def report(self) -> dict[str, Any]:
        """Return the truth about the surfaces for `summary.json`."""
        distance_m = self.rotor_distance_min_m
        return {
            "touches": self.touches,
            "force_max_n": self.force_max_n,
            "force_held_world_n": self._force_held_n(),
            "rotor_distance_min_m": distance_m if math.isfinite(distance_m) else None,
            "surfaces": [
                {
                    "name": placed.config.name,
                    "point_m": placed.point_m,
                    "normal": placed.normal,
                    "stiffness_n_m": placed.config.stiffness_n_m,
                    "friction": placed.config.friction,
                    "gave_way": gone,
                }
                for placed, gone in zip(self.placed, self.gone, strict=True)
            ],
        }


def _unit(v: Sequence[float]) -> Vec3:
    x, y, z = v
    length = math.hypot(x, y, z)
    return (x / length, y / length, z / length)


def _turned(a: Vec3, b: Vec3, angle_rad: float) -> tuple[Vec3, Vec3]:
    """Return two orthogonal unit vectors, turned in their plane from the first towards the second."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    (ax, ay, az), (bx, by, bz) = a, b
    return (c * ax + s * bx, c * ay + s * by, c * az + s * bz), (c * bx - s * ax, c * by - s * ay, c * bz - s * az)
