"""`companion mocap check`: is motion capture streamed as the flight needs it? `companion mocap align`: in which axes?"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import sys
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING, Any

from rich.console import Console

from companion.commissioning.mocap import align as mocap_align
from companion.commissioning.mocap import judge as mocap_judge
from companion.commissioning.mocap.judge import FrameSeen, Route
from companion.commissioning.mocap.watch import MocapWatch, discover, path_to
from companion.commissioning.sensor_report import Result, add_options, finish, run_until_interrupted
from companion.config.base import Location
from companion.config.document import ConfigError, Data
from companion.config.loader import FlightConfig, load_flight, load_vehicle
from companion.config.vehicle import MocapDevice, Vehicle
from companion.io.mocap.natnet import ServerInfo
from companion.io.protocols import DeviceError
from companion.model.exit_codes import EXIT_ABORTED
from companion.model.rows import refusals
from companion.preflight.hand_test import evaluation as hand_test_evaluation
from companion.preflight.hand_test.run import HandResult
from companion.runtime.clock import flight_clock
from companion.runtime.console import console_on, tell

if TYPE_CHECKING:
    from companion.io.devices import SomeEdges

MISSION = "configs/missions/catch.yaml"
_SECONDS_MAX = 600.0
_MODEL_WAIT_S = 1.0
"""For the server's description of its bodies."""


def add_parser(commands: Any) -> None:
    """Add `mocap` to the sub-parsers of `companion`."""
    mocap = commands.add_parser("mocap", help="motion capture: check the stream, find its axes")
    parts = mocap.add_subparsers(dest="part", required=True, metavar="PART")
    check = parts.add_parser(
        "check",
        help="server, bodies, rate, jitter, latency, losses",
        description="Watch motion capture and say what is wrong. Nothing moves, PX4 is not needed. Exit 0: fine; 3: something "
        "is wrong.",
    )
    add_options(check)
    check.add_argument("--seconds", type=float, default=10.0, metavar="N", help="watch for so long (default: 10)")
    check.add_argument("--move", action="store_true", help="the vehicle is carried meanwhile: tells which body it is")
    check.set_defaults(run=_check)
    align = parts.add_parser(
        "align",
        help="axes by hand: lift, forward, turn left",
        description="The guided hand test, and which setting explains what it found. Battery in, disarmed, propellers off. Exit 0: "
        "the axes are right; 3: they are not; 4: given up.",
    )
    align.add_argument("mission", nargs="?", default=MISSION, help=f"whose start yaw counts (default: {MISSION})")
    add_options(align)
    align.set_defaults(run=_align)


# -- check -----------------------------------------------------------------------------------------------------------------------


def _check(arguments: argparse.Namespace) -> int:
    if not math.isfinite(arguments.seconds) or not 1.0 <= arguments.seconds <= _SECONDS_MAX:
        raise ConfigError([f"--seconds {arguments.seconds:g}: expected 1 to {_SECONDS_MAX:g}"])
    vehicle = load_vehicle(arguments.vehicle, arguments.overrides)
    result = run_until_interrupted(watch(vehicle, arguments.seconds, moving=arguments.move))
    return finish(arguments, result)


async def watch(vehicle: Vehicle, seconds: float, *, moving: bool) -> Result:
    """Watch the stream of the vehicle file's server, look for another one if it does not answer."""
    device = vehicle.devices.mocap
    clock = flight_clock()
    frames: list[FrameSeen] = []
    edge = MocapWatch(device, clock, frames.append)
    tell(f"motion capture: {device.server}, {device.transport}; nothing moves by itself")
    try:
        async with edge:
            info = edge.server_info
            assert info is not None
            await _described(edge)
            tell(f"watching for {seconds:g} s" + ("; carry the vehicle about, some 30 cm and back" if moving else ""))
            frames.clear()
            start_s = clock()
            await asyncio.sleep(seconds)
            watched_s, kept = clock() - start_s, tuple(frames)
            names, route = edge.names, path_to(edge.server_ip, device)
    except DeviceError as error:
        return await _not_there(str(error), edge.server_info, device)
    judged = mocap_judge.judge(kept, names, info, vehicle, watched_s, route, moving=moving)
    data = mocap_judge.as_json(kept, names, info, route)
    return Result(judged.rows, data, _text(kept, names, info, route), judged.changes)


async def _described(edge: MocapWatch) -> None:
    """Until the server has described its bodies; one that does not is watched without their names."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_MODEL_WAIT_S):
            while not edge.names:  # noqa: ASYNC110 - the edge tells nobody
                await asyncio.sleep(0.02)


def _text(frames: tuple[FrameSeen, ...], names: dict[int, str], info: ServerInfo, route: Route) -> list[str]:
    lines = [f"bodies of {info.application}, {route.transport}:"]
    for body in mocap_judge.bodies(frames, names):
        share = f"{100.0 * body.tracked / body.frames:.0f} % tracked" if body.frames else "not streamed"
        lines.append(
            f"  id {body.id:<5} {body.name or '-':<20} {share}, moved {100.0 * body.moved_m:.1f} cm, "
            f"marker error {1e3 * body.error_m:.1f} mm"
        )
    t = mocap_judge.timing(frames)
    if t is not None:
        lines += ["arrival of the frames against an even stream:", *mocap_judge.histogram(t)]
    return [*lines, ""]


async def _not_there(problem: str, info: ServerInfo | None, device: MocapDevice) -> Result:
    """The edge's own line; and the server elsewhere on the segment, if this one never answered."""
    changes: dict[Location, Data] = {}
    advice: list[str] = []
    fix = ""
    if info is None:
        tell("no answer; asking the whole segment")
        found = await discover(device.interface, device.command_port)
        for address, server in found.items():
            advice.append(f"found {server.application} (NatNet {server.version}) at {address}")
        if len(found) == 1:
            (address,) = found
            fix = f"set devices.mocap.server: {address}"
            changes["devices", "mocap", "server"] = address
        elif not found:
            advice.append(
                "nobody answers on this segment: Motive is not running, does not stream, or is on another network"
            )
    else:
        changes.update(_streaming(info, device))
    rows = [mocap_judge.SERVER.bad(problem, "", fix)]
    return Result(rows, {"server": None, "bodies": [], "timing": None}, (), changes, advice)


def _streaming(info: ServerInfo, device: MocapDevice) -> dict[Location, Data]:
    """What the server says about how it streams, where the vehicle file says something else."""
    at = ("devices", "mocap")
    changes: dict[Location, Data] = {}
    if info.multicast is None:
        return changes
    transport = "multicast" if info.multicast else "unicast"
    if transport != device.transport:
        changes[*at, "transport"] = transport
    if info.multicast and info.multicast_group and info.multicast_group != device.multicast_group:
        changes[*at, "multicast_group"] = info.multicast_group
    if info.multicast and info.data_port and info.data_port != device.data_port:
        changes[*at, "data_port"] = info.data_port
    if device.natnet_version is not None and info.version != device.natnet_version and info.version in ("3.0", "4.1"):
        changes[*at, "natnet_version"] = info.version
    return changes


# -- align -----------------------------------------------------------------------------------------------------------------------


def _align(arguments: argparse.Namespace) -> int:
    config = load_flight(arguments.mission, arguments.vehicle, overrides=arguments.overrides)
    people = console_on(sys.stderr if arguments.json else sys.stdout)
    outcome = run_until_interrupted(_carried(config, people, json=arguments.json))
    if outcome is None:
        tell("companion mocap align: given up; nothing was changed")
        return EXIT_ABORTED
    return finish(arguments, outcome)


async def _carried(config: FlightConfig, console: Console, *, json: bool) -> Result | None:
    """None: ended by hand."""
    from companion.preflight.hand_test.command import ENDED_BY_HAND, perform  # with it comes MAVSDK

    tell(
        "axes of motion capture, by hand: lift, forward, turn left; put the machine where the mission starts, nose as there"
    )
    async with _two_devices(config) as edges:
        outcome: HandResult | str = next(iter(edges.failures.values()), "")
        if not outcome:
            outcome = await perform(edges, config, console, json)
    if isinstance(outcome, str):
        if outcome == ENDED_BY_HAND:
            return None
        return Result([hand_test_evaluation.ended(outcome, "companion mocap align")], {"alignment": None})
    up_axis, start = config.vehicle.devices.mocap.up_axis, config.mission.start
    found = mocap_align.alignment(outcome, up_axis, math.radians(start.yaw_deg))
    rows = hand_test_evaluation.rows(outcome, up_axis)
    world = mocap_align.world_row(found, start.yaw_tolerance_deg)
    changes = mocap_align.changes(found, up_axis) if refusals(rows) else {}
    rows += [world] if world is not None else []
    return Result(rows, {"alignment": mocap_align.as_json(found)}, (), changes)


@contextlib.asynccontextmanager
async def _two_devices(config: FlightConfig) -> AsyncIterator[SomeEdges]:
    """Motion capture and PX4, the one passed on to the other; what does not open is in `failures`."""
    from companion.io.devices import SomeEdges, VisionValve
    from companion.io.mocap.driver import NatNetMocap
    from companion.io.px4.driver import MavsdkAutopilot

    clock, devices = flight_clock(), config.vehicle.devices
    edges = SomeEdges(VisionValve())

    def pass_on(pose: Any) -> None:
        if edges.autopilot is not None and pose.tracking_valid:
            edges.autopilot.send_vision(pose)

    async with contextlib.AsyncExitStack() as stack:
        try:
            edges.mocap = await stack.enter_async_context(NatNetMocap(devices.mocap, clock, pass_on))
            edges.autopilot = await stack.enter_async_context(MavsdkAutopilot(devices.autopilot, clock))
        except DeviceError as error:
            edges.failures["device"] = str(error)
        yield edges
