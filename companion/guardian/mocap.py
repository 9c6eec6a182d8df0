"""The guardian's motion-capture client: a second NatNet client on plain sockets.

In standby it keeps its connection to the server and reads only the newest frame. After a takeover it reads every frame. Parser and
frame conversion are those of the flight (`companion.io.mocap.natnet`, `companion.io.mocap.pose`).
"""

from __future__ import annotations

import contextlib
import socket

from companion.guardian.settings import MocapSettings
from companion.io.mocap import natnet
from companion.io.mocap.natnet import Malformed, Message, NatNetVersion
from companion.io.mocap.natnet_source import join_source
from companion.io.mocap.pose import VERSIONS, mocap_pose
from companion.model.types import MocapPose
from companion.safety.stream_watch import StreamWatch

CONNECT_PERIOD_S = 0.25
KEEP_ALIVE_PERIOD_S = 0.5
SILENCE_RECONNECT_S = 1.0
_MAX_DATAGRAMS = 256
_MAX_BYTES = 65535


class MocapProblem(Exception):
    """Motion capture cannot be received; one line for the user."""


class MocapClient:
    """Receives poses of the vehicle's rigid body; no call waits.

    Args:
        settings: addresses and rigid body.

    Raises:
        MocapProblem: a host name does not resolve, or a socket cannot be opened.
    """

    def __init__(self, settings: MocapSettings) -> None:
        self._settings = settings
        where = f"mocap {settings.server}:{settings.command_port}"
        try:
            self._server = (socket.gethostbyname(settings.server), settings.command_port)
        except OSError:
            raise MocapProblem(f"{where}: the host name cannot be resolved; use an IPv4 address") from None
        self.sockets: list[socket.socket] = []
        """Sockets to wait on."""
        try:
            self._command = self._open(settings.interface, 0)
            if settings.transport == "multicast":
                data = self._open(settings.multicast_group, settings.data_port)
                join_source(data, settings.multicast_group, settings.interface, self._server[0])
        except OSError as error:
            for opened in self.sockets:
                opened.close()
            raise MocapProblem(f"{where}: cannot listen beside the flight process: {error.strerror}") from None
        self._version: NatNetVersion | None = None
        self._clock_frequency_hz: int | None = None
        self._last_number: int | None = None
        self._streams = StreamWatch()
        self._heard_s = float("-inf")
        self._spoke_s = float("-inf")
        self.tracked_s = float("-inf")
        """`time.monotonic` of the newest frame in which the body was tracked."""
        self.problem: str | None = None
        """Why the newest invalid datagram was rejected."""

    def keep_connected(self, now_s: float) -> None:
        """Send connect requests and keep-alives when they are due; call every 10 to 50 ms."""
        known = self._version is not None
        if now_s - self._spoke_s < (KEEP_ALIVE_PERIOD_S if known else CONNECT_PERIOD_S):
            return
        self._spoke_s = now_s
        # A server that was restarted knows its client only after a new connect request.
        if not known or now_s - self._heard_s > SILENCE_RECONNECT_S:
            self._send(natnet.encode_connect("companion guardian"))
        elif self._settings.transport == "unicast":
            self._send(natnet.encode_request(Message.KEEP_ALIVE))

    def poses(self, now_s: float, origin_s: float = 0.0) -> list[MocapPose]:
        """Read all waiting datagrams; return the body's poses in order, stamped `now_s - origin_s`."""
        return [pose for datagram in self._datagrams() if (pose := self._pose(datagram, now_s, origin_s)) is not None]

    def poll_newest(self, now_s: float) -> None:
        """Read all waiting datagrams and parse only the newest frame (standby)."""
        newest = None
        for datagram in self._datagrams():
            newest = datagram
        if newest is not None:
            self._pose(newest, now_s, 0.0)

    def close(self) -> None:
        """Disconnect from the server and close the sockets."""
        if self._settings.transport == "unicast" and self.sockets:
            self._send(natnet.encode_message(Message.DISCONNECT))
        for opened in self.sockets:
            opened.close()
        self.sockets.clear()

    def _open(self, address: str, port: int) -> socket.socket:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sockets.append(opened)
        opened.setblocking(False)
        if port:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind((address, port))
        return opened

    def _send(self, datagram: bytes) -> None:
        with contextlib.suppress(OSError):  # the network is down for now: the next one may get through
            self._command.sendto(datagram, self._server)

    def _datagrams(self) -> list[bytes]:
        """Return the waiting frames; handle other messages."""
        frames: list[bytes] = []
        for opened in self.sockets:
            for _ in range(_MAX_DATAGRAMS):
                try:
                    datagram, address = opened.recvfrom(_MAX_BYTES)
                except (BlockingIOError, InterruptedError):
                    break
                except OSError:  # an ICMP error of an earlier send
                    continue
                if address[0] != self._server[0]:
                    continue
                kind = natnet.message_id(datagram)
                if kind == Message.FRAME:
                    frames.append(datagram)
                elif kind == Message.SERVER_INFO:
                    self._take_server_info(datagram)
        return frames

    def _take_server_info(self, datagram: bytes) -> None:
        info = natnet.parse_server_info(datagram)
        if isinstance(info, Malformed):
            self.problem = info.reason
        elif info.version in VERSIONS:
            self._version = VERSIONS[info.version]
            self._clock_frequency_hz = info.clock_frequency_hz
        else:
            self.problem = f"the server speaks NatNet {info.version}, expected {' or '.join(VERSIONS)}"

    def _pose(self, datagram: bytes, now_s: float, origin_s: float) -> MocapPose | None:
        if self._version is None:
            return None
        frame = natnet.parse_frame(datagram, self._version, self._settings.rigid_body_id, self._clock_frequency_hz)
        if isinstance(frame, Malformed):
            self.problem = frame.reason
            return None
        if self._streams.update(frame.number, frame.body, now_s):
            self.problem = "two servers at one address: frame numbers arrive in two sequences"
            return None
        if not natnet.is_newer(frame.number, self._last_number, now_s - self._heard_s):
            return None
        self._last_number = frame.number
        self._heard_s = now_s
        pose = mocap_pose(frame, now_s - origin_s, self._settings.up_axis)
        if pose is not None and pose.tracking_valid:
            self.tracked_s = now_s
        return pose
