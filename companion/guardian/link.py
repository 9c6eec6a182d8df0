"""The guardian's MAVLink link, on the address that the flight process used. No call waits."""

from __future__ import annotations

import contextlib
import math
import struct
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.guardian.retreat import Setpoint
from companion.io.px4 import messages
from companion.io.px4.frames import FrameReader, FrameWriter
from companion.io.px4.wire import UdpWire, Wire
from companion.model.frames import ned_from_enu, quat_from_euler_zyx, wrap_rad
from companion.model.types import AttitudeSetpoint, AutopilotRequest, MocapPose

Message = Any

_HEARTBEAT = struct.pack("<I5B", 0, mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 3)
"""Payload with the fields that MAVSDK uses for a companion computer."""
_POSITION_TARGET = struct.Struct("<I11fH3B")


class Link:
    """MAVLink 2 over a wire, with the identity of the companion.

    Args:
        wire: an open wire.
        own: system and component id of the companion.
        autopilot_system: system id of PX4.
    """

    def __init__(self, wire: Wire, own: tuple[int, int], autopilot_system: int) -> None:
        self.wire = wire
        self._autopilot_system = autopilot_system
        self._writer = FrameWriter(*own)
        self._reader = FrameReader(stream=not isinstance(wire, UdpWire))
        self._decoder = mavlink.MAVLink(None)

    def receive(self) -> list[Message]:
        """Return PX4's messages that have arrived. Malformed data is dropped and never raises."""
        found: list[Message] = []
        if isinstance(self.wire, UdpWire):
            self.wire.system = self._autopilot_system
        px4 = (self._autopilot_system, messages.MAV_COMP_ID_AUTOPILOT1)
        for _, data in self.wire.receive():
            for received in self._reader.read(data):
                if (received.system, received.component) == px4:
                    with contextlib.suppress(mavlink.MAVError):  # a message that the dialect does not define
                        found.append(self._decoder.decode(bytearray(received.frame)))
        return found

    def send_heartbeat(self) -> None:
        """Send HEARTBEAT."""
        self._send(messages.HEARTBEAT_ID, _HEARTBEAT)

    def send_vision(self, pose: MocapPose) -> None:
        """Send VISION_POSITION_ESTIMATE with the fields and time base of the flight process.

        Raises:
            ValueError: the pose is not finite.
        """
        self._send(messages.VISION_POSITION_ESTIMATE_ID, messages.vision_position_estimate(pose))

    def send_request(self, request: AutopilotRequest) -> None:
        """Send the MAVLink command of a request."""
        self._send_command(*messages.command(request))

    def request_message(self, message_id: int) -> None:
        """Send MAV_CMD_REQUEST_MESSAGE: PX4 sends the message immediately, once."""
        self._send_command(messages.REQUEST_MESSAGE, float(message_id), 0.0)

    def request_rate(self, message_id: int, rate_hz: float) -> None:
        """Send MAV_CMD_SET_MESSAGE_INTERVAL."""
        self._send_command(messages.SET_MESSAGE_INTERVAL, float(message_id), 1e6 / rate_hz)

    def send_zero_thrust(self, t_s: float, yaw_rad: float) -> None:
        """Send SET_ATTITUDE_TARGET: level, at `yaw_rad` (world ENU), with zero thrust. Only for a vehicle on the ground."""
        level = AttitudeSetpoint(quat_from_euler_zyx(0.0, 0.0, yaw_rad), 0.0)
        payload = messages.attitude_target(level, int(t_s * 1e3), self._autopilot_system)
        self._send(messages.SET_ATTITUDE_TARGET_ID, payload)

    def send_position(self, t_s: float, setpoint: Setpoint) -> None:
        """Send SET_POSITION_TARGET_LOCAL_NED with position, velocity, acceleration and yaw."""
        payload = _POSITION_TARGET.pack(
            int(t_s * 1e3) & 0xFFFFFFFF,
            *ned_from_enu(setpoint.position_world_m),
            *ned_from_enu(setpoint.velocity_world_m_s),
            *ned_from_enu(setpoint.acceleration_world_m_s2),
            wrap_rad(0.5 * math.pi - setpoint.yaw_rad),
            0.0,
            mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE,
            self._autopilot_system,
            messages.MAV_COMP_ID_AUTOPILOT1,
            mavlink.MAV_FRAME_LOCAL_NED,
        )
        self._send(mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED, payload)

    def _send_command(self, command: int, param1: float, param2: float) -> None:
        self._send(*messages.command_long(command, param1, param2, self._autopilot_system))

    def _send(self, message_id: int, payload: bytes) -> None:
        self.wire.send(self._writer.frame(message_id, payload))
