"""NatNet 3.0 and 4.1 datagrams. Pure: bytes in, frozen records out; no sockets and no clock.

Source: NatNet SDK, `NatNetTypes.h` and the depacketisation of its packet client. Little endian; every datagram starts with `<HH`
(message id, bytes that follow). A section of a frame starts with `u32 count`, since 4.1 followed by `u32 bytes`. Positions are in
metres, attitudes are quaternions, both in the axes that Motive streams; `z_up_from_y_up` turns a y-up stream into the companion's
world.

Nothing here raises on a bad datagram: parsers return `Malformed` with a reason.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Literal

from companion.model.types import IDENTITY_QUAT, Quat, Vec3

NatNetVersion = Literal["3.0", "4.1"]
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
    UNRECOGNIZED_REQUEST = 100


class Descriptor(IntEnum):
    """Types of model definitions."""

    MARKER_SET = 0
    RIGID_BODY = 1
    SKELETON = 2
    FORCE_PLATE = 3
    DEVICE = 4
    CAMERA = 5
    ASSET = 6


MAX_NAME_BYTES: Final = 256
RIGID_BODY_BYTES: Final = 38
LABELLED_MARKER_BYTES: Final = 26
RESTART_GAP_FRAMES: Final = 200
"""UDP does not reorder over a second of frames: a jump back this far means that the server was restarted."""
RESTART_SILENCE_S: Final = 0.5

_HEADER = struct.Struct("<HH")
_U32 = struct.Struct("<I")
_COUNT_BYTES = struct.Struct("<II")
_RIGID_BODY = struct.Struct("<I7ffH")
_SUFFIX = struct.Struct("<IIdQQQ")
_SENDER = struct.Struct("<256s4s4s")
_CONNECTION = struct.Struct("<QH?4s")
_CONNECT_OPTIONS_BYTES = 6  # subscribedDataOnly, BitstreamVersion[4] (0.0.0.0: the server's own), terminator
_VEC3_BYTES = 12
_PARAM_TRACKING_VALID = 0x01
_QUAT_NORM_TOLERANCE = 0.02


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
        """Program, its version and NatNet's, such as "Motive 3.1, NatNet 4.1"."""
        version = ".".join(map(str, self.application_version)).removesuffix(".0").removesuffix(".0")
        return f"{self.application} {version}, NatNet {self.version}".strip()


@dataclass(frozen=True, slots=True)
class RigidBody:
    """One rigid body of a frame, in the axes that the server streams."""

    id: int
    position_m: Vec3
    quat_wxyz: Quat
    error_m: float
    tracking_valid: bool


@dataclass(frozen=True, slots=True)
class Frame:
    """The data of one frame that the companion uses."""

    number: int
    timestamp_s: float
    """Time of the frame on the server's own time base."""
    latency_s: float | None
    """Time from mid-exposure to transmission; None if the server has no exposure stamp or no clock frequency."""
    exposure_s: float | None
    """Time of mid-exposure on the server's own clock; None in the same cases."""
    body: RigidBody | None
    """The requested rigid body; None if it is not in this frame."""
    body_ids: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class BodyDefinition:
    """Streaming id and name of a rigid body."""

    id: int
    name: str


def message_id(datagram: Buffer) -> int | None:
    """Return the message id of a datagram, or None if it is shorter than a header."""
    if len(datagram) < _HEADER.size:
        return None
    number: int = _HEADER.unpack_from(datagram)[0]
    return number


def encode_message(message: Message, payload: bytes = b"") -> bytes:
    """Return a datagram of header and payload (at most 65535 bytes)."""
    return _HEADER.pack(message, len(payload)) + payload


def encode_request(message: Message, text: str = "") -> bytes:
    """Return a client datagram with a zero-terminated string (NAT_REQUEST "FrameRate", keep-alive "", ...)."""
    return encode_message(message, text.encode() + b"\0")


def encode_connect(application: str = "companion") -> bytes:
    """Return a NAT_CONNECT datagram: sSender and connection options that request the server's own bitstream version."""
    sender = _SENDER.pack(application.encode()[: MAX_NAME_BYTES - 1], bytes(4), bytes((4, 1, 0, 0)))
    return encode_message(Message.CONNECT, sender + bytes(_CONNECT_OPTIONS_BYTES))


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
    payload = _payload(datagram, Message.SERVER_INFO)
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
        application=_text(name.partition(b"\0")[0]),
        application_version=tuple(application_version),
        natnet_version=tuple(natnet_version),
        clock_frequency_hz=frequency_hz,
        data_port=data_port,
        multicast=multicast,
        multicast_group=group,
    )


def parse_frame(
    datagram: Buffer, version: NatNetVersion, body_id: int, clock_frequency_hz: int | None
) -> Frame | Malformed:
    """Parse the requested rigid body and the suffix of a NAT_FRAMEOFDATA datagram; all other sections are skipped.

    Args:
        datagram: the datagram including its header.
        version: the server's NatNet version.
        body_id: streaming id of the requested rigid body.
        clock_frequency_hz: from `ServerInfo`, for the latency.
    """
    payload = _payload(datagram, Message.FRAME)
    if isinstance(payload, Malformed):
        return payload
    try:
        return _frame(payload, version == "4.1", body_id, clock_frequency_hz)
    except (struct.error, ValueError) as error:
        # Every read past the end and every missing terminator ends up here, so no field needs a check of its own.
        return Malformed(f"frame of {len(payload)} bytes ends early or has wrong section sizes ({error})")


def parse_model_definitions(datagram: Buffer, version: NatNetVersion) -> tuple[BodyDefinition, ...] | Malformed:
    """Parse NAT_MODELDEF: ids and names of the rigid bodies, without those of skeletons and assets."""
    payload = _payload(datagram, Message.MODELDEF)
    if isinstance(payload, Malformed):
        return payload
    try:
        return _model_definitions(payload, version == "4.1")
    except (struct.error, ValueError) as error:
        return Malformed(f"model definitions of {len(payload)} bytes end early or have wrong sizes ({error})")


def _payload(datagram: Buffer, expected: Message) -> bytes | Malformed:
    if len(datagram) < _HEADER.size:
        return Malformed(f"datagram of {len(datagram)} bytes; a header has {_HEADER.size}")
    message, size = _HEADER.unpack_from(datagram)
    if message != expected:
        return Malformed(f"message id {message}, expected {expected.value}")
    if len(datagram) < _HEADER.size + size:
        return Malformed(f"header announces {size} bytes, received {len(datagram) - _HEADER.size}")
    return bytes(datagram[_HEADER.size : _HEADER.size + size])


def _frame(data: bytes, sized: bool, body_id: int, clock_frequency_hz: int | None) -> Frame | Malformed:
    number: int = _U32.unpack_from(data)[0]
    offset = _skip_marker_sets(data, 4, sized)
    offset = _skip_fixed(data, offset, sized, _VEC3_BYTES)  # other (unlabelled) markers

    count, start = _section(data, offset, sized)
    offset = start + RIGID_BODY_BYTES * count
    if offset > len(data):
        return Malformed(f"{count} rigid bodies do not fit into {len(data)} bytes")
    if sized and _U32.unpack_from(data, start - 4)[0] != RIGID_BODY_BYTES * count:
        return Malformed(f"{count} rigid bodies are not {RIGID_BODY_BYTES} bytes each: a different bitstream version")
    ids = tuple(_U32.unpack_from(data, start + RIGID_BODY_BYTES * i)[0] for i in range(count))
    body: RigidBody | None = None
    if body_id in ids:
        found = _rigid_body(data, start + RIGID_BODY_BYTES * ids.index(body_id))
        if isinstance(found, Malformed):
            return found
        body = found

    if sized:
        for _ in range(5):  # skeletons, assets, labelled markers, force plates, devices
            _, size = _COUNT_BYTES.unpack_from(data, offset)
            offset += 8 + size
    else:
        offset = _skip_skeletons(data, offset)
        offset = _skip_fixed(data, offset, sized, LABELLED_MARKER_BYTES)
        offset = _skip_channels(data, offset)  # force plates
        offset = _skip_channels(data, offset)  # devices
    _, _, timestamp_s, exposure, _, transmit = _SUFFIX.unpack_from(data, offset)
    latency_s: float | None = None
    exposure_s: float | None = None
    if clock_frequency_hz and exposure and transmit >= exposure:
        latency_s = (transmit - exposure) / clock_frequency_hz
        exposure_s = exposure / clock_frequency_hz
    return Frame(
        number=number, timestamp_s=timestamp_s, latency_s=latency_s, exposure_s=exposure_s, body=body, body_ids=ids
    )


def _rigid_body(data: bytes, offset: int) -> RigidBody | Malformed:
    number, x, y, z, qx, qy, qz, qw, error_m, params = _RIGID_BODY.unpack_from(data, offset)
    valid = bool(params & _PARAM_TRACKING_VALID)
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    pose_ok = math.isfinite(x + y + z + error_m) and abs(norm - 1.0) < _QUAT_NORM_TOLERANCE
    if pose_ok:
        return RigidBody(
            id=number,
            position_m=(x, y, z),
            quat_wxyz=(qw / norm, qx / norm, qy / norm, qz / norm),
            error_m=error_m,
            tracking_valid=valid,
        )
    if valid:
        return Malformed(
            f"rigid body {number}: tracked, but its pose is not finite or its quaternion's norm is {norm:g}"
        )
    # Motive fills an untracked body with arbitrary values, zeros included.
    return RigidBody(id=number, position_m=(0.0, 0.0, 0.0), quat_wxyz=IDENTITY_QUAT, error_m=0.0, tracking_valid=False)


def _section(data: bytes, offset: int, sized: bool) -> tuple[int, int]:
    """Return the count of a section and the offset of its first element."""
    count: int = _U32.unpack_from(data, offset)[0]
    return count, offset + (8 if sized else 4)


def _skip_marker_sets(data: bytes, offset: int, sized: bool) -> int:
    count, start = _section(data, offset, sized)
    if sized:
        size: int = _U32.unpack_from(data, offset + 4)[0]
        return start + size
    for _ in range(count):
        start = _skip_string(data, start)
        markers: int = _U32.unpack_from(data, start)[0]
        start += 4 + _VEC3_BYTES * markers
    return start


def _skip_fixed(data: bytes, offset: int, sized: bool, element_bytes: int) -> int:
    count, start = _section(data, offset, sized)
    return start + element_bytes * count


def _skip_skeletons(data: bytes, offset: int) -> int:
    count, offset = _section(data, offset, sized=False)
    for _ in range(count):
        _, bones = _COUNT_BYTES.unpack_from(data, offset)
        offset += 8 + RIGID_BODY_BYTES * bones
    return offset


def _skip_channels(data: bytes, offset: int) -> int:
    """Skip force plates or devices: an id and channels, each with its own number of floats."""
    count, offset = _section(data, offset, sized=False)
    for _ in range(count):
        _, channels = _COUNT_BYTES.unpack_from(data, offset)
        offset += 8
        for _ in range(channels):
            values: int = _U32.unpack_from(data, offset)[0]
            offset += 4 + 4 * values
    return offset


def _skip_string(data: bytes, offset: int) -> int:
    return data.index(b"\0", offset, offset + MAX_NAME_BYTES) + 1


def _skip_strings(data: bytes, offset: int) -> int:
    count: int = _U32.unpack_from(data, offset)[0]
    offset += 4
    for _ in range(count):
        offset = _skip_string(data, offset)
    return offset


def _model_definitions(data: bytes, sized: bool) -> tuple[BodyDefinition, ...]:
    bodies: list[BodyDefinition] = []
    count: int = _U32.unpack_from(data)[0]
    offset = 4
    for _ in range(count):
        kind: int = _U32.unpack_from(data, offset)[0]
        offset += 4
        if sized:
            size: int = _U32.unpack_from(data, offset)[0]
            offset += 4
            if kind == Descriptor.RIGID_BODY:
                bodies.append(_body_definition(data, offset))
            offset += size
            continue
        if kind == Descriptor.RIGID_BODY:
            bodies.append(_body_definition(data, offset))
        elif kind not in _SKIP_DESCRIPTION:
            raise ValueError(f"description of unknown type {kind}")
        offset = _SKIP_DESCRIPTION[kind](data, offset)
    if offset > len(data):
        raise ValueError("the last description is cut off")
    return tuple(bodies)


def _body_definition(data: bytes, offset: int) -> BodyDefinition:
    end = _skip_string(data, offset)
    return BodyDefinition(_U32.unpack_from(data, end)[0], _text(data[offset : end - 1]))


def _text(name: bytes) -> str:
    """Return a name for display: one line without terminal control characters."""
    text = name.decode("utf-8", "replace")
    return "".join(character if character.isprintable() else "?" for character in text)


def _skip_body(data: bytes, offset: int) -> int:
    """Skip name, id, parent and offset, then position and active label of each marker (3.0)."""
    offset = _skip_string(data, offset) + 8 + _VEC3_BYTES
    markers: int = _U32.unpack_from(data, offset)[0]
    return offset + 4 + (_VEC3_BYTES + 4) * markers


def _skip_marker_set_description(data: bytes, offset: int) -> int:
    return _skip_strings(data, _skip_string(data, offset))


def _skip_skeleton_description(data: bytes, offset: int) -> int:
    offset = _skip_string(data, offset)
    _, bones = _COUNT_BYTES.unpack_from(data, offset)
    offset += 8
    for _ in range(bones):
        offset = _skip_body(data, offset)
    return offset


def _skip_force_plate(data: bytes, offset: int) -> int:
    # id, serial; width, length, origin, 12x12 calibration, 4 corners as floats; plate type, channel type; channel names
    return _skip_strings(data, _skip_string(data, offset + 4) + 4 * (2 + 3 + 144 + 12) + 8)


def _skip_device(data: bytes, offset: int) -> int:
    return _skip_strings(data, _skip_string(data, _skip_string(data, offset + 4)) + 8)


def _skip_camera(data: bytes, offset: int) -> int:
    return _skip_string(data, offset) + 4 * 7


_SKIP_DESCRIPTION: Final = {
    int(Descriptor.MARKER_SET): _skip_marker_set_description,
    int(Descriptor.RIGID_BODY): _skip_body,
    int(Descriptor.SKELETON): _skip_skeleton_description,
    int(Descriptor.FORCE_PLATE): _skip_force_plate,
    int(Descriptor.DEVICE): _skip_device,
    int(Descriptor.CAMERA): _skip_camera,
}
