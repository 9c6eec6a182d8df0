"""The guardian's client of a motion-capture system that is a plug-in."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import TypeVar

from msgspec.structs import replace

from companion import plugins
from companion.io.mocap.system import MocapSettings, PoseClient, valid_poses
from companion.model.types import MocapPose

T = TypeVar("T")


class PluginClient:
    """Client of a motion-capture system that is a plug-in; no call waits, and none raises what the plug-in raises.

    Args:
        settings: addresses, rigid body, type and options.

    Raises:
        Exception: the plug-in cannot be loaded, or its client cannot be made.
    """

    def __init__(self, settings: MocapSettings) -> None:
        self.where = f"mocap {settings.type} {settings.server}"
        """Beginning of a text on this client."""
        self._client: PoseClient = plugins.find(plugins.MOCAP_SYSTEMS, settings.type).load()(settings)
        self.tracked_s = float("-inf")
        """`monotonic` of the newest frame in which the body was tracked."""
        self._failure: str | None = None
        self._rejected: str | None = None
        self.sockets: tuple[socket.socket, ...] = ()
        """No sockets to wait on: the plug-in may close its own at any time, and one that raises may leave its datagrams unread."""

    @property
    def problem(self) -> str | None:
        """Return the plug-in's first exception, or why its newest rejected pose or datagram was invalid; None if there is none."""
        found = self._contained(lambda: str(self._client.problem or ""), "")
        return self._failure or self._rejected or found or None

    def keep_connected(self, now_s: float) -> None:
        """Send what the server needs to go on streaming; call every 10 to 50 ms."""
        self._contained(lambda: self._client.keep_connected(now_s), None)

    def poses(self, now_s: float, origin_s: float = 0.0) -> list[MocapPose]:
        """Return the body's valid poses that have arrived, in order, stamped with their arrival less `origin_s`."""
        return self._contained(lambda: self._poses(now_s, origin_s), [])

    def _poses(self, now_s: float, origin_s: float) -> list[MocapPose]:
        poses, rejected = valid_poses(self._client.poses(now_s), now_s)
        if rejected:
            self._rejected = rejected[-1]
        if any(pose.tracking_valid for pose in poses):
            self.tracked_s = now_s
        return [replace(pose, stamp_s=pose.stamp_s - origin_s) for pose in poses]

    def poll_newest(self, now_s: float) -> None:
        """Read what has arrived; used in standby."""
        self.poses(now_s)

    def close(self) -> None:
        """Close the client."""
        self._contained(self._client.close, None)

    def _contained(self, call: Callable[[], T], otherwise: T) -> T:
        try:
            return call()
        except Exception as error:
            self._failure = self._failure or plugins.one_line(error)
            return otherwise
