"""Which messages the PX4 stub acts upon: fusion table, setpoint masks, commands to the link. No sockets."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.model.frames import quat_from_euler_zyx
from sitl.autopilot.modes import NavState
from sitl.autopilot.receive import Receiver
from sitl.autopilot.setpoints import PositionTarget, decode_attitude_target, decode_position_target
from sitl.autopilot.streams import STREAMS, Schedule
from sitl.autopilot.types import AttitudeTarget
from tests.sitl.px4_rig import Rig

NAN = math.nan


class Wire:
    """Encodes and decodes through MAVLink's bytes, and keeps the replies."""

    def __init__(self, rig: Rig, system: int = 245, component: int = 190) -> None:
        self.schedule = Schedule(ground=False)
        self.replies: list[Any] = []
        self.texts: list[str] = []
        self.list_requests = 0
        self._receiver = Receiver(rig.stub)
        self._out = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._in = mavlink.MAVLink(None)

    def deliver(self, message: Any) -> None:
        for decoded in self._in.parse_buffer(message.pack(self._out)):
            self._receiver.handle(self, decoded)

    def send(self, message: Any) -> None:
        self.replies.append(message)

    def send_all_params(self) -> None:
        self.list_requests += 1

    def note_ground_station(self) -> None:
        self.texts.append("ground station")

    def status_text(self, severity: int, text: str) -> None:
        self.texts.append(text)

    def command(self, number: int, *params: float, target: int = 1) -> int:
        p = [*params, *[0.0] * (7 - len(params))]
        self.deliver(mavlink.MAVLink_command_long_message(target, 1, number, 0, *p))
        acks = [reply for reply in self.replies if reply.get_type() == "COMMAND_ACK" and reply.command == number]
        return int(acks[-1].result) if acks else -1


def odometry(frame: int, estimator: int) -> Any:
    body, nothing, unknown = mavlink.MAV_FRAME_BODY_FRD, (0.0,) * 6, [0.0] * 21
    pose = (0.1, 0.2, -0.3, [1, 0, 0, 0])
    return mavlink.MAVLink_odometry_message(0, frame, body, *pose, *nothing, unknown, unknown, 0, estimator)


VISION = mavlink.MAVLink_vision_position_estimate_message(0, 0.1, 0.2, -0.3, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("message", "ev_ctrl", "fused"),
    [
        (VISION, 11, True),
        (VISION, 0, False),
        (odometry(mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_ESTIMATOR_TYPE_VISION), 11, True),
        (odometry(mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_ESTIMATOR_TYPE_VISION), 11, True),
        (odometry(mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_ESTIMATOR_TYPE_UNKNOWN), 11, False),
        (odometry(mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_ESTIMATOR_TYPE_MOCAP), 11, False),
        (odometry(14, mavlink.MAV_ESTIMATOR_TYPE_VISION), 11, False),  # MAV_FRAME_MOCAP_NED
        (mavlink.MAVLink_att_pos_mocap_message(0, [1, 0, 0, 0], 0.1, 0.2, -0.3), 11, False),
        (mavlink.MAVLink_vision_position_estimate_message(0, NAN, 0.2, -0.3, 0.0, 0.0, 0.0), 11, False),
    ],
)
def test_only_what_ekf2_fuses_moves_the_estimate(message: Any, ev_ctrl: int, fused: bool) -> None:
    rig = Rig({"EKF2_EV_CTRL": ev_ctrl})
    rig.vision = False
    wire = Wire(rig)
    rig.run(0.2)
    for _ in range(20):
        wire.deliver(message)
        rig.run(0.02)
    estimate = rig.stub.estimate
    assert estimate is not None
    assert estimate.vision_fused is fused
    assert estimate.position_valid is fused
    if fused:
        assert estimate.position_ned_m == pytest.approx((0.1, 0.2, -0.3), abs=0.05)
    assert wire.texts == [], "PX4 says nothing about it"


QUAT = quat_from_euler_zyx(0.1, -0.2, 0.3)
RATES_IGNORED = 7


@pytest.mark.parametrize(
    ("mask", "q", "rates", "thrust", "expected"),
    [
        (RATES_IGNORED, QUAT, (0.0, 0.0, 0.0), 0.4, AttitudeTarget(QUAT, 0.4)),
        (RATES_IGNORED, QUAT, (NAN, NAN, NAN), 0.4, AttitudeTarget(QUAT, 0.4)),
        (3, QUAT, (0.0, 0.0, 0.5), 0.4, AttitudeTarget(QUAT, 0.4, 0.5)),
        (RATES_IGNORED, QUAT, (0.0, 0.0, 0.0), 1.5, AttitudeTarget(QUAT, 1.0)),
        (RATES_IGNORED, QUAT, (0.0, 0.0, 0.0), NAN, None),
        (RATES_IGNORED, (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.4, None),
        (RATES_IGNORED | 64, QUAT, (0.0, 0.0, 0.0), 0.4, None),
        (128, QUAT, (0.1, 0.2, 0.3), 0.4, None),
    ],
)
def test_attitude_target_masks(mask: int, q: Any, rates: Any, thrust: float, expected: Any) -> None:
    got = decode_attitude_target(mask, q, rates, thrust)
    if isinstance(expected, AttitudeTarget):
        assert isinstance(got, AttitudeTarget)
        assert got.attitude_ned_frd == pytest.approx(expected.attitude_ned_frd)
        assert (got.thrust, got.yaw_rate_rad_s) == (expected.thrust, expected.yaw_rate_rad_s)
    else:
        assert got == expected


POS, VEL, ACC = (1.0, 2.0, -3.0), (0.1, 0.2, 0.3), (0.0, 0.0, -1.0)


@pytest.mark.parametrize(
    ("mask", "frame", "expected"),
    [
        (0b1001_1111_1000 | 2048, 1, PositionTarget(POS, yaw_rad=0.7)),
        (0b0001_1100_0111 | 1024 | 2048, 1, PositionTarget(velocity_ned_m_s=VEL)),
        (0b0001_1100_0000 | 2048, 1, PositionTarget(POS, VEL, yaw_rad=0.7)),
        (0b0000_0011_1111 | 1024, 1, PositionTarget(acceleration_ned_m_s2=ACC, yaw_rate_rad_s=0.2)),
        (0b0001_1100_0111 | 1024 | 2048, 8, PositionTarget(velocity_ned_m_s=(-0.2, 0.1, 0.3))),
        (0b0001_1111_1000, 8, None),  # a position in the body frame
        (0, 7, None),  # MAV_FRAME_LOCAL_OFFSET_NED
    ],
)
def test_position_target_masks(mask: int, frame: int, expected: PositionTarget | None) -> None:
    got = decode_position_target(mask, frame, POS, VEL, ACC, 0.7, 0.2, math.pi / 2)
    if expected is None or frame == 1:
        assert got == expected
    else:
        assert got is not None
        assert got.velocity_ned_m_s == pytest.approx(expected.velocity_ned_m_s)


def test_commands_to_the_link_are_answered_as_px4_does() -> None:
    rig = Rig()
    wire = Wire(rig)
    rig.run(0.1)
    interval, request = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE
    assert wire.command(interval, mavlink.MAVLINK_MSG_ID_ODOMETRY, 5000) == mavlink.MAV_RESULT_ACCEPTED
    assert wire.schedule.interval_us(mavlink.MAVLINK_MSG_ID_ODOMETRY) == round(1e6 / 124)
    assert wire.command(interval, mavlink.MAVLINK_MSG_ID_ODOMETRY, -1) == mavlink.MAV_RESULT_ACCEPTED
    assert wire.schedule.interval_us(mavlink.MAVLINK_MSG_ID_ODOMETRY) == -1
    assert wire.command(interval, mavlink.MAVLINK_MSG_ID_ODOMETRY, 0) == mavlink.MAV_RESULT_ACCEPTED
    assert wire.schedule.interval_us(mavlink.MAVLINK_MSG_ID_ODOMETRY) == round(1e6 / 30)
    assert wire.command(interval, 9999, 5000) == mavlink.MAV_RESULT_FAILED
    assert wire.command(request, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == mavlink.MAV_RESULT_ACCEPTED
    version = next(reply for reply in wire.replies if reply.get_type() == "AUTOPILOT_VERSION")
    assert version.flight_sw_version >> 16 == 1 << 8 | 16
    assert wire.command(request, mavlink.MAVLINK_MSG_ID_HOME_POSITION) == mavlink.MAV_RESULT_DENIED, "no origin yet"
    wire.deliver(mavlink.MAVLink_set_gps_global_origin_message(1, 473977420, 85455940, 488000))
    rig.run(0.1)
    assert wire.command(request, mavlink.MAVLINK_MSG_ID_HOME_POSITION) == mavlink.MAV_RESULT_ACCEPTED
    assert wire.command(request, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT) == mavlink.MAV_RESULT_ACCEPTED
    where = next(reply for reply in wire.replies if reply.get_type() == "GLOBAL_POSITION_INT")
    assert where.lat == pytest.approx(473977420, abs=20)
    assert wire.command(mavlink.MAV_CMD_NAV_TAKEOFF, target=7) == -1, "a command for another system"
    assert rig.stub.nav_state is NavState.LOITER


@pytest.mark.parametrize(
    ("message_id", "asked_hz", "expected_hz"),
    [
        (mavlink.MAVLINK_MSG_ID_ODOMETRY, 200.0, 124.0),
        (mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, 250.0, 241.0),
        (mavlink.MAVLINK_MSG_ID_HEARTBEAT, 50.0, 1.0),
        (mavlink.MAVLINK_MSG_ID_ODOMETRY, 40.0, 40.0),
    ],
)
def test_stream_rates_have_px4s_ceilings(message_id: int, asked_hz: float, expected_hz: float) -> None:
    schedule = Schedule(ground=False)
    schedule.set_rate(message_id, asked_hz)
    sent = sum(message_id in schedule.due(step * 0.002) for step in range(5000))
    assert sent == pytest.approx(expected_hz * 10.0, abs=2)


def test_every_stream_can_be_encoded() -> None:
    """After 5000 s stamps in microseconds no longer fit 32 bits."""
    rig = Rig()
    rig.t_s = 5000.0
    encoder = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for stream in STREAMS.values():
        message = stream.build(rig.stub)
        assert message is None or message.pack(encoder)
    rig.run(0.2)
    Wire(rig).deliver(mavlink.MAVLink_set_gps_global_origin_message(1, 473977420, 85455940, 488000))
    rig.run(0.1)
    rig.mode(4, 2)
    rig.arm()
    rig.run(0.5)
    for message_id, stream in STREAMS.items():
        message = stream.build(rig.stub)
        assert message is not None, message_id
        assert message.get_msgId() == message_id
        assert message.pack(encoder)
