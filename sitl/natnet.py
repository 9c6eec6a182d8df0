"""An emulated NatNet server (Motive): multicast and unicast, with any bitstream version from 3.0 on.

The packet layouts follow the NatNet SDK (`NatNetTypes.h`, packet client). This module shares only the message ids with the companion's
parser, so that an error in either becomes visible. The caller adds latency and noise.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Self

from companion.io.mocap.definitions import Descriptor
from companion.io.mocap.natnet import Message
from companion.model.algebra import plus
from companion.model.frames import quat_rotate
from companion.model.types import Quat, Vec3
from companion.runtime.clock import monotonic

CLOCK_FREQUENCY_HZ: Final = 10_000_000
"""Frequency of the Windows performance counter, as Motive reports it."""
_CLOCK_ORIGIN_S: Final = 1000.0  # the server has been running; tick 0 means "no stamp"
_APPLICATION = b"Motive"
_MARKER_NAMES, _SIZES, _PIVOT_ROTATION, _NEWEST = (4, 0), (4, 1), (4, 2), (4, 4)
"""Versions from which a server has the named property, and the newest version that the SDK describes."""
_CLIENT_TIMEOUT_S: Final = 5.0
_NUMBERS: Final = 100_000
"""More frames than a server sends before a flight begins."""
_MARKERS_BODY_M: Final[tuple[Vec3, ...]] = (
    (0.16, 0.0, 0.05),
    (-0.12, 0.10, 0.05),
    (-0.12, -0.12, 0.05),
    (0.0, 0.05, 0.11),
)
_STRAY_MARKER_M: Final[Vec3] = (2.5, -2.0, 0.03)  # a reflection on the floor
LOOPBACK, LOOPBACK_BROADCAST = "127.0.0.1", "127.255.255.255"
"""A socket bound to the loopback address receives no broadcasts, so a second socket listens for them."""
OTHER_BODY: Final = "wand"
OTHER_PLACE_M: Final[Vec3] = (1.9, -1.5, 0.04)
"""Position of the second rigid body, which lies on the floor."""
_MARKER_SIZE_M: Final = 0.014
_MARKER_OCCLUDED = 0x01
_MARKER_POINT_CLOUD_SOLVED = 0x02
_MARKER_MODEL_SOLVED = 0x04
_MARKER_HAS_MODEL = 0x08
_MARKER_UNLABELLED = 0x10
_END_OF_DATA = bytes(4)


@dataclass(frozen=True, slots=True)
class BodyPose:
    """Pose of one rigid body in one frame, in the axes of the stream."""

    id: int
    position_m: Vec3
    quat_wxyz: Quat
    valid: bool = True
    error_m: float = 0.0002


class NatNetServer:
    """Streams motion-capture frames and answers clients; an async context manager on the running event loop.

    A client becomes a unicast client when it connects or, with a multicast group, when it sends a keep-alive.

    Args:
        version: NatNet bitstream version, such as "4.1". One later than 4.4 has an additional section of unknown content.
        command_port: command port; 0 for any free one.
        data_port: source port of every frame and destination of multicast frames; 0 for any free one.
        multicast_group: multicast address, or None to stream to unicast clients only.
        bodies: id and name of each rigid body.
        clock: time that the server lives in, s.
        stamps: clock of the stamps in frames and in answers to echo requests, s; None for `clock`.
    """

    def __init__(
        self,
        version: str = "4.1",
        command_port: int = 0,
        data_port: int = 0,
        multicast_group: str | None = None,
        bodies: Sequence[tuple[int, str]] = ((1, "companion"),),
        clock: Callable[[], float] = monotonic,
        stamps: Callable[[], float] | None = None,
    ) -> None:
        self._clock = clock
        self._stamps = stamps or clock
        self.version = version
        self.multicast_group = multicast_group
        self.bodies = tuple(bodies)
        self.dropped = 0
        """Number of datagrams that could not be sent."""
        self.requests = 0
        self._ports = (command_port, data_port)
        self._command: socket.socket | None = None
        self._data: socket.socket | None = None
        self._broadcast: socket.socket | None = None
        self._clients: dict[tuple[str, int], float] = {}
        """Time at which each unicast client was last heard, by its address."""
        self.frame_number = 0
        """Number of the newest frame; 0 before the first."""

    @property
    def command_port(self) -> int:
        """Port that clients send to."""
        return _port(self._command, self._ports[0])

    @property
    def data_port(self) -> int:
        """Port that multicast frames go to."""
        return _port(self._data, self._ports[1])

    @property
    def unicast_clients(self) -> tuple[tuple[str, int], ...]:
        """Addresses of the unicast clients."""
        return tuple(self._clients)

    async def __aenter__(self) -> Self:
        """Open both sockets.

        Raises:
            OSError: a port is in use; the text names the cause.
        """
        try:
            self._command = self._bind(self._ports[0])
            self._data = self._bind(self._ports[1])
            self._broadcast = self._bind(self.command_port, LOOPBACK_BROADCAST)
            if self.multicast_group is not None:
                self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LOOPBACK))
                self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
                self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        except BaseException:
            self._close()
            raise
        for opened in self._listening():
            asyncio.get_running_loop().add_reader(opened.fileno(), self._answer_all, opened)
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close both sockets."""
        for opened in self._listening():
            asyncio.get_running_loop().remove_reader(opened.fileno())
        self._close()

    def _listening(self) -> list[socket.socket]:
        return [opened for opened in (self._command, self._broadcast) if opened is not None]

    def start_over(self) -> None:
        """Go on at a frame number that does not depend on the past: world time starts over."""
        self.frame_number += _NUMBERS - self.frame_number % _NUMBERS
        self._clients = dict.fromkeys(self._clients, self._clock())

    def publish(
        self,
        t_s: float,
        poses: Sequence[BodyPose],
        exposure_t_s: float | None,
        markers: Sequence[Vec3] = (_STRAY_MARKER_M,),
    ) -> None:
        """Send one frame to every client; never blocks.

        Args:
            t_s: time of transmission on the world's clock.
            exposure_t_s: middle of the cameras' exposure on the same clock, or None if the cameras do not report it.
            markers: markers that belong to no rigid body, in the axes of the stream.
        """
        self.frame_number += 1
        oldest_s = self._clock() - _CLIENT_TIMEOUT_S
        self._clients = {address: heard_s for address, heard_s in self._clients.items() if heard_s >= oldest_s}
        addresses = list(self._clients)
        if self.multicast_group is not None:
            addresses.insert(0, (self.multicast_group, self.data_port))
        if addresses:
            frame = encode_frame(self.version, self.frame_number, t_s, poses, exposure_t_s, dict(self.bodies), markers)
            for address in addresses:
                self._send(self._data, frame, address)

    def _bind(self, port: int, address: str = LOOPBACK) -> socket.socket:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            opened.setblocking(False)
            opened.bind((address, port))
        except OSError as error:
            opened.close()
            raise OSError(error.errno, f"NatNet server: cannot bind UDP {address}:{port} ({error.strerror})") from None
        return opened

    def _close(self) -> None:
        for opened in (self._command, self._data, self._broadcast):
            if opened is not None:
                opened.close()
        self._command = self._data = self._broadcast = None
        self._clients.clear()

    def _send(self, sender: socket.socket | None, datagram: bytes, address: tuple[str, int]) -> None:
        if sender is None:
            return
        try:
            sender.sendto(datagram, address)
        except OSError:
            self.dropped += 1

    def _answer_all(self, opened: socket.socket) -> None:
        while self._command is not None:
            try:
                datagram, address = opened.recvfrom(65535)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:  # an ICMP error from an earlier answer
                continue
            self.requests += 1
            self._answer(datagram, (address[0], address[1]))

    def _answer(self, datagram: bytes, address: tuple[str, int]) -> None:
        if len(datagram) < 4:
            return
        message: int = struct.unpack_from("<H", datagram)[0]
        now_s = self._clock()
        if message == Message.CONNECT:
            if self.multicast_group is None:
                self._clients[address] = now_s
            self._reply(Message.SERVER_INFO, self._server_info(), address)
        elif message == Message.KEEP_ALIVE:
            self._clients[address] = now_s
        elif message == Message.ECHO_REQUEST and len(datagram) >= 12:
            self._reply(Message.ECHO_RESPONSE, datagram[4:12] + struct.pack("<Q", _ticks(self._stamps())), address)
        elif message == Message.REQUEST_MODELDEF:
            self._reply(Message.MODELDEF, encode_model_definitions(self.version, self.bodies), address)
        elif message == Message.DISCONNECT:
            self._clients.pop(address, None)
        else:
            self._reply(Message.UNRECOGNIZED_REQUEST, b"", address)

    def _reply(self, message: Message, payload: bytes, address: tuple[str, int]) -> None:
        self._send(self._command, struct.pack("<HH", message, len(payload)) + payload, address)

    def _server_info(self) -> bytes:
        group = socket.inet_aton(self.multicast_group or "0.0.0.0")
        major, minor = _numbers(self.version)
        motive = bytes((max(1, major - 1), minor, 0, 0))
        sender = struct.pack("<256s4s4s", _APPLICATION, motive, bytes((major, minor, 0, 0)))
        return (
            sender + struct.pack("<QH?", CLOCK_FREQUENCY_HZ, self.data_port, self.multicast_group is not None) + group
        )


def encode_frame(
    version: str,
    number: int,
    t_s: float,
    poses: Sequence[BodyPose],
    exposure_t_s: float | None,
    names: dict[int, str],
    single: Sequence[Vec3] = (_STRAY_MARKER_M,),
) -> bytes:
    """Return one NAT_FRAMEOFDATA datagram with all sections that this NatNet version defines.

    Args:
        version: NatNet bitstream version.
        t_s: as for `NatNetServer.publish`.
        poses: as for `NatNetServer.publish`.
        exposure_t_s: as for `NatNetServer.publish`.
        names: name of each rigid body, by its id.
        single: markers that belong to no rigid body. As Motive does, each is listed twice: among the other markers, and without a
            label among the labelled ones, with an id that is its place in this frame.
    """
    sizes = _numbers(version) >= _SIZES
    markers = {
        pose.id: [plus(pose.position_m, quat_rotate(pose.quat_wxyz, offset)) for offset in _MARKERS_BODY_M]
        for pose in poses
    }
    sets = [(names.get(body_id, f"body {body_id}"), points) for body_id, points in markers.items()]
    sets.append(("all", [point for points in markers.values() for point in points]))
    marker_sets = b"".join(
        name.encode()
        + b"\0"
        + struct.pack("<I", len(points))
        + b"".join(struct.pack("<3f", *point) for point in points)
        for name, points in sets
    )
    bodies = b"".join(_rigid_body(pose) for pose in poses)
    labelled = b"".join(
        struct.pack("<I3ffHf", pose.id << 16 | k, *point, _MARKER_SIZE_M, _marker_params(pose), pose.error_m)
        for pose in poses
        for k, point in enumerate(markers[pose.id], start=1)
    )
    params = _MARKER_UNLABELLED | _MARKER_POINT_CLOUD_SOLVED
    labelled += b"".join(
        struct.pack("<I3ffHf", 900001 + k, *point, _MARKER_SIZE_M, params, 0.0004) for k, point in enumerate(single)
    )

    def section(count: int, content: bytes) -> bytes:
        sized = struct.pack("<I", len(content)) if sizes else b""
        return struct.pack("<I", count) + sized + content

    exposure = 0 if exposure_t_s is None else _ticks(exposure_t_s)
    suffix = struct.pack("<IIdQQQ", 0, 0, t_s, exposure, exposure, _ticks(t_s))
    if sizes:
        whole_s = int(t_s)
        suffix += struct.pack("<II", whole_s, int((t_s - whole_s) * 0xFFFFFFFF))
    payload = b"".join(
        (
            struct.pack("<I", number & 0xFFFFFFFF),
            section(len(sets), marker_sets),
            section(len(single), b"".join(struct.pack("<3f", *point) for point in single)),
            section(len(poses), bodies),
            section(0, b""),  # skeletons
            section(0, b"") if sizes else b"",  # assets
            section(len(_MARKERS_BODY_M) * len(poses) + len(single), labelled),
            section(0, b""),  # force plates
            section(0, b""),  # devices
            section(1, b"unknown\0") if _numbers(version) > _NEWEST else b"",
            suffix,
            struct.pack("<H", 0),
            _END_OF_DATA,
        )
    )
    return struct.pack("<HH", Message.FRAME, len(payload)) + payload


def encode_model_definitions(version: str, bodies: Sequence[tuple[int, str]]) -> bytes:
    """Return the payload of NAT_MODELDEF: marker sets, rigid bodies and one camera."""
    descriptions: list[tuple[Descriptor, bytes]] = []
    count = len(_MARKERS_BODY_M)
    labels = [f"Marker{k}".encode() + b"\0" for k in range(1, count + 1)]
    for number, name in bodies:
        text = name.encode() + b"\0"
        descriptions.append((Descriptor.MARKER_SET, text + struct.pack("<I", count) + b"".join(labels)))
        pivot = struct.pack("<Ii3f", number, -1, 0.0, 0.0, 0.0)
        if _numbers(version) >= _PIVOT_ROTATION:
            pivot += struct.pack("<4f", 0.0, 0.0, 0.0, 1.0)
        body = text + pivot + struct.pack("<I", count)
        body += b"".join(struct.pack("<3f", *offset) for offset in _MARKERS_BODY_M) + struct.pack("<I", 0) * count
        if _numbers(version) >= _MARKER_NAMES:
            body += b"".join(labels)
        descriptions.append((Descriptor.RIGID_BODY, body))
    camera = b"Prime 13 #1\0" + struct.pack("<7f", 3.0, 3.0, 2.8, 0.0, 0.0, 0.0, 1.0)
    descriptions.append((Descriptor.CAMERA, camera))
    parts = [struct.pack("<I", len(descriptions))]
    for kind, content in descriptions:
        parts.append(struct.pack("<I", kind))
        if _numbers(version) >= _SIZES:
            parts.append(struct.pack("<I", len(content)))
        parts.append(content)
    return b"".join(parts)


def _numbers(version: str) -> tuple[int, int]:
    major, _, minor = version.partition(".")
    return int(major), int(minor)


def _rigid_body(pose: BodyPose) -> bytes:
    w, x, y, z = pose.quat_wxyz
    return struct.pack("<I3f4ffH", pose.id, *pose.position_m, x, y, z, w, pose.error_m, 1 if pose.valid else 0)


def _marker_params(pose: BodyPose) -> int:
    solved = _MARKER_POINT_CLOUD_SOLVED if pose.valid else _MARKER_OCCLUDED
    return _MARKER_HAS_MODEL | _MARKER_MODEL_SOLVED | solved


def _ticks(t_s: float) -> int:
    return round((t_s + _CLOCK_ORIGIN_S) * CLOCK_FREQUENCY_HZ)


def _port(opened: socket.socket | None, configured: int) -> int:
    return configured if opened is None else int(opened.getsockname()[1])
