"""`companion fly|check|sitl`, which load a mission, and the small commands `schema` and `replay`."""

from __future__ import annotations

import argparse
import errno
import json
import math
import os
import socket
import sys
from pathlib import Path
from typing import Any

from companion.cli.options import (
    MISSION_HELP,
    MISSION_OR_DEFAULT_HELP,
    Shorthand,
    add_law,
    add_overrides,
    add_seed,
    add_sitl,
    add_world,
    refuse_contradictions,
    time_stamp,
)
from companion.cli.schema import schema_json
from companion.config.document import ConfigError
from companion.config.ground import FOXGLOVE_DEFAULT, listen_address
from companion.config.loader import FlightConfig
from companion.config.shipped import DEFAULT_MISSION
from companion.mission.check import check_mission
from companion.model.exit_codes import EXIT_OK
from companion.runtime.console import terminal_console
from companion.sitl_config.loader import COMMAND_LINE_WORLD, DEFAULT_WORLD, SitlConfig, load_sitl
from companion.sitl_config.team import ENDS, load_team


def add_parser(commands: Any) -> None:
    """Add the commands to the sub-parsers of `companion`."""
    fly = commands.add_parser("fly", help="fly a mission", description="Fly a mission, on the vehicle or in SITL.")
    _add_flight_options(fly)
    add_sitl(fly, "fly in the simulated world: with the PX4 stub, or with a real PX4 (SITL)")
    fly.add_argument(
        "--speed",
        metavar="FACTOR|max",
        help="with --sitl: simulated seconds in a second at most (default: 1; a busy computer takes longer)",
    )
    fly.add_argument(
        "--real-time",
        action="store_true",
        help="with --sitl: on the computer's clock, as on the vehicle, to measure latency and jitter",
    )
    fly.add_argument("--out", metavar="DIR", help="folder for log and report (default: flights/TIME-MISSION)")
    fly.add_argument(
        "--no-report", action="store_true", help="write only log and summary; companion report writes the rest"
    )
    fly.add_argument(
        "--mqtt", metavar="URL|off", help="broker for telemetry and commands (default: the vehicle file's)"
    )
    fly.add_argument(
        "--qgroundcontrol",
        metavar="ADDRESS",
        help="forward MAVLink to a ground station, e.g. udpout://192.168.1.20:14550",
    )
    fly.add_argument(
        "--foxglove",
        metavar="HOST:PORT",
        help=f"show the flight live in Foxglove, which opens ws://HOST:PORT (without a value: {FOXGLOVE_DEFAULT})",
    )
    fly.add_argument(
        "--wait-for-start", action="store_true", help="when ready, wait on the ground until an operator commands start"
    )
    _add_member(fly)
    fly.set_defaults(run=_fly)

    check = commands.add_parser(
        "check",
        help="run all preflight checks: devices, PX4's parameters, frames, mission; nothing moves",
        description="Run every check that a flight runs before it arms. Exit code 0: the vehicle may fly, 3: it may not.",
    )
    _add_flight_options(check, mission_default=True)
    add_sitl(check, "check the simulated world's devices, with the PX4 stub or a real PX4")
    check.add_argument("--hand", action="store_true", help="also run the guided hand test, which a new set-up requires")
    check.add_argument("--json", action="store_true", help="print only the rows, as JSON")
    check.add_argument("--plan-only", action="store_true", help="check only the mission, without devices")
    _add_member(check)
    check.set_defaults(run=_check)

    schema = commands.add_parser("schema", help="print the JSON Schema of a file, for editors")
    schema.add_argument("kind", choices=("mission", "vehicle", "controller", "team", "world"))
    schema.set_defaults(run=lambda a: print(schema_json(a.kind)) or EXIT_OK)

    sitl = commands.add_parser("sitl", help="run only the simulated world, for QGroundControl or your own script")
    _add_flight_options(sitl, mission_default=True)
    sitl.add_argument("--px4", action="store_true", help="use a real PX4 (SITL) instead of the stub")
    sitl.set_defaults(run=_sitl)

    replay = commands.add_parser(
        "replay", help="run the core again on a log's inputs; exit 0 if every output is bit-identical"
    )
    replay.add_argument("log", type=Path)
    replay.set_defaults(run=_replay)


def _add_member(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--member", choices=ENDS, help="MISSION is a team file, and this is the vehicle at that end of the bar"
    )


def _add_flight_options(parser: argparse.ArgumentParser, mission_default: bool = False) -> None:
    if mission_default:
        parser.add_argument("mission", nargs="?", default=DEFAULT_MISSION, help=MISSION_OR_DEFAULT_HELP)
    else:
        parser.add_argument("mission", help=MISSION_HELP)
    parser.add_argument("--vehicle", metavar="FILE", help="vehicle file instead of the mission's")
    add_law(parser)
    add_overrides(parser, "e.g. world.payload_kg=0.3")
    add_world(parser)
    add_seed(parser)


def _load(arguments: argparse.Namespace, *, hardware: bool, real_px4: bool = False) -> SitlConfig:
    for name, path in (("MISSION", arguments.mission), ("--vehicle", arguments.vehicle)):
        if path is not None and not path.strip():
            raise ConfigError(f"companion {arguments.command}: {name}: expected the name of a file, got an empty one")
    # Nothing of a world is read on hardware, and drawing one takes NumPy.
    world = DEFAULT_WORLD if hardware and arguments.world == COMMAND_LINE_WORLD else arguments.world
    if getattr(arguments, "member", None) is not None:
        if not hardware:
            text = "expected only on the vehicle; in the simulated world both fly: companion team fly FILE --sitl"
            raise ConfigError(f"companion {arguments.command}: --member {arguments.member}: {text}")
        law, preset = arguments.controller, arguments.preset
        team = load_team(
            arguments.mission,
            arguments.overrides,
            controller_law=law,
            preset=preset,
            on_hardware=arguments.member,
            world=world,
        )
        return dict(team.members)[arguments.member]
    return load_sitl(
        arguments.mission,
        arguments.vehicle,
        arguments.controller,
        arguments.preset,
        arguments.overrides,
        hardware=hardware,
        world=world,
        real_px4=real_px4,
    )


def _check(arguments: argparse.Namespace) -> int:
    from companion.cli import check as check_command  # imports MAVSDK

    hardware = arguments.sitl is None and not arguments.plan_only
    return check_command.run(arguments, _load(arguments, hardware=hardware, real_px4=arguments.sitl == "px4"))


def _fly(arguments: argparse.Namespace) -> int:
    from companion.cli.campaign import reserved_folder
    from companion.launcher.run import run_flight

    speed = speed_of(arguments)
    if arguments.mqtt is not None:
        off, url = arguments.mqtt == "off", json.dumps(arguments.mqtt)
        key, value = ("vehicle.ground.mqtt", "null") if off else ("vehicle.ground.mqtt.url", url)
        arguments.overrides += [Shorthand.of("--mqtt", key, value, arguments.mqtt)]
    for key in ("qgroundcontrol", "foxglove"):
        if getattr(arguments, key) is not None:
            value = getattr(arguments, key)
            arguments.overrides += [Shorthand.of(f"--{key}", f"vehicle.ground.{key}", json.dumps(value), value)]
    if arguments.wait_for_start:
        arguments.overrides += [Shorthand.of("--wait-for-start", "mission.start.takeoff", "by_operator", "")]
    refuse_contradictions(arguments)
    config = _load(arguments, hardware=arguments.sitl is None, real_px4=arguments.sitl == "px4")
    problems = _no_server(config) or [
        *check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases),
        *start_impossible(config),
        *no_bus_time(config, speed),
    ]
    if problems:
        raise ConfigError(problems)
    default = Path("flights") / f"{time_stamp()}-{config.mission.name}"
    with reserved_folder("fly", arguments.out, default, "flight.mcap") as out:
        return run_flight(
            config, out, sitl=arguments.sitl, console=terminal_console(), report=not arguments.no_report, speed=speed
        )


def speed_of(arguments: argparse.Namespace) -> float | None:
    """Return the speed of a flight in simulated time, or None for one in real time; raises ConfigError if the options are invalid."""
    given, command = arguments.speed, f"companion {arguments.command}"
    if (given is not None or arguments.real_time) and arguments.sitl is None:
        option = "--speed" if given is not None else "--real-time"
        raise ConfigError(
            f"{command}: {option}: expected only with --sitl, because a vehicle flies in real time; add --sitl or leave it out"
        )
    if given is not None and arguments.real_time:
        raise ConfigError(
            f"{command}: --speed {given}: expected not together with --real-time, which flies on the computer's clock; leave one out"
        )
    if given is None:
        return None if arguments.real_time or arguments.sitl is None else 1.0
    try:
        speed = math.inf if given == "max" else float(given)
    except ValueError:
        speed = math.nan
    if not speed > 0.0 or (math.isinf(speed) and given != "max"):
        raise ConfigError(f"{command}: --speed {given}: expected a number above 0, such as 0.25, or max")
    return speed


def no_bus_time(config: SitlConfig, speed: float | None) -> list[str]:
    """Return one line on why the world's faults have no effect in simulated time; an empty list if they have."""
    if speed is None or all(fault.kind != "bus_delay" for fault in config.world.faults):
        return []
    return ["world.faults: bus_delay: the servo bus takes no time in simulated time; add --real-time"]


def _no_server(config: FlightConfig) -> list[str]:
    """Return one line on why the Foxglove server cannot start; an empty list if it can."""
    address = config.vehicle.ground.foxglove
    if address is None:
        return []
    host, port = listen_address(address)
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as server:
            server.setsockopt(
                socket.SOL_SOCKET, socket.SO_REUSEADDR, 1
            )  # as the real one: ended connections do not matter
            server.bind((host, port))
    except OSError as error:
        why = "another program uses the port" if error.errno == errno.EADDRINUSE else error.strerror
        return [f"vehicle.ground.foxglove (--foxglove) is {address}, but {why}; give another: --foxglove HOST:PORT"]
    return []


def start_impossible(config: FlightConfig) -> list[str]:
    """Return one line on why a flight with `--wait-for-start` could never be started; an empty list if it could."""
    if config.mission.start.takeoff != "by_operator":
        return []
    mqtt = config.vehicle.ground.mqtt
    if mqtt is None:
        why = "vehicle.ground.mqtt is null"
    elif not mqtt.commands:
        why = "vehicle.ground.mqtt.commands is false"
    elif not (mqtt.address.tls or mqtt.address.loopback):
        why = f"vehicle.ground.mqtt.url is {mqtt.url}, and commands are not accepted over an unencrypted connection to another computer"
    else:
        return []
    return [f"mission.start.takeoff is by_operator (--wait-for-start), but start could not be commanded: {why}"]


def _sitl(arguments: argparse.Namespace) -> int:
    config = _load(arguments, hardware=False, real_px4=arguments.px4)
    # The world replaces this process, so that signals reach it directly and it cannot outlive a parent.
    file = os.memfd_create("sitl-config", 0)
    os.write(file, config.model_dump_json().encode())
    command = [sys.executable, "-P", "-m", "sitl", "--config", f"/proc/self/fd/{file}"]
    if arguments.px4:
        command += ["--px4", str((Path("flights") / f"{time_stamp()}-sitl" / "px4").resolve())]
    os.execv(sys.executable, command)


def _replay(arguments: argparse.Namespace) -> int:
    from companion.analysis import replay

    return replay.run(arguments.log)
