"""Extracts MAVLink frames to and from a ground station from datagrams, checks them, and passes or refuses them. Pure: no socket, no
clock.

A message from the ground passes only as a whole frame with a valid checksum, of a kind that ground stations need, and never with
the vehicle's own ids (`docs/qgroundcontrol.md`).
"""

from __future__ import annotations

from collections import Counter

from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4.frames import CRC_EXTRA, REQUEST_EVENT, Frame, frames

UP_RATE_HZ = 100.0
UP_BURST = 100
"""Largest burst of messages from the ground; a ground station with a joystick needs 60 per second."""
GROUND_SYSTEMS_MAX = 4
"""Largest number of ground stations' system ids, because PX4 keeps a record of each."""
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


def command_of(payload: bytes) -> int:
    """Return the MAV_CMD; MAVLink 2 truncates trailing zeros of a payload."""
    return int.from_bytes(payload[_COMMAND_OFFSET : _COMMAND_OFFSET + 2], "little")


class DownlinkFilter:
    """Filter of the vehicle's messages to the ground: thins fast streams.

    The rest is renumbered for each sender, because a ground station counts gaps in the numbers as lost messages.
    """

    def __init__(self) -> None:
        self._next_s: dict[tuple[int, int, int], float] = {}
        self._sequence: Counter[tuple[int, int]] = Counter()
        self._extras: dict[int, int | None] = dict(CRC_EXTRA)

    def pick(self, datagram: bytes, now_s: float) -> list[bytes]:
        """Return the frames to send from a datagram that the flight process forwarded."""
        picked = []
        for frame in frames(datagram):
            if frame is None or not self._due(frame, now_s):
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
