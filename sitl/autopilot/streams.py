"""Telemetry streams of the PX4 stub: PX4's default and maximum rates, and a schedule on world time; without I/O or clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from sitl.autopilot import telemetry
from sitl.autopilot.autopilot import Px4Stub

Message = Any
Builder = Callable[[Px4Stub], Message | None]


@dataclass(frozen=True, slots=True)
class Stream:
    """One message type with its rates in Hz: the defaults on the onboard and the ground station link, and the maximum."""

    build: Builder
    onboard_hz: float
    ground_hz: float
    ceiling_hz: float = 50.0


# Defaults: mavlink_main.cpp, MAVLINK_MODE_ONBOARD and MAVLINK_MODE_NORMAL of 1.16. Ceilings: measured, or the rate of the topic.
STREAMS: dict[int, Stream] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: Stream(telemetry.heartbeat, 1.0, 1.0, 1.0),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: Stream(telemetry.attitude_quaternion, 50.0, 10.0, 212.0),
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: Stream(telemetry.highres_imu, 50.0, 0.0, 241.0),
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: Stream(telemetry.local_position_ned, 30.0, 1.0, 124.0),
    mavlink.MAVLINK_MSG_ID_ODOMETRY: Stream(telemetry.odometry, 30.0, 0.0, 124.0),
    mavlink.MAVLINK_MSG_ID_ATTITUDE: Stream(telemetry.attitude, 100.0, 15.0, 212.0),
    mavlink.MAVLINK_MSG_ID_TIMESYNC: Stream(telemetry.timesync_request, 10.0, 0.0, 10.0),
    mavlink.MAVLINK_MSG_ID_ALTITUDE: Stream(telemetry.altitude, 10.0, 1.0),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: Stream(telemetry.attitude_target, 10.0, 2.0, 124.0),
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: Stream(telemetry.position_target_local_ned, 10.0, 1.5),
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: Stream(telemetry.battery_status, 0.5, 0.5, 10.0),
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: Stream(telemetry.estimator_status, 1.0, 0.5),
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: Stream(telemetry.extended_sys_state, 5.0, 1.0),
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: Stream(telemetry.global_position_int, 50.0, 5.0, 124.0),
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: Stream(telemetry.gps_global_origin, 1.0, 1.0),
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: Stream(telemetry.home_position, 0.5, 0.5),
    mavlink.MAVLINK_MSG_ID_PING: Stream(telemetry.ping, 1.0, 0.1, 1.0),
    mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: Stream(telemetry.servo_output_raw, 10.0, 1.0, 212.0),
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: Stream(telemetry.sys_status, 5.0, 1.0),
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: Stream(telemetry.system_time, 1.0, 0.0),
    mavlink.MAVLINK_MSG_ID_VFR_HUD: Stream(telemetry.vfr_hud, 10.0, 4.0),
    mavlink.MAVLINK_MSG_ID_VIBRATION: Stream(telemetry.vibration, 0.5, 0.1),
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: Stream(telemetry.autopilot_version, 0.0, 0.0, 1.0),
}


class Schedule:
    """Schedule, in world time, of the streams of one link."""

    def __init__(self, ground: bool) -> None:
        self._default_hz = {key: stream.ground_hz if ground else stream.onboard_hz for key, stream in STREAMS.items()}
        self._period_s: dict[int, float] = {}
        self._due_s: dict[int, float] = {}
        for key, rate_hz in self._default_hz.items():
            self.set_rate(key, rate_hz)

    def start_over(self) -> None:
        """Let every stream be due at once: world time starts over."""
        self._due_s = dict.fromkeys(self._due_s, -math.inf)

    def set_rate(self, message_id: int, rate_hz: float) -> bool:
        """Set the rate of a stream, limited by PX4's maximum; 0 stops it. Return False if there is no such stream."""
        stream = STREAMS.get(message_id)
        if stream is None:
            return False
        self._period_s.pop(message_id, None)
        if rate_hz > 0.0:
            self._period_s[message_id] = 1.0 / min(rate_hz, stream.ceiling_hz)
            self._due_s.setdefault(message_id, -math.inf)
        return True

    def set_interval_us(self, message_id: int, interval_us: float) -> bool:
        """Handle MAV_CMD_SET_MESSAGE_INTERVAL: -1 stops the stream, 0 is the default rate; return False without such a stream."""
        if message_id not in STREAMS or not math.isfinite(interval_us):
            return False
        if interval_us == 0:
            return self.set_rate(message_id, self._default_hz[message_id])
        return self.set_rate(message_id, 1e6 / interval_us if interval_us > 0 else 0.0)

    def interval_us(self, message_id: int) -> int:
        """Return the interval in us for MESSAGE_INTERVAL: -1 for a stopped stream, 0 for an unknown one."""
        if message_id not in STREAMS:
            return 0
        period_s = self._period_s.get(message_id)
        return -1 if period_s is None else round(period_s * 1e6)

    def due(self, t_s: float) -> list[int]:
        """Return the ids of the streams to send now; a stream that fell behind is sent once, not in a burst."""
        ids = []
        for key, period_s in self._period_s.items():
            at_s = self._due_s[key]
            if t_s >= at_s:
                ids.append(key)
                self._due_s[key] = at_s + period_s if t_s - at_s < period_s else t_s + period_s
        return ids

    def messages(self, stub: Px4Stub, t_s: float) -> Iterator[Message]:
        """Yield the message of every stream that is due at world time `t_s` and has something to send."""
        for message_id in self.due(t_s):
            message = STREAMS[message_id].build(stub)
            if message is not None:
                yield message
