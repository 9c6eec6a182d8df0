"""The vehicle in its room, projected to 2D shapes: quadrotor, arm, net, tether and payload.

World ENU, body FLU, metres. A frame is a list of shapes in pixels, the farthest first; `companion.analysis.animation` draws them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from companion.analysis.arm_skeleton import pose
from companion.analysis.log import Array
from companion.model.frames import quat_rotate
from companion.model.hanging_line import hanging_line_m
from companion.model.logged_geometry import TetherGeometry, logged_geometry
from companion.model.types import Joints, Quat, Vec2, Vec3

FRAME, LEG, ROTOR, FRONT, LINK, NET, BALL, TETHER = (
    "#2d3a45", "#a3afba", "#7d8c99", "#1f6fb4", "#e07b22", "#8f7a1e", "#c2255c", "#2e9d6b"
)  # fmt: skip
FLOOR, GRID, WALL = "#eef2f5", "#d3dbe2", "#c3ccd4"
BALL_RADIUS_M = 0.035
VIEW_M = 1.6
_NEAR_M = 0.1
_X, _Y, _Z = np.eye(3)


@dataclass(frozen=True, slots=True)
class Shape:
    """A line, an area or a text in pixels (x right, y down). A line of one point is a disc."""

    points: Array
    """Shape (N, 2)."""
    colour: str
    width: float = 0.0
    """Width of the line or size of the text; 0 for a filled area."""
    alpha: float = 1.0
    text: str = ""
    align: str = "center"
    """Horizontal alignment of a text at its point: left, center or right."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of all moving parts at one time."""

    position_world_m: Vec3
    attitude_wxyz: Quat
    arm_rad: Joints
    ball_world_m: tuple[Vec3, ...]
    """Centre of the flying payload and its earlier positions, newest first; empty before the throw and after the catch."""
    caught: bool
    meeting_world_m: Vec3 | None = None
    """Where the net is to meet it; None if no meeting is planned."""


class Camera:
    """Pinhole camera that looks at a point."""

    def __init__(
        self,
        target_m: Array,
        yaw_rad: float,
        pitch_rad: float,
        distance_m: float,
        size_px: Vec2,
        view_m: float = VIEW_M,
    ) -> None:
        """Place the camera.

        Args:
            target_m: world point in the middle of the frame.
            yaw_rad: horizontal direction of view, measured from world x.
            pitch_rad: angle of the view below the horizon.
            size_px: width and height of the frame.
            view_m: what its height covers at the target.
        """
        cy, sy, cp, sp = math.cos(yaw_rad), math.sin(yaw_rad), math.cos(pitch_rad), math.sin(pitch_rad)
        self._axes = np.array([[sy, -cy, 0.0], [-sp * cy, -sp * sy, -cp], [cp * cy, cp * sy, -sp]])
        self._eye = target_m - distance_m * self._axes[2]
        self._middle = np.array(size_px) / 2
        self._focal_px = size_px[1] * distance_m / view_m

    def depth_m(self, point: Array) -> float:
        """Return the distance of a point from the eye along the direction of view."""
        return float(self._axes[2] @ (point - self._eye))

    def scale(self, point: Array) -> float:
        """Return pixels per metre at a point."""
        return self._focal_px / max(self.depth_m(point), _NEAR_M)

    def pixels(self, points: Array, *, closed: bool = False) -> Array:
        """Return the pixel coordinates of world points, shape (N, 2). The part of a line or area behind the eye is cut off."""
        seen = (points - self._eye) @ self._axes.T
        if (seen[:, 2] < _NEAR_M).any():
            seen = _cut(seen, closed=closed)
        out: Array = self._middle + seen[:, :2] * (self._focal_px / seen[:, 2:])
        return out


def _cut(seen: Array, *, closed: bool) -> Array:
    rows = []
    for k in range(len(seen)):
        here, last = seen[k], seen[k - 1]
        if (k or closed) and (here[2] < _NEAR_M) != (last[2] < _NEAR_M):
            rows.append(last + (here - last) * (_NEAR_M - last[2]) / (here[2] - last[2]))
        if here[2] >= _NEAR_M:
            rows.append(here)
    return np.array(rows).reshape(-1, 3)


class Scene:
    """Geometry of a vehicle and its room."""

    def __init__(self, vehicle: dict[str, Any]) -> None:
        """Read the geometry from the `vehicle` section of an effective configuration.

        Raises:
            KeyError, ValueError: the section, which `FlightLog.read` has checked, lacks a value or describes no vehicle.
        """
        found = logged_geometry(vehicle)
        self._rotors_m = found.rotors.positions_body_m
        self._hub_m: float = found.rotors.arm_m * math.sqrt(0.5)
        self._disk_m, self._foot_m = found.disk_radius_m, found.ground_clearance_m
        self._arm, self._net_radius_m, self._tether_line = found.arm, found.net_radius_m, found.tether
        self._low, self._high = np.array(found.room_min_world_m), np.array(found.room_max_world_m)

    @property
    def standing_height_m(self) -> float:
        """Height of the body's origin while the vehicle rests on the ground, world z."""
        return float(self._low[2] + self._foot_m)

    @property
    def joint_count(self) -> int:
        """Number of the arm's joints."""
        return len(self._arm.joint_axes)

    def net_world_m(self, pose: Pose) -> Array:
        """Return the centre of the net, world frame, m."""
        return self._world(pose, self._arm_body_m(pose.arm_rad)[-1])

    def shapes(self, camera: Camera, pose: Pose, *, room: bool = True) -> list[Shape]:
        """Return the shapes of one frame, the farthest first, with or without the room."""
        shapes = self._room(camera) if room else []
        centre = np.array(pose.position_world_m)
        shapes.append(self._shadow(camera, centre, 0.8 * (self._hub_m + self._disk_m), 0.16))
        parts = self._machine(camera, pose)
        if self._tether_line is not None:
            parts.append(self._tether(camera, pose, self._tether_line))
        if pose.meeting_world_m is not None:
            at, net_m = np.array(pose.meeting_world_m), self._net_radius_m or BALL_RADIUS_M
            for u, v in ((_X, _Y), (_X, _Z), (_Y, _Z)):
                shapes.append(Shape(camera.pixels(_circle(at, u, v, net_m), closed=True), BALL, 0.0, 0.12))
        for k, ball in enumerate(pose.ball_world_m):
            if k == 0:
                shapes.append(self._shadow(camera, np.array(ball), BALL_RADIUS_M, 0.3))
                parts.append(_ball(camera, np.array(ball)))
            else:
                trace = Shape(camera.pixels(np.array([ball])), BALL, 0.03 * camera.scale(np.array(ball)), 0.55 / k**0.5)
                shapes.append(trace)
        for _, part in sorted(parts, key=lambda part: -part[0]):
            shapes += part
        return shapes

    def _world(self, pose: Pose, body: Array) -> Array:
        return np.array(pose.position_world_m) + body @ _rotation(pose.attitude_wxyz).T

    def _arm_body_m(self, arm_rad: Joints) -> Array:
        """Return the positions of all joints and of the centre of the net, body frame, m, shape (joints + 1, 3)."""
        points: Array = pose(self._arm, np.array([arm_rad], dtype=np.float64))[0][0]
        return points

    def _room(self, camera: Camera) -> list[Shape]:
        (x0, y0, z0), (x1, y1, z1) = self._low, self._high
        floor = np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]])
        shapes = [Shape(camera.pixels(floor, closed=True), FLOOR)]
        step = 0.5 if max(x1 - x0, y1 - y0) < 10 else 1.0
        lines = [[(x, y0, z0), (x, y1, z0)] for x in np.arange(math.ceil(x0 / step) * step, x1, step)]
        lines += [[(x0, y, z0), (x1, y, z0)] for y in np.arange(math.ceil(y0 / step) * step, y1, step)]
        shapes += [Shape(camera.pixels(np.array(line)), GRID, 1.0) for line in lines]
        top = floor + np.array([0.0, 0.0, z1 - z0])
        edges = [*zip(floor, np.roll(floor, 1, 0), strict=True), *zip(top, np.roll(top, 1, 0), strict=True)]
        edges += zip(floor, top, strict=True)
        return shapes + [Shape(camera.pixels(np.array(edge)), WALL, 1.0) for edge in edges]

    def _shadow(self, camera: Camera, point: Array, radius_m: float, alpha: float) -> Shape:
        below = np.array([point[0], point[1], self._low[2]])
        return Shape(camera.pixels(_circle(below, _X, _Y, radius_m), closed=True), FRAME, 0.0, alpha)

    def _tether(self, camera: Camera, pose: Pose, tether: TetherGeometry) -> tuple[float, list[Shape]]:
        end = self._world(pose, np.array(tether.attachment_body_m))
        x, y, z = end.tolist()
        line = np.array(hanging_line_m(tether.anchor_world_m, (x, y, z), tether.length_m, float(self._low[2])))
        return camera.depth_m(end) + 0.2, [
            Shape(camera.pixels(line), TETHER, 2.0),
            Shape(camera.pixels(line[:1]), FRAME, 9.0),
        ]

    def _machine(self, camera: Camera, pose: Pose) -> list[tuple[float, list[Shape]]]:
        """Return the parts of the vehicle, each with its distance from the eye."""

        def world(*body: Any) -> Array:
            return self._world(pose, np.array(body, dtype=np.float64))

        x_axis, y_axis, _ = (_rotation(pose.attitude_wxyz)[:, k] for k in range(3))
        pixels = camera.pixels
        scale = camera.scale(np.array(pose.position_world_m))
        parts: list[tuple[float, list[Shape]]] = []
        for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            foot = world((0.55 * x * self._hub_m, 0.75 * y * self._hub_m, -self._foot_m))
            leg = pixels(np.vstack([world((0.3 * x * self._hub_m, 0.3 * y * self._hub_m, 0)), foot]))
            toe = pixels(np.vstack([foot, world((0.95 * x * self._hub_m, 0.75 * y * self._hub_m, -self._foot_m))]))
            heel = pixels(np.vstack([foot, world((0, 0.75 * y * self._hub_m, -self._foot_m))]))
            parts.append((camera.depth_m(foot[0]), [Shape(line, LEG, 0.012 * scale) for line in (leg, toe, heel)]))
        for rotor_x, rotor_y, z in self._rotors_m:
            hub = world((rotor_x, rotor_y, z + 0.02))
            disk = pixels(_circle(hub[0], x_axis, y_axis, self._disk_m), closed=True)
            colour = FRONT if rotor_x > 1e-9 else ROTOR
            boom = pixels(np.vstack([world((0, 0, z - 0.01)), world((rotor_x, rotor_y, z - 0.01)), hub]))
            parts.append(
                (
                    camera.depth_m(hub[0]),
                    [
                        Shape(boom, FRAME, 0.022 * scale),
                        Shape(disk, colour, 0.0, 0.45),
                        Shape(pixels(hub), FRAME, 0.035 * scale),
                    ],
                )
            )
        parts.append((camera.depth_m(world((0, 0, 0))[0]), self._body(camera, pose)))
        *joints, net = self._world(pose, self._arm_body_m(pose.arm_rad))
        if not joints:
            return parts
        length_m = max(math.dist(net, joints[-1]), 1e-6)
        wrist = net + (joints[-1] - net) * min(1.0, self._net_radius_m / length_m)
        links = [*pairwise(joints), (joints[-1], wrist)]
        parts.append(
            (
                camera.depth_m(joints[-1]),
                [
                    *(
                        Shape(pixels(np.array(link)), LINK, (0.024 if number == len(links) else 0.03) * scale)
                        for number, link in enumerate(links, 1)
                    ),
                    *(Shape(pixels(np.array([joint])), FRAME, 0.042 * scale) for joint in joints),
                    Shape(pixels(np.array([wrist])), FRAME, 0.036 * scale),
                ],
            )
        )
        if not self._net_radius_m:
            return parts
        along = (net - joints[-1]) / length_m
        across = np.cross(along, y_axis)
        hoops = [
            pixels(_circle(net, u, v, self._net_radius_m))
            for u, v in ((y_axis, across), (along, y_axis), (along, across))
        ]
        bag = [Shape(hoops[-1], NET, 0.0, 0.14), *(Shape(np.vstack([hoop, hoop[:1]]), NET, 1.4) for hoop in hoops)]
        ball = _ball(camera, net)[1] if pose.caught else []
        return [*parts, (camera.depth_m(net), ball + bag)]

    def _body(self, camera: Camera, pose: Pose) -> list[Shape]:
        """Return the faces of the central box, the nearest last."""
        half = np.array([0.42, 0.3, 0.0]) * self._hub_m + 0.035 * _Z
        faces = []
        for axis in range(3):
            u, v = (np.eye(3)[(axis + k) % 3] * half for k in (1, 2))
            for sign in (-1.0, 1.0):
                middle = sign * np.eye(3)[axis] * half + 0.015 * _Z
                face = self._world(pose, np.array([middle + u + v, middle + u - v, middle - u - v, middle - u + v]))
                shade = ("#3b4a57", "#24303a", "#4d5d6b")[axis]
                faces.append((camera.depth_m(face.mean(axis=0)), Shape(camera.pixels(face, closed=True), shade)))
        return [face for _, face in sorted(faces, key=lambda face: -face[0])]


def _ball(camera: Camera, centre: Array) -> tuple[float, list[Shape]]:
    at, size = camera.pixels(centre[None]), 2 * BALL_RADIUS_M * camera.scale(centre)
    shine = at - np.array([0.18, 0.2]) * size
    return camera.depth_m(centre), [Shape(at, BALL, size), Shape(shine, "#ffffff", 0.3 * size, 0.65)]


def _circle(centre: Array, u: Array, v: Array, radius_m: float) -> Array:
    angle = np.linspace(0.0, 2 * math.pi, 18, endpoint=False)[:, None]
    out: Array = centre + radius_m * (np.cos(angle) * u + np.sin(angle) * v)
    return out


@lru_cache(maxsize=1)
def _rotation(attitude_wxyz: Quat) -> Array:
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return np.array([quat_rotate(attitude_wxyz, axis) for axis in axes]).T
