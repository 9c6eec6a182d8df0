"""The two ways of an attitude setpoint over real UDP against pymavlink: what leaves, and what a silent caller leaves behind."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Literal, get_args

import pytest
from mavsdk.plugins.offboard.offboard import Attitude
from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4.driver import MavsdkAutopilot
from companion.io.px4.setpoints import DirectSetpoints, OffboardSetpoints
from companion.model.frames import quat_from_euler_zyx
from companion.model.types import AttitudeSetpoint, FlightMode
from tests.io.px4_peer import Px4Peer
from tests.io.test_px4 import DO_SET_MODE, GOLDEN_ATTITUDES, WRONG_SETPOINTS, assert_attitude_target, edge
from tests.support import eventually, free_udp_port

Way = Literal["direct", "offboard"]
WAYS: tuple[Way, ...] = get_args(Way)
LEVEL = AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 0.5)


async def test_the_plugin_sends_the_same_attitude_and_thrust_and_nothing_that_must_not_leave() -> None:
    """MAVSDK itself would send it."""
    port = free_udp_port()
    with Px4Peer(port) as peer:
        async with edge(port, setpoint_path="offboard") as autopilot:
            for number, (euler_world_rad, euler_ned_rad) in enumerate(GOLDEN_ATTITUDES, 1):
                assert autopilot.send_attitude(AttitudeSetpoint(quat_from_euler_zyx(*euler_world_rad), 0.625))
                target = await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET", number)
                assert_attitude_target(target, euler_ned_rad)
            for setpoint in WRONG_SETPOINTS:
                with pytest.raises(ValueError, match="setpoint"):
                    autopilot.send_attitude(setpoint)
            assert autopilot.send_attitude(LEVEL)
            await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET", len(GOLDEN_ATTITUDES) + 1)
        assert {target.thrust for target in peer.of("SET_ATTITUDE_TARGET")} == {0.625, LEVEL.thrust}


async def fly_in_offboard(peer: Px4Peer, autopilot: MavsdkAutopilot) -> None:
    """PX4 says OFFBOARD, the companion has heard it, and one setpoint has arrived."""
    peer.custom_mode = 6 << 16
    await eventually(
        lambda: (status := autopilot.status()) is not None and status.mode is FlightMode.OFFBOARD, "OFFBOARD"
    )
    assert autopilot.send_attitude(LEVEL)
    await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET")


async def counted(peer: Px4Peer, for_s: float) -> int:
    before = peer.packets_so_far() and len(peer.of("SET_ATTITUDE_TARGET"))
    await asyncio.sleep(for_s)
    assert peer.packets_so_far()
    return len(peer.of("SET_ATTITUDE_TARGET")) - before


@pytest.mark.parametrize("way", WAYS)
async def test_each_setpoint_leaves_once_and_a_caller_who_falls_silent_leaves_nothing_behind(way: Way) -> None:
    """A thread of the plugin repeats the last one at 20 Hz: PX4's failsafe would not see that the flight loop hangs."""

    port = free_udp_port()
    with Px4Peer(port) as peer:
        async with edge(port, setpoint_path=way) as autopilot:
            await fly_in_offboard(peer, autopilot)
            assert await counted(peer, 0.5) == 0
            for k in range(10):
                assert autopilot.send_attitude(AttitudeSetpoint(LEVEL.attitude_wxyz, 0.1 + 0.05 * k))
            await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET", 11)
            assert autopilot.send_attitude(None) is False
            assert await counted(peer, 0.5) == 0
            sent = [target.thrust for target in peer.of("SET_ATTITUDE_TARGET")]
            assert sent == pytest.approx([LEVEL.thrust] + [0.1 + 0.05 * k for k in range(10)])
        assert await counted(peer, 0.5) == 0, "the edge is left"
        assert peer.commands(DO_SET_MODE) == [], "MAVSDK's offboard.stop() would command HOLD"


async def test_what_the_plugin_does_not_send_in_time_leaves_straight_and_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.io.px4.setpoints.PLUGIN_MAX_S", 0.0)

    port = free_udp_port()
    with Px4Peer(port) as peer:
        async with edge(port, setpoint_path="offboard") as autopilot:
            await fly_in_offboard(peer, autopilot)
            for _ in range(20):
                assert autopilot.send_attitude(LEVEL)
                await asyncio.sleep(0.02)
            await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET", 21)
        assert peer.packets_so_far() and len(peer.of("SET_ATTITUDE_TARGET")) == 21


def test_a_setpoint_that_the_link_does_not_take_counts_as_not_sent() -> None:
    """After one that was sent: by a full buffer, and by an error in MAVSDK's thread."""
    results: Iterator[bool | OSError] = iter([True, OSError("gone"), True, False])

    def write(frame: bytes) -> bool:
        result = next(results)
        if isinstance(result, OSError):
            raise result
        return result

    path = path_with(write)
    assert [path.send(LEVEL, 0.0) for _ in range(4)] == [True, False, True, False]


@pytest.mark.parametrize(("simulated", "step"), [(False, 0.0625), (True, 2**-15)])
def test_a_repetition_of_the_setpoint_before_does_not_leave_in_place_of_the_new_one(
    monkeypatch: pytest.MonkeyPatch, simulated: bool, step: float
) -> None:
    """A thread of the plugin repeats at 20 Hz of the computer's clock: its frame may come between the call and the new frame. In
    simulated time not even one that is nearly the new one leaves: a flight would depend on how busy the computer is.
    """
    if simulated:
        monkeypatch.setattr("companion.io.px4.setpoints.simulated_time.current", lambda: object())
    sent: list[float] = []

    def write(frame: bytes) -> bool:
        sent.append(mavlink.MAVLink(None).parse_char(frame).thrust)
        return True

    path, thrusts = path_with(write, repeats=True), [0.5 + step * k for k in range(5)]
    assert all(path.send(AttitudeSetpoint(quat_from_euler_zyx(0.1, -0.2, 2.0), thrust), 0.0) for thrust in thrusts)
    assert sent == thrusts


def path_with(write: Callable[[bytes], bool], repeats: bool = False) -> OffboardSetpoints:
    """Return a path whose plugin sends what it is given as MAVSDK does, or repeats what it holds before each new attitude."""

    class Plugin:
        held = Attitude(0.0, 0.0, 0.0, 0.0)

        def set_attitude(self, attitude: Attitude) -> None:
            for one in (self.held, attitude) if repeats else (attitude,):
                q = quat_from_euler_zyx(*map(math.radians, (one.roll_deg, one.pitch_deg, one.yaw_deg)))
                message = mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, q, 0.0, 0.0, 0.0, one.thrust_value)
                with contextlib.suppress(OSError):
                    path.pass_on(bytes(message.pack(mavlink.MAVLink(None))))
            self.held = attitude

    path = OffboardSetpoints(None, write, DirectSetpoints(lambda number, payload: False, 1))
    path._plugin = Plugin()
    return path
