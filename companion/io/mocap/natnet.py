"""NatNet datagrams: header, requests and server description. Pure: bytes in, frozen records out; no sockets and no clock.

Source: NatNet SDK, `NatNetTypes.h` and the depacketisation of its packet client. Little endian; every datagram starts with `<HH`
(message id, bytes that follow). `companion.io.mocap.frames` reads frames of data, `companion.io.mocap.definitions` model definitions.
Positions are in metres, attitudes are quaternions, both in the axes that Motive streams; `z_up_from_y_up` turns a y-up stream into the
companion's world.

No parser raises on a bad datagram: it returns `Malformed` with a reason.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from companion.model.types import Quat, Vec3

Version = tuple[int, int]
"""Major and minor number of a bitstream."""
Buffer = bytes | bytearray | memoryview


class Message(IntEnum):
    """Message ids (NAT_* of NatNetTypes.h)."""

    CONNECT = 0
    SERVER_INFO = 1
    REQUEST = 2
    RESPONSE = 3
    REQUEST_MODELDEF = 4
    MODELDEF = 5
    REQUEST_FRAME = 6
    FRAME = 7
    MESSAGE_STRING = 8
    DISCONNECT = 9
    KEEP_ALIVE = 10
    ECHO_REQUEST = 12
    ECHO_RESPONSE = 13
    UNRECOGNIZED_REQUEST = 100


OLDEST_VERSION: Final[Version] = (3, 0)
NEWEST_DESCRIBED_VERSION: Final[Version] = (4, 4)
"""The newest version whose bytes the SDK's packet clients describe. A later one is read as far as its section sizes allow."""
SECTION_SIZES_SINCE: Final[Version] = (4, 1)
"""First version in which each section of a frame and each model definition states its size in bytes."""
MAX_NAME_BYTES: Final = 256
RESTART_GAP_FRAMES: Final = 200
"""UDP does not reorder over a second of frames: a jump back this far means that the server was restarted."""
RESTART_SILENCE_S: Final = 0.5

U32: Final = struct.Struct("<I")
COUNT_BYTES: Final = struct.Struct("<II")
VEC3_BYTES: Final = 12
_HEADER = struct.Struct("<HH")
_SENDER = struct.Struct("<256s4s4s")
_CONNECTION = struct.Struct("<QH?4s")
_ECHO_REQUEST = struct.Struct("<Q")
_ECHO_RESPONSE = struct.Struct("<QQ")
_CONNECT_OPTIONS_BYTES = 6  # subscribedDataOnly, BitstreamVersion[4] (0.0.0.0: the server's own), terminator


@dataclass(frozen=True, slots=True)
class Malformed:
    """A datagram that does not match its header."""

    reason: str


@dataclass(frozen=True, slots=True)
class ServerInfo:
    """NAT_SERVERINFO: sSender_Server."""

    application: str
    application_version: tuple[int, int, int, int]
    natnet_version: tuple[int, int, int, int]
    clock_frequency_hz: int | None
    """Ticks per second of the stamps in a frame's suffix."""
    data_port: int | None
    multicast: bool | None
    multicast_group: str | None

    @property
    def version(self) -> str:
        """Major and minor NatNet version, such as "4.1"."""
        return f"{self.natnet_version[0]}.{self.natnet_version[1]}"

    @property
    def name(self) -> str:
        """Name and version of the server program, and the NatNet version, such as "Motive 3.1, NatNet 4.1"."""
        version = ".".join(map(str, self.application_version)).removesuffix(".0").removesuffix(".0")
        return f"{self.application} {version}, NatNet {self.version}".strip()


def message_id(datagram: Buffer) -> int | None:
    """Return the message id of a datagram, or None if it is shorter than a header."""
    if len(datagram) < _HEADER.size:
        return None
    number: int = _HEADER.unpack_from(datagram)[0]
    return number


def encode_message(message: Message, payload: bytes = b"") -> bytes:
    """Return a datagram of header and payload (at most 65535 bytes)."""
    return _HEADER.pack(message, len(payload)) + payload


def encode_request(message: Message) -> bytes:
    """Return a request to the server. Its payload is one zero byte, an empty string, as in the requests of NatNet's own client."""
    return encode_message(message, b"\0")


def encode_connect(application: str = "companion") -> bytes:
    """Return a NAT_CONNECT datagram: sSender and connection options that request the server's own bitstream version."""
    sender = _SENDER.pack(application.encode()[: MAX_NAME_BYTES - 1], bytes(4), bytes((4, 1, 0, 0)))
    return encode_message(Message.CONNECT, sender + bytes(_CONNECT_OPTIONS_BYTES))


def encode_echo_request(token: int) -> bytes:
    """Return a NAT_ECHOREQUEST; the server repeats the token (u64) in its answer."""
    return encode_message(Message.ECHO_REQUEST, _ECHO_REQUEST.pack(token))


def parse_echo_response(datagram: Buffer) -> tuple[int, int] | Malformed:
    """Parse NAT_ECHORESPONSE: the token of the request, and the server's clock at its reception, in ticks."""
    payload = payload_of(datagram, Message.ECHO_RESPONSE)
    if isinstance(payload, Malformed):
        return payload
    if len(payload) < _ECHO_RESPONSE.size:
        return Malformed(f"echo response of {len(payload)} bytes, expected {_ECHO_RESPONSE.size}")
    token, ticks = _ECHO_RESPONSE.unpack_from(payload)
    return token, ticks


def is_newer(number: int, last_number: int | None, silence_s: float) -> bool:
    """Return whether a frame number follows the last accepted one, modulo 2^32 or after a restart of the server.

    Args:
        number: number of the frame that just arrived.
        last_number: number of the frame accepted last, None before the first.
        silence_s: time since that frame, s.
    """
    if last_number is None:
        return True
    ahead = (number - last_number) & 0xFFFFFFFF
    if ahead == 0:
        return False
    if ahead < 0x80000000:
        return True
    return 0x100000000 - ahead >= RESTART_GAP_FRAMES or silence_s > RESTART_SILENCE_S


def z_up_from_y_up(position_m: Vec3, quat_wxyz: Quat) -> tuple[Vec3, Quat]:
    """Rotate from Motive's y-up axes (world and body alike) to z-up, by +90 deg about x: (x, y, z) -> (x, -z, y)."""
    x, y, z = position_m
    qw, qx, qy, qz = quat_wxyz
    return (x, -z, y), (qw, qx, -qz, qy)


def parse_server_info(datagram: Buffer) -> ServerInfo | Malformed:
    """Parse NAT_SERVERINFO; clock and connection fields are None for a server before 3.0 or a short reply."""
    payload = payload_of(datagram, Message.SERVER_INFO)
    if isinstance(payload, Malformed):
        return payload
    if len(payload) < _SENDER.size:
        return Malformed(f"server info of {len(payload)} bytes, expected {_SENDER.size} or more")
    name, application_version, natnet_version = _SENDER.unpack_from(payload)
    frequency_hz: int | None = None
    data_port: int | None = None
    multicast: bool | None = None
    group: str | None = None
    if len(payload) >= _SENDER.size + _CONNECTION.size:
        ticks, data_port, multicast, address = _CONNECTION.unpack_from(payload, _SENDER.size)
        frequency_hz = ticks or None
        group = ".".join(str(byte) for byte in address)
    return ServerInfo(
        application=printable(name.partition(b"\0")[0]),
        application_version=tuple(application_version),
        natnet_version=tuple(natnet_version),
        clock_frequency_hz=frequency_hz,
        data_port=data_port,
        multicast=multicast,
        multicast_group=group,
    )


def payload_of(datagram: Buffer, expected: Message) -> bytes | Malformed:
    """Return what follows the header of a datagram with the expected message id."""
    if len(datagram) < _HEADER.size:
        return Malformed(f"datagram of {len(datagram)} bytes; a header has {_HEADER.size}")
    message, size = _HEADER.unpack_from(datagram)
    if message != expected:
        return Malformed(f"message id {message}, expected {expected.value}")
    if len(datagram) < _HEADER.size + size:
        return Malformed(f"header announces {size} bytes, received {len(datagram) - _HEADER.size}")
    return bytes(datagram[_HEADER.size : _HEADER.size + size])


def printable(name: bytes) -> str:
    """Return a name for display: one line without terminal control characters."""
    text = name.decode("utf-8", "replace")
    return "".join(character if character.isprintable() else "?" for character in text)


def skip_string(data: bytes, offset: int) -> int:
    """Return the offset after a zero-terminated string. Raise ValueError if the string does not end within 256 bytes."""
    return data.index(b"\0", offset, offset + MAX_NAME_BYTES) + 1
