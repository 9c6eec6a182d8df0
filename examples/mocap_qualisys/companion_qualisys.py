"""Qualisys Track Manager (QTM) as a motion-capture system of the companion. It has not been tried with a real QTM yet.

QTM's real-time protocol, version 1.25: commands and their answers on TCP, and on request one UDP datagram per frame with the component
6DRes, which has for each body the position in mm, the rotation matrix column by column, and the residual in mm. Everything is NaN while
a body is not tracked. Bodies have no ids; their order is that of the names in the answer to `GetParameters 6D`. Qualisys' own package
`qtm-rt` decodes the frames; its connection is not used, because it needs an event loop and streams on TCP.
"""

from __future__ import annotations

import math
import selectors
import socket
import struct
import xml.etree.ElementTree as ET

from qtm_rt.packet import QRTPacket, QRTPacketType, RTCommand, RTheader

from companion.config.base import Model
from companion.io.arrival import arrived_s
from companion.io.mocap.sockets import open_udp, waiting
from companion.io.mocap.system import MocapSettings
from companion.model.types import IDENTITY_QUAT, MocapPose, Quat

_RETRY_S = 1.0
"""Time between two attempts to connect, and the longest time without a frame after which the stream is requested again."""
_ANSWER_MAX_BYTES = 1_000_000
_DATA_HEAD = struct.Struct("<II8xII")
"""Size and type of the packet, time stamp (8 bytes), frame number, number of components."""


class QualisysOptions(Model):
    """Qualisys Track Manager (QTM) over its real-time protocol."""

    body_name: str
    """Name of the vehicle's 6DOF body in QTM."""
    port: int = 22223
    """QTM's TCP port for little-endian clients."""


class QualisysTrackManager:
    """Receives the poses of one body; `server` is the address of QTM's computer, `interface` this computer's in the same network."""

    options = QualisysOptions
    server_name = "Qualisys Track Manager, real-time protocol 1.25"

    def __init__(self, settings: MocapSettings) -> None:
        if settings.up_axis != "z":
            raise ValueError(f"QTM's z axis must point up, devices.mocap.up_axis is {settings.up_axis}")
        options = QualisysOptions.model_validate(dict(settings.options))
        self._name = options.body_name
        self._server = (socket.gethostbyname(settings.server), options.port)
        self._frames = open_udp(settings.interface)
        self._commands: socket.socket | None = None
        self._ready = False
        """Whether the TCP connection stands."""
        self._answers = b""
        self._bodies: list[str] = []
        self._due_s = -math.inf
        """Time of `now_s` at which QTM counts as silent."""
        self.problem: str | None = None

    def keep_connected(self, now_s: float) -> None:
        """Connect to QTM and request its stream; do so again if no frames arrive."""
        if now_s >= self._due_s:
            self._due_s = now_s + _RETRY_S
            if self._ready:
                self._send("GetParameters 6D")  # the answer starts the stream: bodies may have been added
            else:
                self._connect()
        if self._commands is not None:
            try:
                self._receive(self._commands)
            except (OSError, ValueError, struct.error, ET.ParseError) as error:
                self._lose(f"QTM {self._server[0]}:{self._server[1]}: {error}")

    def poses(self, now_s: float) -> list[MocapPose]:
        """Return the body's poses that have arrived since the last call."""
        found = []
        for datagram in waiting(self._frames):
            if datagram.sender_ip != self._server[0]:
                continue
            try:
                found.append(self._pose(datagram.data, arrived_s(datagram.ancillary, lambda: now_s)))
            except (struct.error, ValueError) as error:
                self.problem = f"datagram of {len(datagram.data)} bytes: {error}"
                continue
            self._due_s = now_s + _RETRY_S
        return found

    def close(self) -> None:
        """Close both sockets; QTM then ends the stream."""
        self._frames.close()
        if self._commands is not None:
            self._commands.close()
            self._commands = None

    def _connect(self) -> None:
        if self._commands is not None:
            self._commands.close()
        self._answers = b""
        self._commands = opened = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        opened.setblocking(False)
        opened.connect_ex(self._server)

    def _lose(self, problem: str) -> None:
        self.problem, self._ready = problem, False
        if self._commands is not None:
            self._commands.close()
            self._commands = None

    def _send(self, command: str) -> None:
        assert self._commands is not None
        text = command.encode()
        size = RTheader.size + len(text) + 1
        packet = struct.pack(RTCommand % len(text), size, QRTPacketType.PacketCommand.value, text, b"\0")
        try:
            self._commands.send(packet)
        except OSError as error:
            self._lose(f"QTM {self._server[0]}:{self._server[1]}: {error}")

    def _receive(self, commands: socket.socket) -> None:
        if not self._ready:
            if not _writable(commands):
                return
            problem = commands.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            if problem:
                raise OSError(problem, "no connection (is QTM running, with this port for little-endian clients?)")
            self._ready = True
            self._send("Version 1.25")
            self._send("GetParameters 6D")
            return
        try:
            data = commands.recv(65536)
        except BlockingIOError:
            return
        if not data:
            raise OSError("QTM has closed the connection")
        self._answers += data
        while len(self._answers) >= RTheader.size:
            size, kind = RTheader.unpack_from(self._answers)
            if not RTheader.size <= size <= _ANSWER_MAX_BYTES:
                raise ValueError(f"an answer of {size} bytes")
            if len(self._answers) < size:
                return
            answer, self._answers = self._answers[RTheader.size : size], self._answers[size:]
            self._take(QRTPacketType(kind), answer.rstrip(b"\0"))

    def _take(self, kind: QRTPacketType, answer: bytes) -> None:
        if kind is QRTPacketType.PacketError:
            self.problem = f"QTM refuses: {answer.decode(errors='replace')}"
        elif kind is QRTPacketType.PacketXML:
            self._bodies = [body.findtext("Name", "") for body in ET.fromstring(answer).iter("Body")]
            if self._name not in self._bodies:
                self.problem = f"QTM has no 6DOF body {self._name!r}; it has: {', '.join(self._bodies) or 'none'}"
            else:
                self._send(f"StreamFrames AllFrames UDP:{self._frames.getsockname()[1]} 6DRes")

    def _pose(self, data: bytes, stamp_s: float) -> MocapPose:
        size, kind, _, components = _DATA_HEAD.unpack_from(data)
        if (size, kind, components) != (len(data), QRTPacketType.PacketData.value, 1):
            raise ValueError(
                f"packet of type {kind} with {components} components and a size of {size}, expected one of 6DRes"
            )
        packet = QRTPacket(data[RTheader.size :])
        component = packet.get_6d_residual()
        bodies = component[1] if component is not None else []
        if len(bodies) != len(self._bodies):
            raise ValueError(f"{len(bodies)} bodies, but QTM has named {len(self._bodies)}")
        (x_mm, y_mm, z_mm), (matrix,), (residual_mm,) = bodies[self._bodies.index(self._name)]
        tracked = all(map(math.isfinite, (x_mm, y_mm, z_mm, *matrix)))
        return MocapPose(
            stamp_s=stamp_s,
            frame_number=packet.framenumber,
            position_world_m=(1e-3 * x_mm, 1e-3 * y_mm, 1e-3 * z_mm) if tracked else (0.0, 0.0, 0.0),
            attitude_wxyz=_quat(matrix) if tracked else IDENTITY_QUAT,
            tracking_valid=tracked,
            marker_error_m=1e-3 * residual_mm if tracked and math.isfinite(residual_mm) else 0.0,
            exposure_server_s=1e-6 * packet.timestamp,
        )


def _quat(columns: tuple[float, ...]) -> Quat:
    """Return the quaternion of a rotation matrix that is given column by column."""
    xx, yx, zx, xy, yy, zy, xz, yz, zz = columns
    w = math.sqrt(max(0.0, 1.0 + xx + yy + zz)) / 2.0
    x = math.copysign(math.sqrt(max(0.0, 1.0 + xx - yy - zz)) / 2.0, zy - yz)
    y = math.copysign(math.sqrt(max(0.0, 1.0 - xx + yy - zz)) / 2.0, xz - zx)
    z = math.copysign(math.sqrt(max(0.0, 1.0 - xx - yy + zz)) / 2.0, yx - xy)
    return (w, x, y, z)


def _writable(opened: socket.socket) -> bool:
    with selectors.DefaultSelector() as selector:
        selector.register(opened, selectors.EVENT_WRITE)
        return bool(selector.select(0))
