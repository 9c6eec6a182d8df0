"""The flight process of `companion fly`: opens the devices, runs the ticks, shuts down in order.

The launcher starts it as `python -m companion.flight.main --config FILE --out DIR --channel FD --guardian FD`. It ends with the
outcome's exit code.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import signal
import socket
import sys
import traceback
from functools import partial
from pathlib import Path

from companion import plugins
from companion.config.device_plugins import BUILT_IN
from companion.config.loader import FlightConfig
from companion.flight.command_queue import Operator, StartCancelled
from companion.flight.control_loop import Flight
from companion.flight.fallback_landing import land_without_core, unflown
from companion.flight.heartbeat import HeartbeatSender
from companion.flight.startup import Checked, Refused, changed_since, check_before_flight, with_hover_thrust
from companion.guardian.client import GuardianClient
from companion.io.devices import open_devices
from companion.io.protocols import DeviceError
from companion.model.exit_codes import EXIT_CODES, EXIT_INTERNAL, EXIT_REFUSED
from companion.model.launcher_messages import FlightEnded, Recorded, RefusedFlight, Started
from companion.model.types import Outcome
from companion.recorder.client import RecorderProcess, epoch_offset_ns
from companion.runtime import ipc, simulated_time
from companion.runtime.clock import clock_origin_s, flight_clock
from companion.runtime.event_loop import run
from companion.runtime.realtime import FLIGHT_PRIORITY, claim_realtime, collect_no_garbage


def _claim_computer(config: FlightConfig) -> str:
    """Return, in words, what the operating system grants the flight process for precise timing."""
    if simulated_time.current() is not None:
        collect_no_garbage()
        return "simulated time, which waits for this computer"
    computer = config.vehicle.computer
    return str(claim_realtime(FLIGHT_PRIORITY, cpus=computer.cpus, lock_memory=computer.lock_memory))


def plugins_of_others(config: FlightConfig) -> dict[str, str]:
    """Return name, distribution and version of each device and each type of phase that another package provides, for the log."""
    devices = config.vehicle.devices
    named = [
        (plugins.MOCAP_SYSTEMS, devices.mocap.type),
        (plugins.FORCE_SENSORS, devices.force and devices.force.type),
        (plugins.ARMS, devices.arm and devices.arm.type),
    ]
    found = [str(plugins.find(group, name)) for group, name in named if name and name not in BUILT_IN[group]]
    types = sorted({phase.type for phase in config.mission.phases})
    phases = [plugin for plugin in (plugins.find(plugins.PHASES, name) for name in types) if not plugin.own]
    versions = {f"phase_{plugin.entry.name}": f"{plugin.distribution} {plugin.version}" for plugin in phases}
    return ({"device_plugins": "; ".join(found)} if found else {}) | versions


TAKEOVER_S = 0.5
"""Time within which a guardian that has to take over at the end has done so."""


async def fly(
    config: FlightConfig,
    out: Path,
    channel: socket.socket,
    guardian_channel: socket.socket | None = None,
    *,
    sitl: bool = False,
) -> Outcome:
    """Open the devices, fly, and close them.

    Args:
        guardian_channel: channel to the guardian; None if there is no guardian.

    Raises:
        DeviceError: a device is missing or does not meet the requirements; nothing was armed.
        Refused: the preflight refuses the flight; nothing was armed.
        StartCancelled: a landing was requested before the first tick; nothing was armed.
    """
    origin_s = clock_origin_s()
    clock = flight_clock(origin_s)
    client = GuardianClient(guardian_channel, clock) if guardian_channel is not None else None
    operator = Operator(channel)
    law = plugins.find(plugins.CONTROL_LAWS, config.controller.law)
    checked: Checked | None = None
    async with contextlib.AsyncExitStack() as stack:
        stack.enter_context(operator.attention())
        devices = await operator.unless_land(stack.enter_async_context(open_devices(config, clock)))
        if devices.found_armed:  # the vehicle may be flying: do not wait
            config = unflown(config)
        else:
            checked = await operator.unless_land(check_before_flight(devices, config, clock, out, channel, sitl))
            config = await operator.unless_land(with_hover_thrust(config, devices.autopilot))
            if client is not None:
                await operator.unless_land(client.wait_ready())
        guardian = HeartbeatSender(client, devices.autopilot.identity(), origin_s) if client is not None else None
        try:
            recorder = await asyncio.to_thread(
                RecorderProcess.start,
                out / "flight.mcap",
                config_json=config.model_dump_json(),
                epoch_offset_ns=epoch_offset_ns(clock()),
                metadata={
                    "mission": config.mission.name,
                    "law": law.entry.name,
                    "law_distribution": law.distribution,
                    "law_version": law.version,
                    "preset": config.controller.preset,
                    "simulated": str(sitl).lower(),
                    "clock": "real" if simulated_time.current() is None else "simulated",
                    **plugins_of_others(config),
                },
                simulated=sitl,
            )
        except DeviceError as error:
            if not devices.found_armed:
                raise
            if guardian is not None:
                guardian.begin_without_core(clock(), devices.autopilot.status())
            print(error, file=sys.stderr, flush=True)  # no log, but a landing
            outcome = await land_without_core(devices.autopilot, channel, clock, guardian)
            ipc.send(channel, FlightEnded(outcome))
            if guardian is not None and guardian.goodbye(devices.autopilot.status(), lost=outcome is Outcome.LOST):
                await asyncio.sleep(TAKEOVER_S)  # the guardian ends this process
            return outcome
        try:
            if not devices.found_armed:
                recorder.client.metadata("autopilot", {"firmware": await devices.autopilot.firmware()})
            if checked is not None:
                checked.log_to(recorder.client)
                operator.recheck = partial(changed_since, checked.params, devices.autopilot)
            if client is not None:
                client.share_recorder(recorder.client.fileno())
            flight = Flight(config, devices, recorder, channel, operator, clock, guardian)
            got = _claim_computer(config)
            recorder.client.metadata("realtime", {"got": got})
            simulated = simulated_time.current() is not None
            ipc.send(channel, Started(recorder_pid=recorder.process.pid, realtime=got, simulated=simulated))
            try:
                outcome = await flight.run()
            except Exception:  # after any error the vehicle may be in the air
                with contextlib.suppress(
                    OSError, ValueError
                ):  # a full disk under flight.log loses the text, not the landing
                    traceback.print_exc()
                    sys.stderr.flush()
                if guardian is not None and guardian.would_take_over:
                    os._exit(EXIT_INTERNAL)  # end at once: the guardian lands, and this process must not disturb it
                flight.judge_without_core()
                outcome = await land_without_core(devices.autopilot, channel, clock, guardian)
            if devices.team is not None:
                counts = devices.team.counts()._asdict()
                recorder.client.metadata("team_link", {name: str(count) for name, count in counts.items()})
            ipc.send(channel, FlightEnded(outcome))
            if guardian is not None and guardian.goodbye(devices.autopilot.status(), lost=outcome is Outcome.LOST):
                await asyncio.sleep(TAKEOVER_S)  # the guardian ends this process, and goes on in the open log
        finally:
            report = await asyncio.to_thread(recorder.finish)
        ipc.send(channel, FlightEnded(outcome, Recorded(report.samples, report.dropped, report.error)))
    return outcome


def main(argv: list[str] | None = None) -> int:
    """Entry point of the flight process."""
    parser = argparse.ArgumentParser(prog="companion.flight.main")
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--channel", type=int, required=True, help="socket to the launcher")
    parser.add_argument("--guardian", type=int, required=True, help="socket to the guardian")
    parser.add_argument("--sitl", action="store_true", help="the devices are simulated")
    parser.add_argument("--time", help="page and channel of simulated time")
    arguments = parser.parse_args(argv)
    if arguments.time is not None:
        simulated_time.enter(arguments.time)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the launcher handles Ctrl-C and requests a landing
    config = FlightConfig.model_validate_json(arguments.config.read_text(encoding="utf-8"))
    channel = socket.socket(fileno=arguments.channel)
    channel.setblocking(False)
    try:
        guardian = socket.socket(fileno=arguments.guardian)
        outcome = run(fly(config, arguments.out, channel, guardian, sitl=arguments.sitl))
    except DeviceError as error:
        ipc.send(channel, RefusedFlight(tuple(str(error).splitlines()), device_failed=True))
        return EXIT_REFUSED
    except Refused as refused:
        ipc.send(channel, RefusedFlight(tuple(refused.lines)))
        return EXIT_REFUSED
    except StartCancelled:
        outcome = Outcome.ABORTED
        ipc.send(channel, FlightEnded(outcome))
    return EXIT_CODES[outcome]


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # MAVSDK's C++ threads may outlive the interpreter's teardown
