"""A takeover landing on simulated time, between PX4's end of its link and the messages of a vehicle that lands."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.config.safety import Safety
from companion.guardian.heartbeat import Heartbeat
from companion.guardian.link import Link
from companion.guardian.takeover_landing import TakeoverLanding
from companion.model.frames import attitude_ned_frd_from_enu_flu, quat_from_euler_zyx
from companion.model.types import Event, MocapPose, Quat, Vec3
from companion.safety.mocap import limits_of
from companion.safety.pose_filter import PoseFilter

STANDING_M, TILT_MAX_RAD = 0.3, math.radians(40.0)
START_S, STEP_S = 20.0, 0.01
LIMITS = limits_of(Safety())
LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)
ON_ITS_BACK = quat_from_euler_zyx(math.pi, 0.0, 0.0)
ON_ITS_ROTORS = quat_from_euler_zyx(math.radians(-55.0), 0.0, 0.0)
ARMED = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_SAFETY_ARMED
DISARMED = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
LAND_MODE, OFFBOARD_MODE = 4 << 16 | 6 << 24, 6 << 16


class Wire:
    """PX4's end of the link in memory, which keeps what was sent."""

    lost = False

    def __init__(self) -> None:
        self.ready = True
        self._decoder = mavlink.MAVLink(None)
        self.sent: list[Any] = []

    def fileno(self) -> int:
        return -1

    def send(self, data: bytes) -> bool:
        self.sent += self._decoder.parse_buffer(data) or []
        return True

    def receive(self) -> list[tuple[float, bytes]]:
        return []

    def close(self) -> None:
        pass

    def commands(self, number: int) -> list[Any]:
        return [m for m in self.sent if m.get_type() == "COMMAND_LONG" and m.command == number]

    @property
    def poses(self) -> list[Any]:
        return [m for m in self.sent if m.get_type() == "VISION_POSITION_ESTIMATE"]


def beat(*, mocap_refused: bool = False, pose_stamp_s: float = START_S - 0.1) -> Heartbeat:
    return Heartbeat(
        tick=1,
        t_s=START_S - 0.1,
        origin_s=0.0,
        mission_t_s=5.0,
        lifting=True,
        pilot=False,
        goodbye=False,
        mocap_refused=mocap_refused,
        autopilot_system=1,
        own_system=1,
        own_component=191,
        local_port=0,
        pose_stamp_s=pose_stamp_s,
        position_world_m=(0.0, 0.0, STANDING_M),
    )


class Landing:
    """A takeover landing of a vehicle that PX4 lands."""

    def __init__(self, last: Heartbeat) -> None:
        self.wire = Wire()
        self.notices: list[Event] = []
        self.t_s = START_S
        link = Link(self.wire, (1, 191), 1)
        self.takeover = TakeoverLanding(
            last, STANDING_M, TILT_MAX_RAD, PoseFilter(LIMITS), link, START_S, self.notices.append
        )

    def run(
        self,
        duration_s: float,
        *,
        attitude: Quat = LEVEL,
        height_m: float = STANDING_M,
        messages: tuple[str, ...] = ("position", "attitude", "imu"),
        mocap: bool = True,
        corrupt: Callable[[Any], None] = lambda message: None,
        mode: int = LAND_MODE,
        armed: bool = True,
        beating: bool = True,
    ) -> None:
        """Run with PX4 in a mode, armed, at rest at a height, without its land detector; `corrupt` changes each state message."""
        q = attitude_ned_frd_from_enu_flu(attitude)
        for _ in range(round(duration_s / STEP_S)):
            self.t_s += STEP_S
            state = {
                "position": mavlink.MAVLink_local_position_ned_message(0, 0.0, 0.0, -height_m, 0.0, 0.0, 0.0),
                "attitude": mavlink.MAVLink_attitude_quaternion_message(0, *q, 0.0, 0.0, 0.0),
                "imu": mavlink.MAVLink_highres_imu_message(0, 0.0, 0.0, -9.81, *[0.0] * 10, 63),
            }
            said = [state[name] for name in messages]
            for message in said:
                corrupt(message)
            heartbeat = mavlink.MAVLink_heartbeat_message(2, 12, ARMED if armed else DISARMED, mode, 4, 3)
            if mocap:
                number = round(self.t_s / STEP_S)
                position: Vec3 = (1e-6 * (number % 7), 0.0, height_m)  # no measurement is the same twice
                self.takeover.take_poses(
                    [
                        MocapPose(
                            stamp_s=self.t_s,
                            frame_number=number,
                            position_world_m=position,
                            attitude_wxyz=attitude,
                            tracking_valid=True,
                            marker_error_m=0.0,
                        )
                    ]
                )
            self.takeover.take_messages(self.t_s, [heartbeat, *said] if beating else said)
            if self.takeover.landed is None:
                self.takeover.step(self.t_s)

    @property
    def positions(self) -> list[Any]:
        return [m for m in self.wire.sent if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]

    @property
    def forced(self) -> bool:
        return any(m.param2 == 21196.0 for m in self.wire.commands(mavlink.MAV_CMD_COMPONENT_ARM_DISARM))

    @property
    def zero_thrust(self) -> bool:
        return any(m.get_type() == "SET_ATTITUDE_TARGET" for m in self.wire.sent)
