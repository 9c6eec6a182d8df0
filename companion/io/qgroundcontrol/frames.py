"""Extracts MAVLink frames to and from a ground station from datagrams, checks them, and passes or refuses them. Pure: no socket, no
clock.

A message from the ground passes only as a whole frame with a valid checksum, of a kind that ground stations need, and never with
the vehicle's own ids, because MAVSDK does not distinguish messages by the connection on which they arrive
(`docs/qgroundcontrol.md`).
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

from pymavlink.dialects.v20 import common as mavlink
from pymavlink.generator.mavcrc import x25crc

_V1, _V2 = 0xFE, 0xFD
_V1_HEADER_BYTES, _V2_HEADER_BYTES, _CHECKSUM_BYTES, _SIGNATURE_BYTES = 6, 10, 2, 13
_FLAG_SIGNED = 1
REQUEST_EVENT = 412
"""Message id from MAVLink's events.xml, which pymavlink's dialect does not contain; its CRC_EXTRA is 33."""
_CRC_EXTRA: dict[int, int] = {number: message.crc_extra for number, message in mavlink.mavlink_map.items()}
_CRC_EXTRA[REQUEST_EVENT] = 33
_NAMES: dict[int, str] = {number: message.msgname for number, message in mavlink.mavlink_map.items()}

UP_RATE_HZ = 100.0
UP_BURST = 100
"""Largest burst of messages from the ground; a ground station with a joystick needs 60 per second."""
GROUND_SYSTEMS_MAX = 4
"""Largest number of ground stations' system ids. It is limited because MAVSDK keeps a record of each."""
STREAM_RATE_HZ = 10.0
"""Rate of each fast stream to the ground; the companion requests up to 250 Hz from PX4."""

GROUND_MESSAGES = frozenset(
    getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    for name in (
        *("HEARTBEAT", "PING", "SYSTEM_TIME", "SET_MODE", "MANUAL_CONTROL", "COMMAND_LONG", "COMMAND_INT"),
        *("PARAM_REQUEST_READ", "PARAM_REQUEST_LIST", "PARAM_SET", "FILE_TRANSFER_PROTOCOL", "SERIAL_CONTROL"),
        *("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_REQUEST_LIST", "MISSION_COUNT", "MISSION_ITEM"),
        *("MISSION_ITEM_INT", "MISSION_ACK", "MISSION_CLEAR_ALL", "MISSION_SET_CURRENT"),
        *("LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "LOG_ERASE", "LOG_REQUEST_END", "LOGGING_ACK"),
    )
) | {REQUEST_EVENT}
"""Messages that a ground station may send. Setpoints, estimates of the vehicle's pose, sensor readings and replies are not
among them.
"""
REFUSED_COMMANDS = frozenset({mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 611, 43003})
"""Commands that would slow the flight's streams (511) or move the estimate (SET_GLOBAL_ORIGIN, EXTERNAL_POSITION_ESTIMATE)."""
COMMANDS = (mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT)
_COMMAND_OFFSET = 28
"""Offset of the uint16 `command` in the payload of both COMMAND_LONG and COMMAND_INT."""
_AUTOPILOT_OFFSET = 5
"""Offset of the uint8 `autopilot` in the payload of HEARTBEAT."""
_BASE_MODE_OFFSET = 6
"""Offset of the uint8 `base_mode` in the payload of HEARTBEAT."""
_PROOF_MAX_BYTES = 1500
"""Longest datagram that is searched for a HEARTBEAT: one Ethernet frame. Bridges put several messages into one datagram."""
_PROOF_FRAMES_MAX = 32
_PROOF_CHECKSUMS_MAX = 2

FAST_STREAMS = frozenset(
    getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    for name in (
        *("ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "HIGHRES_IMU", "SCALED_IMU"),
        *(
            "SCALED_IMU2",
            "SCALED_IMU3",
            "SCALED_PRESSURE",
            "ODOMETRY",
            "ATTITUDE_TARGET",
            "SERVO_OUTPUT_RAW",
            "VFR_HUD",
        ),
        *(
            "POSITION_TARGET_LOCAL_NED",
            "POSITION_TARGET_GLOBAL_INT",
            "ACTUATOR_OUTPUT_STATUS",
            "RC_CHANNELS",
            "TIMESYNC",
        ),
        *("ALTITUDE", "DISTANCE_SENSOR", "OPTICAL_FLOW_RAD", "VIBRATION", "ESTIMATOR_STATUS"),
    )
)


class TokenBucket:
    """Token bucket: limits a burst and the mean rate."""

    def __init__(self, rate_hz: float, burst: int) -> None:
        self._rate_hz = rate_hz
        self._burst = float(burst)
        self._left = float(burst)
        self._seen_s: float | None = None

    def take(self, now_s: float) -> bool:
        """Return whether one more message is allowed, and count it."""
        if self._seen_s is not None:
            self._left = min(self._burst, self._left + (now_s - self._seen_s) * self._rate_hz)
        self._seen_s = now_s
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


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
        extra = _CRC_EXTRA.get(self.message_id)
        return extra is not None and self.checksum == self.right_checksum(extra)

    def numbered(self, sequence: int, extra: int) -> bytes:
        """Return the same frame, which must not be signed, with another sequence number."""
        data = bytearray(self.data[: self._end])
        data[4 if data[0] == _V2 else 2] = sequence & 0xFF
        return bytes(data) + struct.pack("<H", _checksum(bytes(data[1:]), extra))

    @property
    def _end(self) -> int:
        """Return the end of the payload."""
        return len(self.data) - (_SIGNATURE_BYTES if self.signed else 0) - _CHECKSUM_BYTES


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
    checksum = x25crc(data)
    checksum.accumulate(bytes((extra,)))
    return int(checksum.crc)


def command_of(payload: bytes) -> int:
    """Return the MAV_CMD; MAVLink 2 truncates trailing zeros of a payload."""
    return int.from_bytes(payload[_COMMAND_OFFSET : _COMMAND_OFFSET + 2], "little")


class DownlinkFilter:
    """Filter of the vehicle's messages to the ground: drops the companion's own traffic and thins fast streams.

    The rest is renumbered for each sender, because a ground station counts gaps in the numbers as lost messages.

    Args:
        own: system and component id of MAVSDK.
    """

    def __init__(self, own: tuple[int, int]) -> None:
        self._own = own
        self._next_s: dict[tuple[int, int, int], float] = {}
        self._sequence: Counter[tuple[int, int]] = Counter()
        self._extras: dict[int, int | None] = dict(_CRC_EXTRA)

    def pick(self, datagram: bytes, now_s: float) -> list[bytes]:
        """Return the frames to send from a datagram that MAVSDK forwarded."""
        picked = []
        for frame in frames(datagram):
            if frame is None or (frame.system, frame.component) == self._own or not self._due(frame, now_s):
                continue
            extra = self._extra(frame)
            if extra is None or frame.signed:
                picked.append(frame.data)
                continue
            sender = (frame.system, frame.component)
            picked.append(frame.numbered(self._sequence[sender], extra))
            self._sequence[sender] += 1
        return picked

    def _extra(self, frame: Frame) -> int | None:
        """Return CRC_EXTRA of the frame's message. If the dialect does not define the message, derive it from its first frame by trying
        all 256 values against the checksum.
        """
        if frame.message_id not in self._extras:
            fits = (extra for extra in range(256) if frame.right_checksum(extra) == frame.checksum)
            self._extras[frame.message_id] = next(fits, None)
        return self._extras[frame.message_id]

    def _due(self, frame: Frame, now_s: float) -> bool:
        if frame.message_id not in FAST_STREAMS:
            return True
        key = (frame.system, frame.component, frame.message_id)
        due_s = self._next_s.get(key, now_s)
        if now_s < due_s:
            return False
        # On a grid, so that a stream of 12 Hz does not become one of 6; a grid that was missed starts again.
        self._next_s[key] = max(due_s + 1.0 / STREAM_RATE_HZ, now_s)
        return True
