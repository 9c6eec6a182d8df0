"""QGroundControl's end of the link (pymavlink) against MAVSDK's forwarding, the relay, and PX4's stub or a scripted PX4."""

from __future__ import annotations

import asyncio
import json
import marshal
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import common as mavlink

from companion.config.document import ConfigError
from companion.config.loader import load_flight
from companion.io.protocols import DeviceError
from companion.io.px4.driver import MavsdkAutopilot
from companion.io.qgroundcontrol.channel import pack, unpack
from companion.io.qgroundcontrol.relay import GONE
from companion.io.qgroundcontrol.station import GroundStation, check_address
from companion.model.outputs import Outputs
from companion.model.types import (
    AttitudeSetpoint,
    AutopilotRequest,
    Event,
    FlightMode,
    Inputs,
    LinkIdentity,
    SafetyAction,
    Severity,
)
from tests.analysis.synthetic_flight import synthetic_flight
from tests.io.px4_peer import POSITION_NED_M, Px4Peer
from tests.io.qgroundcontrol_peer import GroundPeer
from tests.io.stub_rig import standing_stub
from tests.io.test_px4 import edge
from tests.safety.healthy import SLOW
from tests.support import CATCH, DEADLINE_S, eventually, free_udp_port

LEVEL = AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 0.2)
NONE = AutopilotRequest.NONE
ROW = next(iter(synthetic_flight()))
"""Inputs and outputs of a tick."""


def is_in_mode(autopilot: MavsdkAutopilot, mode: FlightMode) -> bool:
    status = autopilot.status()
    return status is not None and status.mode is mode


def inputs(tick: int = 0) -> Inputs:
    return replace(ROW[0], tick=tick, t_s=tick * 0.005)


def outputs(tick: int = 0, phase: str = "approach", events: tuple[Event, ...] = ()) -> Outputs:
    tether = replace(SLOW, slack_m=0.75, stop_slack_m=0.5)
    return replace(
        ROW[1], tick=tick, t_s=tick * 0.005, phase=phase, progress=0.25, request=NONE, events=events, tether=tether
    )


@asynccontextmanager
async def link(port: int, address: str) -> AsyncIterator[tuple[MavsdkAutopilot, GroundStation]]:
    async with edge(port, forwarding=True) as autopilot, GroundStation(address, autopilot) as station:
        yield autopilot, station


@asynccontextmanager
async def stationed(
    *, beating: bool = True, armed: bool = False
) -> AsyncIterator[tuple[GroundPeer, Px4Peer, MavsdkAutopilot, GroundStation]]:
    """A ground station, a scripted PX4 and what is between them."""
    port = free_udp_port()
    with GroundPeer(beating) as ground, Px4Peer(port) as px4:
        px4.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
        async with link(port, ground.address) as (autopilot, station):
            yield ground, px4, autopilot, station


async def send_setpoints(autopilot: MavsdkAutopilot, px4: Px4Peer, count: int, each: Callable[[int], None]) -> None:
    """In portions that PX4's socket holds, so that what does not arrive was not sent."""
    for tick in range(count):
        each(tick)
        assert autopilot.send_attitude(LEVEL)
        if tick % 50 == 49:
            await asyncio.to_thread(px4.wait_for, "SET_ATTITUDE_TARGET", tick + 1)
    await asyncio.to_thread(px4.wait_for, "SET_ATTITUDE_TARGET", count)


async def test_qgroundcontrol_sees_the_stub_reads_a_parameter_hears_our_words_and_chooses_a_mode() -> None:
    port = free_udp_port()
    with GroundPeer() as ground:
        async with standing_stub(port) as stub, link(port, ground.address) as (autopilot, station):
            await asyncio.to_thread(ground.wait_for, "HEARTBEAT", 1, autopilot=mavlink.MAV_AUTOPILOT_PX4)
            await asyncio.to_thread(ground.wait_for, "ATTITUDE_QUATERNION", 1)
            value = await asyncio.to_thread(ground.read_param, "COM_OF_LOSS_T")
            assert value.param_value == pytest.approx(stub.params.real("COM_OF_LOSS_T"))
            ours = await asyncio.to_thread(ground.wait_for, "HEARTBEAT", 191)
            assert (ours.type, ours.autopilot) == (18, 8)  # MAV_TYPE_ONBOARD_CONTROLLER, MAV_AUTOPILOT_INVALID

            event = Event(
                t_s=1.0,
                id="tether_short",
                severity=Severity.CRITICAL,
                action=SafetyAction.RETRACT,
                text="slack 0.1 m: going back",
            )
            station.report_tick(inputs(), outputs(events=(event,)))
            notice = await asyncio.to_thread(ground.wait_for, "STATUSTEXT", 191, text="phase approach")
            assert notice.severity == mavlink.MAV_SEVERITY_INFO
            text = "RETRACT: slack 0.1 m: going back"
            notice = await asyncio.to_thread(ground.wait_for, "STATUSTEXT", 191, text=text)
            assert notice.severity == mavlink.MAV_SEVERITY_CRITICAL
            slack = await asyncio.to_thread(ground.wait_for, "NAMED_VALUE_FLOAT", 191, name="slack_m")
            assert slack.value == pytest.approx(0.75)
            stop = await asyncio.to_thread(ground.wait_for, "NAMED_VALUE_FLOAT", 191, name="stop_slk_m")
            assert stop.value == pytest.approx(0.5)
            await asyncio.to_thread(ground.wait_for, "NAMED_VALUE_FLOAT", 191, name="progress", value=0.25)
            # The companion's own part of the talk with PX4 (component 195) concerns no other program.
            assert ground.senders() == {(1, 1), (1, 191)}
            assert station.take_messages() == [f"ground station 127.0.0.1:{ground.port} is connected"]

            custom = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
            for main, sub, mode in ((1.0, 0.0, FlightMode.MANUAL), (4.0, 3.0, FlightMode.HOLD)):
                fields = (custom, main, sub, 0.0, 0.0, 0.0, 0.0)
                ground.say(mavlink.MAVLink_command_long_message(1, 1, 176, 0, *fields))
                await eventually(partial(is_in_mode, autopilot, mode), mode.name)
            await asyncio.to_thread(ground.wait_for, "COMMAND_ACK", 1, command=176)


async def test_a_forced_disarm_from_the_ground_does_not_reach_an_armed_px4() -> None:
    async with stationed(armed=True) as (ground, px4, _, station):
        await asyncio.to_thread(ground.wait_for, "HEARTBEAT", 1, autopilot=mavlink.MAV_AUTOPILOT_PX4)
        ground.say(mavlink.MAVLink_command_long_message(1, 1, 400, 0, 0.0, 21196.0, *[0.0] * 5))
        ground.say(mavlink.MAVLink_command_int_message(1, 1, 0, 400, 0, 0, 0.0, 21196.0, 0.0, 0.0, 0, 0, 0.0))
        ground.say(mavlink.MAVLink_command_long_message(1, 1, 21, 0, *[0.0] * 7))
        await eventually(lambda: bool(px4.commands(21)), "LAND, which was sent after them")
        assert px4.commands(400) == []
        assert [message for message in px4.of("COMMAND_INT") if message.command == 400] == []
        counts: list[int] = []

        def refused() -> bool:
            found = re.findall(r"(\d+) command 400 while PX4 is armed", " ".join(station.take_messages()))
            counts.extend(map(int, found))
            return sum(counts) == 2

        await eventually(refused, "what was refused, in one report or in two")


def _forgeries() -> list[Any]:
    """What would arm, fly and charge the vehicle in the companion's eyes."""
    armed = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    return [
        mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, armed, 6 << 16, 4, 3),
        mavlink.MAVLink_attitude_quaternion_message(1, 0.0, 1.0, 0.0, 0.0, 9.0, 9.0, 9.0),
        mavlink.MAVLink_local_position_ned_message(1, 66.0, 66.0, -66.0, 6.0, 6.0, 6.0),
        mavlink.MAVLink_highres_imu_message(1, 99.0, 99.0, 99.0, *[9.0] * 10, 0xFFFF),
        mavlink.MAVLink_extended_sys_state_message(0, mavlink.MAV_LANDED_STATE_IN_AIR),
        mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_CRITICAL, b"forged"),
        mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_RESULT_DENIED),
    ]


def _believed(autopilot: MavsdkAutopilot) -> list[str]:
    """Which of the forgeries the companion took."""
    status, vehicle = autopilot.status(), autopilot.vehicle()
    assert status is not None and vehicle is not None
    east, north, up = vehicle.position_world_m
    found = [text for text in autopilot.take_messages() if "forged" in text]
    found += ["armed"] if status.armed else []
    found += ["position"] if (north, east, -up) != pytest.approx(POSITION_NED_M) else []
    found += ["attitude"] if abs(vehicle.attitude_wxyz[3]) < 0.5 else []
    found += ["imu"] if abs(vehicle.specific_force_body_m_s2[0]) > 50.0 else []
    return found


async def test_nothing_that_the_ground_forges_enters_the_companions_state() -> None:
    port = free_udp_port()
    with GroundPeer() as ground, Px4Peer(port) as px4, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        async with link(port, ground.address) as (autopilot, station):
            await eventually(lambda: autopilot.vehicle() is not None and autopilot.status() is not None, "a state")
            # PX4 falls silent: nothing overwrites what comes in.
            px4.beating = False
            await asyncio.to_thread(px4.packets_so_far)
            before = autopilot.vehicle()
            encoder = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
            own_port = station.vehicle_port
            assert own_port
            for message in _forgeries():
                for system, component in ((1, 1), (1, 195), (255, 1), (255, 190)):
                    ground.say(message, system, component)
                stranger.sendto(message.pack(encoder), ("127.0.0.1", own_port))
            # What was sent later through the same sockets has been through.
            await asyncio.to_thread(ground.read_param, "MPC_THR_HOVER")
            assert _believed(autopilot) == []
            assert autopilot.vehicle() == before
            forged = [m for m in px4.of("HEARTBEAT") if m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED]
            assert {m.get_srcSystem() for m in forged} <= {255}  # PX4 takes a ground station's for what it is
            assert not px4.of("ATTITUDE_QUATERNION") and not px4.of("COMMAND_ACK") and not px4.of("STATUSTEXT")
            reports = station.take_messages()
            assert any("sent with the vehicle's system id 1" in line for line in reports), reports
            # The same from PX4's side is believed: this test can tell.
            for message in _forgeries():
                px4.say(message)
            await eventually(lambda: autopilot.vehicle() != before, "PX4's own")
            await eventually(lambda: (s := autopilot.status()) is not None and s.armed, "PX4's own heartbeat")
            assert "attitude" in _believed(autopilot)


async def test_px4_never_hears_the_companions_words_and_no_station_in_its_name() -> None:
    async with stationed(beating=False, armed=True) as (ground, px4, autopilot, station):
        for tick in range(200):
            station.report_tick(inputs(tick), outputs(tick, phase=f"phase{tick}"))
        await asyncio.to_thread(ground.wait_for, "NAMED_VALUE_FLOAT", 191)
        await asyncio.to_thread(ground.wait_for, "HEARTBEAT", 191)
        assert autopilot.send_attitude(LEVEL)
        await asyncio.to_thread(px4.wait_for, "SET_ATTITUDE_TARGET")
        heard = {(m.get_srcSystem(), m.get_srcComponent()) for m in px4.received}
        assert heard == {(1, 195)}
        assert mavlink.MAV_TYPE_GCS not in {m.type for m in px4.of("HEARTBEAT")}


async def test_a_ground_station_that_connects_late_receives_the_phase() -> None:
    async with stationed(beating=False) as (ground, _, _, station):
        station.report_tick(inputs(), outputs(phase="catch"))
        await asyncio.to_thread(ground.wait_for, "STATUSTEXT", 191, text="phase catch")
        assert len(ground.of("STATUSTEXT", 191)) == 1
        ground.beating = True
        await eventually(lambda: len(ground.of("STATUSTEXT", 191)) == 2, "the phase again")


async def test_a_relay_that_was_killed_costs_the_ground_station_and_nothing_else() -> None:
    async with stationed() as (ground, px4, autopilot, station):
        await asyncio.to_thread(ground.wait_for, "HEARTBEAT", 1)
        assert station.relay_pid is not None
        os.kill(station.relay_pid, signal.SIGKILL)
        reports: list[str] = []

        def each(tick: int) -> None:
            station.report_tick(inputs(tick), outputs(tick, phase=f"phase{tick}"))
            reports.extend(station.take_messages())

        await send_setpoints(autopilot, px4, 400, each)
        assert await autopilot.read_param("COM_RC_IN_MODE") == 4

        def reported() -> bool:
            reports.extend(station.take_messages())
            return any("relay has ended" in line for line in reports)

        # A killed process ends when the kernel comes to it.
        await eventually(reported, "the relay's end")
        assert [line for line in reports if "relay has ended" in line] == [
            f"ground station {ground.address}: the relay has ended; nothing is forwarded"
        ]


async def test_a_stopped_relay_blocks_no_other_program() -> None:
    async with stationed() as (ground, px4, autopilot, station):
        await asyncio.to_thread(ground.wait_for, "HEARTBEAT", 1)
        assert station.relay_pid is not None
        os.kill(station.relay_pid, signal.SIGSTOP)
        try:
            # More than its sockets hold.
            await send_setpoints(
                *(autopilot, px4, 2000),
                lambda tick: station.report_tick(inputs(tick), outputs(tick, phase=f"phase{tick}")),
            )
        finally:
            os.kill(station.relay_pid, signal.SIGCONT)
        station.report_tick(inputs(2000), outputs(2000, phase="landing"))
        await asyncio.to_thread(ground.wait_for, "HEARTBEAT", 191)


class NoForwarder:
    """For a station that is not opened."""

    def identity(self) -> LinkIdentity:
        raise AssertionError

    def forward_to(self, port: int) -> int:
        raise AssertionError


@pytest.mark.parametrize(
    "packet",
    [
        marshal.dumps({"text": "hello"}, 2),
        marshal.dumps({"text": "hello"}, 2)[:-3],
        b"\xff\x00",
        b"[" * 4000,
        b"{}",
        b"[1]",
        b'{"port": 1}',
        b'{"text": {"a": NaN}}',
        b'{"text": "' + b"x" * 4000,
        json.dumps({"text": "\x1b[2J" + "x" * 3000}).encode(),
    ],
    ids=range(10),
)
def test_whatever_the_relay_sends_costs_the_flight_a_line_at_most(packet: bytes) -> None:
    """The relay faces the network: who takes it over must reach nothing in the flight process."""
    station = GroundStation("udpout://127.0.0.1:14550", NoForwarder())
    ours, relay = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, relay:
        ours.setblocking(False)
        station._channel = ours
        relay.send(packet)
        relay.send(pack({"text": "messages refused: 3 HEARTBEAT"}))
        *lines, last = station.take_messages()
        assert len(lines) == 1 and len(lines[0]) <= 400 and lines[0] != "hello" and lines[0].isprintable()
        assert last == "messages refused: 3 HEARTBEAT"


@pytest.mark.parametrize(("bye", "texts"), [(False, 1), (True, 0)])
def test_when_the_flight_process_dies_the_ground_is_informed_and_the_relay_ends(bye: bool, texts: int) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with GroundPeer() as ground, ours:
        with theirs:
            arguments = ["--fd", str(theirs.fileno()), "--host", "127.0.0.1", "--port", str(ground.port)]
            arguments += ["--system", "1", "--name", "qgc"]
            command = [sys.executable, "-m", "companion.io.qgroundcontrol.relay", *arguments]
            relay = subprocess.Popen(command, pass_fds=(theirs.fileno(),))
        try:
            ours.settimeout(DEADLINE_S)
            assert "port" in unpack(ours.recv(4096))
            ground.wait_for("HEARTBEAT", 191)
            if bye:
                ours.send(pack({"bye": True}))
            ours.close()
            assert relay.wait(DEADLINE_S) == 0
        finally:
            relay.kill()
            relay.wait()
        ground.settle()
        assert [(m.severity, m.text) for m in ground.of("STATUSTEXT")] == [(mavlink.MAV_SEVERITY_ALERT, GONE)] * texts


@pytest.mark.parametrize(
    "address",
    [
        "",
        "14550",
        "udpin://0.0.0.0:14550",
        "serial:///dev/ttyUSB0:57600",
        "udpout://:14550",
        "udpout://127.0.0.1:65536",
    ],
)
def test_an_address_that_is_none_is_one_line(address: str) -> None:
    with pytest.raises(DeviceError) as caught:
        check_address(address)
    line = str(caught.value)
    assert line.startswith(f"ground.qgroundcontrol {address}: expected ") and "\n" not in line


@pytest.mark.parametrize(
    ("address", "found"),
    [
        ("udpout://no-such-host.invalid:14550", "an address of no-such-host.invalid"),
        ("udpout://224.0.0.1:14550", "found the group 224.0.0.1"),
        ("udpout://255.255.255.255:14550", "found the group 255.255.255.255"),
    ],
)
async def test_a_host_that_cannot_be_spoken_to_is_one_line_and_leaves_nothing_open(address: str, found: str) -> None:
    port = free_udp_port()
    with Px4Peer(port):
        with pytest.raises(DeviceError) as caught:
            async with link(port, address):
                pytest.fail("it opened")
        line = str(caught.value)
        assert found in line and "\n" not in line


def test_an_address_that_is_none_is_reported_before_any_device_is_opened() -> None:
    with pytest.raises(ConfigError, match=r"vehicle\.ground\.qgroundcontrol: expected udpout://HOST:PORT"):
        load_flight(CATCH, overrides=["vehicle.ground.qgroundcontrol=udpout://127.0.0.1:0"])
