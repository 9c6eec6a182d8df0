"""The guardian's motion-capture client: that of the flight process (`companion.io.mocap.contained`), without its event loop."""

from __future__ import annotations

import dataclasses
import socket
from collections.abc import Sequence

from msgspec.structs import replace

from companion import plugins
from companion.io.mocap.contained import ContainedClient
from companion.io.mocap.optitrack import OptiTrack
from companion.io.mocap.system import MocapSettings, PoseClient
from companion.io.protocols import DeviceError
from companion.model.types import MocapPose
from companion.runtime.clock import Clock, monotonic


class GuardianMocap:
    """Receives poses of the vehicle's rigid body, and no markers; no call waits or raises.

    Args:
        settings: addresses, rigid body, type and options.
        clock: the clock that the stamps are on before `origin_s` is subtracted.

    Raises:
        DeviceError: the client cannot be made.
    """

    def __init__(self, settings: MocapSettings, clock: Clock = monotonic) -> None:
        self._clock, settings = clock, dataclasses.replace(settings, ball=None, bar_id=None)
        try:
            self._client = ContainedClient(_make(settings), settings, clock)
        except DeviceError:
            raise
        except Exception as error:
            raise DeviceError(
                f"mocap {settings.type} {settings.server}: the client cannot be made: {plugins.one_line(error)}"
            ) from None
        self.keep_connected, self.close = self._client.keep_connected, self._client.close
        self.where = self._client.where
        self.tracked_s = float("-inf")
        """Time of the newest pose in which the body was tracked."""

    @property
    def sockets(self) -> Sequence[socket.socket]:
        """Return the sockets to wait on; a plug-in may have none."""
        return self._client.extended.sockets

    @property
    def problem(self) -> str | None:
        """Return the client's newest problem; None if there was none."""
        return self._client.problem

    def poses(self, origin_s: float = 0.0) -> list[MocapPose]:
        """Return the body's valid poses that have arrived, in order, stamped with their arrival less `origin_s`; none of them while
        two servers stream from one address.
        """
        poses = self._client.poses()
        if self._client.extended.has_two_streams():
            return []
        if any(pose.tracking_valid for pose in poses):
            self.tracked_s = self._clock()
        return [replace(pose, stamp_s=pose.stamp_s - origin_s) for pose in poses]


def _make(settings: MocapSettings) -> PoseClient:
    if settings.type == "natnet":  # found without a search, which imports what the guardian does not need
        return OptiTrack(settings)
    client: PoseClient = plugins.find(plugins.MOCAP_SYSTEMS, settings.type).load()(settings)
    return client
