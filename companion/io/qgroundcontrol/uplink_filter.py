"""Filter of messages from a ground station to the vehicle. Pure: time is an argument.

A message passes only as a whole frame with a valid checksum, of a kind that ground stations need, and never with the vehicle's own
ids (`docs/internals/qgroundcontrol.md`).

While PX4 is armed only listed messages pass: those that read, and those that end or pause the flight (LAND, HOLD, a pilot's mode, a
disarm that PX4 itself may refuse). Everything else is refused until PX4 is disarmed, including a forced disarm, a restart, flight
termination, parameters, missions, files, and RETURN, which climbs although the vehicle is tethered.
"""

from __future__ import annotations

import math
import struct
from collections import Counter

from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4.frames import REQUEST_EVENT, Frame, autopilot_heartbeat, frames
from companion.runtime.token_bucket import TokenBucket

UP_RATE_HZ = 100.0
UP_BURST = 100
"""Largest burst of messages from the ground; a ground station with a joystick needs 60 per second."""
GROUND_SYSTEMS_MAX = 4
"""Largest number of ground stations' system ids, because PX4 keeps a record of each."""
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
HEARTBEAT_MAX_AGE_S = 3.0
"""Max age of PX4's heartbeat, which is sent once per second. Without a fresh one PX4 counts as armed."""

ARMED_MESSAGES = frozenset(
    getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    for name in (
        *("HEARTBEAT", "PING", "SYSTEM_TIME", "MANUAL_CONTROL", "SET_MODE", "COMMAND_LONG", "COMMAND_INT"),
        *("PARAM_REQUEST_READ", "PARAM_REQUEST_LIST", "LOGGING_ACK"),
        *("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_REQUEST_LIST", "MISSION_ACK"),
    )
) | {REQUEST_EVENT}

_READING_COMMANDS = frozenset(
    {
        mavlink.MAV_CMD_REQUEST_MESSAGE,
        mavlink.MAV_CMD_GET_MESSAGE_INTERVAL,
        mavlink.MAV_CMD_GET_HOME_POSITION,
        mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION,
        mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
    }
)
_ALTCTL, _POSCTL, _AUTO, _STABILIZED = 2, 3, 4, 7
"""PX4's main modes as numbered in px4_custom_mode.h."""
_LOITER, _LAND = 3, 6
"""PX4's sub-modes of AUTO."""
_ARMED_MODES = frozenset({(_AUTO, _LOITER), (_AUTO, _LAND), (_POSCTL, 0), (_ALTCTL, 0), (_STABILIZED, 0)})
_COMMAND_BYTES = 33
"""Size of COMMAND_LONG's payload. COMMAND_INT's payload is longer and has param1 to param4 in the same place."""
_SET_MODE_BYTES = 6


class ArmedState:
    """Tracks whether PX4 is armed.

    Args:
        vehicle_system: MAVLink system id of PX4.
    """

    def __init__(self, vehicle_system: int) -> None:
        self._vehicle_system = vehicle_system
        self._disarmed_s: float | None = None
        self._arming_s = -math.inf

    def hear(self, datagram: bytes, now_s: float) -> None:
        """Update the state from a datagram of PX4's; only PX4's HEARTBEAT has an effect."""
        heard = autopilot_heartbeat(datagram)
        if heard is not None and heard.system == self._vehicle_system:
            self._disarmed_s = None if heard.armed else now_s

    def expect_arming(self, now_s: float) -> None:
        """Note that the companion is requesting arming; the HEARTBEAT that confirms it arrives up to a second later."""
        self._arming_s = now_s

    def armed(self, now_s: float) -> bool:
        """Return True unless fresh heartbeats show that PX4 is disarmed."""
        if self._disarmed_s is None or now_s - self._disarmed_s > HEARTBEAT_MAX_AGE_S:
            return True
        return now_s - self._arming_s <= HEARTBEAT_MAX_AGE_S


class UplinkFilter:
    """Filter of a ground station's messages to the vehicle.

    Args:
        vehicle_system: MAVLink system id of PX4, which is also the companion's.
        while_armed: while PX4 is armed, pass everything that passes while it is disarmed, except SERIAL_CONTROL.
        console: pass SERIAL_CONTROL while PX4 is not armed.
    """

    def __init__(self, vehicle_system: int, *, while_armed: bool = False, console: bool = False) -> None:
        self.state = ArmedState(vehicle_system)
        self.refused: Counter[str] = Counter()
        self._vehicle_system = vehicle_system
        self._while_armed, self._console = while_armed, console
        self._systems: set[int] = set()
        self._bucket = TokenBucket(UP_RATE_HZ, UP_BURST)

    def admit(self, datagram: bytes, now_s: float) -> list[bytes]:
        """Return the frames to pass on, each as one datagram."""
        passed = []
        for frame in frames(datagram):
            reason = self._objection(frame, now_s)
            if reason is None and frame is not None:
                passed.append(frame.data)
            else:
                self.refused[str(reason)] += 1
        return passed

    def _objection(self, frame: Frame | None, now_s: float) -> str | None:
        if frame is None or not frame.intact():
            return "not MAVLink"
        if frame.system in (0, self._vehicle_system):
            return f"sent with the vehicle's system id {frame.system}"
        if frame.message_id not in GROUND_MESSAGES:
            return f"{frame.name}, which a ground station may not send"
        if frame.message_id in COMMANDS and command_of(frame.payload) in REFUSED_COMMANDS:
            return f"command {command_of(frame.payload)}, which the flight does not allow"
        reason = self._now(frame, self.state.armed(now_s))
        if reason is not None:
            return reason
        if frame.system not in self._systems:
            if len(self._systems) >= GROUND_SYSTEMS_MAX:
                return f"from a fifth ground station (system id {frame.system})"
            self._systems.add(frame.system)
        return None if self._bucket.take(now_s) else f"more than {UP_RATE_HZ:g} messages a second"

    def _now(self, frame: Frame, armed: bool) -> str | None:
        """Return why the frame is refused in the present state, or None if it passes."""
        if frame.message_id == mavlink.MAVLINK_MSG_ID_SERIAL_CONTROL:
            if not self._console:
                return "SERIAL_CONTROL, which ground.qgroundcontrol_console does not allow"
            return "SERIAL_CONTROL while PX4 is armed" if armed else None
        return refusal_while_armed(frame) if armed and not self._while_armed else None


def refusal_while_armed(frame: Frame) -> str | None:
    """Return why an intact frame of a ground station is refused while PX4 is armed, or None if it may pass."""
    if frame.message_id not in ARMED_MESSAGES:
        return f"{frame.name} while PX4 is armed"
    if frame.message_id == mavlink.MAVLINK_MSG_ID_SET_MODE:
        custom_mode, _, base_mode = struct.unpack("<IBB", _padded(frame, _SET_MODE_BYTES))
        allowed = _mode_allowed(float(base_mode), float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24))
        return None if allowed else "a request for this mode while PX4 is armed"
    if frame.message_id in COMMANDS and not _command_allowed(frame):
        return f"command {command_of(frame.payload)} while PX4 is armed"
    return None


def _command_allowed(frame: Frame) -> bool:
    command = command_of(frame.payload)
    params = struct.unpack_from("<7f", _padded(frame, _COMMAND_BYTES))
    if command == mavlink.MAV_CMD_NAV_LAND or command in _READING_COMMANDS:
        return True
    if command == mavlink.MAV_CMD_DO_SET_MODE:
        return _mode_allowed(*params[:3])
    if command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
        return params[:2] == (0.0, 0.0)  # disarm, not forced: PX4 refuses it in the air
    if command == mavlink.MAV_CMD_DO_REPOSITION:  # QGroundControl's Pause: hold position
        return frame.message_id == mavlink.MAVLINK_MSG_ID_COMMAND_LONG and all(map(math.isnan, params[4:7]))
    return False


def _mode_allowed(base_mode: float, main_mode: float, sub_mode: float) -> bool:
    custom = base_mode in range(256) and int(base_mode) & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    return bool(custom) and (main_mode, sub_mode) in _ARMED_MODES


def _padded(frame: Frame, size: int) -> bytes:
    """Return the payload's first `size` bytes; MAVLink 2 truncates trailing zeros."""
    return frame.payload[:size].ljust(size, b"\0")


def command_of(payload: bytes) -> int:
    """Return the MAV_CMD; MAVLink 2 truncates trailing zeros of a payload."""
    return int.from_bytes(payload[_COMMAND_OFFSET : _COMMAND_OFFSET + 2], "little")
