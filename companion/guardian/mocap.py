"""The guardian's motion-capture client: the flight's NatNet client (`companion.io.mocap.client`) on plain sockets, or a plug-in's.

In standby it keeps its connection to the server and reads only the newest frame. After a takeover it reads every frame.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import TYPE_CHECKING

from companion.io.mocap import natnet, sockets
from companion.io.mocap.client import NatNetClient
from companion.io.mocap.natnet import Message
from companion.io.mocap.system import MocapSettings
from companion.model.types import MocapPose

if TYPE_CHECKING:
    from companion.guardian.plugin_mocap import PluginClient


class MocapProblem(Exception):
    """Motion-capture data cannot be received. The exception's text is one line for the user."""


class MocapClient:
    """Receives poses of the vehicle's rigid body; no call waits.

    Args:
        settings: addresses and rigid body.

    Raises:
        MocapProblem: a host name does not resolve, or a socket cannot be opened.
    """

    def __init__(self, settings: MocapSettings) -> None:
        self.where = where = f"mocap {settings.server}:{settings.command_port}"
        """Beginning of a text on this client."""
        try:
            self._server = (socket.gethostbyname(settings.server), settings.command_port)
        except OSError:
            raise MocapProblem(f"{where}: the host name cannot be resolved; use an IPv4 address") from None
        self.sockets: list[socket.socket] = []
        """Sockets to wait on."""
        try:
            self._command = sockets.open_udp(settings.interface)
            self.sockets.append(self._command)
            if settings.transport == "multicast":
                data = sockets.open_udp(settings.multicast_group, settings.data_port, shared=True)
                self.sockets.append(data)
                sockets.join_source(data, settings.multicast_group, settings.interface, self._server[0])
        except OSError as error:
            for opened in self.sockets:
                opened.close()
            raise MocapProblem(f"{where}: cannot share the port with the flight process: {error.strerror}") from None
        self._client = NatNetClient(
            settings.rigid_body_id, settings.up_axis, settings.transport, application="companion guardian"
        )
        self._sent_s = float("-inf")
        self.tracked_s = float("-inf")
        """`monotonic` of the newest frame in which the body was tracked."""

    @property
    def problem(self) -> str | None:
        """Why the newest rejected datagram was invalid; None if none was rejected."""
        return self._client.problem

    def keep_connected(self, now_s: float) -> None:
        """Send connect requests and keep-alives when they are due; call every 10 to 50 ms."""
        if now_s - self._sent_s >= self._client.request_period_s:
            self._sent_s = now_s
            sockets.send(self._command, self._client.requests(now_s), self._server)

    def poses(self, now_s: float, origin_s: float = 0.0) -> list[MocapPose]:
        """Read all waiting datagrams; return the body's poses in order, stamped `now_s - origin_s`."""
        return [pose for datagram in self._datagrams() if (pose := self._pose(datagram, now_s, origin_s)) is not None]

    def poll_newest(self, now_s: float) -> None:
        """Read all waiting datagrams and parse only the newest frame; used in standby."""
        newest = None
        for datagram in self._datagrams():
            if natnet.message_id(datagram) == Message.FRAME:
                newest = datagram
            else:
                self._client.receive(datagram, now_s)
        if newest is not None:
            self._pose(newest, now_s, 0.0)

    def close(self) -> None:
        """Disconnect from the server and close the sockets."""
        if self.sockets:
            sockets.send(self._command, self._client.farewell(), self._server)
        for opened in self.sockets:
            opened.close()
        self.sockets.clear()

    def _datagrams(self) -> Iterator[bytes]:
        """Read the waiting datagrams of the server."""
        for opened in self.sockets:
            for datagram in sockets.waiting(opened):
                if datagram.sender_ip == self._server[0]:
                    yield datagram.data

    def _pose(self, datagram: bytes, now_s: float, origin_s: float) -> MocapPose | None:
        frame = self._client.receive(datagram, now_s)
        if frame is None or self._client.two_streams:
            return None
        pose = self._client.pose(frame, now_s - origin_s)
        if pose is not None and pose.tracking_valid:
            self.tracked_s = now_s
        return pose


def open_client(settings: MocapSettings) -> MocapClient | PluginClient:
    """Return a client of the vehicle's motion-capture system.

    Raises:
        MocapProblem: it cannot be opened.
    """
    if settings.type == "natnet":
        return MocapClient(settings)
    from companion.guardian.plugin_mocap import PluginClient  # imports what a guardian for NatNet does not need

    try:
        return PluginClient(settings)
    except Exception as error:
        raise MocapProblem(f"mocap {settings.type} {settings.server}: the client cannot be made: {error}") from None
