"""Typed channels of the log at lower rates, for viewers (Foxglove, PlotJuggler); no reader of the companion needs them.

================  ==========================  =========================================================================
``/tf``           foxglove.FrameTransform     world -> body, 50 Hz
``/tf_arm``       foxglove.FrameTransforms    body -> link1 -> ... -> net, 50 Hz
``/pose``         foxglove.PoseInFrame        motion capture as received, 50 Hz
``/reference``    foxglove.PoseInFrame        reference pose, 50 Hz
``/scene``        foxglove.SceneUpdate        the tether, the ball that is seen with where it meets the net, and the bar, 20 Hz
``/scene_path``   foxglove.SceneUpdate        flown and reference path so far, every 2 s
``/scene_static`` foxglove.SceneUpdate        room, anchor, planned path, vehicle, arm, net: once, and for a new plan or live viewer
================  ==========================  =========================================================================

A viewer that jumps in time requests only the newest message of each topic. Data with different rates, and data sent once, therefore
have topics of their own. Vehicle, arm and net are drawn once and locked to their frames; the frames move. A message with a
non-finite value is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import foxglove
from foxglove.channels import FrameTransformChannel, FrameTransformsChannel, PoseInFrameChannel, SceneUpdateChannel
from foxglove.messages import (
    Color,
    Duration,
    FrameTransform,
    FrameTransforms,
    Point3,
    Pose,
    PoseInFrame,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    Timestamp,
    Vector3,
)

from companion.model.arm_skeleton import NO_ARM, ArmSkeleton
from companion.model.frames import quat_rotate
from companion.model.hanging_line import hanging_line_m
from companion.model.logged_geometry import Geometry, logged_bar_length_m, logged_geometry
from companion.model.markers import BallState
from companion.model.outputs import Outputs, TetherState
from companion.model.team import BarPose
from companion.model.types import Inputs, Quat, Reference, Vec3
from companion.recorder.viewer_scene import (
    BALL,
    BALL_M,
    BAR,
    HANDLE_M,
    MEETING,
    path_of,
    point3,
    rotor_disk,
    sphere,
    static_entities,
    tether_colour,
    trail,
)

PERIOD_S = 0.02
SCENE_PERIOD_S = 0.05
PATH_PERIOD_S = 2.0
_EARLY_S = 0.0025
"""Time by which a message may be sent before it is due: half a tick."""
_LIFETIME = Duration(0, 500_000_000)
"""Lifetime of moving entities: they disappear half a second after their last update."""
_FRESH_S = 0.1
"""Max age of a motion-capture pose; an older one is stale."""
_FLOWN = Color(r=0.12, g=0.44, b=0.71, a=1.0)
_REFERENCE = Color(r=0.88, g=0.48, b=0.13, a=0.9)
_TRAIL_POINTS = 256
_TRAIL_PERIOD_S = 0.1
_STRAIGHT = Quaternion(w=1.0, x=0.0, y=0.0, z=0.0)


class ViewerChannels:
    """Writes the viewer messages of a tick, each at its own rate.

    Args:
        prefix: beginning of the names of topics and of the vehicle's frames, such as ``left/``, if a file has several vehicles.
    """

    def __init__(self, context: foxglove.Context, prefix: str = "") -> None:
        self._prefix = prefix
        self._tf = FrameTransformChannel(f"/{prefix}tf", context=context)
        self._arm = FrameTransformsChannel(f"/{prefix}tf_arm", context=context)
        self._pose = PoseInFrameChannel(f"/{prefix}pose", context=context)
        self._reference = PoseInFrameChannel(f"/{prefix}reference", context=context)
        self._scene = SceneUpdateChannel(f"/{prefix}scene", context=context)
        self._path = SceneUpdateChannel(f"/{prefix}scene_path", context=context)
        self._static = SceneUpdateChannel(f"/{prefix}scene_static", context=context)
        self._geometry: Geometry | None = None
        self._bar_m: float | None = None
        self._joints = _Joints(NO_ARM, prefix)
        self._planned: tuple[Vec3, ...] = ()
        self._static_due = False
        self._due_s = self._scene_due_s = self._path_due_s = -math.inf
        self._flown_trail, self._reference_trail = _Trail(), _Trail()

    def configure(self, config: Any) -> None:
        """Set the effective configuration (nested dicts); the scene of an invalid one is empty."""
        try:
            self._geometry = logged_geometry(config["vehicle"])
        except (KeyError, TypeError, ValueError, AttributeError):
            self._geometry = None
        self._bar_m = logged_bar_length_m(config)
        self._joints = _Joints(self._geometry.arm if self._geometry is not None else NO_ARM, self._prefix)
        self._static_due = True

    def plan(self, path: Any) -> None:
        """Set the planned path, [[x, y, z], ...] in the world."""
        self._planned = path_of(path)
        self._static_due = True

    def repeat_static(self) -> None:
        """Write the static scene again with the next tick, for a viewer that has just connected; callable from any thread."""
        self._static_due = True

    def tick(self, stamp_ns: int, inputs: Inputs, outputs: Outputs) -> None:
        """Write the messages that are due in this tick.

        Args:
            stamp_ns: wall clock of the tick, for every message and its header.
            inputs, outputs: the tick's records. After a step back of the flight clock everything is due.
        """
        t_s = inputs.t_s
        frames_due, scene_due = due(t_s, self._due_s, PERIOD_S), due(t_s, self._scene_due_s, SCENE_PERIOD_S)
        if not (frames_due or scene_due) or not math.isfinite(t_s):
            return
        stamp = timestamp(stamp_ns)
        if self._static_due:
            self._static_due = False
            entities = static_entities(self._geometry, self._planned, stamp, self._prefix)
            self._static.log(SceneUpdate(entities=entities), log_time=stamp_ns)
        pose = _vehicle_pose(inputs)
        if frames_due:
            self._due_s = t_s
            self._frames(stamp, stamp_ns, pose, inputs, outputs)
        if scene_due:
            self._scene_due_s = t_s
            if pose is not None:
                self._tether(stamp_ns, pose, outputs.tether)
            if outputs.ball is not None:
                self._ball(stamp_ns, outputs.ball)
            if inputs.bar is not None and inputs.bar.tracking_valid and t_s - inputs.bar.stamp_s <= _FRESH_S:
                self._bar(stamp_ns, inputs.bar)
            partner = inputs.partner
            if partner is not None and not self._prefix and t_s - partner.stamp_s <= _FRESH_S:
                self._partner(stamp_ns, partner.said.position_world_m)
            self._paths(t_s, stamp, stamp_ns, pose, outputs.reference)

    def _frames(
        self, stamp: Timestamp, stamp_ns: int, pose: tuple[Vec3, Quat] | None, inputs: Inputs, outputs: Outputs
    ) -> None:
        mocap, arm, reference = inputs.mocap, inputs.arm, outputs.reference
        if pose is not None:
            (x, y, z), (w, i, j, k) = pose
            message = FrameTransform(
                timestamp=stamp,
                parent_frame_id="world",
                child_frame_id=f"{self._prefix}body",
                translation=Vector3(x=x, y=y, z=z),
                rotation=Quaternion(w=w, x=i, y=j, z=k),
            )
            self._tf.log(message, log_time=stamp_ns)
        if arm is not None:
            self._joints.log(self._arm, stamp, stamp_ns, arm.angle_rad)
        if mocap is not None and mocap.tracking_valid:
            _log_pose(self._pose, stamp, stamp_ns, mocap.position_world_m, mocap.attitude_wxyz)
        if reference is not None:
            half = 0.5 * reference.yaw_rad
            turned = (math.cos(half), 0.0, 0.0, math.sin(half)) if math.isfinite(half) else (math.nan,) * 4
            _log_pose(self._reference, stamp, stamp_ns, reference.position_world_m, turned)

    def _show(self, stamp_ns: int, name: str, **shapes: Any) -> None:
        """Write one entity that moves."""
        entity = SceneEntity(timestamp=timestamp(stamp_ns), frame_id="world", id=name, lifetime=_LIFETIME, **shapes)
        self._scene.log(SceneUpdate(entities=[entity]), log_time=stamp_ns)

    def _tether(self, stamp_ns: int, pose: tuple[Vec3, Quat], watched: TetherState | None) -> None:
        geometry = self._geometry
        if geometry is None or (tether := geometry.tether) is None:
            return
        (px, py, pz), attitude = pose
        bx, by, bz = quat_rotate(attitude, tether.attachment_body_m)
        end = (px + bx, py + by, pz + bz)
        slack_m = tether.length_m - math.dist(tether.anchor_world_m, end)
        held = watched is not None and (watched.taut or watched.snagged)
        points = hanging_line_m(tether.anchor_world_m, end, tether.length_m, geometry.room_min_world_m[2])
        line = trail([point3(p) for p in points], tether_colour(tether, slack_m, held=held), 4.0)
        self._show(stamp_ns, "tether", lines=[line])

    def _ball(self, stamp_ns: int, ball: BallState) -> None:
        balls = [sphere(ball.position_world_m, BALL_M, BALL)]
        if ball.meeting_world_m is not None:
            net_m = self._geometry.net_radius_m if self._geometry is not None else 0.0
            balls.append(sphere(ball.meeting_world_m, net_m or BALL_M, MEETING))
        if not math.isfinite(sum(ball.position_world_m) + sum(ball.meeting_world_m or ())):
            return
        self._show(stamp_ns, "ball", spheres=balls)

    def _bar(self, stamp_ns: int, bar: BarPose) -> None:
        if self._bar_m is None or not _usable(bar.position_world_m, bar.attitude_wxyz):
            return
        (x, y, z), (dx, dy, dz) = bar.position_world_m, quat_rotate(bar.attitude_wxyz, (0.5 * self._bar_m, 0.0, 0.0))
        ends = (x + dx, y + dy, z + dz), (x - dx, y - dy, z - dz)
        line, handles = trail([point3(end) for end in ends], BAR, 8.0), [sphere(end, HANDLE_M, BAR) for end in ends]
        self._show(stamp_ns, "bar", lines=[line], spheres=handles)

    def _partner(self, stamp_ns: int, position_world_m: Vec3) -> None:
        """Write where the other vehicle of a team is, as a disk of this one's size; a file with both vehicles shows it whole."""
        if self._geometry is None or not _usable(position_world_m, (1.0, 0.0, 0.0, 0.0)):
            return
        self._show(stamp_ns, "other vehicle", cylinders=[rotor_disk(position_world_m, self._geometry.radius_m, 0.02)])

    def _paths(
        self, t_s: float, stamp: Timestamp, stamp_ns: int, pose: tuple[Vec3, Quat] | None, reference: Reference | None
    ) -> None:
        if pose is not None:
            self._flown_trail.add(t_s, pose[0])
        if reference is not None:
            self._reference_trail.add(t_s, reference.position_world_m)
        if not due(t_s, self._path_due_s, PATH_PERIOD_S):
            return
        self._path_due_s = t_s
        entities = [
            SceneEntity(timestamp=stamp, frame_id="world", id=name, lines=[trail(one.points, colour)])
            for name, one, colour in (
                ("flown", self._flown_trail, _FLOWN),
                ("reference", self._reference_trail, _REFERENCE),
            )
            if len(one.points) > 1
        ]
        if entities:
            self._path.log(SceneUpdate(entities=entities), log_time=stamp_ns)


class _Joints:
    """Writes the arm's frames; their constant parts are built once."""

    def __init__(self, arm: ArmSkeleton, prefix: str) -> None:
        self._links: list[tuple[str, str, Vector3]] = []
        """Parent, child and position in the parent of each link's frame."""
        x, y, z = arm.shoulder_body_m
        parent, offset = f"{prefix}body", Vector3(x=x, y=y, z=z)
        for number, (x, y, z) in enumerate(arm.links_body_m, start=1):
            self._links.append((parent, f"{prefix}link{number}", offset))
            parent, offset = f"{prefix}link{number}", Vector3(x=x, y=y, z=z)
        self._axes = arm.joint_axes
        self._net = (parent, f"{prefix}net", offset)

    def log(self, channel: FrameTransformsChannel, stamp: Timestamp, stamp_ns: int, angle_rad: Sequence[float]) -> None:
        """Write all frames in one message."""
        if not self._links or len(angle_rad) != len(self._links) or not math.isfinite(sum(angle_rad)):
            return
        turns = [_turn(axis, angle) for axis, angle in zip(self._axes, angle_rad, strict=True)]
        frames = [
            FrameTransform(
                timestamp=stamp, parent_frame_id=parent, child_frame_id=child, translation=offset, rotation=turn
            )
            for (parent, child, offset), turn in zip([*self._links, self._net], [*turns, _STRAIGHT], strict=True)
        ]
        channel.log(FrameTransforms(transforms=frames), log_time=stamp_ns)


def _turn(axis: Vec3, angle_rad: float) -> Quaternion:
    s = math.sin(0.5 * angle_rad)
    return Quaternion(w=math.cos(0.5 * angle_rad), x=s * axis[0], y=s * axis[1], z=s * axis[2])


class _Trail:
    """A path with a bounded number of points: when it is full every second point is removed and the sampling period doubles."""

    def __init__(self) -> None:
        self.points: list[Point3] = []
        self._period_s = _TRAIL_PERIOD_S
        self._last_s = -math.inf

    def add(self, t_s: float, position: Sequence[float]) -> None:
        """Add the position if the sampling period has passed."""
        if 0.0 <= t_s - self._last_s < self._period_s or not all(map(math.isfinite, position)):
            return
        self._last_s = t_s
        self.points.append(Point3(x=position[0], y=position[1], z=position[2]))
        if len(self.points) > _TRAIL_POINTS:
            self.points = self.points[::2]
            self._period_s *= 2.0


def _log_pose(
    channel: PoseInFrameChannel, stamp: Timestamp, stamp_ns: int, position: Sequence[float], attitude: Sequence[float]
) -> None:
    if not _usable(position, attitude):
        return
    pose = Pose(
        position=Vector3(x=position[0], y=position[1], z=position[2]),
        orientation=Quaternion(w=attitude[0], x=attitude[1], y=attitude[2], z=attitude[3]),
    )
    channel.log(PoseInFrame(timestamp=stamp, frame_id="world", pose=pose), log_time=stamp_ns)


def due(t_s: float, last_s: float, period_s: float) -> bool:
    """Whether a period has passed; also true if the clock has gone back or is not finite."""
    return not 0.0 <= t_s - last_s < period_s - _EARLY_S


def timestamp(stamp_ns: int) -> Timestamp:
    """Return a wall-clock time in ns as a Foxglove time stamp."""
    return Timestamp(stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)


def _vehicle_pose(inputs: Inputs) -> tuple[Vec3, Quat] | None:
    """Return position and attitude from motion capture, or else from PX4; None if neither is fresh, tracked and finite."""
    mocap, vehicle = inputs.mocap, inputs.vehicle
    if mocap is not None and mocap.tracking_valid and inputs.t_s - mocap.stamp_s <= _FRESH_S:
        if _usable(mocap.position_world_m, mocap.attitude_wxyz):
            return mocap.position_world_m, mocap.attitude_wxyz
    if vehicle is not None and _usable(vehicle.position_world_m, vehicle.attitude_wxyz):
        return vehicle.position_world_m, vehicle.attitude_wxyz
    return None


def _usable(position: Sequence[float], attitude: Sequence[float]) -> bool:
    """Whether the values are finite and the attitude is a unit quaternion."""
    x, y, z = position
    w, i, j, k = attitude
    return math.isfinite(x + y + z) and abs(w * w + i * i + j * j + k * k - 1.0) < 0.01
