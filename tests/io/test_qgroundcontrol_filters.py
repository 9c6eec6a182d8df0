"""What passes the filters to and from a ground station, message by message; frames come from pymavlink."""

from __future__ import annotations

import math
import random
import struct
from typing import Any

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import common as mavlink
from pymavlink.generator.mavcrc import x25crc

from companion.io.qgroundcontrol.downlink_filter import STREAM_RATE_HZ, DownlinkFilter
from companion.io.qgroundcontrol.texts import TEXTS_WAITING_MAX, Texts, event_text, value_messages, values
from companion.io.qgroundcontrol.uplink_filter import GROUND_SYSTEMS_MAX, UP_BURST, UP_RATE_HZ, UplinkFilter
from companion.model.types import Event, SafetyAction, Severity
from tests.analysis.synthetic_flight import synthetic_flight

VEHICLE = 1
_HEARTBEAT = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
_READ = mavlink.MAVLink_param_request_read_message(VEHICLE, 1, b"MAV_SYS_ID", -1)


def packed(message: Any, system: int = 255, component: int = 190, *, v1: bool = False) -> bytes:
    data: bytes = message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=component), force_mavlink1=v1)
    return data


def long(number: int, *params: float) -> Any:
    return mavlink.MAVLink_command_long_message(VEHICLE, 1, number, 0, *params, *[0.0] * (7 - len(params)))


def integer(number: int, *params: float) -> Any:
    four = [*params, *[0.0] * (4 - len(params))]
    return mavlink.MAVLink_command_int_message(VEHICLE, 1, 0, number, 0, 0, *four, 0, 0, 0.0)


def px4_heartbeat(*, armed: bool, system: int = VEHICLE) -> bytes:
    base_mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
    return packed(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, base_mode, 0, 4, 3), system, 1)


def uplink_of(*, armed: bool, while_armed: bool = False, console: bool = False) -> UplinkFilter:
    uplink = UplinkFilter(VEHICLE, while_armed=while_armed, console=console)
    uplink.state.hear(px4_heartbeat(armed=armed), 0.0)
    return uplink


def signed(message: Any) -> bytes:
    encoder = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    encoder.signing.secret_key = bytes(range(32))
    encoder.signing.sign_outgoing = True
    data: bytes = message.pack(encoder)
    return data


@pytest.mark.parametrize(
    "data",
    [
        *(packed(_HEARTBEAT), packed(_READ), packed(_READ, v1=True), signed(_READ)),
        *(packed(long(mavlink.MAV_CMD_NAV_LAND)), packed(integer(mavlink.MAV_CMD_DO_SET_MODE))),
        packed(mavlink.MAVLink_set_mode_message(VEHICLE, 1, 3 << 16)),
        packed(mavlink.MAVLink_param_set_message(VEHICLE, 1, b"MPC_XY_VEL_MAX", 2.0, 9)),
    ],
)
def test_what_a_ground_station_says_passes_unchanged(data: bytes) -> None:
    uplink = uplink_of(armed=False)
    assert uplink.admit(data, 0.0) == [data]
    assert not uplink.refused


def set_mode(main: int, sub: int, base_mode: int = 1) -> Any:
    return mavlink.MAVLink_set_mode_message(VEHICLE, base_mode, main << 16 | sub << 24)


_NAN = math.nan
_DANGEROUS = {
    "forced disarm": long(400, 0.0, 21196.0),
    "forced disarm as COMMAND_INT": integer(400, 0.0, 21196.0),
    "forced disarm, not quite": long(400, 0.4, 21195.6),
    "arm": long(400, 1.0),
    "forced arm": long(400, 1.0, 21196.0),
    "disarm, NaN": long(400, _NAN, _NAN),
    "restart": long(246, 1.0),
    "restart as COMMAND_INT": integer(246, 1.0),
    "flight termination": long(185, 1.0),
    "motor test": long(310, 1.0, 1.0),
    "actuator": long(187, 1.0),
    "failure injection": long(420, 0.0, 1.0),
    "take off": long(22),
    "return": long(20),
    "reposition somewhere": long(192, -1.0, 1.0, 0.0, _NAN, 47.0, 8.0, 500.0),
    "reposition as COMMAND_INT": integer(192, -1.0, 1.0, 0.0, _NAN),
    "set home": long(179, 1.0),
    "calibration": long(241, 1.0),
    "parameters reset": long(245, 2.0),
    "mission start": long(300),
    "mode MANUAL": long(176, 1.0, 1.0),
    "mode ACRO": long(176, 1.0, 5.0),
    "mode OFFBOARD": long(176, 1.0, 6.0),
    "mode MISSION": long(176, 1.0, 4.0, 4.0),
    "mode RETURN": integer(176, 1.0, 4.0, 5.0),
    "mode TERMINATION": long(176, 1.0, 10.0),
    "mode, not PX4's": long(176, 128.0, 3.0),
    "mode, NaN": long(176, _NAN, 3.0),
    "SET_MODE MANUAL": set_mode(1, 0),
    "SET_MODE MISSION": set_mode(4, 4),
    "SET_MODE, not PX4's": set_mode(3, 0, 128),
    "PARAM_SET": mavlink.MAVLink_param_set_message(VEHICLE, 1, b"COM_OF_LOSS_T", 60.0, 9),
    "mission upload": mavlink.MAVLink_mission_count_message(VEHICLE, 1, 3),
    "mission item": mavlink.MAVLink_mission_item_int_message(VEHICLE, 1, 0, 0, 16, 1, 1, *[0.0] * 4, 0, 0, 0.0),
    "mission cleared": mavlink.MAVLink_mission_clear_all_message(VEHICLE, 1),
    "mission item chosen": mavlink.MAVLink_mission_set_current_message(VEHICLE, 1, 2),
    "file transfer": mavlink.MAVLink_file_transfer_protocol_message(0, VEHICLE, 1, [8] * 251),
    "logs erased": mavlink.MAVLink_log_erase_message(VEHICLE, 1),
    "log data": mavlink.MAVLink_log_request_data_message(VEHICLE, 1, 1, 0, 90),
}
_CONSOLE = mavlink.MAVLink_serial_control_message(10, 2, 0, 0, 6, [*b"reboot", *[0] * 64])


@pytest.mark.parametrize("v1", [False, True], ids=["MAVLink 2", "MAVLink 1"])
@pytest.mark.parametrize("name", _DANGEROUS)
def test_what_may_stop_rotors_or_change_the_flight_waits_until_px4_is_disarmed(name: str, v1: bool) -> None:
    data = packed(_DANGEROUS[name], v1=v1)
    uplink = uplink_of(armed=True)
    assert uplink.admit(data, 0.1) == []
    assert all(reason.endswith("while PX4 is armed") for reason in uplink.refused)
    assert uplink_of(armed=True, while_armed=True).admit(data, 0.1) == [data], "asked for"
    assert uplink_of(armed=False).admit(data, 0.1) == [data]


@pytest.mark.parametrize("v1", [False, True], ids=["MAVLink 2", "MAVLink 1"])
@pytest.mark.parametrize(
    "message",
    [
        *(_HEARTBEAT, _READ, long(21), integer(21), long(400), integer(400), long(512, 148.0), long(520, 1.0)),
        *(long(176, 1.0, 4.0, 6.0), long(176, 209.0, 4.0, 3.0), integer(176, 1.0, 3.0), long(176, 1.0, 2.0)),
        *(set_mode(4, 6), set_mode(4, 3, 209), set_mode(3, 0), set_mode(7, 0)),
        long(192, -1.0, 1.0, 0.0, _NAN, _NAN, _NAN, _NAN),
        mavlink.MAVLink_manual_control_message(VEHICLE, 0, 0, 500, 0, 0),
        mavlink.MAVLink_mission_request_list_message(VEHICLE, 1),
    ],
    ids=lambda message: str(message)[:60],
)
def test_what_lands_holds_or_reads_passes_while_px4_is_armed(message: Any, v1: bool) -> None:
    data = packed(message, v1=v1)
    assert uplink_of(armed=True).admit(data, 0.1) == [data]


@pytest.mark.parametrize(
    ("armed", "while_armed", "console", "passes"),
    [
        (False, False, False, False),
        (False, False, True, True),
        (True, False, True, False),
        (True, True, True, False),
        (False, True, False, False),
    ],
)
def test_px4s_console_is_open_on_the_ground_alone_and_only_when_asked_for(
    armed: bool, while_armed: bool, console: bool, passes: bool
) -> None:
    data = packed(_CONSOLE)
    uplink = uplink_of(armed=armed, while_armed=while_armed, console=console)
    assert uplink.admit(data, 0.1) == ([data] if passes else [])


def test_px4_counts_as_armed_until_it_says_that_it_is_not_and_when_it_falls_silent() -> None:
    data = packed(_DANGEROUS["forced disarm"])
    uplink = UplinkFilter(VEHICLE)
    assert uplink.admit(data, 0.0) == [], "nothing heard yet"
    uplink.state.hear(px4_heartbeat(armed=False, system=7), 0.0)
    uplink.state.hear(px4_heartbeat(armed=False)[:-1], 0.0)
    assert uplink.admit(data, 0.1) == [], "another system's, and one that is cut"
    uplink.state.hear(px4_heartbeat(armed=False), 0.2)
    assert uplink.admit(data, 0.3) == [data]
    assert uplink.admit(data, 3.3) == [], "silent for more than 3 s"
    uplink.state.hear(px4_heartbeat(armed=False), 4.0)
    uplink.state.expect_arming(4.1)
    uplink.state.hear(px4_heartbeat(armed=False), 4.2)
    assert uplink.admit(data, 4.3) == [], "the companion has asked for arming"
    uplink.state.hear(px4_heartbeat(armed=False), 8.0)
    assert uplink.admit(data, 8.1) == [data], "PX4 did not arm"


_QUAT = (1.0, 0.0, 0.0, 0.0)
_FORGED = [
    mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 209, 6 << 16, 4, 3),
    mavlink.MAVLink_attitude_quaternion_message(1, *_QUAT, 0.0, 0.0, 0.0),
    mavlink.MAVLink_local_position_ned_message(1, *[0.0] * 6),
    mavlink.MAVLink_command_ack_message(400, 0),
    mavlink.MAVLink_param_value_message(b"MPC_THR_HOVER", 0.9, 9, 1, 0),
    _READ,
]


@pytest.mark.parametrize("message", _FORGED, ids=lambda message: message.get_type())
@pytest.mark.parametrize("system", [0, VEHICLE])
@pytest.mark.parametrize("component", [1, 190, 195])
def test_nothing_passes_in_the_vehicles_name(message: Any, system: int, component: int) -> None:
    uplink = uplink_of(armed=False)
    for v1 in (False, True):
        assert uplink.admit(packed(message, system, component, v1=v1), 0.0) == []
    assert uplink.refused == {f"sent with the vehicle's system id {system}": 2}


@pytest.mark.parametrize(
    "message",
    [
        mavlink.MAVLink_set_attitude_target_message(0, VEHICLE, 1, 7, _QUAT, 0.0, 0.0, 0.0, 1.0),
        mavlink.MAVLink_vision_position_estimate_message(1, *[0.0] * 6),
        mavlink.MAVLink_att_pos_mocap_message(1, _QUAT, 0.0, 0.0, 0.0),
        mavlink.MAVLink_set_gps_global_origin_message(VEHICLE, 1, 1, 1),
        mavlink.MAVLink_hil_gps_message(1, 3, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 9),
        mavlink.MAVLink_request_data_stream_message(VEHICLE, 1, 0, 1, 0),
        mavlink.MAVLink_timesync_message(0, 1),
        mavlink.MAVLink_command_ack_message(400, 0),
        long(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL),
        integer(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL),
        long(43003),
    ],
    ids=lambda message: message.get_type(),
)
def test_setpoints_estimates_sensors_and_the_flights_streams_are_not_the_grounds_to_touch(message: Any) -> None:
    uplink = uplink_of(armed=False)
    assert uplink.admit(packed(message), 0.0) == []
    assert uplink.refused.total() == 1


def test_a_forged_frame_inside_of_another_or_behind_rubbish_does_not_get_out() -> None:
    """A parser that looks for the next start byte in what has failed would find it; nothing that failed is passed on."""
    forged = packed(_FORGED[0], VEHICLE, 1)
    broken = bytearray(
        packed(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, list(forged.ljust(251, b"\x01"))))
    )
    whole = bytes(broken)
    broken[-1] ^= 0xFF
    uplink = uplink_of(armed=False)
    for data in (bytes(broken), whole[:-1], b"\x00" + forged, forged[:-1], bytes([0xFD, 40]) + forged, b""):
        assert uplink.admit(data, 0.0) == []
    # Whole, it is a file transfer whose content is its own affair; forged frames behind it are judged by themselves.
    assert uplink.admit(whole + forged, 0.0) == [whole]


def test_rubbish_of_every_kind_passes_nothing_and_breaks_nothing() -> None:
    random_bytes = random.Random(7)
    uplink = uplink_of(armed=False)
    good = packed(_READ)
    for _ in range(3000):
        data = bytearray(random_bytes.choice((good, random_bytes.randbytes(random_bytes.randrange(300)))))
        if data == good:
            data[random_bytes.randrange(len(data))] ^= 1 << random_bytes.randrange(8)
        elif data:
            data[0] = random_bytes.choice((0xFD, 0xFE))
        passed = uplink.admit(bytes(data), 0.0)
        # The checksum leaves out the start byte only, and a changed one starts no frame.
        assert passed == []
    assert uplink.refused.total() >= 2900


def test_a_flood_is_cut_to_the_rate_and_counted() -> None:
    uplink = uplink_of(armed=False)
    data = packed(_READ)
    passed = sum(len(uplink.admit(data, i / 1000.0)) for i in range(10_000))
    assert passed == pytest.approx(UP_BURST + 10 * UP_RATE_HZ, abs=2)
    assert uplink.refused == {"more than 100 messages a second": 10_000 - passed}


def test_the_number_of_system_ids_is_limited() -> None:
    uplink = uplink_of(armed=False)
    passed = [system for system in range(2, 256) if uplink.admit(packed(_HEARTBEAT, system), float(system))]
    assert passed == list(range(2, 2 + GROUND_SYSTEMS_MAX))


def test_fast_streams_are_thinned_answers_are_not_and_the_numbers_have_no_gaps() -> None:
    px4 = mavlink.MAVLink(None, srcSystem=VEHICLE, srcComponent=1)
    downlink, ground = DownlinkFilter(), mavlink.MAVLink(None)
    heard: list[Any] = []
    for tick in range(1000):
        for message in (
            mavlink.MAVLink_attitude_quaternion_message(tick, *_QUAT, 0.0, 0.0, 0.0),
            mavlink.MAVLink_param_value_message(b"MAV_SYS_ID", 1.0, 6, 1, 0),
        ):
            data = message.pack(px4)
            px4.seq = (px4.seq + 1) % 256
            for out in downlink.pick(data, tick * 0.005):
                heard += ground.parse_buffer(out) or []
    kinds = [message.get_type() for message in heard]
    assert kinds.count("PARAM_VALUE") == 1000
    assert kinds.count("ATTITUDE_QUATERNION") == pytest.approx(5 * STREAM_RATE_HZ, abs=1)
    assert [message.get_seq() for message in heard] == [i % 256 for i in range(len(heard))]


def test_a_stream_slower_than_the_limit_is_not_thinned() -> None:
    downlink = DownlinkFilter()
    data = packed(mavlink.MAVLink_attitude_quaternion_message(1, *_QUAT, 0.0, 0.0, 0.0), VEHICLE, 1)
    rate_hz = 0.97 * STREAM_RATE_HZ
    assert sum(len(downlink.pick(data, i / rate_hz)) for i in range(200)) == 200


def test_signed_frames_and_those_with_a_checksum_that_fits_nothing_keep_their_bytes() -> None:
    downlink = DownlinkFilter()
    unknown = bytes([0xFD, 1, 0, 0, 77, VEHICLE, 1, 0xF0, 0xFF, 0x7F, 5, 0, 0])
    for data in (signed(_READ), unknown, unknown):
        assert downlink.pick(data, 0.0) == [data]


def test_a_message_that_the_dialect_lacks_is_numbered_too() -> None:
    """RESPONSE_EVENT_ERROR (413), CRC_EXTRA 77: PX4 says it, pymavlink does not know it."""
    head, payload, extra = (0xFD, 5, 0, 0, 77, VEHICLE, 1, 413 & 0xFF, 413 >> 8, 0), (1, 0, 2, 0, 1), 77

    def frame(sequence: int) -> bytes:
        data = bytes((*head[:4], sequence, *head[5:], *payload))
        checksum = x25crc(data[1:] + bytes((extra,))).crc
        return data + struct.pack("<H", checksum)

    downlink = DownlinkFilter()
    assert [downlink.pick(frame(77 + 10 * i), 0.0) for i in range(3)] == [[frame(i)] for i in range(3)]


def _heard(messages: list[Any]) -> list[tuple[int, str]]:
    """Put together as a ground station does: by id, until a chunk that is not full."""
    ground, encoder = mavlink.MAVLink(None), mavlink.MAVLink(None, srcSystem=VEHICLE, srcComponent=191)
    heard: list[tuple[int, str]] = []
    text, chunk = "", 0
    for message in (ground.parse_buffer(message.pack(encoder))[0] for message in messages):
        assert message.chunk_seq == chunk
        text += message.text
        if message.id == 0 or len(message.text) < 50:
            heard.append((message.severity, text))
            text, chunk = "", 0
        else:
            chunk += 1
    assert text == ""
    return heard


@pytest.mark.parametrize("length", [1, 49, 50, 51, 99, 100, 101, 150, 200, 201, 5000])
def test_a_text_of_any_length_arrives_as_one(length: int) -> None:
    text = ("phase approach, 12.3 m " * 300)[:length].rstrip().ljust(length, "x")
    texts = Texts()
    texts.say(6, text)
    expected = text if length <= 200 else text[:197] + "..."
    assert _heard(texts.due(0.0)) == [(6, expected)]


def test_texts_are_bounded_gravest_first_and_what_was_left_out_is_said() -> None:
    texts = Texts()
    for i in range(500):
        texts.say(6, f"chatter {i}")
    texts.say(2, "LAND: motion capture lost")
    first = _heard(texts.due(0.0))
    assert first[0] == (2, "LAND: motion capture lost")
    assert len(first) == 10
    rest = [text for i in range(1, 100) for text in _heard(texts.due(i * 0.1))]
    assert rest[-1] == (5, f"{501 - TEXTS_WAITING_MAX} messages dropped; see the log")
    assert len(first) + len(rest) == TEXTS_WAITING_MAX + 1


def test_events_say_what_is_done_and_characters_that_mavlink_lacks_do_not_hurt() -> None:
    def event(severity: Severity, action: SafetyAction) -> Event:
        return Event(t_s=1.0, id="some", severity=severity, action=action, text="tilt 35°")

    assert event_text(event(Severity.CRITICAL, SafetyAction.AUTOPILOT_LAND)) == (2, "AUTOPILOT LAND: tilt 35°")
    assert event_text(event(Severity.WARNING, SafetyAction.WARN)) == (4, "tilt 35°")
    assert event_text(event(Severity.INFO, SafetyAction.NOMINAL))[0] == 6
    texts = Texts()
    texts.say(4, "tilt 35°\n\0")
    assert _heard(texts.due(0.0)) == [(4, "tilt 35? ?")]


def test_a_value_that_is_not_finite_is_left_out() -> None:
    named = {"slack_m": 1.5, "rho": float("nan"), "e_p_m": float("inf")}
    encoder = mavlink.MAVLink(None, srcSystem=VEHICLE, srcComponent=191)
    (message,) = value_messages(2**32 + 5, named)
    decoded = mavlink.MAVLink(None).parse_buffer(message.pack(encoder))[0]
    assert (decoded.name, decoded.value, decoded.time_boot_ms) == ("slack_m", 1.5, 5)


def test_values_have_names_that_fit_and_none_of_a_sick_tick_breaks_the_tick_that_shows_it() -> None:
    """NaN and infinity from a sensor, an estimator or the law: not sent, and nothing is raised in the flight process."""
    inputs, outputs, _ = next(
        row for row in synthetic_flight() if row[1].control and row[1].attitude and row[0].vehicle
    )
    assert inputs.vehicle is not None and outputs.control is not None and outputs.attitude is not None
    assert all(len(name) <= 10 for name in values(inputs, outputs))
    for sick in (math.nan, math.inf, -math.inf, 1e308):
        wild = (sick, sick, sick, sick)
        seen = replace(inputs, vehicle=replace(inputs.vehicle, attitude_wxyz=wild))
        made = replace(
            outputs,
            progress=sick,
            attitude=replace(outputs.attitude, attitude_wxyz=wild),
            control=replace(outputs.control, error=(sick,) * 8, rho=sick, payload_estimate_kg=sick),
        )
        for message in value_messages(0, values(seen, made)):
            assert math.isfinite(message.value)
            assert message.pack(mavlink.MAVLink(None, 1, 191))
