"""MAVLink: conversion of MAVSDK's messages to the companion's records, and damaged datagrams at the port of a running driver."""

from __future__ import annotations

import asyncio
import math
import struct
import sys
import time
from random import Random
from typing import Any, ClassVar, Self

from pymavlink.dialects.v20 import common as mavlink
from pymavlink.generator.mavcrc import x25crc

from companion.config.devices import AutopilotDevice
from companion.guardian.link import Link
from companion.guardian.px4 import Px4State
from companion.io.px4 import messages
from companion.io.px4.driver import MavsdkAutopilot
from companion.io.px4.params import value_of
from companion.io.px4.wire import UdpWire
from companion.model.types import FlightMode, VehicleState
from tests.fuzz.mutate import mutated
from tests.fuzz.target import Target, Wrong, one_line
from tests.io.px4_peer import Px4Peer
from tests.support import DEADLINE_S, free_udp_port

_SIZE_MAX_BYTES = 1500
_HEADER_BYTES, _CRC_BYTES, _STX = 10, 2, 0xFD


class MemoryWire(UdpWire):
    """The guardian's receive queue, without a socket."""

    def __init__(self) -> None:
        self.waiting: list[bytes] = []

    def receive(self) -> list[tuple[float, bytes]]:
        waiting, self.waiting = self.waiting, []
        return [(0.0, data) for data in waiting]


class MavlinkTarget(Target):
    """An input is a datagram for the guardian's parser and records, and for the converters behind MAVSDK's MavlinkDirect."""

    name: ClassVar[str] = "mavlink"

    def __init__(self) -> None:
        self._corpus = corpus()
        self._wire = MemoryWire()
        self._link = Link(self._wire, (1, 191), 1)
        self._usual = [self._received(data)[0] for data in self._corpus[:6]]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing."""

    def make(self, rng: Random) -> bytes:
        return damaged_datagram(rng, self._corpus)

    def feed(self, data: bytes) -> None:
        state = Px4State()
        for message in self._usual:
            state.take(1.0, message)
        for message in self._received(data):
            state.take(2.0, message)
            self._convert(message)
        state.status()
        self._check(state.vehicle(), state.yaw_rad())
        for message in self._received(self._corpus[0]):
            state.take(3.0, message)
            armed_and_mode = messages.heartbeat_state(message.base_mode, message.custom_mode, message.system_status)[:2]
            status = state.status()
            if armed_and_mode == (True, FlightMode.OFFBOARD) and status is not None and status.heartbeat_stamp_s == 3.0:
                return
        raise Wrong("a valid heartbeat behind it is not understood")

    def _received(self, data: bytes) -> list[Any]:
        self._wire.waiting.append(data)
        return self._link.receive()

    def _convert(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            armed, mode, _ = messages.heartbeat_state(message.base_mode, message.custom_mode, message.system_status)
            if not isinstance(armed, bool) or not isinstance(mode, FlightMode):
                raise Wrong(f"heartbeat: {armed}, {mode}")
        elif kind == "COMMAND_ACK":
            messages.result_text(message.result)
        elif kind == "AUTOPILOT_VERSION":
            messages.firmware(message)
        elif kind == "PARAM_VALUE":
            name, value = value_of(message)
            if isinstance(value, int) is (message.param_type == mavlink.MAV_PARAM_TYPE_REAL32):
                raise Wrong(f"{name}: {value!r} of type {message.param_type}")
        elif kind == "BATTERY_STATUS":
            voltage_v, remaining = messages.battery(message.voltages, message.battery_remaining)
            if (voltage_v is not None and voltage_v <= 0.0) or (remaining is not None and not 0.0 <= remaining <= 1.0):
                raise Wrong(f"battery {voltage_v} V, {remaining}")

    def _check(self, state: VehicleState | None, yaw_rad: float | None) -> None:
        if yaw_rad is not None and not math.isfinite(yaw_rad):
            raise Wrong(f"yaw {yaw_rad}")
        if state is not None:
            numbers = (*state.position_world_m, *state.velocity_world_m_s, *state.angular_rate_body_rad_s)
            if not all(map(math.isfinite, (*numbers, *state.specific_force_body_m_s2))):
                raise Wrong(f"a vehicle state that is not finite: {state}")
            if abs(math.hypot(*state.attitude_wxyz) - 1.0) > 1e-6:
                raise Wrong(f"an attitude that is not of unit norm: {state}")


class MavlinkWireTarget(Target):
    """An input is a datagram from the autopilot's address to the port of a running driver."""

    name: ClassVar[str] = "mavlink-wire"
    inputs: ClassVar[int] = 1

    def __init__(self) -> None:
        self._corpus = corpus()
        self._offboard = False
        self._raised: list[str] = []

    def __enter__(self) -> Self:
        self._loop = asyncio.new_event_loop()
        port = free_udp_port()
        self._peer = Px4Peer(port)
        self._peer.__enter__()
        device = AutopilotDevice(address=f"udpin://127.0.0.1:{port}", discovery_timeout_s=DEADLINE_S)
        self._edge = MavsdkAutopilot(device, time.monotonic)
        self._loop.run_until_complete(self._edge.__aenter__())
        self._peer.beating = False
        # An exception in a callback of MAVSDK's threads escapes to nobody but this hook.
        self._hook, sys.unraisablehook = sys.unraisablehook, self._on_unraisable
        return self

    def __exit__(self, *_: object) -> None:
        sys.unraisablehook = self._hook
        self._loop.run_until_complete(self._edge.__aexit__(None, None, None))
        self._loop.close()
        self._peer.__exit__(None, None, None)

    def _on_unraisable(self, event: Any) -> None:
        self._raised.append(f"{event.exc_type.__name__}: {event.exc_value} ({event.err_msg})")

    def make(self, rng: Random) -> bytes:
        return damaged_datagram(rng, self._corpus)

    def feed(self, data: bytes) -> None:
        edge, peer = self._edge, self._peer
        peer._socket.sendto(data, peer.remote)
        self._offboard = not self._offboard
        expected = FlightMode.OFFBOARD if self._offboard else FlightMode.HOLD
        deadline_s = time.monotonic() + DEADLINE_S
        heartbeat = _heartbeat(6 << 16 if self._offboard else 4 << 16 | 3 << 24)
        # The parser may take the first ones for the rest of a damaged message.
        while (status := edge.status()) is None or status.mode != expected:
            if time.monotonic() > deadline_s:
                raise Wrong(f"a valid heartbeat behind it is not understood: {status}")
            peer.say(heartbeat)
            edge.vehicle()
            time.sleep(0.0005)
        for line in edge.take_messages():
            one_line(line, "a message for people")
        peer.received.clear()
        if self._raised:
            raised, self._raised = self._raised, []
            raise Wrong(f"an exception in a callback: {raised[0]}")


def damaged_datagram(rng: Random, messages_: list[bytes]) -> bytes:
    """Return damaged messages; in half of them length and checksum are valid, so that the content counts."""
    data = mutated(rng, messages_, _SIZE_MAX_BYTES)
    return sealed(data) if rng.random() < 0.5 else data


def sealed(data: bytes) -> bytes:
    """Return a MAVLink 2 message with the payload of `data` and valid length and checksum, if its id is known."""
    if len(data) < _HEADER_BYTES:
        return data
    number = int.from_bytes(data[7:10], "little")
    kind = mavlink.mavlink_map.get(number)
    if kind is None:
        return data
    payload = data[_HEADER_BYTES : _HEADER_BYTES + 255]
    head = bytes((len(payload), 0)) + data[3:_HEADER_BYTES]
    crc = x25crc(head + payload)
    crc.accumulate(bytes((kind.crc_extra,)))
    return bytes((_STX,)) + head + payload + struct.pack("<H", crc.crc)


def corpus() -> list[bytes]:
    """Return every message that the driver handles, and others of PX4. The first is an armed heartbeat in OFFBOARD."""
    speaker = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    said = [
        _heartbeat(6 << 16),
        _heartbeat(4 << 16 | 6 << 24),
        mavlink.MAVLink_local_position_ned_message(1000, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3),
        mavlink.MAVLink_attitude_quaternion_message(1000, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3),
        mavlink.MAVLink_highres_imu_message(1000, 0.1, 0.2, -9.8, 0.1, 0.2, 0.3, *(0.0,) * 7, 0xFFFF),
        mavlink.MAVLink_extended_sys_state_message(0, 2),
        mavlink.MAVLink_battery_status_message(0, 0, 1, 2000, [4000] * 4 + [65535] * 6, 100, 0, 0, 77, 0, 0),
        mavlink.MAVLink_command_ack_message(400, 4, 0, 0, 1, 1),
        mavlink.MAVLink_command_ack_message(176, 0, 0, 0, 1, 1),
        mavlink.MAVLink_statustext_message(4, b"Preflight Fail: heading estimate invalid"),
        mavlink.MAVLink_statustext_message(2, "Überlänge \n\x1b[31m".encode()),
        mavlink.MAVLink_param_value_message(b"MPC_THR_HOVER", 0.5, mavlink.MAV_PARAM_TYPE_REAL32, 100, 3),
        mavlink.MAVLink_autopilot_version_message(0, 0x011001FF, 0, 0, 0, [1] * 8, [0] * 8, [0] * 8, 0, 0, 0),
        mavlink.MAVLink_sys_status_message(0, 0, 0, 500, 16000, 2000, 77, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_timesync_message(0, 123456789),
    ]
    whole = [bytes(message.pack(speaker)) for message in said]
    return [*whole, b"".join(whole)]


def _heartbeat(custom_mode: int) -> Any:
    flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, flags, custom_mode, 4, 3
    )
