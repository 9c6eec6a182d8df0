"""The guardian's landing on simulated time, message by message."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import common as mavlink

from companion.config.loader import load_flight
from companion.guardian.heartbeat import Heartbeat
from companion.guardian.px4 import Px4State
from companion.guardian.retreat import Retreat
from companion.guardian.settings import read_settings
from companion.model.frames import attitude_ned_frd_from_enu_flu, quat_from_euler_zyx
from companion.model.types import LandedState, MocapPose
from companion.safety.autopilot_landing import TIMEOUT_S
from companion.safety.mocap import limits_of
from tests.guardian.landing_rig import (
    ARMED,
    DISARMED,
    LAND_MODE,
    LEVEL,
    OFFBOARD_MODE,
    ON_ITS_BACK,
    ON_ITS_ROTORS,
    STANDING_M,
    START_S,
    Landing,
    beat,
)
from tests.safety.healthy import healthy
from tests.support import HOVER


def test_on_the_floor_level_setpoints_without_thrust_are_streamed_at_50_hz_at_the_present_yaw() -> None:
    yaw_rad = 0.7
    landing = Landing(beat())
    landing.run(3.0, attitude=quat_from_euler_zyx(0.0, 0.0, yaw_rad), mocap=False)
    found = [m for m in landing.wire.sent if m.get_type() == "SET_ATTITUDE_TARGET"]
    level = attitude_ned_frd_from_enu_flu(quat_from_euler_zyx(0.0, 0.0, yaw_rad))
    assert {(m.target_system, m.target_component, m.type_mask, m.thrust) for m in found} == {(1, 1, 7, 0.0)}
    assert {(m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate) for m in found} == {(0.0, 0.0, 0.0)}
    assert all(m.q == pytest.approx(level, abs=1e-6) for m in found)
    ms = [m.time_boot_ms for m in found]
    assert {b - a for a, b in itertools.pairwise(ms)} <= {19, 20, 21, 29, 30, 31}
    assert landing.t_s * 1e3 - 31 <= ms[-1] <= landing.t_s * 1e3


def nan_position(message: Any) -> None:
    if message.get_type() == "LOCAL_POSITION_NED":
        message.x = math.nan


@pytest.mark.parametrize(
    ("messages", "corrupt"),
    [(("attitude",), lambda _: None), (("attitude", "imu"), lambda _: None), (("position", "attitude"), nan_position)],
    ids=["attitude alone", "no position", "a position that is no number"],
)
def test_px4s_attitude_is_enough_for_a_flip(messages: tuple[str, ...], corrupt: Callable[[Any], None]) -> None:
    landing = Landing(beat())
    landing.run(1.5, attitude=ON_ITS_BACK, height_m=1.0, messages=messages, corrupt=corrupt)
    assert landing.forced


def test_a_position_or_an_imu_sample_that_never_came_counts_for_nothing() -> None:
    px4 = Px4State()
    assert px4.vehicle() is None
    px4.take(3.0, mavlink.MAVLink_attitude_quaternion_message(0, *LEVEL, 0.0, 0.0, 0.0))
    vehicle = px4.vehicle()
    assert vehicle is not None
    assert (vehicle.position_stamp_s, vehicle.attitude_stamp_s, vehicle.imu_stamp_s) == (-math.inf, 3.0, -math.inf)
    assert vehicle.position_world_m == vehicle.velocity_world_m_s == vehicle.specific_force_body_m_s2 == (0.0, 0.0, 0.0)


def test_px4s_messages_become_its_state() -> None:
    px4 = Px4State()
    assert (px4.status(), px4.pilot, px4.yaw_rad()) == (None, False, None)
    px4.take(1.0, mavlink.MAVLink_heartbeat_message(2, 12, ARMED, 3 << 16, 4, 3))
    assert px4.pilot, "armed and in position mode"
    px4.take(2.0, mavlink.MAVLink_heartbeat_message(2, 12, DISARMED, 3 << 16, 4, 3))
    px4.take(2.1, mavlink.MAVLink_extended_sys_state_message(0, mavlink.MAV_LANDED_STATE_ON_GROUND))
    status = px4.status()
    assert status is not None and not px4.pilot
    assert (status.heartbeat_stamp_s, status.armed, status.landed) == (2.0, False, LandedState.ON_GROUND)
    px4.take(3.0, mavlink.MAVLink_attitude_quaternion_message(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert px4.yaw_rad() is None, "no attitude at all"
    q = attitude_ned_frd_from_enu_flu(quat_from_euler_zyx(0.0, 0.0, 0.7))
    px4.take(3.1, mavlink.MAVLink_attitude_quaternion_message(0, *q, 0.1, 0.2, 0.3))
    px4.take(3.2, mavlink.MAVLink_local_position_ned_message(0, 1.0, 2.0, -3.0, 0.1, 0.2, -0.3))
    px4.take(3.3, mavlink.MAVLink_highres_imu_message(0, 0.0, 0.0, -9.81, *[0.0] * 10, 63))
    for broken in (
        mavlink.MAVLink_local_position_ned_message(0, 1.0, 2.0, -3.0, 0.1, 0.2, math.inf),
        mavlink.MAVLink_attitude_quaternion_message(0, *q, 0.1, 0.2, math.nan),
        mavlink.MAVLink_highres_imu_message(0, 0.0, math.nan, -9.81, *[0.0] * 10, 63),
    ):
        px4.take(4.0, broken)
    vehicle = px4.vehicle()
    assert vehicle is not None and px4.yaw_rad() == pytest.approx(0.7)
    assert (vehicle.position_stamp_s, vehicle.attitude_stamp_s, vehicle.imu_stamp_s) == (3.2, 3.1, 3.3)
    assert vehicle.position_world_m == pytest.approx((2.0, 1.0, 3.0))
    assert vehicle.velocity_world_m_s == pytest.approx((0.2, 0.1, 0.3))
    assert vehicle.specific_force_body_m_s2 == pytest.approx((0.0, 0.0, 9.81))


def test_only_a_rejected_manoeuvre_is_a_refusal() -> None:
    px4 = Px4State()
    for command in (511, 512):  # SET_MESSAGE_INTERVAL, REQUEST_MESSAGE
        px4.take(1.0, mavlink.MAVLink_command_ack_message(command, 2))
    assert px4.refusal is None
    px4.take(1.0, mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_NAV_LAND, 2))
    assert px4.refusal is not None and px4.refusal.startswith("MAV_CMD 21 ")
    px4.take(1.0, mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_NAV_LAND, 0))
    assert px4.refusal is None


def test_tipped_over_on_the_floor_it_is_disarmed_by_force() -> None:
    landing = Landing(beat())
    landing.run(0.4, attitude=ON_ITS_ROTORS, height_m=0.45)
    assert not landing.forced
    landing.run(0.4, attitude=ON_ITS_ROTORS, height_m=0.45)
    assert landing.forced and landing.takeover.overturned
    landing.takeover.restart(landing.t_s)
    landing.run(0.05)
    assert landing.takeover.overturned, "also after an error"
    assert "tipped over on the floor: FORCE_DISARM is requested at once" in [notice.text for notice in landing.notices]


def test_from_a_surface_the_vehicle_moves_back_before_px4_is_told_to_land() -> None:
    landing, yawed = Landing(replace(beat(), back_world_m=(-0.3, 0.0, 0.0))), quat_from_euler_zyx(0.0, 0.0, 0.3)
    landing.run(1.0, mode=OFFBOARD_MODE, height_m=1.1, attitude=yawed)
    assert landing.positions and not landing.wire.commands(mavlink.MAV_CMD_NAV_LAND)
    landing.run(1.5, mode=OFFBOARD_MODE, height_m=1.1, attitude=yawed)
    east_m = [m.y for m in landing.positions]
    assert east_m == sorted(east_m, reverse=True) and east_m[-1] == pytest.approx(-0.3, abs=1e-3)
    assert {round(m.z, 6) for m in landing.positions} == {-1.1}
    assert {round(m.yaw, 6) for m in landing.positions} == {round(0.5 * math.pi - 0.3, 6)}
    assert landing.wire.commands(mavlink.MAV_CMD_NAV_LAND)


def test_the_way_back_leads_straight_to_its_end_and_its_rates_are_those_of_its_positions() -> None:
    vehicle, way, step_s = healthy().vehicle, (-0.3, 0.1, 0.05), 1e-4
    assert vehicle is not None
    retreat = Retreat.begin(5.0, vehicle, way)
    for share in (0.1, 0.37, 0.5, 0.81):
        t_s = 5.0 + share * retreat.duration_s
        a, b, c = (retreat.setpoint(t_s + k * step_s) for k in (-1, 0, 1))
        assert a is not None and b is not None and c is not None
        for axis in range(3):
            before_m, now_m, after_m = (s.position_world_m[axis] for s in (a, b, c))
            assert b.velocity_world_m_s[axis] == pytest.approx((after_m - before_m) / (2.0 * step_s), abs=1e-6)
            curved = (after_m - 2.0 * now_m + before_m) / step_s**2
            assert b.acceleration_world_m_s2[axis] == pytest.approx(curved, abs=1e-4)
            gone = (now_m - vehicle.position_world_m[axis]) / way[axis]
            assert gone == pytest.approx((b.position_world_m[0] - vehicle.position_world_m[0]) / way[0])
    last = retreat.setpoint(5.0 + 0.9999 * retreat.duration_s)
    assert last is not None
    assert last.position_world_m == pytest.approx([p + w for p, w in zip(vehicle.position_world_m, way, strict=True)])
    assert retreat.setpoint(5.0 + 1.0001 * retreat.duration_s) is None


AT_A_SURFACE = replace(beat(), back_world_m=(-0.3, 0.0, 0.0))


@pytest.mark.parametrize(
    ("last", "lands"),
    [(replace(AT_A_SURFACE, pilot=True), False), (replace(AT_A_SURFACE, mocap_refused=True), True)],
    ids=["a pilot flies", "motion capture is refused"],
)
def test_no_position_setpoint_against_a_pilot_or_on_poses_that_the_flight_process_rejected(
    last: Heartbeat, lands: bool
) -> None:
    landing = Landing(last)
    landing.run(1.0, mode=OFFBOARD_MODE, height_m=1.1)
    assert landing.positions == []
    assert bool(landing.wire.commands(mavlink.MAV_CMD_NAV_LAND)) is lands


@pytest.mark.parametrize(
    ("mode", "armed", "moves"), [(OFFBOARD_MODE, True, True), (OFFBOARD_MODE, False, False), (LAND_MODE, True, False)]
)
def test_disarmed_or_out_of_offboard_it_is_not_moved_back(mode: int, armed: bool, moves: bool) -> None:
    landing = Landing(AT_A_SURFACE)
    landing.run(0.6, mode=mode, height_m=1.1, armed=armed)
    assert bool(landing.positions) is moves
    assert ("PX4 lands" in [notice.text for notice in landing.notices]) is (mode == LAND_MODE)


def test_the_way_back_is_flown_at_half_a_metre_per_second_squared_and_consistent_in_itself() -> None:
    landing = Landing(AT_A_SURFACE)
    landing.run(4.0, mode=OFFBOARD_MODE, height_m=1.1)
    found = landing.positions
    t_s = [m.time_boot_ms * 1e-3 for m in found]
    for (t0, a), (t1, b) in itertools.pairwise(zip(t_s, found, strict=True)):
        assert 0.019 < t1 - t0 < 0.031
        assert b.y - a.y == pytest.approx(0.5 * (a.vy + b.vy) * (t1 - t0), abs=1e-4)
        assert b.vy - a.vy == pytest.approx(0.5 * (a.afy + b.afy) * (t1 - t0), abs=2e-3)
    assert max(abs(m.afy) for m in found) == pytest.approx(0.5, abs=0.005)
    assert t_s[-1] - t_s[0] == pytest.approx(1.86, abs=0.04)


def test_without_a_position_of_px4_it_waits_for_one_for_0_3_s_and_then_lands() -> None:
    landing = Landing(AT_A_SURFACE)
    landing.run(0.28, mode=OFFBOARD_MODE, messages=("attitude",))
    assert not landing.positions and not landing.wire.commands(mavlink.MAV_CMD_NAV_LAND)
    landing.run(0.06, mode=OFFBOARD_MODE, messages=("attitude",))
    assert not landing.positions and landing.wire.commands(mavlink.MAV_CMD_NAV_LAND)


@pytest.mark.parametrize(("after_s", "landed"), [(1.4, None), (1.6, True)])
def test_a_disarmed_of_before_the_takeover_does_not_end_the_landing_after_an_error(
    after_s: float, landed: bool | None
) -> None:
    """PX4 reports it once a second; the vehicle may have been armed since."""
    landing = Landing(beat())
    landing.takeover.take_messages(
        START_S + after_s, [mavlink.MAVLink_heartbeat_message(2, 12, DISARMED, LAND_MODE, 4, 3)]
    )
    landing.takeover.restart(START_S + after_s)
    assert landing.takeover.landed is landed


@pytest.mark.parametrize(
    ("mode", "armed", "pilot", "commanded"),
    [
        (OFFBOARD_MODE, True, False, True),
        (LAND_MODE, True, False, False),
        (OFFBOARD_MODE, False, False, False),
        (OFFBOARD_MODE, True, True, False),
    ],
)
def test_after_an_error_px4_is_told_to_land_unless_it_does_or_a_pilot_flies(
    mode: int, armed: bool, pilot: bool, commanded: bool
) -> None:
    landing = Landing(replace(beat(), pilot=pilot))
    said = mavlink.MAVLink_heartbeat_message(2, 12, ARMED if armed else DISARMED, mode, 4, 3)
    landing.takeover.take_messages(START_S + 0.1, [said])
    landing.takeover.restart(START_S + 0.1)
    assert bool(landing.wire.commands(mavlink.MAV_CMD_NAV_LAND)) is commanded
    assert landing.takeover.landed is None
    landing.takeover.restart(START_S + 4 * TIMEOUT_S + 1.0)
    assert landing.takeover.landed is not armed, "errors without end"


def test_requests_are_repeated_at_their_rates() -> None:
    landing = Landing(beat())
    landing.run(2.0, mode=OFFBOARD_MODE, height_m=1.0)
    assert [m.param1 for m in landing.wire.commands(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL)] == [32, 31, 105, 245, 230]
    assert [m.param2 for m in landing.wire.commands(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL)] == [2e4, 2e4, 2e4, 1e5, 1e5]
    assert len(landing.wire.commands(mavlink.MAV_CMD_REQUEST_MESSAGE)) == pytest.approx(20, abs=2)
    assert len(landing.wire.commands(mavlink.MAV_CMD_NAV_LAND)) == pytest.approx(8, abs=1)
    assert len([m for m in landing.wire.sent if m.get_type() == "HEARTBEAT"]) == 2
    landing.takeover.link_reopened()
    landing.run(0.1, mode=OFFBOARD_MODE, height_m=1.0)
    assert len(landing.wire.commands(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL)) == 10, "PX4 may have restarted"


def test_messages_are_numbered_and_unused_fields_are_zero() -> None:
    landing = Landing(replace(beat(), back_world_m=(-0.3, 0.0, 0.0)))
    landing.run(0.5, mode=OFFBOARD_MODE, height_m=1.1)
    assert landing.positions and {m.yaw_rate for m in landing.positions} == {0.0}
    numbers = [m.get_seq() for m in landing.wire.sent]
    assert numbers == list(range(len(numbers)))
    commands = [m for m in landing.wire.sent if m.get_type() == "COMMAND_LONG"]
    assert {(m.param3, m.param4, m.param5, m.param6, m.param7, m.confirmation) for m in commands} == {(0.0,) * 6}


def test_px4s_mode_is_awaited_for_0_15_s_before_it_is_told_to_land() -> None:
    landing = Landing(beat())
    landing.run(0.15, height_m=1.0, beating=False)
    assert not landing.wire.commands(mavlink.MAV_CMD_NAV_LAND)
    landing.run(0.03, height_m=1.0, beating=False)
    assert landing.wire.commands(mavlink.MAV_CMD_NAV_LAND)


def test_on_a_link_without_a_peer_it_sends_nothing_for_a_second() -> None:
    landing = Landing(beat())
    landing.wire.ready = False
    landing.run(0.98, height_m=1.0, beating=False, mocap=False)
    assert landing.wire.sent == []
    landing.run(0.3, height_m=1.0, beating=False)
    assert landing.wire.commands(mavlink.MAV_CMD_NAV_LAND)


@pytest.mark.parametrize(("beating", "lost_s"), [(True, 4 * TIMEOUT_S), (False, TIMEOUT_S)])
def test_what_does_not_land_is_given_up_after_four_attempts_and_a_silent_one_after_the_first(
    beating: bool, lost_s: float
) -> None:
    landing = Landing(beat())
    landing.run(1.0, height_m=2.0)
    landing.run(lost_s - 2.0, height_m=2.0, beating=beating)
    assert landing.takeover.landed is None
    landing.run(2.0, height_m=2.0, beating=beating)
    assert landing.takeover.landed is False
    assert landing.notices[-1].id == "guardian_lost_vehicle"
    assert landing.notices[-1].text == "the landing could not be confirmed"


@pytest.mark.parametrize(("silent_s", "landed"), [(2.4, None), (2.6, False), (TIMEOUT_S, False)])
def test_a_px4_that_was_heard_in_the_last_2_5_s_is_landed_again(silent_s: float, landed: bool | None) -> None:
    landing = Landing(beat())
    landing.run(TIMEOUT_S - silent_s + 0.1, height_m=2.0, beating=silent_s < TIMEOUT_S)
    landing.run(silent_s, height_m=2.0, beating=False)
    landing.run(0.1, height_m=2.0, beating=False)
    assert landing.takeover.landed is landed


def test_a_pose_that_jumps_is_not_sent_and_is_reported_once() -> None:
    landing = Landing(beat())
    landing.run(0.5)
    sent = len(landing.wire.poses)
    landing.run(0.05, height_m=STANDING_M + 0.8)
    assert len(landing.wire.poses) == sent
    assert [notice.id for notice in landing.notices].count("guardian_mocap") == 1
    assert landing.takeover.pose is not None and landing.takeover.pose.position_world_m[2] == STANDING_M


def test_its_settings_are_those_of_the_flight(tmp_path: Path) -> None:
    changed = ["mocap_jump_m=0.17", "mocap_jump_deg=31", "estimate_disagreement_m=0.42", "mocap_latency_max_s=0.13"]
    changed += ["mocap_latency_warn_s=0.06", "tilt_abort_deg=37", "guardian_timeout_s=0.15"]
    config = load_flight(HOVER, overrides=[f"vehicle.safety.{one}" for one in changed])
    path = tmp_path / "config.json"
    path.write_text(config.model_dump_json(), encoding="utf-8")
    settings, vehicle = read_settings(path), config.vehicle
    assert settings.pose_limits == (0.17, math.radians(31.0), 0.42, 0.13) == limits_of(vehicle.safety)
    assert (settings.tilt_max_rad, settings.timeout_s) == (math.radians(37.0), 0.15)
    assert settings.clearance_m == vehicle.airframe.ground_clearance_m
    assert settings.autopilot_address == vehicle.devices.autopilot.address


def pose_at(t_s: float, **changes: Any) -> MocapPose:
    pose = MocapPose(
        stamp_s=t_s,
        frame_number=round(t_s * 1e3),
        position_world_m=(5e-7 + 1e-6 * (round(t_s * 1e3) % 7), 0.0, STANDING_M),
        attitude_wxyz=LEVEL,
        tracking_valid=True,
        marker_error_m=0.0,
        latency_s=0.005,
    )
    return replace(pose, **changes)


@pytest.mark.parametrize(
    "bad",
    [
        {"attitude_wxyz": quat_from_euler_zyx(0.0, 0.0, math.pi)},
        {"position_world_m": (0.3, 0.0, STANDING_M)},
        {"latency_s": 0.13},
        {"position_world_m": (0.0, 0.0, 0.0), "tracking_valid": False},
    ],
    ids=["turned", "shifted", "too late", "not tracked"],
)
def test_it_judges_each_pose_as_the_flight_process_does(bad: dict[str, Any]) -> None:
    landing = Landing(beat())
    landing.run(0.3)
    sent, t_s = len(landing.wire.poses), landing.t_s
    for k in range(40):
        landing.takeover.take_poses([pose_at(t_s + 0.01 * k + 0.002, **bad)])
        landing.takeover.take_poses([pose_at(t_s + 0.01 * k + 0.007)])
        landing.run(0.01, mocap=False)
    assert len(landing.wire.poses) == sent + 40
    assert {(round(m.x, 3), round(m.z, 3), round(m.yaw, 1)) for m in landing.wire.poses[sent:]} == {
        (0.0, -STANDING_M, round(landing.wire.poses[0].yaw, 1))
    }


@pytest.mark.parametrize(
    ("delays_s", "sent"),
    [
        ((0.001, 0.15, 0.001, 0.15), (True, False, True, False)),
        ((0.15, 0.001, 0.15, 0.001), (True, True, False, True)),
    ],
    ids=["first in time", "first late"],
)
def test_delays_are_measured_against_the_shortest_of_a_server_that_was_never_seen(
    delays_s: tuple[float, ...], sent: tuple[bool, ...]
) -> None:
    """As after a restart of the server: its clock is any, and the latency in a frame ends at the transmission."""
    landing = Landing(beat())
    landing.run(0.3)
    for delay_s, passes in zip(delays_s, sent, strict=True):
        landing.run(0.01, mocap=False)
        before, pose = len(landing.wire.poses), pose_at(landing.t_s)
        sent_server_s = 5000.0 + landing.t_s - delay_s
        landing.takeover.take_poses([replace(pose, exposure_server_s=sent_server_s - 0.005)])
        assert len(landing.wire.poses) == before + passes


def test_a_repeated_pose_is_not_sent() -> None:
    landing = Landing(beat())
    landing.run(0.3)
    sent, pose = len(landing.wire.poses), pose_at(landing.t_s + 0.005)
    landing.takeover.take_poses([replace(pose, stamp_s=pose.stamp_s + 0.005 * k) for k in range(5)])
    assert len(landing.wire.poses) == sent + 1


def test_the_first_poses_wait_for_px4s_state_to_be_judged() -> None:
    """A takeover from a hang: the last pose that the flight process accepted is 0.2 s old."""
    landing = Landing(beat(pose_stamp_s=START_S - 0.2))
    turned = quat_from_euler_zyx(0.0, 0.0, math.pi)
    landing.takeover.take_poses([pose_at(START_S, attitude_wxyz=turned)])
    assert landing.wire.poses == [] and landing.notices == []
    landing.run(0.05, mocap=False)
    landing.takeover.take_poses([pose_at(landing.t_s, attitude_wxyz=turned), pose_at(landing.t_s + 0.005)])
    assert len(landing.wire.poses) == 1
    assert landing.takeover.pose is not None and landing.takeover.pose.attitude_wxyz == LEVEL


def test_poses_that_the_flight_process_rejected_are_neither_passed_on_nor_evaluated() -> None:
    """The flight process landed because of dragged poses and died; the guardian sent them to PX4 and used them."""
    landing = Landing(beat(mocap_refused=True, pose_stamp_s=START_S - 5.0))
    landing.run(10.0, attitude=ON_ITS_ROTORS)
    assert landing.wire.poses == []
    assert not landing.forced, "only motion capture says so low that it is tipped over"
    assert landing.takeover.pose is None
    assert [notice.id for notice in landing.notices].count("guardian_mocap") == 1
    believed = Landing(beat(pose_stamp_s=START_S - 5.0))
    believed.run(10.0, attitude=ON_ITS_ROTORS)
    assert believed.wire.poses and believed.forced


def test_a_height_by_dead_reckoning_is_vouched_for_once_and_not_anew_in_each_round() -> None:
    """PX4 drops its height soon after the last pose, so it proves nothing in the second attempt of 30 s."""
    landing = Landing(beat())
    landing.run(TIMEOUT_S + 1.0, height_m=2.0, mocap=False)
    assert not landing.zero_thrust
    landing.run(10.0, mocap=False)
    assert not landing.zero_thrust
    assert landing.takeover.landed is None


def test_a_height_by_dead_reckoning_counts_from_the_last_pose_on_whoever_passed_it_on() -> None:
    by_the_flight = Landing(beat())
    by_the_flight.run(3.0, mocap=False)
    assert by_the_flight.zero_thrust
    long_ago = Landing(beat(pose_stamp_s=START_S - 4.0))
    long_ago.run(3.0, mocap=False)
    assert not long_ago.zero_thrust
    by_the_guardian = Landing(beat(pose_stamp_s=START_S - 4.0))
    by_the_guardian.run(1.0, height_m=0.5)
    by_the_guardian.run(3.0, mocap=False)
    assert by_the_guardian.zero_thrust


def test_a_pose_that_is_not_sent_does_not_keep_back_the_next_one() -> None:
    landing = Landing(beat())
    landing.run(0.5)
    before, t_s = len(landing.wire.poses), landing.t_s
    jumps = pose_at(t_s + 0.002, position_world_m=(1.0, 0.0, STANDING_M))
    landing.takeover.take_poses([pose_at(t_s + 0.001, tracking_valid=False), jumps, pose_at(t_s + 0.003)])
    assert len(landing.wire.poses) == before + 1


def test_without_any_attitude_of_px4_it_waits_to_move_back_and_then_lands() -> None:
    landing = Landing(AT_A_SURFACE)
    landing.run(0.6, mode=OFFBOARD_MODE, height_m=1.1, messages=("imu",))
    assert not landing.positions and landing.wire.commands(mavlink.MAV_CMD_NAV_LAND)
