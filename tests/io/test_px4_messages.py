"""Pure parts of the autopilot edge: modes, battery, answers, and the pacing of requests."""

from __future__ import annotations

import math
import struct

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4 import messages
from companion.io.px4.frames import FrameWriter
from companion.io.px4.requests import ANSWER_DEADLINE_S, RETRY_S, SETTLE_S, RequestQueue
from companion.io.px4.texts import SAME_TEXT_S
from companion.model.types import AttitudeSetpoint, AutopilotRequest, FlightMode, LandedState

ARM, LAND, NONE = AutopilotRequest.ARM, AutopilotRequest.LAND, AutopilotRequest.NONE
ARM_DISARM, DENIED = 400, 2
CUSTOM = 1


@pytest.mark.parametrize(
    ("main", "sub", "mode"),
    [
        (6, 0, FlightMode.OFFBOARD),
        (4, 2, FlightMode.TAKEOFF),
        (4, 3, FlightMode.HOLD),
        (4, 5, FlightMode.RETURN),
        (4, 6, FlightMode.LAND),
        (4, 9, FlightMode.LAND),
        (4, 4, FlightMode.OTHER),  # mission
        *((pilot, 0, FlightMode.MANUAL) for pilot in (1, 2, 3, 5, 7, 8)),
        (10, 0, FlightMode.OTHER),  # termination
        (0, 0, FlightMode.UNKNOWN),
    ],
)
def test_px4_modes(main: int, sub: int, mode: FlightMode) -> None:
    assert messages.flight_mode(CUSTOM, main << 16 | sub << 24) is mode


def test_a_truncated_payload_ends_in_zeros_and_a_missing_time_is_none() -> None:
    assert messages.local_position_ned(struct.pack("<I3f", 7, 1.0, -2.5, math.inf)) == (
        (1.0, -2.5, math.inf),
        (0.0,) * 3,
    )
    attitude = struct.pack("<7f", 1.0, 0.0, 0.0, 0.0, 0.5, -0.5, 0.25)
    read = messages.attitude_quaternion(struct.pack("<I", 1500) + attitude + b"more")
    assert read == ((1.0, 0.0, 0.0, 0.0), (0.5, -0.5, 0.25), 1.5)
    assert messages.attitude_quaternion(struct.pack("<I", 0) + attitude)[2] is None
    assert messages.highres_imu(struct.pack("<Q3f", 2500000, 1.0, 2.0, 3.0)) == ((1.0, 2.0, 3.0), 2.5)
    assert messages.highres_imu(struct.pack("<Q3f", 0, 1.0, 2.0, 3.0))[1] is None


def test_a_mode_without_the_custom_flag_is_unknown() -> None:
    assert messages.flight_mode(0, 6 << 16) is FlightMode.UNKNOWN


@pytest.mark.parametrize(("base_mode", "armed"), [(129, True), (1, False)])
@pytest.mark.parametrize("system_status", [3, 4, 5])
def test_a_heartbeat_says_armed_mode_and_whether_a_failsafe_acts(
    base_mode: int, armed: bool, system_status: int
) -> None:
    assert messages.heartbeat_state(base_mode, 6 << 16, system_status) == (armed, FlightMode.OFFBOARD, system_status)


def test_an_unheard_of_landed_state_is_unknown() -> None:
    assert messages.landed_state(2) is LandedState.IN_AIR
    assert messages.landed_state(17) is LandedState.UNKNOWN


def test_of_several_batteries_the_worst_known_value_counts() -> None:
    batteries = messages.Batteries()
    assert batteries.worst() == (None, None, None)
    for stamp_s, id_, cell_mv, percent in (
        (1.0, 0, 4000, 90),
        (2.0, 1, 3500, -1),
        (3.0, 2, 65535, 40),
        (4.0, 0, 3900, 80),
    ):
        cells = [cell_mv] * 4 + [65535] * 6
        message = mavlink.MAVLink_battery_status_message(id_, 0, 1, 2000, cells, 100, 0, 0, percent, 0, 0)
        batteries.take(stamp_s, message)
    assert batteries.worst() == pytest.approx((14.0, 0.4, 2.0))


def test_battery_that_the_autopilot_does_not_know_is_none() -> None:
    assert messages.battery([15200, *[65535] * 9], 40) == pytest.approx((15.2, 0.4))
    assert messages.battery([3800] * 4 + [65535] * 6, 40) == pytest.approx((15.2, 0.4))
    assert messages.battery([65535] * 10, -1) == (None, None)


def test_the_setpoint_keeps_single_precision() -> None:
    q = (0.9238795325112867, 0.0, 0.0, 0.3826834323650898)
    payload = messages.attitude_target(AttitudeSetpoint(q, 0.123456789), 2**32 + 5, 7)
    sent = mavlink.MAVLink(None).parse_buffer(FrameWriter(1, 191).frame(messages.SET_ATTITUDE_TARGET_ID, payload))[0]
    assert sent.time_boot_ms == 5  # 32 bits on the wire
    assert sent.target_system == 7
    assert math.hypot(*sent.q) == pytest.approx(1.0, abs=1e-7)
    assert sent.thrust == pytest.approx(0.123456789, abs=1e-8)


def test_answers_in_words() -> None:
    assert messages.result_text(2) == "denied (MAV_RESULT 2)"
    assert messages.result_text(99) == "unknown result (MAV_RESULT 99)"


def test_a_request_repeated_in_every_tick_is_a_command_every_half_second_until_it_is_answered() -> None:
    requests = RequestQueue()
    sent_s = [tick * 0.005 for tick in range(400) if requests.claim(ARM, tick * 0.005)]
    assert sent_s == pytest.approx([0.0, 0.5, 1.0, 1.5])
    assert requests.pending() == 1
    requests.answer(ARM_DISARM, DENIED, 2.5)
    assert requests.pending() == 0
    assert requests.claim(ARM, 2.5)
    assert requests.take_messages(2.5) == ["ARM refused: denied (MAV_RESULT 2)"]
    assert requests.take_messages(2.5) == []


def test_a_refused_request_waits_half_a_second_from_command_to_command() -> None:
    requests = RequestQueue()
    assert requests.claim(ARM, 0.0)
    requests.answer(ARM_DISARM, DENIED, 0.01)
    assert not requests.claim(ARM, RETRY_S - 0.001)
    assert requests.claim(ARM, RETRY_S)


def test_a_command_in_progress_is_not_repeated_before_its_deadline() -> None:
    requests = RequestQueue()
    assert requests.claim(ARM, 0.0)
    requests.answer(ARM_DISARM, messages.MAV_RESULT_IN_PROGRESS, 0.1)
    assert not requests.claim(ARM, 0.1 + ANSWER_DEADLINE_S - 0.001)
    assert requests.claim(ARM, 0.1 + ANSWER_DEADLINE_S)


def test_the_same_refusal_is_reported_again_only_after_a_while() -> None:
    requests = RequestQueue()
    for t_s in (0.0, 1.0, SAME_TEXT_S):
        assert requests.claim(ARM, t_s)
        requests.answer(ARM_DISARM, DENIED, t_s)
    assert requests.take_messages(SAME_TEXT_S) == ["ARM refused: denied (MAV_RESULT 2)"] * 2


def test_an_accepted_request_waits_for_the_heartbeat_that_shows_it() -> None:
    requests = RequestQueue()
    assert requests.claim(ARM, 0.0)
    requests.answer(ARM_DISARM, 0, 0.01)
    assert not requests.claim(ARM, SETTLE_S)
    assert requests.claim(ARM, 0.01 + SETTLE_S)
    assert requests.take_messages(2.0) == []


def test_an_answer_to_arming_goes_to_the_older_of_arm_and_disarm() -> None:
    requests = RequestQueue()
    assert requests.claim(ARM, 0.0)
    assert requests.claim(AutopilotRequest.DISARM, 0.1)
    requests.answer(ARM_DISARM, DENIED, 0.2)
    requests.answer(ARM_DISARM, 0, 0.3)
    assert requests.take_messages(0.3) == ["ARM refused: denied (MAV_RESULT 2)"]
    assert requests.pending() == 0


def test_an_answer_to_another_programs_command_is_ignored() -> None:
    requests = RequestQueue()
    assert requests.claim(ARM, 0.0)
    requests.answer(511, DENIED, 0.1)
    assert requests.pending() == 1
    assert requests.take_messages(0.1) == []


def test_land_never_waits_for_another_kind() -> None:
    requests = RequestQueue()
    assert requests.claim(AutopilotRequest.OFFBOARD, 0.0)
    assert requests.claim(ARM, 0.0)
    assert requests.claim(LAND, 0.0)
    assert not requests.claim(NONE, 0.0)
    assert requests.pending() == 3


def test_a_lost_answer_is_reported_after_its_deadline() -> None:
    requests = RequestQueue()
    times_s = [k * RETRY_S for k in range(8)]
    assert all(requests.claim(LAND, t_s) for t_s in times_s)
    assert requests.take_messages(times_s[-1]) == ["LAND: no answer within 3 s; requesting it again"]


def test_the_newest_messages_are_kept_when_none_are_taken() -> None:
    requests = RequestQueue()
    for number in range(500):
        requests.hear({"severity": 2, "text": str(number), "id": number, "chunk_seq": 0}, 0.0)
    assert requests.take_messages(0.0) == [f"critical: {number}" for number in range(300, 500)]
