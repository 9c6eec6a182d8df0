"""Another program feeds PX4 (`devices.mocap.type: external`): its link to PX4, and flights without motion capture of the companion."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from companion.analysis.report import write_report
from companion.analysis.summary import summarise
from companion.model.frames import quat_from_euler_zyx
from companion.model.types import Event, Outcome, SafetyAction
from companion.safety.stop import StopModel
from companion.sitl_config.loader import load_sitl
from sitl.autopilot.mavlink import MavlinkServer, Ports
from sitl.campaigns.flights import log_of
from sitl.external_vision import ExternalVision
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from sitl.mocap import MocapFrame
from tests.sitl.px4_rig import Rig
from tests.support import DEADLINE_S, HOVER, HOVERS_S, LOW_HOVER, SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")

EXTERNAL = "vehicle.devices.mocap.type=external"


async def test_poses_reach_px4_on_a_link_of_their_own() -> None:
    rig = Rig()
    frame = MocapFrame(7, 0.0, (1.0, 2.0, 3.0), quat_from_euler_zyx(0.1, -0.2, 0.5), True, 0.0)
    async with (
        MavlinkServer(rig.stub, Ports(0, 0), None, Ports(0, 0)) as server,
        ExternalVision(("127.0.0.1", server.vision_port)) as vision,
    ):
        assert server.vision_port != server.onboard_port
        server.link_down = True  # the companion's link, not this one
        before = rig.stub.vision_received
        vision.publish(frame._replace(valid=False), 1.0)
        vision.publish(frame, 1.005)
        async with asyncio.timeout(DEADLINE_S):
            while rig.stub.vision_received == before:  # noqa: ASYNC110 - the stub signals nothing
                await asyncio.sleep(0.001)
        await asyncio.sleep(0)
        assert rig.stub.vision_received == before + 1, "an untracked body is no pose"
        assert server.messages_in == 0


def fly(mission: Any, *faults: dict[str, Any], sets: Sequence[str] = ()) -> tuple[FastFlight, FastResult]:
    low = [f"{key}={value}" for key, value in LOW_HOVER.items()] if mission == HOVER else []
    overrides = [EXTERNAL, *low, "world.seed=1", f"world.faults={json.dumps(list(faults))}", *sets]
    flight = FastFlight(load_sitl(mission, preset="recommended", overrides=overrides))
    return flight, flight.run()


def events_of(result: FastResult) -> list[Event]:
    return [event for outputs in result.outputs for event in outputs.events]


def test_a_catch_completes_on_px4s_estimate_alone() -> None:
    _, result = fly(SHORT_CATCH)
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert result.caught and not result.crashed and not result.armed
    assert all(inputs.mocap is None for inputs in result.inputs)
    assert not [event for event in events_of(result) if event.action.rank >= SafetyAction.WARN.rank]


@pytest.mark.usefixtures("undrawn")
def test_the_other_programs_end_is_found_px4_lands_and_the_flight_has_its_report(tmp_path: Path) -> None:
    flight, result = fly(HOVER, {"kind": "mocap_loss", "t_s": HOVERS_S})
    begun_s = flight.faults.begun_s
    assert begun_s is not None
    first = next(event for event in events_of(result) if event.t_s >= begun_s)
    assert (first.id, first.action) == ("vision_lost", SafetyAction.AUTOPILOT_LAND)
    assert first.t_s - begun_s < 0.7, "PX4 clears the flags 0.55 s after the last pose"
    assert result.outputs[-1].outcome is Outcome.ABORTED
    assert not result.crashed and not result.armed
    start, end = result.truth[0].position_world_m, result.truth[-1].position_world_m
    assert math.dist(start[:2], end[:2]) <= StopModel(flight.config.vehicle.safety).distance_m(1.0)
    log = log_of(flight.config.flight, result, None)
    summary = summarise(log, outcome="aborted", controller="adaptive", preset="recommended")
    assert summary["latency_ms"]["mocap_to_setpoint"]["p99"] is None
    assert "aborted" in write_report(log, summary, tmp_path).read_text(encoding="utf-8")


def test_the_guardian_lands_on_the_other_programs_poses() -> None:
    _, result = fly(HOVER, {"kind": "kill_flight", "t_s": HOVERS_S})
    assert result.guardian_landed
    assert "guardian_touchdown" in {event.id for event in result.guardian_events}
    assert not result.crashed and not result.armed


def test_frozen_poses_of_the_other_program_end_in_no_crash_and_rotors_that_stop() -> None:
    _, result = fly(HOVER, {"kind": "mocap_freeze", "t_s": HOVERS_S})
    assert not result.crashed and not result.armed
