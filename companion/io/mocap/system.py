"""What a motion-capture system that is a plug-in provides. `companion.config.device_plugins` checks its settings before a flight.

The flight process and the guardian each make a client of their own from the same settings, because the guardian lands the vehicle
after the flight process has died. `companion.io.mocap.plugin_driver` runs the flight's, `companion.guardian.plugin_mocap` the
guardian's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, Protocol

import msgspec

from companion.model.types import IDENTITY_QUAT, MocapPose

_AGE_MAX_S: Final = 1.0
_AHEAD_MAX_S: Final = 0.001
_POSITION_MAX_M: Final = 1000.0
_QUAT_NORM_TOLERANCE: Final = 0.02


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
    type: str = "natnet"
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
    server_name: str
    """Program and protocol, such as "Vicon Tracker, UDP object stream"."""
    problem: str | None
    """Why the newest rejected datagram was invalid, as one line; None if none was rejected."""

    def keep_connected(self, now_s: float) -> None:
        """Send what the server needs to go on streaming; called every 10 to 50 ms. It may open, replace and close sockets."""

    def poses(self, now_s: float) -> list[MocapPose]:
        """Return the poses that have arrived since the last call, in order, in the world frame (z up) and the body frame FLU.

        The flight process calls it every 1 ms, the guardian every 10 ms; it may open, replace and close sockets. A pose's `stamp_s`
        is its arrival, `now_s` or earlier, and `tracking_valid` is False while the body is not tracked. Frame numbers increase.
        `valid_poses` rejects invalid poses.
        """

    def close(self) -> None:
        """Close the sockets; never raises."""


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
    for returned in poses:
        pose = msgspec.convert(msgspec.to_builtins(returned), MocapPose)  # a struct's constructor does not check types
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
