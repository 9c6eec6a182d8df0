"""`python -m sitl`: the simulated world as a process.

`companion sitl` and `companion fly --sitl` start this process. With --for-launcher it writes JSON lines to standard output and ends
when standard input closes; the second of two vehicles has a `--channel` of its own.
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
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
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
from sitl.autopilot.backend import AutopilotBackend
from sitl.autopilot.mavlink import LinkError
from sitl.faults.processes import ProcessFaults
from sitl.faults.timing import FaultError, with_fault_times
from sitl.lockstep import LockstepLoop, MachineTime, TimeKeeper
from sitl.px4.backend import RealPx4
from sitl.px4.hil_link import Px4Error
from sitl.server import Sitl
from sitl.wires import MachineWires, Ports
from sitl.world.pair import pair_scene
from sitl.world.start import start_of
from sitl.world.throws import with_throws

_STANDARD = Ports(autopilot_local=14580, autopilot_remote=14540, mocap_command=1510, mocap_data=1511, multicast=True)

BAR_FILE = "bar.json"
"""File with the true course of the bar that two vehicles carry, next to the configuration of the left one."""
TRUTH_FILE = "world.json"
"""File with the vehicle's true course, the autopilot's modes and the motion-capture frames. It is written next to the configuration
after a flight with faults or several throws.
"""


def _send(message: WorldMessage, descriptor: int = 1) -> None:
    with contextlib.suppress(OSError):  # the launcher is gone; standard input ends too
        os.write(
            descriptor, json.dumps(to_jsonable(message)).encode() + b"\n"
        )  # unbuffered, so that nothing is flushed into a closed pipe


@dataclass(frozen=True, slots=True)
class _Member:
    """A machine of the world and the launcher that flies it."""

    config: SitlConfig
    folder: Path
    channel: tuple[int, int]
    """Descriptors from which it reads what the launcher says, and to which it writes."""
    time: MachineTime | None
    px4_folder: Path | None

    def send(self, message: WorldMessage) -> None:
        """Send a message to the launcher."""
        _send(message, self.channel[1])

    def machine(self, for_launcher: bool) -> MachineWires:
        """Return the machine, whose links are not open yet."""
        config, start = self.config, self.config.mission.start
        on_message = self.send if for_launcher else _print_message
        px4 = None
        if self.px4_folder is not None:
            airframe = config.vehicle.airframe
            px4 = RealPx4(airframe, config.world, self.px4_folder, lambda text: on_message(WorldProgress(text)))
        pose = start_of(start.position_m, start.yaw_deg, start.arm_deg)
        ports = Ports() if for_launcher else _STANDARD
        return MachineWires(config.vehicle, config.world, pose, ports, on_message, px4, self.time)


async def _serve(members: Sequence[_Member], for_launcher: bool, speed: float) -> None:
    machines = [member.machine(for_launcher) for member in members]
    times = [member.time for member in members if member.time is not None]
    keeper = TimeKeeper(times, speed) if times else None
    make_scene = None if len(members) == 1 else partial(pair_scene, [member.config for member in members])
    sitl = Sitl(machines, keeper, make_scene)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, sitl.stop)
    async with sitl.wires() as devices:

        def on_ready() -> None:
            if not for_launcher:
                _print_addresses(devices[0], machines[0].autopilot)
                return
            for member, machine, addresses in zip(members, machines, devices, strict=True):
                member.send(WorldReady(addresses, machine.flight_environment()))

        if for_launcher:
            _end_with_launchers(sitl, [member.channel[0] for member in members])
        if keeper is None:
            claim_realtime(WORLD_PRIORITY, lock_memory=False)
        else:
            collect_no_garbage()
        await sitl.run(on_ready)
    if for_launcher:
        _send_final(sitl, members)


def _send_final(sitl: Sitl, members: Sequence[_Member]) -> None:
    with contextlib.suppress(OSError):  # a flight's folder may be missing or the disk full
        if sitl.bar is not None:
            (members[0].folder / BAR_FILE).write_text(json.dumps(to_jsonable(sitl.bar.report())), encoding="utf-8")
        for machine, member in zip(sitl.machines, members, strict=True):
            if member.config.world.faults or member.config.world.throws > 1:
                text = json.dumps(machine.ground_truth(sitl.slipped_s))
                (member.folder / TRUTH_FILE).write_text(text, encoding="utf-8")
    for machine, member in zip(sitl.machines, members, strict=True):
        member.send(WorldEnded(machine.final(sitl.slipped_s)))


def _end_with_launchers(sitl: Sitl, descriptors: Sequence[int]) -> None:
    """Read each flight process's pid from its launcher; once all launchers have ended, end the world when all have landed."""
    loop = asyncio.get_running_loop()
    open_ends = set(descriptors)

    def on_input(descriptor: int, flight: ProcessFaults) -> None:
        data = os.read(descriptor, 4096)
        for line in data.splitlines():
            with contextlib.suppress(ValueError):
                flight.pid = int(json.loads(line)["pid"])
        if not data:
            loop.remove_reader(descriptor)
            open_ends.discard(descriptor)
            if not open_ends:
                sitl.leave()

    for descriptor, machine in zip(descriptors, sitl.machines, strict=True):
        loop.add_reader(descriptor, on_input, descriptor, machine.flight)


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


def _print_addresses(devices: dict[str, dict[str, Any]], px4: AutopilotBackend) -> None:
    port = 14540 + (px4.number if isinstance(px4, RealPx4) else 0)
    name = "PX4 stub" if not isinstance(px4, RealPx4) else f"PX4 {px4.about()['version']}"
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


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(map(int, text.split(",")))


def _time_of(text: str) -> MachineTime:
    page, flight, guardian = _numbers(text)
    channels = {"flight": socket.socket(fileno=flight), "guardian": socket.socket(fileno=guardian)}
    return MachineTime(Page(page), channels)


def main(argv: list[str] | None = None) -> int:
    """Run the world until it is asked to end; return exit code 0, or 3 if the world cannot start or PX4 fails."""
    parser = argparse.ArgumentParser(prog="python -m sitl")
    parser.add_argument(
        "--config",
        type=Path,
        action="append",
        required=True,
        help="effective configuration, a JSON file; repeated for the second of two vehicles that carry a bar",
    )
    parser.add_argument("--for-launcher", action="store_true")
    parser.add_argument(
        "--px4",
        type=Path,
        action="append",
        metavar="DIR",
        help="fly a real PX4; this folder keeps its parameters and logs; repeated for each --config",
    )
    parser.add_argument(
        "--channel",
        action="append",
        default=[],
        metavar="IN,OUT",
        help="descriptors in place of standard input and output, for the second --config",
    )
    parser.add_argument(
        "--time",
        action="append",
        metavar="PAGE,FLIGHT,GUARDIAN",
        help="descriptors of simulated time, for each --config; none: real time",
    )
    parser.add_argument("--speed", type=float, default=1.0, help="simulated seconds in a second at most")
    arguments = parser.parse_args(argv)
    times: list[MachineTime | None] = [_time_of(text) for text in arguments.time or ()]
    times += [None] * (len(arguments.config) - len(times))
    channels = [(0, 1), *(_numbers(text) for text in arguments.channel)]
    members: list[_Member] = []
    try:
        px4 = arguments.px4 or [None] * len(channels)
        for path, channel, time, folder in zip(arguments.config, channels, times, px4, strict=True):
            config = with_fault_times(with_throws(SitlConfig.model_validate_json(path.read_text(encoding="utf-8"))))
            members.append(_Member(config, path.parent, (channel[0], channel[1]), time, folder))
        served = _serve(members, arguments.for_launcher, arguments.speed)
        with asyncio.Runner(loop_factory=LockstepLoop if arguments.time else fine_loop) as runner:
            runner.run(served)
    except (OSError, LinkError, FaultError, Px4Error, FloatingPointError) as error:
        text = f"sitl: {error}"
        if arguments.for_launcher:
            for channel in channels:
                _send(WorldFailed(text), channel[1])
        else:
            print(text, file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
