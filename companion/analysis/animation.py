"""Animation of a flight: the vehicle in 3D with plots of position and arm error, as a GIF or as a player in an HTML page.

Where motion capture does not see the payload before the catch, its path is computed from the throw configured in the simulated world;
for a real flight it is not drawn then.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.analysis import metrics
from companion.analysis.log import Array, FlightLog
from companion.analysis.plot_style import CATCH, INK
from companion.analysis.scene import FRONT, LINK, Camera, Pose, Scene, Shape
from companion.model.best_pose import best_pose
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import PhaseKind, Vec3

WIDTH, HEIGHT = 960, 440
FRAMES_PER_S = 12.5
"""Frame rate; its period is a multiple of 0.01 s, because a GIF stores the delay of a frame in hundredths of a second."""
SPLIT_PX = 600
"""Column that separates the scene (left) from the plots (right)."""
_PLOT_X = (650.0, 946.0)
_PLOTS_Y = ((50.0, 205.0), (262.0, 405.0))
_SOFT, _AXIS, _GRID = "#5b6b79", "#aab4bd", "#e6eaee"
FLYING = (PhaseKind.TAKEOFF, PhaseKind.FLIGHT, PhaseKind.LANDING)
_GRAVITY_WORLD_M_S2 = np.array([0.0, 0.0, -GRAVITY_M_S2])
_TARGET_M = np.array([0.1, 0.0, -0.16])
"""Point that the camera looks at, relative to the vehicle, world axes."""
_SEEN_TICKS = 6
"""Ticks between the places of a ball that was seen."""
_THROWN_S = 0.45
"""Time before the catch during which the payload is drawn."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of the animation."""

    shapes: list[Shape]
    curves_to_px: float
    """Pixel column up to which the curves are drawn."""


@dataclass(frozen=True, slots=True)
class Movie:
    """Frames at `FRAMES_PER_S`, and the shapes that all of them share."""

    axes: list[Shape]
    curves: list[Shape]
    frames: list[Frame]
    still: int
    """Index of the frame to show while paused: shortly before the catch, or a miss."""


def movie_of(log: FlightLog, summary: dict[str, Any]) -> Movie | None:
    """Return the animation of a flight; None if the vehicle did not take off, or its poses, joint angles or geometry were not
    logged.

    Args:
        summary: summary of the flight, with the payload's mass and the simulated world.
    """
    flying = np.flatnonzero([o.phase_kind in FLYING for o in log.outputs])
    moving = (log.columns.mocap_position_world_m, log.columns.arm_rad)
    if len(flying) < 2 or not all(np.isfinite(rows).all(axis=1).any() for rows in moving):
        return None
    try:
        scene = Scene(log.config["vehicle"])
    except (KeyError, ValueError):
        return None
    if scene.joint_count != log.joint_count:
        return None
    first, last = int(flying[0]), _end(log, flying, scene)
    if last <= first:
        return None
    caught = metrics.catch_index(log)
    if caught is not None and caught >= last:
        caught = None
    start_s, t_s = log.outputs[first].mission_t_s - log.columns.t_s[first], log.columns.t_s
    track = Track(log, scene, caught, _throw_velocity_m_s(log, summary))
    axes, curves = _plots(log, t_s + start_s, slice(first, last + 1), caught)
    frames: list[Frame] = []
    still, target = 0, None
    payload_kg = summary["payload_kg"]
    name = "payload" if payload_kg is None else f"{payload_kg:g} kg payload"
    chased = [k for k in range(first, last) if (ball := log.outputs[k].ball) is not None and ball.meeting_s is not None]
    moment = caught if caught is not None or not chased else chased[-1]
    for now_s, speed in _times(t_s[first], t_s[last], None if moment is None else t_s[moment]):
        k = min(int(np.searchsorted(t_s, now_s)), last)
        pose = track.pose(k)
        centre = np.array(pose.position_world_m) + _TARGET_M
        target = centre if target is None else target + 0.25 * (centre - target)
        camera = Camera(target, math.radians(68.0), math.radians(11.0), 4.0, (SPLIT_PX, HEIGHT))
        shapes = scene.shapes(camera, pose)
        shapes += labels(log.outputs[k].phase, t_s[k] + start_s, speed)
        if pose.ball_world_m:
            x, y = camera.pixels(np.array(pose.ball_world_m[:1]))[0]
            shapes.append(Shape(np.array([[min(x + 64.0, 485.0), y - 32.0]]), CATCH, 17.0, text=f"{name}, thrown"))
        elif caught is not None and 0.0 <= t_s[k] - t_s[caught] < 1.2:
            net = camera.pixels(scene.net_world_m(pose)[None])
            shapes.append(Shape(net + np.array([0.0, 56.0]), CATCH, 17.0, text=f"{name}, caught"))
        if moment is not None and k <= moment:
            still = len(frames)
        frames.append(Frame(shapes, float(plot_x((t_s[first], t_s[last]), t_s[k]))))
    return Movie(axes, curves, frames, max(still - 4, 0))


def _end(log: FlightLog, flying: npt.NDArray[np.intp], scene: Scene) -> int:
    """Return the index in the log at which the animation ends: where the landing's reference reaches the floor, or the flight's end."""
    landing = np.array([log.outputs[k].phase_kind is PhaseKind.LANDING for k in flying])
    low = log.columns.reference_position_world_m[flying, 2] < scene.standing_height_m
    return int(flying[np.argmax(landing & low)] if (landing & low).any() else flying[-1])


def _times(first_s: float, last_s: float, moment_s: float | None) -> Iterator[tuple[float, float]]:
    """Yield the time of each frame and its playback speed: 1 is real time, the catch or a miss is slower, a long flight is faster."""
    spans: list[tuple[float, float, float]] = []
    if moment_s is None:
        spans = [(last_s, 0.0, 10.0)]
    else:
        spans = [(moment_s - 1.2, 0.0, 1.8), (moment_s - 0.5, 1.0, 0.0), (moment_s + 0.4, 0.25, 0.0)]
        spans += [(moment_s + 1.6, 1.0, 0.0), (last_s, 0.0, 2.6)]
    now_s = first_s
    for end_s, speed, duration_s in spans:
        end_s = min(end_s, last_s)
        speed = speed or max(1.0, (end_s - now_s) / duration_s)
        while now_s < end_s:
            yield now_s, speed
            now_s += speed / FRAMES_PER_S


class Track:
    """Poses of vehicle, arm and payload; the previous measurement replaces a missing one."""

    def __init__(self, log: FlightLog, scene: Scene, caught: int | None, throw_velocity_m_s: Array | None) -> None:
        columns = log.columns
        self._log, self._caught, self._t_s = log, caught, columns.t_s
        self._mocap = _filled(columns.mocap_position_world_m)
        self._arm = _filled(columns.arm_rad)
        self._throw: tuple[Array, Array] | None = None
        """Position and velocity of the payload at the catch, world frame."""
        if caught is not None and throw_velocity_m_s is not None:
            self._throw = scene.net_world_m(self.pose(caught)), throw_velocity_m_s

    def pose(self, k: int) -> Pose:
        """Return the pose at an index of the log."""
        mocap = best_pose(self._log.inputs[int(self._mocap[k])])
        arm = self._log.inputs[int(self._arm[k])].arm
        assert mocap is not None
        caught = self._caught is not None and k >= self._caught
        ball = None if caught else self._log.outputs[k].ball
        return Pose(
            position_world_m=mocap.position_world_m,
            attitude_wxyz=mocap.attitude_wxyz,
            arm_rad=arm.angle_rad if arm is not None else (),
            ball_world_m=self._thrown(k) if ball is None else self._seen(k),
            caught=caught,
            meeting_world_m=None if ball is None else ball.meeting_world_m,
        )

    def _seen(self, k: int) -> tuple[Vec3, ...]:
        """Return the places of the ball that motion capture has seen."""
        balls = (self._log.outputs[before].ball for before in range(k, max(k - 8 * _SEEN_TICKS, 0), -_SEEN_TICKS))
        return tuple(ball.position_world_m for ball in balls if ball is not None)

    def _thrown(self, k: int) -> tuple[Vec3, ...]:
        """Return the path of the configured throw."""
        if self._caught is None or self._throw is None:
            return ()
        before_s = self._t_s[k] - self._t_s[self._caught]
        if not -_THROWN_S <= before_s < 0.0:
            return ()
        place, velocity = self._throw
        times = (before_s - 0.03 * back for back in range(8))
        places = (place + velocity * t + 0.5 * _GRAVITY_WORLD_M_S2 * t * t for t in times if t >= -_THROWN_S)
        return tuple(tuple(point.tolist()) for point in places)


def _filled(values: Array) -> Array:
    """Return, for each row, the index of the newest finite row up to it; before the first finite row, the index of that one."""
    known = np.isfinite(values).all(axis=1)
    index = np.where(known, np.arange(len(values)), -1)
    filled = np.maximum.accumulate(index)
    filled[filled < 0] = int(np.argmax(known))
    return filled


def _throw_velocity_m_s(log: FlightLog, summary: dict[str, Any]) -> Array | None:
    """Return the payload's velocity at the net, from the simulated world's configuration; None for a real flight."""
    world = summary.get("world") or log.config.get("world") or {}
    velocity = world.get("throw_velocity_m_s")
    return None if velocity is None else np.array(velocity, dtype=np.float64)


def labels(phase: str, mission_s: float, speed: float) -> list[Shape]:
    """Return what stands above the scene."""
    at = np.array([[16.0, 24.0]])
    pace = "¼ speed" if speed < 1 else f"{speed:.{1 if speed < 1.95 else 0}f}× speed"
    if abs(speed - 1) < 0.05:
        pace = "real time"
    return [
        Shape(at, INK, 18.0, text=phase, align="left"),
        Shape(at + np.array([0.0, 24.0]), _SOFT, 14.0, text=f"t = {mission_s:.2f} s", align="left"),
        Shape(at + np.array([100.0, 24.0]), CATCH if speed < 1 else _SOFT, 14.0, text=pace, align="left"),
    ]


def _plots(log: FlightLog, mission_s: Array, ticks: slice, caught: int | None) -> tuple[list[Shape], list[Shape]]:
    """Return the axes and the curves of position error and arm error, or attitude error without an arm."""
    scaled = np.array([o.phase_kind in (PhaseKind.TAKEOFF, PhaseKind.FLIGHT) for o in log.outputs])
    arm = np.degrees(np.linalg.norm(metrics.arm_error_rad(log), axis=1))
    t_s = mission_s[ticks]
    attitude = np.degrees(np.linalg.norm(metrics.attitude_error_rad(log), axis=1))
    position_cm = 100.0 * np.linalg.norm(metrics.position_error_m(log), axis=1)
    below = ("arm error [deg]", arm) if log.joint_count else ("attitude error [deg]", attitude)
    rows = [(name, values[ticks]) for name, values in (("position error [cm]", position_cm), below)]
    axes, curves = plotted((t_s[0], t_s[-1]), t_s, rows, scaled[ticks])
    if caught is not None:
        x = float(plot_x((t_s[0], t_s[-1]), mission_s[caught]))
        axes += [Shape(np.array([[x, top], [x, bottom]]), CATCH, 1.0, 0.6) for top, bottom in _PLOTS_Y]
        axes.append(Shape(np.array([[x + 5, _PLOTS_Y[0][0] + 7]]), CATCH, 12.0, text="catch", align="left"))
    return axes, curves


def plotted(
    span_s: tuple[float, float], t_s: Array, rows: Sequence[tuple[str, Array]], scaled: npt.NDArray[np.bool_]
) -> tuple[list[Shape], list[Shape]]:
    """Return the axes and the curves of two plots, one below the other.

    Args:
        span_s: start and end of the time axis.
        rows: name of each plot, and its values.
        scaled: which of the values the scale must hold.
    """
    axes: list[Shape] = [Shape(np.array([[SPLIT_PX, 0.0], [SPLIT_PX, HEIGHT]]), _GRID, 1.0)]
    curves: list[Shape] = []
    for (top, bottom), colour, (name, values) in zip(_PLOTS_Y, (FRONT, LINK), rows, strict=True):
        seen = values[scaled & np.isfinite(values)]
        limit = _round_up(1.1 * float(seen.max())) if len(seen) else 1.0
        axes.append(Shape(np.array([[_PLOT_X[0] - 34, top - 22]]), INK, 14.0, text=name, align="left"))
        for share in (0.0, 0.5, 1.0):
            y = bottom + share * (top - bottom)
            axes.append(Shape(np.array([[_PLOT_X[0], y], [_PLOT_X[1], y]]), _GRID if share else _AXIS, 1.0))
            axes.append(Shape(np.array([[_PLOT_X[0] - 7, y]]), _SOFT, 12.0, text=f"{share * limit:g}", align="right"))
        curves.append(Shape(_curve(span_s, t_s, values / limit, top, bottom), colour, 2.0))
    for share in (0.0, 0.5, 1.0):
        at = np.array([[_PLOT_X[0] + share * (_PLOT_X[1] - _PLOT_X[0]), _PLOTS_Y[1][1] + 15]])
        text = f"{span_s[0] + share * (span_s[1] - span_s[0]):.0f} s"
        axes.append(Shape(at, _SOFT, 12.0, text=text, align=("left", "center", "right")[round(2 * share)]))
    return axes, curves


def plot_x(span_s: tuple[float, float], t_s: Any) -> Any:
    """Return the pixel column of a time, or of each of an array of times."""
    return _PLOT_X[0] + (t_s - span_s[0]) / (span_s[1] - span_s[0]) * (_PLOT_X[1] - _PLOT_X[0])


def _curve(span_s: tuple[float, float], t_s: Array, share: Array, top: float, bottom: float) -> Array:
    """Return a curve with the largest value of each pixel column; values above the axis, as at touchdown, are drawn at its top."""
    x = plot_x(span_s, t_s)
    starts = np.flatnonzero(np.diff(np.floor(x), prepend=-1.0))
    largest = np.fmax.reduceat(share, starts)
    points = np.column_stack([x[starts], bottom + np.minimum(largest, 1.0) * (top - bottom)])
    known: Array = points[np.isfinite(largest)]
    return known


def _round_up(value: float) -> float:
    """Round up to 1, 2, 3, 4, 6, 8 or 10 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-6)))
    return next(step * power for step in (1, 2, 3, 4, 6, 8, 10) if step * power >= value)


# Output


def player_html(movie: Movie) -> str:
    """Return a self-contained HTML element that plays the animation: a canvas, a button and a slider."""
    styles: dict[tuple[Any, ...], int] = {}

    def packed(shape: Shape) -> list[Any]:
        style = (shape.colour, round(shape.width, 1), round(shape.alpha, 2), shape.align if shape.text else "")
        pixels: list[Any] = np.rint(5.0 * shape.points).astype(int).ravel().tolist()
        return [styles.setdefault(style, len(styles)), *pixels, *([shape.text] if shape.text else [])]

    data: dict[str, Any] = {
        "axes": [packed(shape) for shape in movie.axes],
        "curves": [packed(shape) for shape in movie.curves],
        "frames": [[round(frame.curves_to_px, 1), *map(packed, frame.shapes)] for frame in movie.frames],
    }
    data |= {"width": WIDTH, "height": HEIGHT, "split": SPLIT_PX, "frames_per_s": FRAMES_PER_S, "still": movie.still}
    text = json.dumps(data | {"styles": list(styles)}, separators=(",", ":"), ensure_ascii=False).replace("</", "<\\/")
    script = Path(__file__).with_name("player.js").read_text(encoding="utf-8")
    return (
        "<figure id='player'><canvas role='img' aria-label='The flight in 3D, with its errors'></canvas>"
        "<div><button type='button'>Play</button><input type='range' min='0' aria-label='time'></div>"
        f"<script type='application/json' id='movie'>{text}</script><script>{script}</script></figure>"
    )


def write_gif(movie: Movie, path: Path, width_px: int = 800) -> None:
    """Write the animation as a GIF that repeats forever."""
    from matplotlib import get_data_path
    from PIL import Image, ImageDraw, ImageFont

    zoom = 2.0 * width_px / WIDTH  # drawn twice as large, for smooth edges
    size = (2 * width_px, round(HEIGHT * zoom))
    face = Path(get_data_path(), "fonts/ttf/DejaVuSans.ttf")
    fonts: dict[float, Any] = {}

    def draw(pen: Any, shape: Shape) -> None:
        points = [(x, y) for x, y in (shape.points * zoom).tolist()]
        fill = (*(int(shape.colour[k : k + 2], 16) for k in (1, 3, 5)), round(255 * shape.alpha))
        width = shape.width * zoom
        if shape.text:
            font = fonts.setdefault(width, ImageFont.truetype(face, width))
            pen.text(points[0], shape.text, fill, font, {"left": "lm", "center": "mm", "right": "rm"}[shape.align])
        elif not width:
            pen.polygon(points, fill)
        elif len(points) > 1:
            pen.line(points, fill, max(1, round(width)), joint="curve")
        if width and not shape.text and points:
            for x, y in (points[0], points[-1]):
                pen.ellipse((x - width / 2, y - width / 2, x + width / 2, y + width / 2), fill)

    right = Shape(np.array([[SPLIT_PX, 0], [WIDTH, 0], [WIDTH, HEIGHT], [SPLIT_PX, HEIGHT]]), "#ffffff")
    pictures = []
    for frame in movie.frames:
        picture = Image.new("RGB", size, "white")
        pen = ImageDraw.Draw(picture, "RGBA")
        for shape in (*frame.shapes, right, *movie.axes, *_grown(movie, frame)):
            draw(pen, shape)
        pictures.append(picture.reduce(2))
    palette = pictures[movie.still].quantize(64, dither=Image.Dither.NONE)
    first, *others = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    shown_ms = [round(1000 / FRAMES_PER_S)] * len(others) + [1600]
    first.save(path, "GIF", save_all=True, append_images=others, duration=shown_ms, loop=0, optimize=True)


def _grown(movie: Movie, frame: Frame) -> Iterator[Shape]:
    for curve in movie.curves:
        points = curve.points[curve.points[:, 0] <= frame.curves_to_px]
        if len(points):
            yield replace(curve, points=points)
            yield replace(curve, points=points[-1:], width=8.0)
