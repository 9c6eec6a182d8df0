"""Handlers for the MAVLink messages that the PX4 stub receives: parameters, commands, setpoints and vision; without sockets or
clock.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any, Protocol

from pymavlink.dialects.v20 import common as mavlink

from companion.model.frames import quat_from_euler_zyx
from companion.model.types import Vec3
from sitl.autopilot import telemetry
from sitl.autopilot.autopilot import Px4Stub
from sitl.autopilot.commander import Command, Result
from sitl.autopilot.origin import Origin
from sitl.autopilot.params import HASH_CHECK, MAV_PARAM_TYPE_INT32
from sitl.autopilot.setpoints import decode_attitude_target, decode_position_target
from sitl.autopilot.streams import STREAMS, Schedule
from sitl.autopilot.types import Command7

Message = Any

_FTP_NAK, _FTP_FILE_NOT_FOUND = 129, 10
_FUSED_ESTIMATORS = (mavlink.MAV_ESTIMATOR_TYPE_VISION, mavlink.MAV_ESTIMATOR_TYPE_VIO)
_FUSED_FRAMES = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_FRD)


class Reply(Protocol):
    """Link from which a message arrived."""

    schedule: Schedule

    def send(self, message: Message) -> None:
        """Send a message to the link's partner."""

    def send_all_params(self) -> None:
        """Start sending every parameter."""

    def note_ground_station(self) -> None:
        """Record that a heartbeat from a ground station has arrived."""

    def status_text(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT on this link."""


class Receiver:
    """Dispatches messages by their id."""

    def __init__(self, stub: Px4Stub) -> None:
        self._stub = stub
        self._system = stub.params.integer("MAV_SYS_ID")
        self._component = stub.params.integer("MAV_COMP_ID")
        self._handlers: dict[int, Callable[[Reply, Message], None]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            mavlink.MAVLINK_MSG_ID_PING: self._ping,
            mavlink.MAVLINK_MSG_ID_TIMESYNC: self._timesync,
            mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: self._param_request_list,
            mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ: self._param_request_read,
            mavlink.MAVLINK_MSG_ID_PARAM_SET: self._param_set,
            mavlink.MAVLINK_MSG_ID_COMMAND_LONG: self._command_long,
            mavlink.MAVLINK_MSG_ID_COMMAND_INT: self._command_int,
            mavlink.MAVLINK_MSG_ID_SET_MODE: self._set_mode,
            mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET: self._set_attitude_target,
            mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED: self._set_position_target,
            mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE: self._vision_position_estimate,
            mavlink.MAVLINK_MSG_ID_ODOMETRY: self._odometry,
            mavlink.MAVLINK_MSG_ID_SET_GPS_GLOBAL_ORIGIN: self._set_origin,
            mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_LIST: self._mission_request_list,
            mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL: self._ftp,
            # ATT_POS_MOCAP has no entry: PX4 logs it as mocap odometry, and EKF2 does not fuse that.
        }

    def handle(self, link: Reply, message: Message) -> None:
        """Handle one decoded message if it is addressed to this autopilot or to all systems."""
        handler = self._handlers.get(message.get_msgId())
        if handler is None:
            return
        # A companion computer may share the system id, so only an echo of the stub's own messages is ignored.
        if (message.get_srcSystem(), message.get_srcComponent()) == (self._system, self._component):
            return
        if getattr(message, "target_system", 0) not in (0, self._system):
            return
        if getattr(message, "target_component", 0) not in (0, self._component):
            return
        handler(link, message)

    def _heartbeat(self, link: Reply, message: Message) -> None:
        if message.type == mavlink.MAV_TYPE_GCS:
            link.note_ground_station()

    def _ping(self, link: Reply, message: Message) -> None:
        if message.target_system == 0 and message.target_component == 0:
            link.send(
                mavlink.MAVLink_ping_message(
                    message.time_usec, message.seq, message.get_srcSystem(), message.get_srcComponent()
                )
            )

    def _timesync(self, link: Reply, message: Message) -> None:
        if message.tc1 == 0:
            now_us = telemetry.clock_us(self._stub) + round(self._stub.since_sample_s * 1e6)
            link.send(mavlink.MAVLink_timesync_message(1000 * now_us, message.ts1))

    def _param_request_list(self, link: Reply, _message: Message) -> None:
        link.send_all_params()

    def _param_request_read(self, link: Reply, message: Message) -> None:
        params = self._stub.params
        name: str | None = message.param_id if message.param_index < 0 else params.name_at(message.param_index)
        if name == HASH_CHECK:
            link.send(hash_check_message(self._stub))
        elif name is not None and name in params:
            link.send(param_value_message(self._stub, name))
        else:
            link.status_text(mavlink.MAV_SEVERITY_INFO, f"[pm] unknown param ID: {message.param_id}")

    def _param_set(self, link: Reply, message: Message) -> None:
        name = message.param_id
        if name == HASH_CHECK:
            return
        if name not in self._stub.params:
            link.status_text(mavlink.MAV_SEVERITY_ERROR, f"[pm] unknown param: {name}")
            return
        try:
            self._stub.params.set_from_wire(name, message.param_value, message.param_type)
        except ValueError:
            link.status_text(mavlink.MAV_SEVERITY_ERROR, f"[pm] param types mismatch param: {name}")
            return
        link.send(param_value_message(self._stub, name))

    def _command_long(self, link: Reply, message: Message) -> None:
        params = tuple(getattr(message, f"param{i}") for i in range(1, 8))
        self._command(link, message, (params[0], params[1], params[2], params[3], params[4], params[5], params[6]))

    def _command_int(self, link: Reply, message: Message) -> None:
        # PX4 scales x and y of every COMMAND_INT with a location; INT32_MAX means "not set".
        x, y = (math.nan if value == 2**31 - 1 else value * 1e-7 for value in (message.x, message.y))
        m = message
        self._command(link, message, (m.param1, m.param2, m.param3, m.param4, x, y, m.z))

    def _command(self, link: Reply, message: Message, params: Command7) -> None:
        result = self._link_command(link, message.command, params)
        if result is None:
            result = self._stub.on_command(self._stub.arrival_s, message.command, params)
        link.send(
            mavlink.MAVLink_command_ack_message(
                message.command, int(result), 0, 0, message.get_srcSystem(), message.get_srcComponent()
            )
        )

    def _link_command(self, link: Reply, command: int, params: Command7) -> Result | None:
        """Handle a command that PX4's mavlink module answers itself; return None if the commander must handle it."""
        number = int(params[0]) if math.isfinite(params[0]) else -1
        match command:
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                return Result.ACCEPTED if link.schedule.set_interval_us(number, params[1]) else Result.FAILED
            case mavlink.MAV_CMD_GET_MESSAGE_INTERVAL:
                interval_us = link.schedule.interval_us(number)
                link.send(mavlink.MAVLink_message_interval_message(max(0, number), interval_us))
                return Result.ACCEPTED if number in STREAMS else Result.FAILED
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                return self._request(link, number)
            case mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
                return self._request(link, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            case mavlink.MAV_CMD_GET_HOME_POSITION:
                return self._request(link, mavlink.MAVLINK_MSG_ID_HOME_POSITION)
            case _:
                return None

    def _request(self, link: Reply, message_id: int) -> Result:
        stream = STREAMS.get(message_id)
        message = stream.build(self._stub) if stream is not None else None
        if message is None:
            return Result.DENIED
        link.send(message)
        return Result.ACCEPTED

    def _set_mode(self, link: Reply, message: Message) -> None:
        main_mode, sub_mode = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF
        params: Command7 = (float(message.base_mode), float(main_mode), float(sub_mode), 0.0, 0.0, 0.0, 0.0)
        self._stub.on_command(self._stub.arrival_s, Command.DO_SET_MODE, params)

    def _set_attitude_target(self, _link: Reply, message: Message) -> None:
        m = message
        q = (m.q[0], m.q[1], m.q[2], m.q[3])
        rates = (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate)
        target = decode_attitude_target(m.type_mask, q, rates, m.thrust)
        if target is not None:
            self._stub.on_setpoint(self._stub.arrival_s, target)

    def _set_position_target(self, _link: Reply, message: Message) -> None:
        m = message
        target = decode_position_target(
            m.type_mask,
            m.coordinate_frame,
            (m.x, m.y, m.z),
            (m.vx, m.vy, m.vz),
            (m.afx, m.afy, m.afz),
            m.yaw,
            m.yaw_rate,
            self._stub.heading_rad,
        )
        if target is not None:
            self._stub.on_setpoint(self._stub.arrival_s, target)

    def _vision_position_estimate(self, _link: Reply, message: Message) -> None:
        m = message
        self._vision((m.x, m.y, m.z), quat_from_euler_zyx(m.roll, m.pitch, m.yaw))

    def _odometry(self, _link: Reply, message: Message) -> None:
        """Accept ODOMETRY only if it is external vision; PX4 silently ignores frame MOCAP_NED and estimators unset and naive."""
        m = message
        if m.estimator_type in _FUSED_ESTIMATORS and m.frame_id in _FUSED_FRAMES:
            self._vision((m.x, m.y, m.z), (m.q[0], m.q[1], m.q[2], m.q[3]))

    def _vision(self, position_ned_m: Vec3, attitude: tuple[float, float, float, float]) -> None:
        if all(map(math.isfinite, (*position_ned_m, *attitude))):
            self._stub.on_vision(self._stub.arrival_s, position_ned_m, attitude)

    def _set_origin(self, link: Reply, message: Message) -> None:
        self._stub.set_origin(Origin(message.latitude * 1e-7, message.longitude * 1e-7, message.altitude * 1e-3))
        self._request(link, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)

    def _mission_request_list(self, link: Reply, message: Message) -> None:
        link.send(
            mavlink.MAVLink_mission_count_message(
                message.get_srcSystem(), message.get_srcComponent(), 0, message.mission_type
            )
        )

    def _ftp(self, link: Reply, message: Message) -> None:
        """Refuse every file request at once, so that a ground station does not wait."""
        sequence, session, opcode = struct.unpack_from("<HBB", bytes(message.payload))
        if opcode >= 128:
            return
        head = struct.pack(
            "<HBBBBBBIB", sequence + 1 & 0xFFFF, session, _FTP_NAK, 1, opcode, 0, 0, 0, _FTP_FILE_NOT_FOUND
        )
        payload = list(head.ljust(251, b"\0"))
        link.send(
            mavlink.MAVLink_file_transfer_protocol_message(
                0, message.get_srcSystem(), message.get_srcComponent(), payload
            )
        )


def param_value_message(stub: Px4Stub, name: str) -> Message:
    """Return the PARAM_VALUE message for one parameter."""
    params = stub.params
    return mavlink.MAVLink_param_value_message(
        name.encode(), params.wire_value(name), params.mav_type(name), len(params), params.index(name)
    )


def hash_check_message(stub: Px4Stub) -> Message:
    """Return the PARAM_VALUE message for _HASH_CHECK, which has index -1 and is not included in the parameter count."""
    return mavlink.MAVLink_param_value_message(
        HASH_CHECK.encode(), stub.params.hash_check(), MAV_PARAM_TYPE_INT32, len(stub.params), 65535
    )
