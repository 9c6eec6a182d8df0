"""The MAVSDK edge over real UDP against pymavlink: what is on the wire, and what is made of it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.config.devices import AutopilotDevice
from companion.io.protocols import DeviceError
from companion.io.px4 import params as autopilot_params
from companion.io.px4.driver import MavsdkAutopilot
from companion.model.estimator import EstimatorReport
from companion.model.flight_stage import is_killed
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.types import (
    AttitudeSetpoint,
    AutopilotRequest,
    AutopilotStatus,
    FlightMode,
    LandedState,
    MocapPose,
    Quat,
    Vec3,
    VehicleState,
)
from companion.runtime.clock import flight_clock
from tests.io.px4_peer import ACCEL_FRD_M_S2, GYRO_FRD_RAD_S, PARAMS, POSITION_NED_M, VELOCITY_NED_M_S, Px4Peer
from tests.support import DEADLINE_S, eventually, free_udp_port, serial_line

LEAN_RAD = 0.2
DO_SET_MODE, NAV_LAND, ARM_DISARM = 176, 21, 400


def edge(port: int, discovery_timeout_s: float = DEADLINE_S) -> MavsdkAutopilot:
    device = AutopilotDevice(address=f"udpin://127.0.0.1:{port}", discovery_timeout_s=discovery_timeout_s)
    return MavsdkAutopilot(device, flight_clock())


@contextlib.asynccontextmanager
async def linked() -> AsyncIterator[tuple[Px4Peer, MavsdkAutopilot]]:
    """A PX4 and the companion's end of its link."""
    port = free_udp_port()
    with Px4Peer(port) as peer:
        async with edge(port) as autopilot:
            yield peer, autopilot


async def refused(address: str, discovery_timeout_s: float = 20.0) -> str:
    autopilot = MavsdkAutopilot(
        AutopilotDevice(address=address, discovery_timeout_s=discovery_timeout_s), flight_clock()
    )
    with pytest.raises(DeviceError) as caught:
        await autopilot.__aenter__()
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(f"autopilot {address}: expected ")
    return text


# Golden attitudes: Euler angles in the world (ENU/FLU, ZYX; yaw 0 looks along x = east) and the same attitude in NED/FRD.
# Pitch is positive nose down in FLU and nose up in FRD; yaw is counted from east, left, and from north, right.
GOLDEN_ATTITUDES = [
    pytest.param((0.0, 0.0, math.pi / 2), (0.0, 0.0, 0.0), id="level-north"),
    pytest.param((0.0, 0.0, 0.0), (0.0, 0.0, math.pi / 2), id="level-east"),
    pytest.param((0.0, LEAN_RAD, math.pi / 2), (0.0, -LEAN_RAD, 0.0), id="leaning-forward-north"),
    pytest.param((LEAN_RAD, 0.0, math.pi / 2), (LEAN_RAD, 0.0, 0.0), id="leaning-right-north"),
    pytest.param((LEAN_RAD, LEAN_RAD, math.radians(30)), (LEAN_RAD, -LEAN_RAD, math.radians(60)), id="all-three"),
    pytest.param((0.0, 0.0, math.pi), (0.0, 0.0, -math.pi / 2), id="level-west"),
]


@pytest.mark.parametrize(("euler_world_rad", "euler_ned_rad"), GOLDEN_ATTITUDES)
async def test_attitude_setpoint_arrives_as_the_right_quaternion(euler_world_rad: Vec3, euler_ned_rad: Vec3) -> None:
    async with linked() as (peer, autopilot):
        assert autopilot.send_attitude(AttitudeSetpoint(quat_from_euler_zyx(*euler_world_rad), 0.625))
        target = await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET")
    expected = quat_from_euler_zyx(*euler_ned_rad)
    dot = sum(a * b for a, b in zip(target.q, expected, strict=True))
    assert abs(dot) == pytest.approx(1.0, abs=1e-6)
    assert target.thrust == 0.625
    assert target.type_mask == 7  # attitude and thrust count, body rates are ignored
    assert (target.target_system, target.target_component) == (1, 1)


async def test_leaning_forward_pushes_the_thrust_forward_on_both_sides_of_the_wire() -> None:
    """Independent of Euler conventions: where the thrust vector points."""

    port = free_udp_port()
    attitude = quat_from_euler_zyx(0.0, LEAN_RAD, 0.0)
    assert quat_rotate(attitude, (0.0, 0.0, 1.0))[0] == pytest.approx(math.sin(LEAN_RAD))  # towards +x, east
    with Px4Peer(port) as peer:
        async with edge(port) as autopilot:
            assert autopilot.send_attitude(AttitudeSetpoint(attitude, 0.5))
            target = await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET")
    up_frd = (0.0, 0.0, -1.0)
    north, east, down = quat_rotate(tuple(target.q), up_frd)
    assert (north, east, down) == pytest.approx((0.0, math.sin(LEAN_RAD), -math.cos(LEAN_RAD)), abs=1e-6)


@pytest.mark.parametrize(("euler_world_rad", "euler_ned_rad"), GOLDEN_ATTITUDES)
async def test_vision_pose_arrives_in_ned(euler_world_rad: Vec3, euler_ned_rad: Vec3) -> None:
    port = free_udp_port()
    pose = MocapPose(
        stamp_s=12.5,
        latency_s=0.003,
        frame_number=7,
        position_world_m=(1.5, -0.25, 0.75),
        attitude_wxyz=quat_from_euler_zyx(*euler_world_rad),
        tracking_valid=True,
        marker_error_m=0.0,
    )
    with Px4Peer(port) as peer:
        async with edge(port) as autopilot:
            assert autopilot.send_vision(pose)
            estimate = await asyncio.to_thread(peer.wait_for, "VISION_POSITION_ESTIMATE")
    assert (estimate.x, estimate.y, estimate.z) == (-0.25, 1.5, -0.75)
    turns = (estimate.roll - euler_ned_rad[0], estimate.pitch - euler_ned_rad[1], estimate.yaw - euler_ned_rad[2])
    assert [math.remainder(turn, 2 * math.pi) for turn in turns] == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    assert estimate.usec == 12_500_000
    assert math.isnan(estimate.covariance[0])  # PX4 takes its own noise parameters


@pytest.mark.parametrize(
    "setpoint",
    [
        AttitudeSetpoint((math.nan, 0.0, 0.0, 0.0), 0.5),
        AttitudeSetpoint((math.inf, 0.0, 0.0, 0.0), 0.5),
        AttitudeSetpoint((0.0, 0.0, 0.0, 0.0), 0.5),
        AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), math.nan),
        AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), -0.001),
        AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 1.001),
    ],
    ids=["nan", "inf", "no-direction", "thrust-nan", "thrust-negative", "thrust-above-one"],
)
async def test_a_setpoint_that_must_not_leave_does_not(setpoint: AttitudeSetpoint) -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        async with edge(port) as autopilot:
            with pytest.raises(ValueError, match="setpoint"):
                autopilot.send_attitude(setpoint)
            assert autopilot.send_attitude(AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 1.0))
            await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET")
        assert [target.thrust for target in peer.of("SET_ATTITUDE_TARGET")] == [1.0]


def test_vehicle_state_is_complete_and_in_the_companions_frames() -> None:
    async def fly() -> VehicleState:
        port = free_udp_port()
        with Px4Peer(port) as peer:
            peer.attitude_ned_frd = quat_from_euler_zyx(LEAN_RAD, -LEAN_RAD, math.radians(60))
            async with edge(port) as autopilot:
                await eventually(lambda: autopilot.vehicle() is not None, "a complete vehicle state")
                first = autopilot.vehicle()
                assert first is not None
                await eventually(lambda: autopilot.vehicle() != first, "a newer vehicle state")
                second = autopilot.vehicle()
                assert second is not None
                assert second.position_stamp_s >= first.position_stamp_s
                asked_hz = {stream: 1e6 / interval for stream, interval in peer.asked_interval_us.items()}
                assert asked_hz[mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED] == pytest.approx(200.0)
                assert asked_hz[mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION] == pytest.approx(250.0)
                assert asked_hz[mavlink.MAVLINK_MSG_ID_HIGHRES_IMU] == pytest.approx(250.0)
                return second

    state = asyncio.run(fly())
    (n, e, d), (vn, ve, vd) = POSITION_NED_M, VELOCITY_NED_M_S
    assert state.position_world_m == pytest.approx((e, n, -d))
    assert state.velocity_world_m_s == pytest.approx((ve, vn, -vd))
    expected: Quat = quat_from_euler_zyx(LEAN_RAD, LEAN_RAD, math.radians(30))
    assert state.attitude_wxyz == pytest.approx(expected, abs=1e-6)
    f, r, down = GYRO_FRD_RAD_S
    assert state.angular_rate_body_rad_s == pytest.approx((f, -r, -down))
    f, r, down = ACCEL_FRD_M_S2
    assert state.specific_force_body_m_s2 == pytest.approx((f, -r, -down))


async def test_values_that_are_not_finite_leave_the_last_good_state_to_grow_old() -> None:
    async with linked() as (peer, autopilot):
        await eventually(lambda: autopilot.vehicle() is not None, "a complete vehicle state")
        peer.attitude_ned_frd = (math.nan, 0.0, 0.0, 0.0)
        packets = peer.packets_so_far()
        await eventually(lambda: (raw := autopilot._inbox._attitude) is not None and math.isnan(raw[1][0]), "NaN")
        stale = autopilot.vehicle()
        assert stale is not None
        assert all(map(math.isfinite, stale.attitude_wxyz))
        assert autopilot.vehicle() is stale
        assert peer.packets_so_far() >= packets


async def test_status_follows_heartbeat_landed_state_and_battery() -> None:
    async with linked() as (peer, autopilot):
        await eventually(
            lambda: (status := autopilot.status()) is not None and status.battery_voltage_v is not None,
            "heartbeat and battery",
        )
        status = autopilot.status()
        assert status is not None
        assert (status.armed, status.mode) == (False, FlightMode.MANUAL)
        assert status.landed is LandedState.ON_GROUND
        assert (status.battery_voltage_v, status.battery_remaining) == pytest.approx((16.0, 0.77))
        assert not status.radio
        peer.sensors_present = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
        await eventually(lambda: (status := autopilot.status()) is not None and status.radio is True, "a radio")
        peer.custom_mode = 6 << 16
        peer.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        peer.landed = mavlink.MAV_LANDED_STATE_IN_AIR
        await eventually(
            lambda: (
                (status := autopilot.status()) is not None
                and status.armed
                and status.mode is FlightMode.OFFBOARD
                and status.landed is LandedState.IN_AIR
            ),
            "armed, offboard, in air",
        )


def test_of_two_batteries_the_worst_counts_and_one_that_falls_silent_has_an_age() -> None:
    """The full battery masked the empty one, and the last report of a battery counted for ever."""

    async def fly() -> None:
        async with linked() as (peer, autopilot):
            cells = [3500] * 4 + [65535] * 6
            empty = mavlink.MAVLink_battery_status_message(1, 0, 1, 2000, cells, 100, 0, 0, 12, 0, 0)
            peer.say(empty)
            await eventually(lambda: read(autopilot).battery_remaining == 0.12, "the empty battery")
            await eventually(lambda: silent_s(autopilot) > 0.5, "the full one, sent every 0.1 s, hides the silence")
            assert (read(autopilot).battery_voltage_v, read(autopilot).battery_remaining) == (14.0, 0.12)
            peer.say(empty)
            await eventually(lambda: silent_s(autopilot) < 0.5, "it is heard again")

    def read(autopilot: MavsdkAutopilot) -> AutopilotStatus:
        status = autopilot.status()
        assert status is not None
        return status

    def silent_s(autopilot: MavsdkAutopilot) -> float:
        status = read(autopilot)
        return status.heartbeat_stamp_s - (status.battery_stamp_s or -math.inf)

    asyncio.run(fly())


def test_the_heartbeat_of_an_armed_px4_is_requested_so_that_a_kill_is_seen_at_once() -> None:
    """PX4 sends one HEARTBEAT per second and refuses another rate; a kill switch may be released before the next one."""

    async def fly() -> None:
        async with linked() as (peer, autopilot):
            await eventually(lambda: autopilot.vehicle() is not None, "a state")
            assert not [m for m in peer.commands(512) if m.param1 == 0.0], "nothing is asked while it is disarmed"
            peer.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
            peer.heartbeats_on_request = True
            await eventually(lambda: autopilot.vehicle() is not None and armed(autopilot), "armed")
            peer.beat_period_s = math.inf
            peer.system_status = mavlink.MAV_STATE_FLIGHT_TERMINATION
            await eventually(lambda: autopilot.vehicle() is not None and killed(autopilot), "the kill")

    def armed(autopilot: MavsdkAutopilot) -> bool:
        status = autopilot.status()
        return status is not None and status.armed

    def killed(autopilot: MavsdkAutopilot) -> bool:
        return is_killed(autopilot.status())

    asyncio.run(fly())


async def test_heartbeat_loss_shows_as_an_old_stamp() -> None:
    port = free_udp_port()
    clock = flight_clock()
    device = AutopilotDevice(address=f"udpin://127.0.0.1:{port}", discovery_timeout_s=DEADLINE_S)
    with Px4Peer(port) as peer:
        async with MavsdkAutopilot(device, clock) as autopilot:
            await eventually(lambda: autopilot.status() is not None, "a heartbeat")

            def age_s() -> float:
                status = autopilot.status()
                assert status is not None
                return clock() - status.heartbeat_stamp_s

            peer.beating = False
            await eventually(lambda: age_s() > 1.0, "a heartbeat stamp that grows old")
            peer.beating = True
            await eventually(lambda: age_s() < 1.0, "a fresh heartbeat stamp")


async def test_offboard_arm_land_disarm_reach_px4_as_commands() -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        async with edge(port) as autopilot:
            for request in (AutopilotRequest.OFFBOARD, AutopilotRequest.ARM, AutopilotRequest.LAND):
                autopilot.request(request)
            await eventually(lambda: bool(peer.commands(NAV_LAND)), "LAND")
            await eventually(lambda: bool(peer.commands(DO_SET_MODE) and peer.commands(ARM_DISARM)), "OFFBOARD, ARM")
            autopilot.request(AutopilotRequest.DISARM)
            await eventually(lambda: len(peer.commands(ARM_DISARM)) == 2, "DISARM")
            autopilot.request(AutopilotRequest.NONE)
            await eventually(lambda: autopilot._requests.pending() == 0, "the answers")
        mode = peer.commands(DO_SET_MODE)[0]
        assert (mode.param1, mode.param2) == (1.0, 6.0)
        assert [command.param1 for command in peer.commands(ARM_DISARM)] == [1.0, 0.0]
        assert autopilot.take_messages() == []


@pytest.mark.parametrize("request_", [AutopilotRequest.ARM, AutopilotRequest.DISARM, AutopilotRequest.FORCE_DISARM])
async def test_a_request_that_the_core_no_longer_makes_is_never_repeated_by_the_link(
    request_: AutopilotRequest,
) -> None:
    """Its datagram was lost and the core is silent: MAVSDK would send the command three times more, for 1.5 s."""

    port = free_udp_port()
    with Px4Peer(port) as peer:
        peer.acks[ARM_DISARM] = None
        async with edge(port) as autopilot:
            autopilot.request(request_)
            await eventually(lambda: bool(peer.commands(ARM_DISARM)), "the request")
            await asyncio.sleep(1.2)  # longer than MAVSDK waits before it repeats a command: 0.5 s
            assert len(peer.commands(ARM_DISARM)) == 1
            autopilot.request(request_)
            await eventually(lambda: len(peer.commands(ARM_DISARM)) == 2, "the request, made anew by the core")


async def test_a_repeated_request_is_one_command_and_its_refusals_are_reported_once_in_words() -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        peer.acks[ARM_DISARM] = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
        clock = flight_clock()
        device = AutopilotDevice(address=f"udpin://127.0.0.1:{port}", discovery_timeout_s=DEADLINE_S)
        async with MavsdkAutopilot(device, clock) as autopilot:
            start_s = clock()

            def refused_three_times() -> bool:
                autopilot.request(AutopilotRequest.ARM)  # as the core does, in every tick
                return len(peer.commands(ARM_DISARM)) == 3

            await eventually(refused_three_times, "three refused ARM commands")
            assert clock() - start_s >= 1.0  # a lower bound: at most one command each 0.5 s
            reports: list[str] = []
            await eventually(
                lambda: reports.extend(autopilot.take_messages()) or autopilot._requests.pending() == 0,  # type: ignore[func-returns-value]
                "the answers",
            )
            reports += autopilot.take_messages()
        assert reports == ["ARM refused: temporarily rejected (MAV_RESULT 1)"]


async def test_land_goes_out_while_arm_and_offboard_hang() -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        # In progress for as long as it takes: whatever waits for one of them waits for ever.
        peer.acks[ARM_DISARM] = peer.acks[DO_SET_MODE] = mavlink.MAV_RESULT_IN_PROGRESS
        async with edge(port) as autopilot:
            autopilot.request(AutopilotRequest.ARM)
            autopilot.request(AutopilotRequest.OFFBOARD)
            await eventually(lambda: len(peer.working_on) == 2, "ARM and OFFBOARD in progress")
            autopilot.request(AutopilotRequest.LAND)
            await eventually(lambda: bool(peer.commands(NAV_LAND)), "LAND")
            peer.finish(mavlink.MAV_RESULT_FAILED)
            reports: list[str] = []
            await eventually(
                lambda: reports.extend(autopilot.take_messages()) or len(reports) == 2,  # type: ignore[func-returns-value]
                "two refusals",
            )
        assert sorted(reports) == ["ARM refused: failed (MAV_RESULT 4)", "OFFBOARD refused: failed (MAV_RESULT 4)"]


async def test_a_command_without_an_answer_is_reported() -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        peer.acks[ARM_DISARM] = None
        async with edge(port) as autopilot:
            reports: list[str] = []

            def reported() -> bool:
                autopilot.request(AutopilotRequest.ARM)  # as the core does, in every tick
                reports.extend(autopilot.take_messages())
                return bool(reports)

            await eventually(reported, "the command without an answer")
        assert reports == ["ARM: no answer within 3 s; requesting it again"]


async def test_statustexts_become_lines_each_reported_once() -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        async with edge(port) as autopilot:
            reports: list[str] = []

            def text(severity: int, data: bytes, identity: int, chunk: int = 0) -> None:
                peer.say(mavlink.MAVLink_statustext_message(severity, data, identity, chunk))

            critical, info = mavlink.MAV_SEVERITY_CRITICAL, mavlink.MAV_SEVERITY_INFO
            # The first after PX4's boot has the id 0 and chunks all the same.
            text(critical, b"Arming denied: Resolve system health failures firs", 0, 0)
            text(critical, b"t\t", 0, 1)
            text(info, b"GCS connection regained\t", 1)
            for identity in range(2, 5):
                text(critical, b"Preflight Fail: heading estimate not stable", identity)
            text(critical, b"exactly fifty characters, which may be a beginning", 5)
            await eventually(
                lambda: reports.extend(autopilot.take_messages()) or len(reports) >= 3,  # type: ignore[func-returns-value]
                "three texts",
            )
        assert reports == [
            "critical: Arming denied: Resolve system health failures first",
            "critical: Preflight Fail: heading estimate not stable (PX4 does not arm while this holds)",
            "critical: exactly fifty characters, which may be a beginning",
        ]


async def test_px4_sees_a_ground_station_for_as_long_as_it_is_not_armed() -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:

        def beats() -> int:
            return sum(message.type == mavlink.MAV_TYPE_GCS for message in peer.of("HEARTBEAT"))

        async with edge(port) as autopilot:
            await eventually(lambda: beats() >= 2, "a ground station's heartbeats")
            peer.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
            await eventually(lambda: (s := autopilot.status()) is not None and s.armed, "armed")
            at_arming, heard = beats(), len(peer.of("HEARTBEAT"))
            await eventually(
                lambda: len(peer.of("HEARTBEAT")) >= heard + 2, "two of the companion's own heartbeats, 1 Hz"
            )
            assert beats() <= at_arming + 1  # one may have been under way
            peer.base_mode &= ~mavlink.MAV_MODE_FLAG_SAFETY_ARMED
            await eventually(lambda: beats() >= at_arming + 3, "heartbeats after disarming")
        left = beats()
        assert peer.packets_so_far() > 0
        assert beats() == left


async def test_parameters_and_firmware_are_read_from_the_wire() -> None:
    async with linked() as (peer, autopilot):
        peer.deaf_to = {"COM_RC_IN_MODE", "SDLOG_MODE"}
        read = await autopilot.read_params([*PARAMS, "NO_SUCH_ONE", "NOR_THIS"])
        assert read == PARAMS
        assert {name: type(value) for name, value in read.items()} == {n: type(v) for n, v in PARAMS.items()}
        assert await autopilot.read_param("MPC_THR_HOVER") == PARAMS["MPC_THR_HOVER"]
        assert (await autopilot.firmware()).startswith("PX4 1.16.1 release (git 01234567")
        with pytest.raises(DeviceError, match=r"expected PX4's parameter NO_SUCH_ONE, found no such parameter"):
            await autopilot.read_param("NO_SUCH_ONE")
        with pytest.raises(DeviceError, match="1 to 16 of the characters A-Z"):
            await autopilot.read_params(["MPC_THR_HOVER", "lower case"])


async def test_a_silent_px4_does_not_pass_for_one_without_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(autopilot_params, "READ_DEADLINE_S", 2.0)

    async with linked() as (peer, autopilot):
        peer.params.clear()
        with pytest.raises(DeviceError, match=r"PX4's parameters \(2 names, the first COM_RC_IN_MODE\), found 0"):
            await autopilot.read_params(["COM_RC_IN_MODE", "SDLOG_MODE"])


async def test_a_whole_export_with_unknown_names_is_read_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each group of eight unknown names takes 0.4 s, and all of them longer than the deadline for one answer."""
    monkeypatch.setattr(autopilot_params, "ASKS", 1)
    monkeypatch.setattr(autopilot_params, "READ_DEADLINE_S", 2.0)

    port = free_udp_port()
    with Px4Peer(port) as peer:
        peer.params = PARAMS | {f"P_{number}": number for number in range(300)}
        unknown = [f"NO_{number}" for number in range(autopilot_params.WINDOW * 8)]
        async with edge(port) as autopilot:
            assert await autopilot.read_params([*unknown, *peer.params]) == peer.params


async def test_a_parameter_is_written_and_read_back() -> None:
    async with linked() as (peer, autopilot):
        for name, value in (("MPC_THR_HOVER", 0.49), ("SDLOG_MODE", 2), ("COM_RC_IN_MODE", -1)):
            written = await autopilot.write_param(name, value)
            assert written == peer.params[name] == pytest.approx(value, rel=1e-7)
            assert type(written) is type(PARAMS[name])
        with pytest.raises(DeviceError, match=r"a whole number for COM_RC_IN_MODE, an INT32, found 1\.5"):
            await autopilot.write_param("COM_RC_IN_MODE", 1.5)
        with pytest.raises(DeviceError, match="NO_SUCH_ONE, found no such parameter"):
            await autopilot.write_param("NO_SUCH_ONE", 1)


def test_px4_without_an_origin_is_given_one_unless_it_is_armed() -> None:
    async def fly(armed: bool) -> tuple[bool, Any]:
        port = free_udp_port()
        with Px4Peer(port) as peer:
            peer.origin = None
            peer.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
            async with edge(port) as autopilot:
                known = await autopilot.ensure_origin()
            return known, peer.origin

    assert asyncio.run(fly(armed=True)) == (False, None)
    known, origin = asyncio.run(fly(armed=False))
    assert known
    assert (origin.latitude, origin.longitude, origin.altitude) == (0, 0, 0)  # any other moves EKF2's local position
    assert origin.target_system == 1


async def test_an_origin_that_px4_has_is_left_alone() -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        async with edge(port) as autopilot:
            assert await autopilot.ensure_origin()
        assert peer.of("SET_GPS_GLOBAL_ORIGIN") == []


@pytest.mark.parametrize(
    ("forwarding", "armed", "interval_us"), [(False, False, -1.0), (True, False, 0.0), (False, True, None)]
)
async def test_streams_without_a_reader_are_stopped(forwarding: bool, armed: bool, interval_us: float | None) -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        peer.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
        device = AutopilotDevice(address=f"udpin://127.0.0.1:{port}", discovery_timeout_s=DEADLINE_S)
        unread = (mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_ODOMETRY)
        async with MavsdkAutopilot(device, flight_clock(), forwarding=forwarding):
            if not armed:
                await eventually(lambda: all(stream in peer.asked_interval_us for stream in unread), "streams stopped")
        peer.packets_so_far()
        assert [peer.asked_interval_us.get(stream) for stream in unread] == [interval_us, interval_us]
        assert peer.asked_interval_us[mavlink.MAVLINK_MSG_ID_HIGHRES_IMU] > 0.0


async def test_estimator_status_is_asked_for_and_reported() -> None:
    async with linked() as (peer, autopilot):
        assert autopilot.estimator() is None
        peer.estimator = (0x33F, math.nan, 0.25, 0.125, 0.0, 0.0, 0.0, 0.0625, math.nan)
        await eventually(lambda: autopilot.estimator() is not None, "ESTIMATOR_STATUS")
        report = autopilot.estimator()
        assert report is not None
        # PX4 says NaN of a velocity that it does not fuse, and of what it does not know.
        assert report == EstimatorReport(
            stamp_s=report.stamp_s,
            flags=0x33F,
            velocity_ratio=0.0,
            position_horizontal_ratio=0.25,
            position_vertical_ratio=0.125,
            position_horizontal_accuracy_m=0.0625,
            position_vertical_accuracy_m=math.inf,
        )
        assert peer.asked_interval_us[mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS] == pytest.approx(200_000.0)
        await eventually(lambda: autopilot.estimator() != report, "a newer one")


async def test_nothing_is_sent_any_more_once_the_edge_is_left() -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        autopilot = edge(port)
        async with autopilot:
            for _ in range(10):
                assert autopilot.send_attitude(AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 0.5))
            await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET", 10)
            # Nor is anything re-sent while the companion hangs: PX4's own offboard-loss failsafe has to see silence.
            await asyncio.sleep(0.5)
            assert peer.packets_so_far() > 0
            assert len(peer.of("SET_ATTITUDE_TARGET")) == 10
        left = peer.packets_so_far()
        await asyncio.sleep(1.5)  # longer than the period of every stream: setpoints 20 Hz, heartbeats 1 Hz
        assert peer.packets_so_far() == left
        assert autopilot.send_attitude(AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 0.5)) is False
        autopilot.request(AutopilotRequest.LAND)
        assert peer.packets_so_far() == left


async def test_leaving_while_a_command_hangs_is_silent_at_once() -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        peer.acks[ARM_DISARM] = None
        async with edge(port) as autopilot:
            autopilot.request(AutopilotRequest.ARM)
            await eventually(lambda: bool(peer.commands(ARM_DISARM)), "ARM")
        sent = len(peer.commands(ARM_DISARM))
        peer.packets_so_far()
        assert len(peer.commands(ARM_DISARM)) == sent
        assert sent < 4  # MAVSDK had repeats left


async def test_the_port_is_free_again_after_leaving() -> None:
    port = free_udp_port()
    with Px4Peer(port):
        for _ in range(2):
            async with edge(port):
                pass


def test_no_heartbeat_is_one_line_with_the_address() -> None:
    text = asyncio.run(refused(f"udpin://127.0.0.1:{free_udp_port()}", discovery_timeout_s=0.3))
    assert "a PX4 heartbeat within 0.3 s, found none" in text


def test_another_autopilot_is_refused() -> None:
    port = free_udp_port()
    with Px4Peer(port, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA):
        assert "expected PX4, found ARDUPILOT" in asyncio.run(refused(f"udpin://127.0.0.1:{port}"))


def test_busy_port_is_refused_even_though_mavsdk_would_share_it() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        assert f"port {port} to be free, found another program" in asyncio.run(refused(f"udpin://127.0.0.1:{port}"))


def test_an_address_of_another_machine_is_refused() -> None:
    assert "a local address in 192.0.2.1" in asyncio.run(refused("udpin://192.0.2.1:14540"))  # TEST-NET-1


def test_missing_serial_port_is_refused() -> None:
    text = asyncio.run(refused("serial:///dev/no-such-autopilot:921600"))
    assert "the serial port /dev/no-such-autopilot, found No such file or directory" in text


def test_a_plain_file_is_no_serial_port(tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    plain.touch()
    assert "no device file" in asyncio.run(refused(f"serial://{plain}:921600"))


def test_a_baud_rate_that_no_port_has_is_refused() -> None:
    with serial_line() as (_, port):
        assert "to open the connection" in asyncio.run(refused(f"serial://{port}:123"))


async def test_cancelling_the_wait_for_a_heartbeat_leaves_no_port_behind() -> None:
    port = free_udp_port()
    entering = asyncio.create_task(edge(port).__aenter__())
    await asyncio.sleep(0.2)
    entering.cancel()
    with pytest.raises(asyncio.CancelledError):
        await entering
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(("127.0.0.1", port))


def test_mavsdks_own_log_goes_to_python_logging_and_not_to_the_terminal(
    capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    async def fly() -> None:
        async with linked() as (_, _):
            pass

    with caplog.at_level(logging.DEBUG, logger="companion.mavsdk"):
        asyncio.run(fly())
    assert any("MAVSDK version" in record.message for record in caplog.records)
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""
