"""The MAVSDK edge over real UDP against pymavlink: what is on the wire, and what is made of it."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.config.devices import AutopilotDevice
from companion.io.px4.driver import MavsdkAutopilot
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
)
from companion.runtime.clock import Clock, flight_clock
from tests.io.px4_peer import ACCEL_FRD_M_S2, GYRO_FRD_RAD_S, POSITION_NED_M, VELOCITY_NED_M_S, Px4Peer
from tests.io.refusal import refusal
from tests.support import DEADLINE_S, eventually, free_udp_port, level_pose

LEAN_RAD = 0.2
DO_SET_MODE, NAV_LAND, ARM_DISARM = 176, 21, 400


def edge(where: int | str, clock: Clock | None = None, *, forwarding: bool = False, **device: Any) -> MavsdkAutopilot:
    """The companion's end of a link: an address, or a port of this computer."""
    address = where if isinstance(where, str) else f"udpin://127.0.0.1:{where}"
    settings = AutopilotDevice(address=address, **{"discovery_timeout_s": DEADLINE_S, **device})
    return MavsdkAutopilot(settings, clock or flight_clock(), forwarding=forwarding)


def pose_of(number: int, attitude_wxyz: Quat = (1.0, 0.0, 0.0, 0.0), stamp_s: float = 12.5) -> MocapPose:
    return level_pose(stamp_s, frame_number=number, position_world_m=(1.5, -0.25, 0.75), attitude_wxyz=attitude_wxyz)


@contextlib.asynccontextmanager
async def linked() -> AsyncIterator[tuple[Px4Peer, MavsdkAutopilot]]:
    """A PX4 and the companion's end of its link."""
    port = free_udp_port()
    with Px4Peer(port) as peer:
        async with edge(port) as autopilot:
            yield peer, autopilot


def read(autopilot: MavsdkAutopilot) -> AutopilotStatus:
    status = autopilot.status()
    assert status is not None
    return status


def armed(autopilot: MavsdkAutopilot) -> bool:
    status = autopilot.status()
    return status is not None and status.armed


async def refused(address: str, discovery_timeout_s: float = 20.0) -> str:
    text = await refusal(edge(address, discovery_timeout_s=discovery_timeout_s))
    assert text.startswith(f"autopilot {address}: expected ")
    return text


# Golden attitudes: Euler angles in the world (ENU/FLU, ZYX; yaw 0 looks along x = east) and the same attitude in NED/FRD.
# Pitch is positive nose down in FLU and nose up in FRD; yaw is counted from east, left, and from north, right.
GOLDEN_ATTITUDES: tuple[tuple[Vec3, Vec3], ...] = (
    ((0.0, 0.0, math.pi / 2), (0.0, 0.0, 0.0)),
    ((0.0, 0.0, 0.0), (0.0, 0.0, math.pi / 2)),
    ((0.0, LEAN_RAD, math.pi / 2), (0.0, -LEAN_RAD, 0.0)),
    ((LEAN_RAD, 0.0, math.pi / 2), (LEAN_RAD, 0.0, 0.0)),
    ((LEAN_RAD, LEAN_RAD, math.radians(30)), (LEAN_RAD, -LEAN_RAD, math.radians(60))),
    ((0.0, 0.0, math.pi), (0.0, 0.0, -math.pi / 2)),
)
WRONG_SETPOINTS = (
    AttitudeSetpoint((math.nan, 0.0, 0.0, 0.0), 0.5),
    AttitudeSetpoint((math.inf, 0.0, 0.0, 0.0), 0.5),
    AttitudeSetpoint((0.0, 0.0, 0.0, 0.0), 0.5),
    AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), math.nan),
    AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), -0.001),
    AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 1.001),
)


async def test_attitudes_of_setpoints_and_mocap_arrive_in_ned() -> None:
    async with linked() as (peer, autopilot):
        for number, (euler_world_rad, euler_ned_rad) in enumerate(GOLDEN_ATTITUDES, 1):
            attitude = quat_from_euler_zyx(*euler_world_rad)
            assert autopilot.send_attitude(AttitudeSetpoint(attitude, 0.625))
            target = await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET", number)
            assert_attitude_target(target, euler_ned_rad)
            # Independent of Euler conventions: the thrust points to the same side on both ends of the wire.
            north, east, down = quat_rotate(tuple(target.q), (0.0, 0.0, -1.0))
            assert (east, north, -down) == pytest.approx(quat_rotate(attitude, (0.0, 0.0, 1.0)), abs=1e-6)
            assert autopilot.send_vision(pose_of(number, attitude))
            estimate = await asyncio.to_thread(peer.wait_for, "VISION_POSITION_ESTIMATE", number)
            assert (estimate.x, estimate.y, estimate.z) == (-0.25, 1.5, -0.75)
            angles = (estimate.roll, estimate.pitch, estimate.yaw)
            turns = [math.remainder(a - b, 2 * math.pi) for a, b in zip(angles, euler_ned_rad, strict=True)]
            assert turns == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
            assert estimate.usec == 12_500_000
            assert math.isnan(estimate.covariance[0])  # PX4 takes its own noise parameters


def assert_attitude_target(target: Any, euler_ned_rad: Vec3) -> None:
    dot = sum(a * b for a, b in zip(target.q, quat_from_euler_zyx(*euler_ned_rad), strict=True))
    assert abs(dot) == pytest.approx(1.0, abs=1e-6)
    assert target.thrust == 0.625
    assert target.type_mask == 7  # attitude and thrust count, body rates are ignored
    assert (target.target_system, target.target_component) == (1, 1)


async def test_a_setpoint_that_must_not_leave_does_not() -> None:
    async with linked() as (peer, autopilot):
        for setpoint in WRONG_SETPOINTS:
            with pytest.raises(ValueError, match="setpoint"):
                autopilot.send_attitude(setpoint)
        assert autopilot.send_attitude(AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 1.0))
        await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET")
    assert [target.thrust for target in peer.of("SET_ATTITUDE_TARGET")] == [1.0]


async def test_vehicle_state_is_complete_in_the_companions_frames_and_outlives_values_that_are_not_finite() -> None:
    async with linked() as (peer, autopilot):
        peer.attitude_ned_frd = quat_from_euler_zyx(LEAN_RAD, -LEAN_RAD, math.radians(60))
        expected: Quat = quat_from_euler_zyx(LEAN_RAD, LEAN_RAD, math.radians(30))
        await eventually(
            lambda: (s := autopilot.vehicle()) is not None and s.attitude_wxyz == pytest.approx(expected, abs=1e-6),
            "a complete vehicle state",
        )
        first = autopilot.vehicle()
        await eventually(lambda: autopilot.vehicle() != first, "a newer vehicle state")
        state = autopilot.vehicle()
        assert first is not None and state is not None
        assert state.position_stamp_s >= first.position_stamp_s
        asked_hz = {stream: 1e6 / interval for stream, interval in peer.asked_interval_us.items()}
        assert asked_hz[mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED] == pytest.approx(200.0)
        assert asked_hz[mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION] == pytest.approx(250.0)
        assert asked_hz[mavlink.MAVLINK_MSG_ID_HIGHRES_IMU] == pytest.approx(250.0)
        (n, e, d), (vn, ve, vd) = POSITION_NED_M, VELOCITY_NED_M_S
        assert state.position_world_m == pytest.approx((e, n, -d))
        assert state.velocity_world_m_s == pytest.approx((ve, vn, -vd))
        f, r, down = GYRO_FRD_RAD_S
        assert state.angular_rate_body_rad_s == pytest.approx((f, -r, -down))
        f, r, down = ACCEL_FRD_M_S2
        assert state.specific_force_body_m_s2 == pytest.approx((f, -r, -down))
        peer.attitude_ned_frd = (math.nan, 0.0, 0.0, 0.0)
        await eventually(lambda: (raw := autopilot._inbox._attitude) is not None and math.isnan(raw[1][0]), "NaN")
        stale = autopilot.vehicle()
        assert stale is not None and all(map(math.isfinite, stale.attitude_wxyz))
        assert autopilot.vehicle() is stale


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


async def test_of_two_batteries_the_worst_counts_and_one_that_falls_silent_has_an_age() -> None:
    """The full battery masked the empty one, and the last report of a battery counted for ever."""

    def silent_s(autopilot: MavsdkAutopilot) -> float:
        status = read(autopilot)
        return status.heartbeat_stamp_s - (status.battery_stamp_s or -math.inf)

    async with linked() as (peer, autopilot):
        cells = [3500] * 4 + [65535] * 6
        empty = mavlink.MAVLink_battery_status_message(1, 0, 1, 2000, cells, 100, 0, 0, 12, 0, 0)
        peer.say(empty)
        await eventually(lambda: read(autopilot).battery_remaining == 0.12, "the empty battery")
        await eventually(lambda: silent_s(autopilot) > 0.5, "the full one, sent every 0.1 s, hides the silence")
        assert (read(autopilot).battery_voltage_v, read(autopilot).battery_remaining) == (14.0, 0.12)
        peer.say(empty)
        await eventually(lambda: silent_s(autopilot) < 0.5, "it is heard again")


async def test_the_heartbeat_of_an_armed_px4_is_requested_so_that_a_kill_is_seen_at_once() -> None:
    """PX4 sends one HEARTBEAT per second and refuses another rate; a kill switch may be released before the next one."""
    async with linked() as (peer, autopilot):
        await eventually(lambda: autopilot.vehicle() is not None, "a state")
        assert not [m for m in peer.commands(512) if m.param1 == 0.0], "nothing is asked while it is disarmed"
        peer.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        peer.heartbeats_on_request = True
        await eventually(lambda: autopilot.vehicle() is not None and armed(autopilot), "armed")
        peer.beat_period_s = math.inf
        peer.system_status = mavlink.MAV_STATE_FLIGHT_TERMINATION
        await eventually(lambda: autopilot.vehicle() is not None and is_killed(autopilot.status()), "the kill")


async def test_the_status_names_the_system_id_of_px4() -> None:
    async with linked() as (_, autopilot):
        await eventually(lambda: autopilot.status() is not None, "a heartbeat")
        assert read(autopilot).system_id == 1


async def test_heartbeat_loss_shows_as_an_old_stamp() -> None:
    port = free_udp_port()
    clock = flight_clock()
    with Px4Peer(port) as peer:
        async with edge(port, clock) as autopilot:
            await eventually(lambda: autopilot.status() is not None, "a heartbeat")

            def age_s() -> float:
                return clock() - read(autopilot).heartbeat_stamp_s

            peer.beating = False
            await eventually(lambda: age_s() > 1.0, "a heartbeat stamp that grows old")
            peer.beating = True
            await eventually(lambda: age_s() < 1.0, "a fresh heartbeat stamp")


async def test_offboard_arm_land_disarm_reach_px4_as_commands() -> None:
    async with linked() as (peer, autopilot):
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


async def test_a_request_that_the_core_no_longer_makes_is_never_repeated_by_the_link() -> None:
    """Its datagram was lost and the core is silent: MAVSDK would send the command three times more, for 1.5 s."""
    requests = (AutopilotRequest.ARM, AutopilotRequest.DISARM, AutopilotRequest.FORCE_DISARM)
    async with linked() as (peer, autopilot):
        peer.acks[ARM_DISARM] = None
        for count in (3, 6):
            for request in requests:
                autopilot.request(request)
            await eventually(lambda count=count: len(peer.commands(ARM_DISARM)) == count, "the requests")  # type: ignore[misc]
            if count == 3:
                await asyncio.sleep(1.2)  # longer than MAVSDK waits before it repeats a command: 0.5 s
                assert len(peer.commands(ARM_DISARM)) == count


async def test_land_goes_out_while_arm_and_offboard_hang() -> None:
    async with linked() as (peer, autopilot):
        # In progress for as long as it takes: whatever waits for one of them waits for ever.
        peer.acks[ARM_DISARM] = peer.acks[DO_SET_MODE] = mavlink.MAV_RESULT_IN_PROGRESS
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


async def test_px4_sees_a_ground_station_for_as_long_as_it_is_not_armed() -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:

        def beats() -> int:
            return sum(message.type == mavlink.MAV_TYPE_GCS for message in peer.of("HEARTBEAT"))

        async with edge(port) as autopilot:
            await eventually(lambda: beats() >= 2, "a ground station's heartbeats")
            peer.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
            await eventually(lambda: armed(autopilot), "armed")
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
