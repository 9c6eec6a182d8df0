"""Latency of the hot path beside the bare SDKs, measured in one run.

    python benchmarks/wire_latency.py                       # bare loops, then a SITL flight
    python benchmarks/wire_latency.py --flight DIR          # bare loops beside a flight that was flown before
    python benchmarks/wire_latency.py --no-flight           # bare loops only
    python benchmarks/wire_latency.py --json FILE           # the same figures for a script

Two paths: mocap datagram in -> SET_ATTITUDE_TARGET out, and joint read -> current write. The other end of each wire runs in a process
of its own, so it takes no time from the loop under test. All of them but the bare SDK claim the real-time priorities of a flight and
its world.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))  # run as a script, too

from benchmarks.measuring.bus import bare_dynamixel
from benchmarks.measuring.latency import RATE_HZ, WARM_UP, Latency
from benchmarks.measuring.wires import autopilot_edge, bare_mavsdk

SAMPLES = 2000
_FLIGHT_DEADLINE_S = 300.0
_MISSION = Path("configs/missions/catch.yaml")

MOCAP_TO_SETPOINT = "mocap -> setpoint"
"""Datagram arrived at the process' socket -> setpoint sent, by the clock of that process: `latency_ms.mocap_to_setpoint`."""
MOCAP_TO_SETPOINT_WIRE = "same, wire to wire"
"""Datagram sent -> setpoint received, by the clock of the process at the other end."""
JOINT_READ_TO_WRITE = "joint read -> write"
"""Joint states read -> currents written: `latency_ms.joint_read_to_write`."""
BUS_CYCLE = "whole bus cycle"
"""Read begun -> currents written."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    path: str
    loop: str
    latency_ms: Latency
    ratio_p99_to_bare: float | None = None


def fly(mission: Path, out: Path) -> Path:
    """Fly a mission in SITL; the path of its summary.

    Raises:
        RuntimeError: it did not complete or wrote no summary.
    """
    command = [sys.executable, "-m", "companion", "fly", str(mission), "--sitl", "--out", str(out)]
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
    frames = samples + WARM_UP
    flown = None if flight is None else flight_latency(flight())  # first: it is what may fail
    mavsdk_inside, mavsdk_wire = bare_mavsdk(frames)
    edge_inside, edge_wire = autopilot_edge(frames)
    bus = bare_dynamixel(frames)
    rows = [
        Row(path=MOCAP_TO_SETPOINT, loop="bare MAVSDK", latency_ms=mavsdk_inside),
        Row(
            path=MOCAP_TO_SETPOINT,
            loop="MavsdkAutopilot",
            latency_ms=edge_inside,
            ratio_p99_to_bare=edge_inside.p99 / mavsdk_inside.p99,
        ),
    ]
    joints = [Row(path=JOINT_READ_TO_WRITE, loop="bare SDK", latency_ms=bus.command_ms)]
    if flown is not None:
        flown_setpoint, flown_joints = flown
        rows.append(
            Row(
                path=MOCAP_TO_SETPOINT,
                loop="flight",
                latency_ms=flown_setpoint,
                ratio_p99_to_bare=flown_setpoint.p99 / mavsdk_inside.p99,
            )
        )
        joints.append(
            Row(
                path=JOINT_READ_TO_WRITE,
                loop="flight",
                latency_ms=flown_joints,
                ratio_p99_to_bare=flown_joints.p99 / bus.command_ms.p99,
            )
        )
    return [
        *rows,
        Row(path=MOCAP_TO_SETPOINT_WIRE, loop="bare MAVSDK", latency_ms=mavsdk_wire),
        Row(
            path=MOCAP_TO_SETPOINT_WIRE,
            loop="MavsdkAutopilot",
            latency_ms=edge_wire,
            ratio_p99_to_bare=edge_wire.p99 / mavsdk_wire.p99,
        ),
        *joints,
        Row(path=BUS_CYCLE, loop="bare SDK", latency_ms=bus.cycle_ms),
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
