"""Bare loops from mocap datagram to SET_ATTITUDE_TARGET, and the process at the other end of both wires."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import socket
import struct
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

from benchmarks.measuring.far_end import prepare_far_end
from benchmarks.measuring.latency import DEADLINE_S, RATE_HZ, WARM_UP, Latency
from companion.io.arrival import STAMP_ROOM_BYTES, arrived_s, stamp_arrivals
from companion.runtime.realtime import FLIGHT_PRIORITY, claim_realtime

POSE = struct.Struct("<I7f")
LOST_MAX = 0.01
"""Largest share of setpoints that may be missing at the other end."""
_SILENCE_S = 3.0
"""Time after the last frame after which a missing setpoint counts as lost."""


def thrust_of(number: int) -> float:
    """Encode a frame number as a thrust, which SET_ATTITUDE_TARGET carries exactly (multiples of 1/4096)."""
    return 0.25 + (number % 2048) / 4096


def _far_end(parent: Connection, autopilot_port: int, mocap_port: int, frames: int) -> None:
    """Play the other end of both wires: send pose datagrams at 200 Hz, play PX4, and time the setpoints that come back."""
    from pymavlink.dialects.v20 import common as mavlink

    prepare_far_end()
    parent_pid = os.getppid()
    out, into = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), mavlink.MAVLink(None)
    into.robust_parsing = True
    heartbeat = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 1, 6 << 16, 4, 3
    )
    sent_s: dict[float, float] = {}
    latency_s: list[float] = []
    number, due_s, beat_s, last_s, end_s = -1, 0.0, 0.0, 0.0, time.monotonic() + DEADLINE_S + frames / RATE_HZ
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", 0))
        while len(latency_s) < frames and os.getppid() == parent_pid:
            now_s = time.monotonic()
            if now_s > end_s or (number == frames and now_s > max(due_s, last_s) + _SILENCE_S):
                break
            if now_s >= beat_s:
                wire.sendto(heartbeat.pack(out), ("127.0.0.1", autopilot_port))
                beat_s = now_s + 0.25
            if number < 0 and parent.poll():
                number, due_s = 0, now_s
            if 0 <= number < frames and now_s >= due_s:
                pose = POSE.pack(number, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0)
                sent_s[thrust_of(number)] = time.monotonic()
                wire.sendto(pose, ("127.0.0.1", mocap_port))
                number, due_s = number + 1, due_s + 1.0 / RATE_HZ
            wire.settimeout(
                max(1e-4, min(beat_s, due_s if 0 <= number < frames else beat_s, now_s + 0.05) - time.monotonic())
            )
            try:
                datagram, sender = wire.recvfrom(4096)
            except TimeoutError:
                continue
            last_s = back_s = time.monotonic()
            for message in into.parse_buffer(datagram) or []:
                if message.get_type() == "SET_ATTITUDE_TARGET" and message.thrust in sent_s:
                    latency_s.append(back_s - sent_s.pop(message.thrust))
                elif message.get_type() == "COMMAND_LONG":
                    ack = mavlink.MAVLink_command_ack_message(
                        message.command, 0, 0, 0, message.get_srcSystem(), message.get_srcComponent()
                    )
                    wire.sendto(ack.pack(out), sender)
    parent.send(latency_s[WARM_UP:])


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def receive_and_send(mocap: socket.socket, frames: int, send: Callable[[float], object]) -> list[float]:
    """Run the bare loop, one datagram in and one setpoint out. Return the times from the kernel's arrival stamp of each datagram, as
    used in flight, to the return of the send, s. It first claims the flight's priority for all threads that exist by then.
    """
    stamp_arrivals(mocap)
    claim_realtime(FLIGHT_PRIORITY)
    taken_s = []
    for _ in range(frames):
        thrust, came_s = receive(mocap)
        send(thrust)
        taken_s.append(time.monotonic() - came_s)
    return taken_s[WARM_UP:]


def receive(mocap: socket.socket) -> tuple[float, float]:
    """Receive a datagram; return the thrust to answer with, and its arrival on `time.monotonic`."""
    datagram, notes, _, _ = mocap.recvmsg(4096, STAMP_ROOM_BYTES)
    return thrust_of(POSE.unpack(datagram)[0]), arrived_s(notes, time.monotonic)


def with_far_end(
    frames: int, run: Callable[[int, Callable[[], None], socket.socket], list[float]]
) -> tuple[Latency, Latency]:
    """Run a loop against the process at the other end; return the latency inside the loop and from wire to wire."""
    autopilot_port = free_udp_port()
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mocap:
        mocap.bind(("127.0.0.1", 0))
        mocap.settimeout(DEADLINE_S)
        far_end = spawn.Process(target=_far_end, args=(there, autopilot_port, mocap.getsockname()[1], frames))
        far_end.start()
        try:
            inside_s = run(autopilot_port, lambda: here.send("go"), mocap)
            if not here.poll(2 * DEADLINE_S):
                raise RuntimeError("the process at the other end of the wire did not report")
            wire_s = here.recv()
            if len(wire_s) < (1.0 - LOST_MAX) * len(inside_s):
                raise RuntimeError(f"{len(inside_s) - len(wire_s)} of {frames} setpoints were lost on the wire")
        finally:
            far_end.join(5.0)
            if far_end.is_alive():
                far_end.terminate()
                far_end.join()
    return Latency.of(inside_s), Latency.of(wire_s)


def bare_mavsdk(frames: int) -> tuple[Latency, Latency]:
    """Receive, then call Offboard.set_attitude of native MAVSDK, with nothing else in the process."""
    from mavsdk import ComponentType, Configuration, Mavsdk, log_subscribe, log_unsubscribe
    from mavsdk.plugins.offboard.offboard import Attitude, Offboard

    def run(port: int, go: Callable[[], None], mocap: socket.socket) -> list[float]:
        log_subscribe(lambda *_: True)
        with Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)) as mavsdk:
            mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
            system = mavsdk.first_autopilot(DEADLINE_S)
            if system is None:
                raise RuntimeError("MAVSDK did not find the autopilot")
            offboard = Offboard(system)
            go()
            taken_s = receive_and_send(mocap, frames, lambda thrust: offboard.set_attitude(Attitude(1, 2, 3, thrust)))
        log_unsubscribe()
        return taken_s

    return with_far_end(frames, run)


def autopilot_edge(frames: int) -> tuple[Latency, Latency]:
    """Receive, then call MavsdkAutopilot.send_attitude, which converts, checks and sends."""
    from companion.config.devices import AutopilotDevice
    from companion.io.px4.driver import MavsdkAutopilot
    from companion.model.types import IDENTITY_QUAT, AttitudeSetpoint
    from companion.runtime.clock import flight_clock

    def run(port: int, go: Callable[[], None], mocap: socket.socket) -> list[float]:
        async def loop() -> list[float]:
            device = AutopilotDevice(address=f"udpin://127.0.0.1:{port}", discovery_timeout_s=DEADLINE_S)
            async with MavsdkAutopilot(device, flight_clock()) as autopilot:

                def send(thrust: float) -> None:
                    autopilot.send_attitude(AttitudeSetpoint(IDENTITY_QUAT, thrust))

                go()
                # In a thread because it blocks; it is the only work of this process.
                return await asyncio.to_thread(receive_and_send, mocap, frames, send)

        return asyncio.run(loop())

    return with_far_end(frames, run)
