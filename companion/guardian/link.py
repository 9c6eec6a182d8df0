"""The guardian's MAVLink link, on the address that the flight process used. Messages are encoded with pymavlink. No call waits."""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.guardian.retreat import Setpoint
from companion.io.px4 import messages
from companion.io.px4.wire import UdpWire, Wire
from companion.model.frames import attitude_ned_frd_from_enu_flu, ned_from_enu, quat_from_euler_zyx, wrap_rad
from companion.model.types import AutopilotRequest, MocapPose

Message = Any

# One NaN: PX4 uses EKF2_EVP_NOISE and EKF2_EVA_NOISE instead of a covariance.
_COVARIANCE_FROM_PARAMS = [math.nan] + [0.0] * 20


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
        self._encoder = mavlink.MAVLink(None, srcSystem=own[0], srcComponent=own[1])
        self._decoder = self._new_decoder()

    @staticmethod
    def _new_decoder() -> Any:
        decoder = mavlink.MAVLink(None)
        decoder.robust_parsing = True
        return decoder

    def receive(self) -> list[Message]:
        """Return PX4's messages that have arrived. Malformed data is dropped and never raises."""
        found: list[Message] = []
        if isinstance(self.wire, UdpWire):
            self.wire.system = self._autopilot_system
        for _, data in self.wire.receive():
            try:
                parsed = self._decoder.parse_buffer(data) or ()
            except (mavlink.MAVError, ValueError, IndexError):
                self._decoder = self._new_decoder()
                continue
            if isinstance(self.wire, UdpWire) and self._decoder.buf_len():
                self._decoder = self._new_decoder()  # a truncated datagram must not consume the ones after it
            for message in parsed:
                source = (message.get_srcSystem(), message.get_srcComponent())
                if message.get_type() != "BAD_DATA" and source == (
                    self._autopilot_system,
                    messages.MAV_COMP_ID_AUTOPILOT1,
                ):
                    found.append(message)
        return found

    def send(self, message: Message) -> None:
        """Send one message."""
        data = message.pack(self._encoder)
        self._encoder.seq = (self._encoder.seq + 1) % 256
        self.wire.send(data)

    def send_heartbeat(self) -> None:
        """Send HEARTBEAT with the fields that MAVSDK uses for a companion computer."""
        self.send(
            mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_UNINIT, 3
            )
        )

    def send_vision(self, pose: MocapPose) -> None:
        """Send VISION_POSITION_ESTIMATE with the fields and time base of the flight process.

        Raises:
            ValueError: the pose is not finite.
        """
        position_ned_m, euler_rad = messages.vision_ned(pose)
        usec = max(1, int(pose.stamp_s * 1e6))
        self.send(
            mavlink.MAVLink_vision_position_estimate_message(
                usec, *position_ned_m, *euler_rad, _COVARIANCE_FROM_PARAMS, 0
            )
        )

    def send_request(self, request: AutopilotRequest) -> None:
        """Send the MAVLink command of a request."""
        self._send_command(*messages.command(request))

    def request_message(self, message_id: int) -> None:
        """Send MAV_CMD_REQUEST_MESSAGE: PX4 sends the message immediately, once."""
        self._send_command(mavlink.MAV_CMD_REQUEST_MESSAGE, float(message_id), 0.0)

    def request_rate(self, message_id: int, rate_hz: float) -> None:
        """Send MAV_CMD_SET_MESSAGE_INTERVAL."""
        self._send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(message_id), 1e6 / rate_hz)

    def send_zero_thrust(self, t_s: float, yaw_rad: float) -> None:
        """Send SET_ATTITUDE_TARGET: level, at `yaw_rad` (world ENU), with zero thrust. Only for a vehicle on the ground."""
        q = attitude_ned_frd_from_enu_flu(quat_from_euler_zyx(0.0, 0.0, yaw_rad))
        target, component = self._autopilot_system, messages.MAV_COMP_ID_AUTOPILOT1
        self.send(
            mavlink.MAVLink_set_attitude_target_message(
                int(t_s * 1e3) & 0xFFFFFFFF, target, component, messages.TYPE_MASK_IGNORE_RATES, q, 0.0, 0.0, 0.0, 0.0
            )
        )

    def send_position(self, t_s: float, setpoint: Setpoint) -> None:
        """Send SET_POSITION_TARGET_LOCAL_NED with position, velocity, acceleration and yaw."""
        target, component = self._autopilot_system, messages.MAV_COMP_ID_AUTOPILOT1
        self.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                int(t_s * 1e3) & 0xFFFFFFFF,
                target,
                component,
                mavlink.MAV_FRAME_LOCAL_NED,
                mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE,
                *ned_from_enu(setpoint.position_world_m),
                *ned_from_enu(setpoint.velocity_world_m_s),
                *ned_from_enu(setpoint.acceleration_world_m_s2),
                wrap_rad(0.5 * math.pi - setpoint.yaw_rad),
                0.0,
            )
        )

    def _send_command(self, command: int, param1: float, param2: float) -> None:
        target, component = self._autopilot_system, messages.MAV_COMP_ID_AUTOPILOT1
        self.send(
            mavlink.MAVLink_command_long_message(target, component, command, 0, param1, param2, 0.0, 0.0, 0.0, 0.0, 0.0)
        )
