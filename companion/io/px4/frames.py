"""MAVLink frames: received bytes to frames and back, with checksum and sequence number. Pure: no socket, no clock."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, islice
from typing import NamedTuple

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import common as mavlink

_V1, _V2 = 0xFE, 0xFD
_V1_HEADER_BYTES, _V2_HEADER_BYTES, _CHECKSUM_BYTES, _SIGNATURE_BYTES = 6, 10, 2, 13
_FLAG_SIGNED = 1
_MAGIC = re.compile(b"[\xfd\xfe]")
REQUEST_EVENT = 412
"""Message id from MAVLink's events.xml, which pymavlink's dialect does not contain; its CRC_EXTRA is 33."""
CRC_EXTRA: dict[int, int] = {number: message.crc_extra for number, message in mavlink.mavlink_map.items()}
CRC_EXTRA[REQUEST_EVENT] = 33
_EXTRA_BYTE: dict[int, bytes] = {number: bytes((extra,)) for number, extra in CRC_EXTRA.items()}
_NAMES: dict[int, str] = {number: message.msgname for number, message in mavlink.mavlink_map.items()}
_AUTOPILOT_OFFSET = 5
"""Offset of the uint8 `autopilot` in the payload of HEARTBEAT."""
_BASE_MODE_OFFSET = 6
"""Offset of the uint8 `base_mode` in the payload of HEARTBEAT."""
_PROOF_MAX_BYTES = 1500
"""Longest datagram that is searched for a HEARTBEAT: one Ethernet frame. Bridges put several messages into one datagram."""
_PROOF_FRAMES_MAX = 32
_PROOF_CHECKSUMS_MAX = 2
_HEADER = struct.Struct("<BBBBBBBHB")


@dataclass(frozen=True, slots=True)
class Frame:
    """One whole message as received, with its checksum not yet checked."""

    data: bytes
    message_id: int
    system: int
    component: int
    payload: bytes

    @property
    def name(self) -> str:
        """Return the name of the message, or its number."""
        return _NAMES.get(self.message_id, f"message {self.message_id}")

    @property
    def signed(self) -> bool:
        """Return whether a MAVLink 2 signature follows the checksum."""
        return self.data[0] == _V2 and bool(self.data[2] & _FLAG_SIGNED)

    @property
    def checksum(self) -> int:
        """Return the checksum that the frame carries."""
        return int(struct.unpack_from("<H", self.data, self._end)[0])

    def right_checksum(self, extra: int) -> int:
        """Return the correct checksum for the message's CRC_EXTRA."""
        return _checksum(self.data[1 : self._end], extra)

    def intact(self) -> bool:
        """Return whether the message is known and its checksum is correct."""
        extra = CRC_EXTRA.get(self.message_id)
        return extra is not None and self.checksum == self.right_checksum(extra)

    def numbered(self, sequence: int, extra: int) -> bytes:
        """Return the same frame, which must not be signed, with another sequence number."""
        data = bytearray(self.data[: self._end])
        data[4 if data[0] == _V2 else 2] = sequence & 0xFF
        return bytes(data) + struct.pack("<H", _checksum(bytes(data[1:]), extra))

    @property
    def _end(self) -> int:
        return len(self.data) - (_SIGNATURE_BYTES if self.signed else 0) - _CHECKSUM_BYTES


class Received(NamedTuple):
    """One whole frame whose checksum is right, or whose message the dialect does not define."""

    message_id: int
    system: int
    component: int
    payload: bytes
    """Without the trailing zeros that MAVLink 2 truncates."""
    frame: bytes


class FrameReader:
    """Finds the frames in received bytes; damaged ones are skipped.

    Args:
        stream: whether frames may continue in the next bytes (serial, TCP); a datagram contains whole frames.
    """

    def __init__(self, *, stream: bool) -> None:
        self._stream = stream
        self._rest = b""

    def read(self, data: bytes) -> list[Received]:
        """Return the frames that these bytes complete. Never raises."""
        if self._rest:
            data = self._rest + data
        found: list[Received] = []
        at, end = 0, len(data)
        while at < end:
            if data[at] == _V2:
                head, short = _V2_HEADER_BYTES, at + _V2_HEADER_BYTES > end
            elif data[at] == _V1:
                head, short = _V1_HEADER_BYTES, at + _V1_HEADER_BYTES > end
            else:
                magic = _MAGIC.search(data, at)
                at = end if magic is None else magic.start()
                continue
            if not short:
                body = at + head + data[at + 1]
                stop = body + _CHECKSUM_BYTES
                if head == _V2_HEADER_BYTES:
                    flags, system, component = data[at + 2], data[at + 5], data[at + 6]
                    message_id = data[at + 7] | data[at + 8] << 8 | data[at + 9] << 16
                    if flags & _FLAG_SIGNED:
                        stop += _SIGNATURE_BYTES
                else:
                    flags, system, component, message_id = 0, data[at + 3], data[at + 4], data[at + 5]
                short = stop > end
            if short:
                if self._stream:
                    break
                at += 1
                continue
            extra = _EXTRA_BYTE.get(message_id)
            if flags & ~_FLAG_SIGNED or (
                extra is not None and mcrf4xx(data[at + 1 : body] + extra) != data[body] | data[body + 1] << 8
            ):
                at += 1
                continue
            found.append(Received(message_id, system, component, data[at + head : body], data[at:stop]))
            at = stop
        self._rest = data[at:] if self._stream else b""
        return found


class FrameWriter:
    """Makes the frames that leave a link, and numbers them. The sequence number may be taken by several threads."""

    def __init__(self, system: int, component: int) -> None:
        self._system, self._component = system, component
        self._numbers = count()

    def frame(self, message_id: int, payload: bytes) -> bytes:
        """Return a MAVLink 2 frame.

        Args:
            payload: fields in the order of the wire; trailing zeros are truncated.
        """
        payload = payload.rstrip(b"\0") or b"\0"
        number = next(self._numbers) & 0xFF
        low, high = message_id & 0xFFFF, message_id >> 16
        data = _HEADER.pack(_V2, len(payload), 0, 0, number, self._system, self._component, low, high) + payload
        return data + mcrf4xx(data[1:] + _EXTRA_BYTE[message_id]).to_bytes(2, "little")

    def numbered(self, data: bytes) -> bytes:
        """Return the frames in `data`, which another encoder made, with this link's sequence numbers.

        PX4 counts gaps in the numbers of a sender as lost messages.
        """
        whole = []
        for frame in frames(data):
            if frame is None:
                return data
            extra = CRC_EXTRA.get(frame.message_id)
            whole.append(frame.data if extra is None or frame.signed else frame.numbered(next(self._numbers), extra))
        return b"".join(whole)


def frames(datagram: bytes) -> Iterator[Frame | None]:
    """Return the frames in a datagram in order, followed by None if the rest is not a frame."""
    at = 0
    while at < len(datagram):
        frame = _frame_at(datagram, at)
        yield frame
        if frame is None:
            return
        at += len(frame.data)


@dataclass(frozen=True, slots=True)
class AutopilotHeartbeat:
    """Content of a HEARTBEAT of an autopilot (component 1)."""

    system: int
    armed: bool


def autopilot_heartbeat(datagram: bytes) -> AutopilotHeartbeat | None:
    """Return the HEARTBEAT of an autopilot with a correct checksum in the datagram, or None if there is none.

    Unknown senders choose the content, and the control loop waits for this call. A datagram longer than one Ethernet frame is
    therefore ignored; in others only the first 32 frames are read and the first two checksums computed.
    """
    if len(datagram) > _PROOF_MAX_BYTES:
        return None
    beats = (frame for frame in islice(frames(datagram), _PROOF_FRAMES_MAX) if _of_autopilot(frame))
    for frame in islice(beats, _PROOF_CHECKSUMS_MAX):
        if frame is not None and frame.intact():
            base_mode = int.from_bytes(frame.payload[_BASE_MODE_OFFSET : _BASE_MODE_OFFSET + 1], "little")
            return AutopilotHeartbeat(frame.system, bool(base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED))
    return None


def _of_autopilot(frame: Frame | None) -> bool:
    """Return whether the frame claims to be an autopilot's HEARTBEAT. The checksum is not checked."""
    if frame is None or frame.message_id != mavlink.MAVLINK_MSG_ID_HEARTBEAT:
        return False
    autopilot = int.from_bytes(frame.payload[_AUTOPILOT_OFFSET : _AUTOPILOT_OFFSET + 1], "little")
    return bool(frame.component == mavlink.MAV_COMP_ID_AUTOPILOT1 and autopilot != mavlink.MAV_AUTOPILOT_INVALID)


def _frame_at(datagram: bytes, at: int) -> Frame | None:
    left = len(datagram) - at
    if left >= _V2_HEADER_BYTES and datagram[at] == _V2:
        head, length, flags = _V2_HEADER_BYTES, datagram[at + 1], datagram[at + 2]
        if flags & ~_FLAG_SIGNED:
            return None  # the standard forbids interpreting a frame with unknown incompatibility flags
        tail = _CHECKSUM_BYTES + (_SIGNATURE_BYTES if flags & _FLAG_SIGNED else 0)
        system, component = datagram[at + 5], datagram[at + 6]
        message_id = int.from_bytes(datagram[at + 7 : at + 10], "little")
    elif left >= _V1_HEADER_BYTES and datagram[at] == _V1:
        head, length, tail = _V1_HEADER_BYTES, datagram[at + 1], _CHECKSUM_BYTES
        system, component, message_id = datagram[at + 3], datagram[at + 4], datagram[at + 5]
    else:
        return None
    if left < head + length + tail:
        return None
    data = datagram[at : at + head + length + tail]
    return Frame(
        data=data, message_id=message_id, system=system, component=component, payload=data[head : head + length]
    )


def _checksum(data: bytes, extra: int) -> int:
    return int(mcrf4xx(data + bytes((extra,))))
