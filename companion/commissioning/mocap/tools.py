"""`companion mocap check` checks the motion-capture stream, `align` finds its axes, and `pivot` how far the pivot is off."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, get_args

from companion.commissioning.mocap import align as mocap_align
from companion.commissioning.mocap import judge as mocap_judge
from companion.commissioning.mocap import pivot as mocap_pivot
from companion.commissioning.mocap.judge import FrameSeen, Watched
from companion.commissioning.mocap.watch import WatchedTrack, discover, path_to
from companion.commissioning.tool import SENSORS, Cancelled, Report, Session, Tool
from companion.config.base import Location
from companion.config.device_plugins import NATNET
from companion.config.devices import MocapDevice, NatNetVersion
from companion.config.document import Data
from companion.config.loader import load_flight
from companion.config.mission import Start
from companion.config.vehicle import Vehicle
from companion.io.mocap.driver import MocapDriver
from companion.io.mocap.natnet import ServerInfo
from companion.io.mocap.system import MocapSettings
from companion.io.protocols import DeviceError
from companion.model.check_row import refusals
from companion.preflight.hand_test import evaluation as hand_evaluation
from companion.preflight.hand_test.steps import HandResult
from companion.runtime.clock import flight_clock

if TYPE_CHECKING:
    from companion.model.types import MocapPose

_DESCRIPTION_TIMEOUT_S: Final = 1.0
_NO_DATA: Final[Mapping[str, Any]] = {"server": None, "bodies": [], "timing": None}


@dataclass(frozen=True, slots=True)
class NotStreaming:
    """A server that did not answer, or does not stream to this computer."""

    problem: str
    info: ServerInfo | None
    """Server description; None if it did not answer."""
    others: Mapping[str, ServerInfo]
    """Servers that answered a broadcast, by address."""


async def watch(session: Session) -> Watched | NotStreaming:
    """Watch the stream of the vehicle file's server; look for another server if it does not answer.

    Raises:
        DeviceError: the motion-capture system is not NatNet.
    """
    arguments, device = session.arguments, session.vehicle.devices.mocap
    if device.type != NATNET:
        watches = "PX4's estimator" if device.external else "this stream"
        raise DeviceError(
            f"mocap {device.type} {device.server}: companion mocap check reads NatNet only; companion check observes {watches}"
        )
    clock = flight_clock()
    frames: list[FrameSeen] = []
    made: list[WatchedTrack] = []

    def make_client(settings: MocapSettings) -> WatchedTrack:
        made.append(WatchedTrack(settings, frames.append))
        return made[0]

    session.say(f"motion capture: {device.server}, {device.transport}; nothing moves by itself")
    try:
        async with MocapDriver(device, clock, lambda _: None, make_client=make_client):
            (client,) = made
            with contextlib.suppress(TimeoutError):  # without a description the bodies have no names
                async with asyncio.timeout(_DESCRIPTION_TIMEOUT_S):
                    while not client.protocol.names:  # noqa: ASYNC110 - the driver signals nothing
                        await asyncio.sleep(0.02)
            move = "; carry the vehicle about 30 cm away and back" if arguments.move else ""
            session.say(f"watching for {arguments.seconds:g} s{move}")
            frames.clear()
            start_s = clock()
            await asyncio.sleep(arguments.seconds)
            info = client.protocol.info
            assert info is not None
            route = path_to(client.server_ip, device)
            return Watched(
                frames=tuple(frames),
                names=client.protocol.names,
                info=info,
                route=route,
                duration_s=clock() - start_s,
                moving=arguments.move,
            )
    except DeviceError as error:
        if made and (info := made[0].protocol.info) is not None:
            return NotStreaming(str(error), info, {})
        session.say("no answer; searching the whole network segment")
        return NotStreaming(str(error), None, await discover(device.interface, device.command_port))


def judge(seen: Watched | NotStreaming, vehicle: Vehicle) -> Report:
    """Return the report on the stream; without a stream, return a report that proposes the settings to find one."""
    if isinstance(seen, Watched):
        rows, changes = mocap_judge.judge(seen, vehicle)
        return Report(rows, mocap_judge.as_json(seen), mocap_judge.text(seen), changes)
    fix, changes, advice = "", {}, []
    if seen.info is not None:
        changes = _streaming(seen.info, vehicle.devices.mocap)
    elif seen.others:
        advice = [
            f"found {one.application} (NatNet {one.version}) at {address}" for address, one in seen.others.items()
        ]
        if len(seen.others) == 1:
            (address,) = seen.others
            fix = f"set devices.mocap.server: {address}"
            changes = {("devices", "mocap", "server"): address}
    else:
        advice = ["no server answers on this segment: Motive is not running, does not stream, or is on another network"]
    return Report([mocap_judge.SERVER.bad(seen.problem, "", fix)], _NO_DATA, changes=changes, advice=advice)


def _streaming(info: ServerInfo, device: MocapDevice) -> dict[Location, Data]:
    """Return the settings of the server's stream that differ from the vehicle file."""
    if info.multicast is None:
        return {}
    found: dict[str, Data] = {"transport": "multicast" if info.multicast else "unicast"}
    if info.multicast:
        found |= {"multicast_group": info.multicast_group, "data_port": info.data_port}
    if device.natnet_version is not None and info.version in get_args(NatNetVersion):
        found["natnet_version"] = info.version
    return {("devices", "mocap", key): new for key, new in found.items() if new and new != getattr(device, key)}


@dataclass(frozen=True, slots=True)
class Carried:
    """Result of a hand test, and the mission's start."""

    outcome: HandResult | str
    """Measurements, or the reason why there are none."""
    start: Start


async def guide_hand_test(session: Session) -> Carried:
    """Guide the user through the hand test while poses are forwarded to PX4; return its result."""
    from companion.io.devices import AvailableDevices, PoseForwarder  # imports MAVSDK
    from companion.io.px4.driver import MavsdkAutopilot
    from companion.preflight.hand_test.command import ENDED_BY_HAND, perform

    arguments = session.arguments
    config = load_flight(arguments.mission, arguments.vehicle, overrides=arguments.overrides)
    clock, devices, opened = flight_clock(), config.vehicle.devices, AvailableDevices(PoseForwarder())

    def forward(pose: MocapPose) -> None:
        if opened.autopilot is not None and pose.tracking_valid:
            opened.autopilot.send_vision(pose)

    session.say(
        "axes of motion capture: lift, forward, turn left; first place the vehicle at the mission's start position and yaw"
    )
    try:
        async with (
            MocapDriver(devices.mocap, clock, forward) as opened.mocap,
            MavsdkAutopilot(devices.autopilot, clock) as opened.autopilot,
        ):
            outcome = await perform(opened, config, session.console, arguments.json)
    except DeviceError as error:
        outcome = str(error)
    if outcome == ENDED_BY_HAND:
        raise Cancelled("cancelled; nothing was changed")
    return Carried(outcome, config.mission.start)


def judge_axes(carried: Carried, vehicle: Vehicle) -> Report:
    """Return the report on the hand test, which names what is wrong with the axes of motion capture."""
    outcome, start, up_axis = carried.outcome, carried.start, vehicle.devices.mocap.up_axis
    if isinstance(outcome, str):
        return Report([hand_evaluation.ended(outcome, "companion mocap align")], {"alignment": None})
    found = mocap_align.alignment(outcome, up_axis, math.radians(start.yaw_deg))
    rows = hand_evaluation.rows(outcome, up_axis)
    changes = mocap_align.changes(found, up_axis) if refusals(rows) else {}
    world = mocap_align.world_row(found, start.yaw_tolerance_deg)
    return Report([*rows, *([world] if world else [])], {"alignment": mocap_align.as_json(found)}, changes=changes)


TOOLS: Final[Mapping[str, Tool[Any]]] = {
    "check": Tool("mocap check", SENSORS, watch, judge),
    "align": Tool("mocap align", SENSORS, guide_hand_test, judge_axes),
    "pivot": Tool("mocap pivot", SENSORS, mocap_pivot.read, mocap_pivot.judge),
}
