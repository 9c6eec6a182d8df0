"""Latency of the hot path beside the bare SDKs, measured in one run.

    python benchmarks/wire_latency.py                       # bare loops, then a SITL flight
    python benchmarks/wire_latency.py --flight DIR          # bare loops beside a flight that was flown before
    python benchmarks/wire_latency.py --no-flight           # bare loops only
    python benchmarks/wire_latency.py --json FILE           # the same figures for a script

Two paths: mocap datagram in -> SET_ATTITUDE_TARGET out, and joint read -> current write. The other end of each wire runs in a process
of its own, so it takes no time from the loop under test.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

RATE_HZ = 200.0
SAMPLES = 2000
_WARM_UP = 100
_DEADLINE_S = 30.0
_FLIGHT_DEADLINE_S = 300.0
_MISSION = Path("configs/missions/catch.yaml")
# Present current, velocity and position of an XM430 lie together (126, 10 bytes); goal current is 102.
_PRESENT_ADDRESS, _PRESENT_BYTES, _GOAL_CURRENT_ADDRESS, _GOAL_CURRENT_BYTES = 126, 10, 102, 2
_BAUD_BPS = 3_000_000
_SERVO_IDS = (1, 2)
_POSE = struct.Struct("<I7f")

MOCAP_TO_SETPOINT = "mocap -> setpoint"
"""Datagram received -> setpoint sent, by the clock of the flight process: `latency_ms.mocap_to_setpoint`."""
MOCAP_TO_SETPOINT_WIRE = "same, wire to wire"
"""Datagram sent -> setpoint received, by the clock of the process at the other end."""
JOINT_READ_TO_WRITE = "joint read -> write"
"""Joint states read -> currents written: `latency_ms.joint_read_to_write`."""
BUS_CYCLE = "whole bus cycle"
"""Read begun -> currents written."""


@dataclass(frozen=True, slots=True)
class Latency:
    """Percentiles in ms."""

    p50: float
    p99: float
    max: float
    samples: int | None = None

    @classmethod
    def of(cls, seconds: list[float]) -> Latency:
        """Percentiles of samples in s.

        Raises:
            ValueError: no samples.
        """
        if not seconds:
            raise ValueError("no samples: nothing came back over the wire")
        ordered = sorted(seconds)
        last = len(ordered) - 1
        p50, p99, worst = (1e3 * ordered[round(part * last)] for part in (0.5, 0.99, 1.0))
        return cls(p50, p99, worst, len(ordered))


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    path: str
    loop: str
    latency_ms: Latency
    ratio_p99_to_bare: float | None = None


# --- mocap datagram -> SET_ATTITUDE_TARGET ------------------------------------------------------------------------------


def _thrust(number: int) -> float:
    """Carries the frame's number through SET_ATTITUDE_TARGET, exactly (multiples of 1/4096)."""
    return 0.25 + (number % 2048) / 4096


def _room(parent: Connection, autopilot_port: int, mocap_port: int, frames: int) -> None:
    """The other end of both wires: sends pose datagrams at 200 Hz, plays PX4, and stamps what comes back."""
    from pymavlink.dialects.v20 import common as mavlink

    out, into = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), mavlink.MAVLink(None)
    into.robust_parsing = True
    heartbeat = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 1, 6 << 16, 4, 3
    )
    sent_s: dict[float, float] = {}
    latency_s: list[float] = []
    number, due_s, beat_s, end_s = -1, 0.0, 0.0, time.monotonic() + _DEADLINE_S + frames / RATE_HZ
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", 0))
        while len(latency_s) < frames and time.monotonic() < end_s:
            now_s = time.monotonic()
            if now_s >= beat_s:
                wire.sendto(heartbeat.pack(out), ("127.0.0.1", autopilot_port))
                beat_s = now_s + 0.25
            if number < 0 and parent.poll():
                number, due_s = 0, now_s
            if 0 <= number < frames and now_s >= due_s:
                pose = _POSE.pack(number, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0)
                sent_s[_thrust(number)] = time.monotonic()
                wire.sendto(pose, ("127.0.0.1", mocap_port))
                number, due_s = number + 1, due_s + 1.0 / RATE_HZ
            wire.settimeout(
                max(1e-4, min(beat_s, due_s if 0 <= number < frames else beat_s, now_s + 0.05) - time.monotonic())
            )
            try:
                datagram, sender = wire.recvfrom(4096)
            except TimeoutError:
                continue
            arrived_s = time.monotonic()
            for message in into.parse_buffer(datagram) or []:
                if message.get_type() == "SET_ATTITUDE_TARGET" and message.thrust in sent_s:
                    latency_s.append(arrived_s - sent_s.pop(message.thrust))
                elif message.get_type() == "COMMAND_LONG":
                    ack = mavlink.MAVLink_command_ack_message(
                        message.command, 0, 0, 0, message.get_srcSystem(), message.get_srcComponent()
                    )
                    wire.sendto(ack.pack(out), sender)
    parent.send(latency_s[_WARM_UP:])


def _free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _receive_and_send(mocap: socket.socket, frames: int, send: Callable[[float], None]) -> list[float]:
    """The bare loop: one datagram in, one setpoint out. Seconds from return of the receive to return of the send."""
    taken_s = []
    for _ in range(frames):
        number = _POSE.unpack(mocap.recv(4096))[0]
        received_s = time.monotonic()
        send(_thrust(number))
        taken_s.append(time.monotonic() - received_s)
    return taken_s[_WARM_UP:]


def _with_room(
    frames: int, run: Callable[[int, Callable[[], None], socket.socket], list[float]]
) -> tuple[Latency, Latency]:
    """Run a loop against the room process; (inside the loop's process, from wire to wire)."""
    autopilot_port = _free_udp_port()
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mocap:
        mocap.bind(("127.0.0.1", 0))
        mocap.settimeout(_DEADLINE_S)
        room = spawn.Process(target=_room, args=(there, autopilot_port, mocap.getsockname()[1], frames))
        room.start()
        try:
            inside_s = run(autopilot_port, lambda: here.send("go"), mocap)
            if not here.poll(2 * _DEADLINE_S):
                raise RuntimeError("the process at the other end of the wire did not report")
            wire_s = here.recv()
            if len(wire_s) < len(inside_s):
                raise RuntimeError(f"{len(inside_s) - len(wire_s)} of {frames} setpoints were lost on the wire")
        finally:
            room.join(5.0)
            if room.is_alive():
                room.terminate()
                room.join()
    return Latency.of(inside_s), Latency.of(wire_s)


def bare_mavsdk(frames: int) -> tuple[Latency, Latency]:
    """recv -> Offboard.set_attitude of native MAVSDK, and nothing else in the process."""
    from mavsdk import ComponentType, Configuration, Mavsdk, log_subscribe, log_unsubscribe
    from mavsdk.plugins.offboard.offboard import Attitude, Offboard

    def run(port: int, go: Callable[[], None], mocap: socket.socket) -> list[float]:
        log_subscribe(lambda *_: True)
        with Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)) as mavsdk:
            mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
            system = mavsdk.first_autopilot(_DEADLINE_S)
            if system is None:
                raise RuntimeError("MAVSDK did not find the autopilot")
            offboard = Offboard(system)
            go()
            taken_s = _receive_and_send(mocap, frames, lambda thrust: offboard.set_attitude(Attitude(1, 2, 3, thrust)))
        log_unsubscribe()
        return taken_s

    return _with_room(frames, run)


def autopilot_edge(frames: int) -> tuple[Latency, Latency]:
    """recv -> MavsdkAutopilot.send_attitude: frames converted and checked, sent through MavlinkDirect."""
    from companion.clock import flight_clock
    from companion.config.vehicle import AutopilotDevice
    from companion.io.autopilot import MavsdkAutopilot
    from companion.types import IDENTITY_QUAT, AttitudeSetpoint

    def run(port: int, go: Callable[[], None], mocap: socket.socket) -> list[float]:
        async def loop() -> list[float]:
            device = AutopilotDevice(address=f"udpin://127.0.0.1:{port}", discovery_timeout_s=_DEADLINE_S)
            async with MavsdkAutopilot(device, flight_clock()) as autopilot:

                def send(thrust: float) -> None:
                    autopilot.send_attitude(AttitudeSetpoint(IDENTITY_QUAT, thrust))

                go()
                # In a thread as it is blocking; it is the only work of this process.
                return await asyncio.to_thread(_receive_and_send, mocap, frames, send)

        return asyncio.run(loop())

    return _with_room(frames, run)


# --- joint read -> current write ----------------------------------------------------------------------------------------


def _servos(parent: Connection) -> None:
    """Two emulated servos on a pty until the parent says stop."""
    from sitl.servo_bus import ServoBus
    from sitl.servo_model import ServoModel

    async def serve() -> None:
        async with ServoBus([ServoModel(servo_id, baud_bps=_BAUD_BPS) for servo_id in _SERVO_IDS]) as bus:
            parent.send(bus.path)
            await asyncio.to_thread(parent.poll, 10 * _DEADLINE_S)

    asyncio.run(serve())


def bare_dynamixel(cycles: int) -> tuple[Latency, Latency]:
    """dynamixel-sdk's sync read then sync write at 200 Hz; (read done -> write done, read begun -> write done)."""
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    bus = spawn.Process(target=_servos, args=(there,))
    bus.start()
    try:
        if not here.poll(_DEADLINE_S):
            raise RuntimeError("the emulated servo bus did not start")
        return _bus_cycles(here.recv(), cycles)
    finally:
        here.send("stop")
        bus.join(5.0)
        if bus.is_alive():
            bus.terminate()
            bus.join()


def _bus_cycles(path: str, cycles: int) -> tuple[Latency, Latency]:
    from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

    port, packet = PortHandler(path), PacketHandler(2.0)
    if not port.openPort() or not port.setBaudRate(_BAUD_BPS):
        raise RuntimeError(f"dynamixel-sdk cannot open {path}")
    try:
        read = GroupSyncRead(port, packet, _PRESENT_ADDRESS, _PRESENT_BYTES)
        write = GroupSyncWrite(port, packet, _GOAL_CURRENT_ADDRESS, _GOAL_CURRENT_BYTES)
        for servo_id in _SERVO_IDS:
            read.addParam(servo_id)
            write.addParam(servo_id, bytes(_GOAL_CURRENT_BYTES))
        command_s, cycle_s, due_s = [], [], time.monotonic()
        for _ in range(cycles):
            due_s += 1.0 / RATE_HZ
            time.sleep(max(0.0, due_s - time.monotonic()))
            begun_s = time.monotonic()
            failed = read.txRxPacket()
            read_s = time.monotonic()
            if failed:
                raise RuntimeError(f"sync read failed: {packet.getTxRxResult(failed)}")
            for servo_id in _SERVO_IDS:
                position = read.getData(servo_id, 132, 4)
                write.changeParam(servo_id, (position % 2).to_bytes(_GOAL_CURRENT_BYTES, "little"))
            write.txPacket()
            written_s = time.monotonic()
            command_s.append(written_s - read_s)
            cycle_s.append(written_s - begun_s)
    finally:
        port.closePort()
    return Latency.of(command_s[_WARM_UP:]), Latency.of(cycle_s[_WARM_UP:])


# --- the flight -----------------------------------------------------------------------------------------------------------


def fly(mission: Path, out: Path) -> Path:
    """Fly a mission in SITL; the path of its summary.

    Raises:
        RuntimeError: it did not complete or wrote no summary.
    """
    command = [sys.executable, "-m", "companion.cli", "fly", str(mission), "--sitl", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_FLIGHT_DEADLINE_S, check=False)
    summary = out / "summary.json"
    if done.returncode != 0 or not summary.is_file():
        said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
        raise RuntimeError(f"{' '.join(command[1:])} exited {done.returncode}: {said}")
    return summary


def flight_latency(summary: Path) -> tuple[Latency, Latency]:
    """`latency_ms` of summary.json: (mocap_to_setpoint, joint_read_to_write).

    Raises:
        RuntimeError: the file is not there or has no such figures.
    """
    try:
        figures: dict[str, Any] = json.loads(summary.read_text())["latency_ms"]
        mocap, joint = (figures[key] for key in ("mocap_to_setpoint", "joint_read_to_write"))
        return _spread(mocap), _spread(joint)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RuntimeError(f"{summary}: expected a flight's summary.json with latency_ms, found {error!r}") from None


def _spread(figures: dict[str, Any]) -> Latency:
    return Latency(float(figures["p50"]), float(figures["p99"]), float(figures["max"]))


def measure(samples: int, flight: Callable[[], Path] | None) -> list[Row]:
    """All rows. `flight` gives the summary of the flight to set beside the bare loops; None: none."""
    frames = samples + _WARM_UP
    flown = None if flight is None else flight_latency(flight())  # first: it is what may fail
    mavsdk_inside, mavsdk_wire = bare_mavsdk(frames)
    edge_inside, edge_wire = autopilot_edge(frames)
    bus_command, bus_cycle = bare_dynamixel(frames)
    rows = [
        Row(MOCAP_TO_SETPOINT, "bare MAVSDK", mavsdk_inside),
        Row(MOCAP_TO_SETPOINT, "MavsdkAutopilot", edge_inside, edge_inside.p99 / mavsdk_inside.p99),
    ]
    joints = [Row(JOINT_READ_TO_WRITE, "bare SDK", bus_command)]
    if flown is not None:
        flown_setpoint, flown_joints = flown
        rows.append(Row(MOCAP_TO_SETPOINT, "flight", flown_setpoint, flown_setpoint.p99 / mavsdk_inside.p99))
        joints.append(Row(JOINT_READ_TO_WRITE, "flight", flown_joints, flown_joints.p99 / bus_command.p99))
    return [
        *rows,
        Row(MOCAP_TO_SETPOINT_WIRE, "bare MAVSDK", mavsdk_wire),
        Row(MOCAP_TO_SETPOINT_WIRE, "MavsdkAutopilot", edge_wire, edge_wire.p99 / mavsdk_wire.p99),
        *joints,
        Row(BUS_CYCLE, "bare SDK", bus_cycle),
    ]


def show(rows: list[Row]) -> None:
    table = Table(title=f"Latency in ms at {RATE_HZ:g} Hz")
    for title in ("path", "loop"):
        table.add_column(title)
    for title in ("p50", "p99", "max", "p99 / bare"):
        table.add_column(title, justify="right")
    for row in rows:
        figures = row.latency_ms
        ratio = "" if row.ratio_p99_to_bare is None else f"{row.ratio_p99_to_bare:.1f}"
        table.add_row(row.path, row.loop, f"{figures.p50:.3f}", f"{figures.p99:.3f}", f"{figures.max:.3f}", ratio)
    Console().print(table)


def main(arguments: list[str] | None = None) -> int:
    """Exit 0: measured; 1: a part could not be measured, said in one line."""
    parser = argparse.ArgumentParser(description="Latency of the hot path beside the bare SDKs.")
    parser.add_argument("--samples", type=int, default=SAMPLES, help="samples of each bare loop (default %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows there too")
    parser.add_argument("--mission", type=Path, default=_MISSION, help="mission to fly (default %(default)s)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--flight", type=Path, metavar="DIR", help="take this flight (its directory or summary.json)")
    which.add_argument("--no-flight", action="store_true", help="bare loops only")
    options = parser.parse_args(arguments)
    if options.samples < 1:
        parser.error("--samples must be at least 1")
    try:
        with tempfile.TemporaryDirectory(prefix="wire-latency-") as scratch:
            flight: Callable[[], Path] | None = None
            if options.flight is not None:
                flown: Path = options.flight / "summary.json" if options.flight.is_dir() else options.flight
                flight_latency(flown)  # a wrong path is told before anything is measured
                flight = lambda: flown  # noqa: E731
            elif not options.no_flight:
                flight = lambda: fly(options.mission, Path(scratch) / "flight")  # noqa: E731
            rows = measure(options.samples, flight)
    except (RuntimeError, OSError, subprocess.TimeoutExpired) as error:
        print(f"wire_latency: {error}", file=sys.stderr)
        return 1
    show(rows)
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
