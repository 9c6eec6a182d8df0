"""What a motion-capture system provides: `companion.io.mocap.optitrack`, and every plug-in.

The flight process and the guardian each make a client of their own from the same settings, because the guardian lands the vehicle
after the flight process has died. Both run it in `companion.io.mocap.contained`. `companion.config.device_plugins` checks the settings
before a flight.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, NamedTuple, Protocol

import msgspec

from companion.model.markers import MARKERS_MAX, MarkerFrame
from companion.model.team import BarPose
from companion.model.types import IDENTITY_QUAT, MocapPose
from companion.runtime.clock import Clock

_AGE_MAX_S: Final = 1.0
_AHEAD_MAX_S: Final = 0.001
_POSITION_MAX_M: Final = 1000.0
_QUAT_NORM_TOLERANCE: Final = 0.02
_ROUNDING: Final = 1e-9


@dataclass(frozen=True, slots=True)
class MocapSettings:
    """`devices.mocap` of the vehicle file, with the same keys."""

    server: str
    interface: str
    transport: str
    multicast_group: str
    command_port: int
    data_port: int
    rigid_body_id: int
    up_axis: str
    natnet_version: str | None = None
    type: str = "natnet"
    ball: Mapping[str, Any] | None = None
    """`kind` and `id` of the ball that the mission follows; None if no marker is read, as in the guardian."""
    bar_id: int | None = None
    """Id of the rigid body of the bar that two vehicles carry; None if it is not read, as in the guardian."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """`devices.mocap.options`, already checked by the system's model."""


class PoseClient(Protocol):
    """Receives the poses of the vehicle's rigid body; no call waits.

    An entry point of the group `companion.mocap_systems` names its class. The class is called with `MocapSettings`; if it raises, the
    flight does not start. Times are on the clock of the `now_s` argument, s, which differs between the two processes.
    An exception of a method is contained and reported, but the poses of that call are lost.
    """

    options: ClassVar[type[Any]]
    """Subclass of `companion.config.base.Model` that checks `MocapSettings.options`; its docstring describes the system."""

    @property
    def server_name(self) -> str:
        """Program and protocol, such as "Vicon Tracker, UDP object stream". An `ExtendedClient` may return "" before an answer."""

    @property
    def problem(self) -> str | None:
        """Why the newest rejected datagram was invalid, as one line; None if none was rejected."""

    def keep_connected(self, now_s: float) -> None:
        """Send what the server needs to go on streaming; called every 10 to 50 ms. It may open, replace and close sockets."""

    def poses(self, now_s: float) -> list[MocapPose]:
        """Return the poses that have arrived since the last call, in order, in the world frame (z up) and the body frame FLU.

        The flight process calls it every 1 ms, the guardian every 10 ms, unless the client is an `ExtendedClient` with sockets; it may
        open, replace and close sockets. A pose's `stamp_s`
        is its arrival, `now_s` or earlier, and `tracking_valid` is False while the body is not tracked. Frame numbers increase.
        `valid_poses` rejects invalid poses.
        """

    def close(self) -> None:
        """Close the sockets; never raises."""


class Counts(NamedTuple):
    """Datagrams of a client that were dropped."""

    out_of_order: int = 0
    """Frames that arrived after a newer one."""
    malformed: int = 0
    foreign: int = 0
    """Datagrams from another address than the server's."""


class ExtendedClient:
    """Base class of a client that provides more than a `PoseClient` must. What it returns here holds for every other client."""

    sockets: Sequence[socket.socket] = ()
    """Sockets that stay open from the constructor to `close`: `poses` is called as soon as one of them is readable, and reads all."""
    clock: Clock | None = None
    """Clock of `now_s`, set before `poses` is called; it stamps what arrives during a call, for which `now_s` is too old."""
    sees_markers: ClassVar[bool] = False
    """Whether the system hands on single markers; a class without it is refused for a vehicle with `devices.mocap.ball`."""
    where = ""
    """Beginning of a text on this client, such as "mocap 10.0.0.5:1510"; empty for the type and `MocapSettings.server`."""

    def protocol_version(self) -> str:
        """Return the version that the server uses; empty for the type of the system."""
        return ""

    def bodies(self) -> Mapping[int, str] | None:
        """Return the newest frame's rigid bodies by streaming id, with their names or ""; None before one, or if not known."""
        return None

    def markers(self) -> MarkerFrame | None:
        """Return the single markers of the newest frame that `poses` has read, in the world frame, as
        `companion.io.mocap.markers.marker_frame` builds them; None before the first frame, and without `MocapSettings.ball`.
        """
        return None

    def bar(self) -> BarPose | None:
        """Return the bar's rigid body in the newest frame that had it, world frame; None before, or without `bar_id`."""
        return None

    def counts(self) -> Counts:
        """Return the numbers of dropped datagrams."""
        return Counts()

    def has_two_streams(self) -> bool:
        """Return whether the newest poses belong to two mixed streams; the guardian then uses none."""
        return False

    def refusal(self) -> str | None:
        """Return why the flight must not start with this server or body, or None; called for the server, then for the body."""
        return None

    def silence(self, waited_s: float) -> str | None:
        """Return why no tracked pose has arrived in `waited_s`, as one line, or None if the client does not know."""
        return None


def valid_poses(poses: list[MocapPose], now_s: float) -> tuple[list[MocapPose], list[str]]:
    """Check the poses that a client has returned.

    Args:
        poses: return value of `PoseClient.poses`.
        now_s: argument of that call.

    Returns:
        The valid poses, with quaternions of norm 1, and for each of the others the reason for its rejection as one line. A pose is
        valid if it arrived in the last second and is either not tracked or finite, at most 1000 m from the origin in each axis, with
        a quaternion of norm 1 (tolerance 0.02). If a pose is not tracked and not finite, its position becomes zero and its attitude
        the identity.

    Raises:
        TypeError: `poses` is not a list of `MocapPose`, or a value is not a number of Python.
        msgspec.ValidationError: a pose has a value of the wrong type.
    """
    if not (isinstance(poses, list) and all(isinstance(pose, MocapPose) for pose in poses)):
        raise TypeError(f"poses() returned {poses!r:.80}, expected a list of MocapPose")
    valid, rejected = [], []
    for pose in poses:
        if not _has_types(pose):
            pose = msgspec.convert(msgspec.to_builtins(pose), MocapPose)
        norm = math.hypot(*pose.attitude_wxyz)
        finite = (
            all(abs(value) <= _POSITION_MAX_M for value in pose.position_world_m)
            and abs(norm - 1.0) <= _QUAT_NORM_TOLERANCE
            and all(map(math.isfinite, (pose.marker_error_m, pose.latency_s or 0.0, pose.exposure_server_s or 0.0)))
        )
        if not now_s - _AGE_MAX_S < pose.stamp_s <= now_s + _AHEAD_MAX_S:
            rejected.append(
                f"frame {pose.frame_number}: stamped {pose.stamp_s:.3f} s, expected at most {_AGE_MAX_S:g} s before now_s "
                f"({now_s:.3f} s); the pose is rejected"
            )
        elif finite and abs(norm - 1.0) <= _ROUNDING:
            valid.append(pose)
        elif finite:
            w, x, y, z = pose.attitude_wxyz
            valid.append(msgspec.structs.replace(pose, attitude_wxyz=(w / norm, x / norm, y / norm, z / norm)))
        elif not pose.tracking_valid:
            empty = {
                "position_world_m": (0.0, 0.0, 0.0),
                "attitude_wxyz": IDENTITY_QUAT,
                "marker_error_m": 0.0,
                "latency_s": None,
                "exposure_server_s": None,
            }
            valid.append(msgspec.structs.replace(pose, **empty))
        else:
            rejected.append(
                f"frame {pose.frame_number}: position {pose.position_world_m} m with a quaternion of norm {norm:g}, expected finite "
                f"values, at most {_POSITION_MAX_M:g} m and norm 1; the pose is rejected"
            )
    return valid, rejected


def markers_problem(frame: MarkerFrame, now_s: float) -> str | None:
    """Return why a client's return value of `ExtendedClient.markers` is invalid, as one line, or None.

    Raises:
        TypeError: `frame` is no `MarkerFrame`.
        msgspec.ValidationError: it has a value of the wrong type.
    """
    if not isinstance(frame, MarkerFrame):
        raise TypeError(f"markers() returned {frame!r:.80}, expected a MarkerFrame or None")
    checked = msgspec.convert(msgspec.to_builtins(frame), MarkerFrame, strict=True)
    values = [value for marker in checked.markers for value in marker.position_world_m]
    if len(checked.markers) > MARKERS_MAX:
        return f"frame {checked.frame_number}: {len(checked.markers)} markers, expected at most {MARKERS_MAX}; they are dropped"
    if not all(abs(value) <= _POSITION_MAX_M for value in values):
        return f"frame {checked.frame_number}: a marker without a finite position within {_POSITION_MAX_M:g} m; its frame is dropped"
    if not now_s - _AGE_MAX_S < checked.exposed_s <= checked.stamp_s <= now_s + _AHEAD_MAX_S:
        return (
            f"frame {checked.frame_number}: markers stamped {checked.stamp_s:.3f} s at {now_s:.3f} s; they are dropped"
        )
    return None


def _has_types(pose: MocapPose) -> bool:
    """Return whether the values have the types of `MocapPose`: a conversion, which checks them too, takes longer."""
    position_m, quat = pose.position_world_m, pose.attitude_wxyz
    return (
        (type(position_m), type(quat), len(position_m), len(quat)) == (tuple, tuple, 3, 4)
        and {*map(type, (pose.stamp_s, pose.marker_error_m, *position_m, *quat))} == {float}
        and {type(pose.latency_s), type(pose.exposure_server_s)} <= {float, type(None)}
        and (type(pose.frame_number), type(pose.tracking_valid)) == (int, bool)
    )
