"""Measures what a MAVLink ground station costs the flight: delays of setpoints and motion capture to PX4, with and without one.

    python -m benchmarks.ground_station [--seconds 4] [--rounds 5] [--json FILE]

Three processes beside the relay: the flight's side (asyncio at 200 Hz through `MavsdkAutopilot` and `GroundStation`), a process that
sends pose datagrams and plays PX4 (600 telemetry messages a second), and the ground station. The first two claim real-time priority, as
a flight does, where that is permitted. The conditions take turns, so that what else the machine does falls on all of them. Both figures
are taken where PX4 is: time between two SET_ATTITUDE_TARGETs, and pose datagram sent to VISION_POSITION_ESTIMATE received.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import multiprocessing
import os
import socket
import statistics
import struct
import sys
import time
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common as mavlink
from rich.console import Console

from benchmarks.measuring.wires import free_udp_port
from benchmarks.report import print_table, write_json
from companion.config.vehicle import AutopilotDevice
from companion.flight.ticker import Ticker
from companion.io.px4.driver import MavsdkAutopilot
from companion.io.qgroundcontrol.station import VALUES_EVERY, GroundStation
from companion.model.types import (
    AttitudeSetpoint,
    AutopilotRequest,
    Event,
    Inputs,
    MocapPose,
    OperatorCommand,
    Outputs,
    PhaseKind,
    SafetyAction,
    Severity,
    TetherState,
)
from companion.runtime.realtime import FLIGHT_PRIORITY, claim_realtime

RATE_HZ = 200.0
FLOOD_HZ = 1000.0
CONDITIONS = ("off", "absent", "present", "flood", "invalid", "forged")
_DEADLINE_S = 30.0
_POSE = struct.Struct("<d")
_LEVEL = AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 0.2)
_WARM_UP_S = 1.0


@dataclass(slots=True)
class Samples:
    """Samples of one condition, in s."""

    period_s: list[float] = field(default_factory=list)
    vision_s: list[float] = field(default_factory=list)
    tell_s: list[float] = field(default_factory=list)
    to_px4: int = 0
    """Number of messages of the ground station that reached PX4."""
    relay_cpu: float = 0.0
    """CPU time of the relay as a share of a core."""


def px4_and_mocap(parent: Connection, autopilot_port: int, mocap_port: int) -> None:
    """Play PX4 and motion capture until told to stop, then send what arrived to the parent."""
    out, into = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), mavlink.MAVLink(None)
    into.robust_parsing = True
    beat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 129, 6 << 16, 4, 3)
    streams = (
        mavlink.MAVLink_local_position_ned_message(1, *[0.0] * 6),
        mavlink.MAVLink_attitude_quaternion_message(1, 1.0, *[0.0] * 6),
        mavlink.MAVLink_highres_imu_message(1, 0.0, 0.0, -9.81, *[0.0] * 10, 0xFFFF),
    )
    claim_realtime(FLIGHT_PRIORITY)
    setpoints_s: list[float] = []
    vision_s: list[float] = []
    from_ground = 0
    beat_s, due_s = 0.0, time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", 0))
        remote = ("127.0.0.1", autopilot_port)

        def say(message: Any) -> None:
            wire.sendto(message.pack(out), remote)
            out.seq = (out.seq + 1) % 256

        while not parent.poll():
            now_s = time.monotonic()
            if now_s >= beat_s:
                say(beat)
                beat_s = now_s + 0.25
            if now_s >= due_s:
                due_s = max(due_s + 1.0 / RATE_HZ, now_s - 0.02)
                wire.sendto(_POSE.pack(time.monotonic()), ("127.0.0.1", mocap_port))
                for message in streams:
                    say(message)
            wire.settimeout(max(1e-4, min(beat_s, due_s) - time.monotonic()))
            try:
                data = wire.recv(4096)
            except TimeoutError:
                continue
            now_s = time.monotonic()
            for message in into.parse_buffer(data) or []:
                kind = message.get_type()
                if message.get_srcSystem() != 1:
                    from_ground += 1
                elif kind == "SET_ATTITUDE_TARGET":
                    setpoints_s.append(now_s)
                elif kind == "VISION_POSITION_ESTIMATE":
                    vision_s.append(now_s - message.usec * 1e-6)
                elif kind == "COMMAND_LONG":
                    say(mavlink.MAVLink_command_ack_message(message.command, 0, 0, 0, 1, message.get_srcComponent()))
    start_s = setpoints_s[0] + _WARM_UP_S if setpoints_s else 0.0
    times_s = [t for t in setpoints_s if t >= start_s]
    warm = round(_WARM_UP_S * RATE_HZ)
    parent.send(([b - a for a, b in itertools.pairwise(times_s)], vision_s[warm:], from_ground))


def ground(parent: Connection, port: int, condition: str) -> None:
    """Play the ground station: heartbeats, and the flood of the condition."""
    encoder = mavlink.MAVLink(None, srcSystem=1 if condition == "forged" else 255, srcComponent=1)
    station = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    beat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3).pack(station)
    noise = {
        "flood": mavlink.MAVLink_param_request_read_message(1, 1, b"NO_SUCH_NAME", -1).pack(encoder),
        "forged": mavlink.MAVLink_attitude_quaternion_message(1, 0.0, 1.0, *[0.0] * 5).pack(encoder),
        "invalid": bytes(range(256)),
    }.get(condition)
    partner: Any = None
    beat_s, due_s = 0.0, time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", port))
        while not parent.poll():
            now_s = time.monotonic()
            if partner is not None and now_s >= beat_s:
                beat_s = now_s + 1.0
                wire.sendto(beat, partner)
            if noise is not None and partner is not None and now_s >= due_s:
                due_s = max(due_s + 1.0 / FLOOD_HZ, now_s - 0.02)
                wire.sendto(noise, partner)
            wire.settimeout(max(1e-4, (due_s if noise is not None else now_s + 0.01) - time.monotonic()))
            try:
                _, partner = wire.recvfrom(65535)
            except TimeoutError:
                continue


def _said(tick: int, t_s: float) -> tuple[Inputs, Outputs]:
    """Return a tick of a busy flight: an event and a phase every quarter of a second, each with the values."""
    events: tuple[Event, ...] = ()
    if tick % VALUES_EVERY == 0:
        text = "tether: 0.12 m of slack where the machine could stop, want 0.30 m"
        events = (Event(t_s=t_s, id="tether_short", severity=Severity.WARNING, action=SafetyAction.HOLD, text=text),)
    inputs = Inputs(
        tick=tick,
        t_s=t_s,
        command=OperatorCommand.NONE,
        recorder_dropped=0,
    )
    tether = TetherState(
        range_m=1.5,
        slack_m=0.75,
        stop_slack_m=0.5,
        elevation_rad=0.0,
        clearance_m=1.0,
        turns=0.0,
        pull_n=0.0,
        taut=False,
        snagged=False,
        separated=False,
        vehicle_turns=0.0,
    )
    outputs = Outputs(
        tick=tick,
        t_s=t_s,
        mission_t_s=0.0,
        phase=f"phase{tick // VALUES_EVERY}",
        phase_kind=PhaseKind.FLIGHT,
        progress=0.25,
        attitude=_LEVEL,
        request=AutopilotRequest.NONE,
        action=SafetyAction.NOMINAL,
        events=events,
        mocap_trusted=True,
        tether=tether,
        bent_by=(),
    )
    return inputs, outputs


class _Mocap(asyncio.DatagramProtocol):
    def __init__(self, autopilot: MavsdkAutopilot) -> None:
        self._autopilot = autopilot

    def datagram_received(self, data: bytes, addr: Any) -> None:
        (sent_s,) = _POSE.unpack(data)
        pose = MocapPose(
            stamp_s=sent_s,
            latency_s=0.0,
            frame_number=0,
            position_world_m=(0.0, 0.0, 1.0),
            attitude_wxyz=(1.0, 0.0, 0.0, 0.0),
            tracking_valid=True,
            marker_error_m=0.0,
        )
        self._autopilot.send_vision(pose)


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def flight(port: int, mocap: socket.socket, address: str | None, seconds: float, into: Samples) -> None:
    """Run the flight's side once."""
    device = AutopilotDevice(address=f"udpin://127.0.0.1:{port}", discovery_timeout_s=20.0)
    loop = asyncio.get_running_loop()
    async with MavsdkAutopilot(device, time.monotonic, forwarding=address is not None) as autopilot:
        transport, _ = await loop.create_datagram_endpoint(lambda: _Mocap(autopilot), sock=mocap)
        station = GroundStation(address, autopilot) if address is not None else None
        if station is not None:
            await station.__aenter__()
        claim_realtime(FLIGHT_PRIORITY)
        try:
            ticker = Ticker(1.0 / RATE_HZ, time.monotonic)
            pid = station.relay_pid if station is not None else None
            cpu_s, start_s = (_cpu_s(pid) if pid is not None else 0.0), time.monotonic()
            for tick in range(round((seconds + _WARM_UP_S) * RATE_HZ)):
                await ticker.next()
                autopilot.send_attitude(_LEVEL)
                if station is not None:
                    said = _said(tick, time.monotonic() - start_s)
                    begun_s = time.perf_counter()
                    station.tell(*said)
                    into.tell_s.append(time.perf_counter() - begun_s)
                    if tick % 20 == 0:
                        station.take_messages()
            if pid is not None:
                into.relay_cpu = (_cpu_s(pid) - cpu_s) / (time.monotonic() - start_s)
        finally:
            if station is not None:
                await station.__aexit__(None, None, None)
            transport.close()


def run(condition: str, seconds: float, into: Samples) -> None:
    """Measure one condition once."""
    spawn = multiprocessing.get_context("spawn")
    port, ground_port = free_udp_port(), free_udp_port()
    mocap = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    mocap.bind(("127.0.0.1", 0))
    mocap.setblocking(False)
    here, there = spawn.Pipe()
    processes = [(here, spawn.Process(target=px4_and_mocap, args=(there, port, mocap.getsockname()[1])))]
    if condition not in ("off", "absent"):
        ours, theirs = spawn.Pipe()
        processes.append((ours, spawn.Process(target=ground, args=(theirs, ground_port, condition))))
    for _, process in processes:
        process.start()
    try:
        address = None if condition == "off" else f"udpout://127.0.0.1:{ground_port}"
        asyncio.run(flight(port, mocap, address, seconds, into))
        here.send("stop")
        if not here.poll(_DEADLINE_S):
            raise RuntimeError("PX4's end of the wire does not answer")
        period_s, vision_s, to_px4 = here.recv()
    finally:
        for pipe, process in processes:
            pipe.send("stop")
            process.join(5.0)
            if process.is_alive():
                process.terminate()
                process.join()
    into.period_s, into.vision_s, into.to_px4 = period_s, vision_s, to_px4


def figures(rounds: list[list[float]], scale: float) -> dict[str, float] | None:
    """Return the median over the rounds of each percentile, and the overall maximum; None without samples."""
    ordered = [sorted(samples) for samples in rounds if samples]
    if not ordered:
        return None
    found = {
        name: scale * statistics.median(samples[round(part * (len(samples) - 1))] for samples in ordered)
        for name, part in {"p1": 0.01, "p50": 0.5, "p99": 0.99}.items()
    }
    return found | {"max": scale * max(samples[-1] for samples in ordered), "samples": sum(map(len, ordered))}


def main(arguments: list[str] | None = None) -> int:
    """Return 0 if measured, 1 if not, with the reason in one line."""
    parser = argparse.ArgumentParser(description="What a MAVLink ground station costs the flight.")
    parser.add_argument(
        "--seconds", type=float, default=4.0, help="of each condition in each round (default %(default)s)"
    )
    parser.add_argument("--rounds", type=int, default=5, help="(default %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    options = parser.parse_args(arguments)
    measured: dict[str, list[Samples]] = {condition: [] for condition in CONDITIONS}
    try:
        for _ in range(options.rounds):
            for condition in CONDITIONS:
                measured[condition].append(Samples())
                run(condition, options.seconds, measured[condition][-1])
    except (RuntimeError, OSError) as error:
        print(f"ground_station: {error}", file=sys.stderr)
        return 1
    rows = {
        condition: {
            "period_ms": figures([samples.period_s for samples in rounds], 1e3),
            "vision_ms": figures([samples.vision_s for samples in rounds], 1e3),
            "tell_us": figures([samples.tell_s[VALUES_EVERY::VALUES_EVERY] for samples in rounds], 1e6),
            "relay_cpu_percent": 100.0 * max((samples.relay_cpu for samples in rounds), default=0.0),
            "to_px4": sum(samples.to_px4 for samples in rounds),
        }
        for condition, rounds in measured.items()
    }
    title = f"{RATE_HZ:g} Hz, {options.rounds} x {options.seconds:g} s each; floods of {FLOOD_HZ:g} a second"
    print_table(title, [{"condition": condition, **cells(row)} for condition, row in rows.items()], Console(width=150))
    write_json(options.json, rows)
    return 0


def cells(row: dict[str, Any]) -> dict[str, str]:
    """Return the row of the table."""

    def spread(key: str, names: tuple[str, ...], form: str) -> str:
        return "" if row[key] is None else "  ".join(format(row[key][name], form) for name in names)

    return {
        "setpoint period ms: p1, p50, p99, max": spread("period_ms", ("p1", "p50", "p99", "max"), ".2f"),
        "mocap -> PX4 ms: p50, p99, max": spread("vision_ms", ("p50", "p99", "max"), ".2f"),
        "tell us: p50, p99": spread("tell_us", ("p50", "p99"), ".0f"),
        "relay, % of a core": f"{row['relay_cpu_percent']:.1f}",
        "reached PX4": str(row["to_px4"]),
    }


if __name__ == "__main__":
    sys.exit(main())
