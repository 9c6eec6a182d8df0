"""The autopilot's end of the wire, spoken by pymavlink: the test sees each byte that left and chooses each answer."""

from __future__ import annotations

import socket
import struct
import threading
import time
from typing import Any, Self

from pymavlink.dialects.v20 import common as mavlink

from tests.support import DEADLINE_S

_MARK = b"mark"
GYRO_FRD_RAD_S = (0.11, 0.22, -0.33)
ACCEL_FRD_M_S2 = (0.5, -0.25, -9.5)
POSITION_NED_M = (1.0, 2.0, -3.0)
VELOCITY_NED_M_S = (0.1, 0.2, -0.3)
PARAMS: dict[str, float | int] = {
    "MPC_THR_HOVER": 0.4375, "COM_RC_IN_MODE": 4, "MAV_SYS_ID": 1, "SDLOG_MODE": -1, "CAL_GYRO0_ID": 0x7FC00001,
    "CBRK_FLIGHTTERM": 121212, "COM_FLTMODE6": -2147483648,
}  # fmt: skip
"""As PX4 stores them; the bytes of some of the integers are no number when they are read as a float."""


class Px4Peer:
    """Heartbeats to `port` on loopback, 10 Hz by default; streams what SET_MESSAGE_INTERVAL asked for; records all that arrives."""

    def __init__(
        self,
        port: int,
        autopilot: int = mavlink.MAV_AUTOPILOT_PX4,
        at: tuple[str, int] = ("127.0.0.1", 0),
        beat_period_s: float = 0.1,
    ) -> None:
        self.remote = ("127.0.0.1", port)
        self.autopilot = autopilot
        self.base_mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        self.custom_mode = 3 << 16
        self.beating = True
        self.beat_period_s = beat_period_s
        self.origin: Any = True
        """True: there was one from the start. None: there is none. Else the SET_GPS_GLOBAL_ORIGIN that was taken."""
        self.params = dict(PARAMS)
        self.deaf_to: set[str] = set()
        """Parameters whose first request is lost."""
        self.estimator: tuple[Any, ...] | None = None
        """ESTIMATOR_STATUS without its time, sent once it was asked for."""
        self.landed = mavlink.MAV_LANDED_STATE_ON_GROUND
        self.attitude_ned_frd = (1.0, 0.0, 0.0, 0.0)
        self.position_ned_m, self.velocity_ned_m_s = POSITION_NED_M, VELOCITY_NED_M_S
        self.accel_frd_m_s2 = ACCEL_FRD_M_S2
        self.system_status = mavlink.MAV_STATE_ACTIVE
        self.acks: dict[int, int | None] = {}
        """MAV_CMD to MAV_RESULT, accepted where absent; None: no answer at all."""
        self.sensors_present = 0
        self.heartbeats_on_request = False
        self.working_on: list[Any] = []
        """Commands that were answered with IN_PROGRESS; the answer is repeated at 10 Hz."""
        self.asked_interval_us: dict[int, float] = {}
        self.received: list[Any] = []
        self._marks = 0
        self._changed = threading.Condition()
        """Its lock is held while a message is recorded and answered, and while one is sent: by this thread or by the test."""
        self._stop = threading.Event()
        self._out = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._in = mavlink.MAVLink(None)
        self._in.robust_parsing = True
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(at)
        self._socket.settimeout(0.01)
        self._thread = threading.Thread(target=self._run, name="px4-peer")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(10.0)
        self._socket.close()

    @property
    def address(self) -> tuple[str, int]:
        """Where it sends from."""
        host, port = self._socket.getsockname()
        return host, port

    def of(self, name: str) -> list[Any]:
        """All messages of one type so far."""
        with self._changed:
            return [message for message in self.received if message.get_type() == name]

    def commands(self, command: int) -> list[Any]:
        return [message for message in self.of("COMMAND_LONG") if message.command == command]

    def wait_for(self, name: str, count: int = 1, deadline_s: float = DEADLINE_S) -> Any:
        """Block until `count` messages of one type are there; the newest."""
        with self._changed:
            arrived = self._changed.wait_for(
                lambda: sum(m.get_type() == name for m in self.received) >= count, deadline_s
            )
            assert arrived, f"no {name} within {deadline_s} s"
            return [m for m in self.received if m.get_type() == name][-1]

    def packets_so_far(self) -> int:
        """Number of messages that arrived before this call: a mark is sent through the same socket and waited for."""
        with self._changed:
            target = self._marks + 1
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as marker:
                marker.sendto(_MARK, self._socket.getsockname())
            assert self._changed.wait_for(lambda: self._marks >= target, DEADLINE_S), "the peer is stuck"
            return len(self.received)

    def say(self, message: Any) -> None:
        with self._changed:
            self._socket.sendto(message.pack(self._out), self.remote)

    def _run(self) -> None:
        beaten_s = stream_s = 0.0
        while not self._stop.is_set():
            now_s = time.monotonic()
            if self.beating and now_s >= beaten_s + self.beat_period_s:
                beaten_s = now_s
                self._say_slow()
            if self.beating and now_s >= stream_s:
                stream_s = now_s + 0.02
                self._say_fast(int(now_s * 1e3) & 0xFFFFFFFF)
            try:
                datagram = self._socket.recv(4096)
            except TimeoutError:
                continue
            if datagram == _MARK:
                with self._changed:
                    self._marks += 1
                    self._changed.notify_all()
                continue
            for message in self._in.parse_buffer(datagram) or []:
                with self._changed:
                    self._take(message)

    def _take(self, message: Any) -> None:
        self.received.append(message)
        self._changed.notify_all()
        if message.get_type() == "COMMAND_LONG":
            self._answer(message)
        elif message.get_type() == "PARAM_REQUEST_READ" and message.param_id in self.deaf_to:
            self.deaf_to.discard(message.param_id)
        elif message.get_type() == "PARAM_REQUEST_READ" and message.param_id in self.params:
            self._say_param(message.param_id)
        elif message.get_type() == "PARAM_SET" and message.param_id in self.params:
            self._set_param(message)
        elif message.get_type() == "SET_GPS_GLOBAL_ORIGIN":
            self.origin = message

    def _answer(self, message: Any) -> None:
        if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            self.asked_interval_us[int(message.param1)] = message.param2
        result = self.acks.get(message.command, mavlink.MAV_RESULT_ACCEPTED)
        if message.command == mavlink.MAV_CMD_REQUEST_MESSAGE and message.param1 == 49 and self.origin is None:
            result = mavlink.MAV_RESULT_DENIED
        if result is not None:
            self._say_ack(message, result)
        if result == mavlink.MAV_RESULT_IN_PROGRESS:
            self.working_on.append(message)
        if message.command == mavlink.MAV_CMD_REQUEST_MESSAGE and message.param1 == 0 and self.heartbeats_on_request:
            self._say_heartbeat()
        if message.command == mavlink.MAV_CMD_REQUEST_MESSAGE and message.param1 == 148:
            version, git = 0x011001FF, list(bytes.fromhex("efcdab8967452301"))
            self.say(mavlink.MAVLink_autopilot_version_message(0, version, 0, 0, 0, git, [0] * 8, [0] * 8, 0, 0, 0))

    def finish(self, result: int) -> None:
        """Answer every command that is in progress for good."""
        with self._changed:
            while self.working_on:
                self._say_ack(self.working_on.pop(), result)

    def _say_ack(self, command: Any, result: int) -> None:
        self.say(
            mavlink.MAVLink_command_ack_message(
                command.command, result, 0, 0, command.get_srcSystem(), command.get_srcComponent()
            )
        )

    def _say_param(self, name: str) -> None:
        value = self.params[name]
        kind = mavlink.MAV_PARAM_TYPE_INT32 if isinstance(value, int) else mavlink.MAV_PARAM_TYPE_REAL32
        if isinstance(value, int):  # PX4 puts the bytes of the integer where the float is
            value = float(_float_of_int_bytes(value))
        self.say(mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(self.params), 0))

    def _set_param(self, message: Any) -> None:
        """As PX4: silent where the type is another one."""
        integer = isinstance(self.params[message.param_id], int)
        if message.param_type == (mavlink.MAV_PARAM_TYPE_INT32 if integer else mavlink.MAV_PARAM_TYPE_REAL32):
            wire = struct.pack("<f", message.param_value)
            self.params[message.param_id] = struct.unpack("<i" if integer else "<f", wire)[0]
            self._say_param(message.param_id)

    def _say_slow(self) -> None:
        with self._changed:
            for command in self.working_on:
                self._say_ack(command, mavlink.MAV_RESULT_IN_PROGRESS)
        self._say_heartbeat()
        self.say(mavlink.MAVLink_extended_sys_state_message(0, self.landed))
        if self.estimator is not None and mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS in self.asked_interval_us:
            self.say(mavlink.MAVLink_estimator_status_message(int(time.monotonic() * 1e6), *self.estimator))
        self.say(mavlink.MAVLink_sys_status_message(self.sensors_present, 0, 0, 0, 16000, 100, 77, 0, 0, 0, 0, 0, 0))
        cells = [4000] * 4 + [65535] * 6
        self.say(mavlink.MAVLink_battery_status_message(0, 0, 1, 2000, cells, 100, 0, 0, 77, 0, 0))

    def _say_heartbeat(self) -> None:
        self.say(
            mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_QUADROTOR, self.autopilot, self.base_mode, self.custom_mode, self.system_status, 3
            )
        )

    def _say_fast(self, time_boot_ms: int) -> None:
        if mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED in self.asked_interval_us:
            self.say(
                mavlink.MAVLink_local_position_ned_message(time_boot_ms, *self.position_ned_m, *self.velocity_ned_m_s)
            )
        if mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION in self.asked_interval_us:
            self.say(mavlink.MAVLink_attitude_quaternion_message(time_boot_ms, *self.attitude_ned_frd, *GYRO_FRD_RAD_S))
        if mavlink.MAVLINK_MSG_ID_HIGHRES_IMU in self.asked_interval_us:
            rest = (0.0,) * 7
            self.say(
                mavlink.MAVLink_highres_imu_message(
                    time_boot_ms * 1000, *self.accel_frd_m_s2, *GYRO_FRD_RAD_S, *rest, 0xFFFF
                )
            )


def _float_of_int_bytes(value: int) -> float:
    decoded: float = struct.unpack("<f", struct.pack("<i", value))[0]
    return decoded
