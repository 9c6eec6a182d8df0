"""`python -m sitl`: the simulated world as a process.

`companion sitl` and `companion fly --sitl` start this process. With --for-launcher it writes JSON lines to standard output and ends
when standard input closes.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
from pathlib import Path
from typing import Any

from companion.model.codec import to_jsonable
from companion.model.launcher_messages import (
    WorldAtRest,
    WorldEnded,
    WorldEvent,
    WorldFailed,
    WorldMessage,
    WorldProgress,
    WorldReady,
    WorldSlipped,
)
from companion.runtime.event_loop import fine_loop
from companion.runtime.realtime import WORLD_PRIORITY, claim_realtime, collect_no_garbage
from companion.runtime.simulated_time import Page
from companion.sitl_config.loader import SitlConfig
from sitl.autopilot.mavlink import LinkError
from sitl.faults.timing import FaultError, with_fault_times
from sitl.lockstep import LockstepLoop, TimeKeeper
from sitl.px4.backend import RealPx4
from sitl.px4.hil_link import Px4Error
from sitl.server import Ports, Sitl
from sitl.world.start import start_of
from sitl.world.throws import with_throws

_STANDARD = Ports(autopilot_local=14580, autopilot_remote=14540, mocap_command=1510, mocap_data=1511, multicast=True)

TRUTH_FILE = "world.json"
"""File with the vehicle's true course, the autopilot's modes and the motion-capture frames. It is written next to the configuration
after a flight with faults or several throws.
"""


def _send(message: WorldMessage) -> None:
    with contextlib.suppress(OSError):  # the launcher is gone; standard input ends too
        os.write(
            1, json.dumps(to_jsonable(message)).encode() + b"\n"
        )  # unbuffered, so that nothing is flushed into a closed pipe


async def _serve(
    config: SitlConfig, for_launcher: bool, truth_file: Path, px4_folder: Path | None, keeper: TimeKeeper | None
) -> None:
    start = config.mission.start
    ports = Ports() if for_launcher else _STANDARD
    on_message = _send if for_launcher else _print_message
    px4 = None
    if px4_folder is not None:
        airframe = config.vehicle.airframe
        px4 = RealPx4(airframe, config.world, px4_folder, lambda text: on_message(WorldProgress(text)))
    pose = start_of(start.position_m, start.yaw_deg, start.arm_deg)
    sitl = Sitl(config.vehicle, config.world, pose, ports, on_message, px4, keeper)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, sitl.stop)
    async with sitl.wires() as devices:

        def on_ready() -> None:
            if for_launcher:
                _send(WorldReady(devices, sitl.flight_environment()))
            else:
                _print_addresses(devices, px4)

        if for_launcher:
            _end_with_launcher(sitl)
        if keeper is None:
            claim_realtime(WORLD_PRIORITY, lock_memory=False)
        else:
            collect_no_garbage()
        await sitl.run(on_ready)
    if for_launcher:
        _send_final(sitl, truth_file if config.world.faults or config.world.throws > 1 else None)


def _send_final(sitl: Sitl, truth_file: Path | None) -> None:
    if truth_file is not None:
        with contextlib.suppress(OSError):  # the flight's folder may be missing or the disk full
            truth_file.write_text(json.dumps(sitl.ground_truth()), encoding="utf-8")
    _send(WorldEnded(sitl.final()))


def _end_with_launcher(sitl: Sitl) -> None:
    """Read the flight process's pid from standard input. When the launcher ends, end the world once the vehicle has landed."""
    loop = asyncio.get_running_loop()
    descriptor = sys.stdin.fileno()

    def on_input() -> None:
        data = os.read(descriptor, 4096)
        for line in data.splitlines():
            with contextlib.suppress(ValueError):
                sitl.flight.pid = int(json.loads(line)["pid"])
        if not data:
            loop.remove_reader(descriptor)
            sitl.leave()

    loop.add_reader(descriptor, on_input)


def _print_message(message: WorldMessage) -> None:
    match message:
        case WorldEvent():
            print(f"  t = {message.t_s:7.2f} s  payload {message.kind}", flush=True)
        case WorldProgress():
            print(f"  {message.text}", file=sys.stderr, flush=True)
        case WorldSlipped():
            text = f"this computer is busy: the world has paused for {message.slipped_s:.1f} s in all"
            print(f"  {text}", file=sys.stderr, flush=True)
        case WorldAtRest():
            print("  disarmed" if message.at_rest else "  armed", flush=True)


def _print_addresses(devices: dict[str, dict[str, Any]], px4: RealPx4 | None) -> None:
    port = 14540 + (px4.number if px4 is not None else 0)
    name = "PX4 stub" if px4 is None else f"PX4 {px4.about()['version']}"
    print(
        "companion sitl is running; Ctrl-C ends it\n"
        f"  {name:<13} MAVLink 2 on UDP 127.0.0.1:{port} (MAVSDK: udpin://0.0.0.0:{port}), from port {port + 40};\n"
        "                ground stations on 14550; it arms once motion capture arrives as VISION_POSITION_ESTIMATE\n"
        f"  mocap         {_mocap_line(devices.get('mocap'))}\n"
        f"  arm bus       {devices['arm']['port'] if 'arm' in devices else 'none on this vehicle'}\n"
        f"  force sensor  {devices['force']['port'] if 'force' in devices else 'none on this vehicle'}",
        flush=True,
    )


def _mocap_line(mocap: dict[str, Any] | None) -> str:
    if mocap is None:
        return "its poses are sent to PX4 here, as by another program (devices.mocap.type: external)"
    return f"NatNet on 127.0.0.1, command port {mocap['command_port']}, multicast, data port {mocap.get('data_port')}"


def main(argv: list[str] | None = None) -> int:
    """Run the world until it is asked to end; return exit code 0, or 3 if the world cannot start or PX4 fails."""
    parser = argparse.ArgumentParser(prog="python -m sitl")
    parser.add_argument("--config", type=Path, required=True, help="effective configuration, a JSON file")
    parser.add_argument("--for-launcher", action="store_true")
    parser.add_argument(
        "--px4", type=Path, metavar="DIR", help="fly a real PX4; this folder keeps its parameters and logs"
    )
    parser.add_argument("--time", metavar="PAGE,FLIGHT,GUARDIAN", help="descriptors of simulated time; none: real time")
    parser.add_argument("--speed", type=float, default=1.0, help="simulated seconds in a second at most")
    arguments = parser.parse_args(argv)
    config = SitlConfig.model_validate_json(arguments.config.read_text(encoding="utf-8"))
    try:
        truth_file = arguments.config.with_name(TRUTH_FILE)
        keeper = None
        if arguments.time is not None:
            page, flight, guardian = map(int, arguments.time.split(","))
            channels = {"flight": socket.socket(fileno=flight), "guardian": socket.socket(fileno=guardian)}
            keeper = TimeKeeper(Page(page), channels, arguments.speed)
        served = _serve(
            with_fault_times(with_throws(config)), arguments.for_launcher, truth_file, arguments.px4, keeper
        )
        with asyncio.Runner(loop_factory=fine_loop if keeper is None else LockstepLoop) as runner:
            runner.run(served)
    except (OSError, LinkError, FaultError, Px4Error) as error:
        text = f"sitl: {error}"
        if arguments.for_launcher:
            _send(WorldFailed(text))
        else:
            print(text, file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
