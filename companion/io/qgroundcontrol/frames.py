"""MAVLink frames at the door to a ground station: cut out of datagrams, checked, let through or refused. Pure: no socket, no clock.

What comes from the ground passes only as whole frames with a right checksum, of a message that ground stations need, and never in
the vehicle's own name: MAVSDK asks no message which connection it came by (`docs/qgroundcontrol.md`).
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
"""By events.xml of MAVLink, which pymavlink's dialect does not contain; its CRC_EXTRA is 33."""
_CRC_EXTRA: dict[int, int] = {number: message.crc_extra for number, message in mavlink.mavlink_map.items()}
_CRC_EXTRA[REQUEST_EVENT] = 33
_NAMES: dict[int, str] = {number: message.msgname for number, message in mavlink.mavlink_map.items()}

UP_RATE_HZ = 100.0
UP_BURST = 100
"""Messages from the ground; a ground station with a joystick needs 60 a second."""
GROUND_SYSTEMS_MAX = 4
"""MAVSDK keeps a record of every system id that it hears."""
STREAM_RATE_HZ = 10.0
"""Of each fast stream to the ground; the companion asks PX4 for up to 250 Hz."""

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
"""What a ground station says in its own right. No setpoints, no estimates of the vehicle's pose, no sensor readings, no answers."""
REFUSED_COMMANDS = frozenset({mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 611, 43003})
"""Would slow the streams that the flight lives on (511), or move the estimate: SET_GLOBAL_ORIGIN, EXTERNAL_POSITION_ESTIMATE."""
COMMANDS = (mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT)
_COMMAND_OFFSET = 28
"""Of the uint16 `command` in the payload of both COMMAND_LONG and COMMAND_INT."""
_AUTOPILOT_OFFSET = 5
"""Of the uint8 `autopilot` in the payload of HEARTBEAT."""
_BASE_MODE_OFFSET = 6
"""Of the uint8 `base_mode` in the payload of HEARTBEAT."""
_PROOF_MAX_BYTES = 1500
"""One Ethernet frame: the longest datagram that is searched for a HEARTBEAT; bridges put several messages into one."""
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


class Bucket:
    """So many at once, and so many a second in the long run."""

    def __init__(self, rate_hz: float, burst: int) -> None:
        self._rate_hz = rate_hz
        self._burst = float(burst)
        self._left = float(burst)
        self._seen_s: float | None = None

    def take(self, now_s: float) -> bool:
        """One more is allowed."""
        if self._seen_s is not None:
            self._left = min(self._burst, self._left + (now_s - self._seen_s) * self._rate_hz)
        self._seen_s = now_s
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


@dataclass(frozen=True, slots=True)
class Frame:
    """One message as it is on the wire, whole, its checksum not looked at yet."""

    data: bytes
    message_id: int
    system: int
    component: int
    payload: bytes

    @property
    def name(self) -> str:
        """Of the message, or its number."""
        return _NAMES.get(self.message_id, f"message {self.message_id}")

    @property
    def signed(self) -> bool:
        """A MAVLink 2 signature follows the checksum."""
        return self.data[0] == _V2 and bool(self.data[2] & _FLAG_SIGNED)

    @property
    def checksum(self) -> int:
        """As it is in the frame."""
        return int(struct.unpack_from("<H", self.data, self._end)[0])

    def right_checksum(self, extra: int) -> int:
        """As it must be, for the message's CRC_EXTRA."""
        return _checksum(self.data[1 : self._end], extra)

    def intact(self) -> bool:
        """The message is known and its checksum is right."""
        extra = _CRC_EXTRA.get(self.message_id)
        return extra is not None and self.checksum == self.right_checksum(extra)

    def numbered(self, sequence: int, extra: int) -> bytes:
        """The same, which must not be signed, with another sequence number."""
        data = bytearray(self.data[: self._end])
        data[4 if data[0] == _V2 else 2] = sequence & 0xFF
        return bytes(data) + struct.pack("<H", _checksum(bytes(data[1:]), extra))

    @property
    def _end(self) -> int:
        """Of the payload."""
        return len(self.data) - (_SIGNATURE_BYTES if self.signed else 0) - _CHECKSUM_BYTES


def frames(datagram: bytes) -> Iterator[Frame | None]:
    """The frames that a datagram is made of, in order; None, as the last, where the rest is none."""
    at = 0
    while at < len(datagram):
        frame = _frame_at(datagram, at)
        yield frame
        if frame is None:
            return
        at += len(frame.data)


@dataclass(frozen=True, slots=True)
class AutopilotHeartbeat:
    """What an autopilot (component 1) says of itself in HEARTBEAT."""

    system: int
    armed: bool


def autopilot_heartbeat(datagram: bytes) -> AutopilotHeartbeat | None:
    """The HEARTBEAT of an autopilot with a right checksum in the datagram; None if there is none.

    Strangers choose what is read here, and the control loop waits for it: a datagram longer than one Ethernet frame is not looked at,
    of the others only the first 32 frames and the first two checksums.
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
    """It says that it is an autopilot's HEARTBEAT; its checksum is not looked at."""
    if frame is None or frame.message_id != mavlink.MAVLINK_MSG_ID_HEARTBEAT:
        return False
    autopilot = int.from_bytes(frame.payload[_AUTOPILOT_OFFSET : _AUTOPILOT_OFFSET + 1], "little")
    return bool(frame.component == mavlink.MAV_COMP_ID_AUTOPILOT1 and autopilot != mavlink.MAV_AUTOPILOT_INVALID)


def _frame_at(datagram: bytes, at: int) -> Frame | None:
    left = len(datagram) - at
    if left >= _V2_HEADER_BYTES and datagram[at] == _V2:
        head, length, flags = _V2_HEADER_BYTES, datagram[at + 1], datagram[at + 2]
        if flags & ~_FLAG_SIGNED:
            return None  # by the standard a frame with unknown incompatibility flags is not to be understood
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
    return Frame(data, message_id, system, component, data[head : head + length])


def _checksum(data: bytes, extra: int) -> int:
    checksum = x25crc(data)
    checksum.accumulate(bytes((extra,)))
    return int(checksum.crc)


def command_of(payload: bytes) -> int:
    """MAV_CMD; MAVLink 2 cuts zeros off the end of a payload."""
    return int.from_bytes(payload[_COMMAND_OFFSET : _COMMAND_OFFSET + 2], "little")


class Thinner:
    """What of the vehicle's messages goes to the ground: everything but the companion's part of the talk, fast streams thinned out.

    The rest is numbered anew for each sender, as a ground station takes gaps in the numbers for losses of the link.

    Args:
        own: system and component id that MAVSDK speaks with.
    """

    def __init__(self, own: tuple[int, int]) -> None:
        self._own = own
        self._next_s: dict[tuple[int, int, int], float] = {}
        self._sequence: Counter[tuple[int, int]] = Counter()
        self._extras: dict[int, int | None] = dict(_CRC_EXTRA)

    def pick(self, datagram: bytes, now_s: float) -> list[bytes]:
        """What to send of a datagram that MAVSDK forwarded."""
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
        """CRC_EXTRA of the frame's message; of one that the dialect lacks by its first frame, as only one value makes its checksum."""
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
        # On a grid, so that a stream of 12 Hz does not become one of 6; a grid that was missed starts anew.
        self._next_s[key] = max(due_s + 1.0 / STREAM_RATE_HZ, now_s)
        return True
