"""A vehicle without an optional part flies, and nothing that watches that part reports anything."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from companion.analysis import plot_style
from companion.analysis.report import write_report
from companion.analysis.summary import summarise
from companion.config.document import ConfigError
from companion.config.loader import logged_flight
from companion.core.flight_core import FlightCore
from companion.model.types import Outcome, PhaseKind
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import log_of
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.flights.ends import flown_until
from tests.machines import overrides_with_joints
from tests.support import CATCH, HOVER, LOW_HOVER, SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")

NO_FORCE, NO_TETHER, NO_TOOL = "vehicle.devices.force=null", "vehicle.tether=null", "vehicle.tool=null"
NO_PART = (NO_FORCE, NO_TETHER, NO_TOOL, "mission.catch=null")
OBSERVER = "vehicle.force_source=observer"


def flown_without(*absent: str) -> tuple[FastFlight, FastResult]:
    flight = FastFlight(load_sitl(SHORT_CATCH, overrides=absent))
    return flight, flight.run()


@pytest.mark.parametrize("absent", [NO_FORCE, NO_TETHER])
def test_the_catch_is_flown_without_the_part(absent: str) -> None:
    flight, result = flown_without(absent)
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert result.caught, "the payload hangs in the net"
    felt = [] if absent == NO_FORCE else ["catch"]
    assert _reported(result) == ["takeoff", *felt, "touchdown"]
    assert all((i.force is None) is (absent == NO_FORCE) for i in result.inputs[-100:])
    assert all((o.tether is None) is (absent == NO_TETHER) for o in result.outputs[-100:])
    assert absent != NO_TETHER or all(truth.tether_tension_n == 0.0 for truth in result.truth)
    worst_m = max(
        math.dist(truth.position_world_m, o.reference.position_world_m)
        for truth, o in zip(result.truth, result.outputs, strict=True)
        if o.phase_kind is PhaseKind.FLIGHT and o.reference is not None
    )
    assert worst_m < 0.06
    again = FlightCore(logged_flight(flight.config.flight.model_dump_json()))
    assert all(again.step(i) == o for i, o in zip(result.inputs[:1500], result.outputs, strict=False)), "replay"


def test_without_all_three_the_path_is_flown_nothing_is_thrown_and_there_is_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plot_style, "write_png", lambda figure, path: path.write_bytes(b"drawn"))
    flight, result = flown_without(*NO_PART)
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert flight.plant.scene.payload.throws == 0
    assert _reported(result) == ["takeoff", "touchdown"]
    log = log_of(flight.config.flight, result, None)
    summary = summarise(log, outcome="completed", controller="adaptive", preset="recommended")
    assert "completed" in write_report(log, summary, tmp_path).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("absent", "fault", "key"),
    [
        ([NO_FORCE], "force_loss", "devices.force"),
        ([NO_TETHER], "tether_cut", "tether"),
        ([NO_TOOL, NO_FORCE], "payload_dropped", "tool"),
        ([], "clamp_overload", "tool (a clamp)"),
    ],
)
def test_a_fault_of_an_absent_part_is_refused(absent: list[str], fault: str, key: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_sitl(SHORT_CATCH, overrides=[*absent, f"world.faults=[{{kind: {fault}, t_s: 5.0}}]"])
    (line,) = refused.value.lines
    assert fault in line
    assert f"needs {key}" in line


def test_a_force_sensor_without_a_tool_is_refused() -> None:
    with pytest.raises(ConfigError) as refused:
        load_sitl(SHORT_CATCH, overrides=[NO_TOOL])
    (line,) = refused.value.lines
    assert "devices.force: the force-torque sensor is part of the tool, but tool is absent" in line


def _reported(result: FastResult) -> list[str]:
    return [event.id for o in result.outputs for event in o.events]


def test_without_a_force_sensor_the_momentum_observer_detects_the_catch() -> None:
    flight = FastFlight(load_sitl(SHORT_CATCH, overrides=[NO_FORCE, OBSERVER, "world.payload_kg=0.1"]))
    result = flight.run()
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert _reported(result) == ["takeoff", "catch", "touchdown"]
    (catch,) = [event for o in result.outputs for event in o.events if event.id == "catch"]
    contact_s = flight.plant.scene.payload.caught_t_s
    assert contact_s is not None
    assert 0.0 <= catch.t_s - contact_s < 0.2
    carried = [o.control for o in result.outputs if o.control is not None and o.t_s > contact_s + 1.0]
    assert all(c.force_measured_world_n is None for c in carried)
    weights_n = [-c.force_ext_world_n[2] for c in carried if c.force_ext_world_n[2] != 0.0]
    assert math.isclose(sum(weights_n) / len(weights_n), 0.98, abs_tol=0.5)
    before = [o.control for o in result.outputs if o.control is not None and o.t_s < contact_s]
    assert all(c.force_ext_world_n == (0.0, 0.0, 0.0) for c in before), "the law yields to no gust"
    again = FlightCore(logged_flight(flight.config.flight.model_dump_json()))
    assert all(again.step(i) == o for i, o in zip(result.inputs, result.outputs, strict=True)), "replay"


def test_the_momentum_observer_takes_no_wind_for_a_catch() -> None:
    gust = "world.faults=[{kind: gust, t_s: 4.5, duration_s: 0.5, size: 3.0}]"
    flight = FastFlight(load_sitl(SHORT_CATCH, overrides=[OBSERVER, gust, "world.payload_kg=0"]))
    result = flown_until(flight, lambda o: o.phase_kind is PhaseKind.LANDING)
    assert _reported(result) == ["takeoff"]
    controls = [o.control for o in result.outputs if o.control is not None]
    assert any(c.force_measured_world_n is not None for c in controls), "the sensor is logged beside the observer"


def test_with_the_momentum_observer_a_jammed_tether_is_taut_and_no_catch() -> None:
    jam = "world.faults=[{kind: tether_taut, t_s: 8.0, size: 0.05}]"
    flight = FastFlight(load_sitl(CATCH, overrides=[NO_FORCE, OBSERVER, jam, "world.payload_kg=0"]))
    noticed = {"tether_taut", "tether_snagged"}
    result = flown_until(flight, lambda o: any(event.id in noticed for event in o.events))
    reported = _reported(result)
    assert noticed & set(reported)
    assert "catch" not in reported
    assert not result.crashed


def test_the_momentum_observer_flies_an_arm_of_four_joints() -> None:
    overrides = [*overrides_with_joints(4), "vehicle.devices.force=null", OBSERVER]
    overrides += [f"{key}={value}" for key, value in LOW_HOVER.items()]
    result = FastFlight(load_sitl(HOVER, overrides=overrides)).run()
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert _reported(result) == ["takeoff", "touchdown"]


def test_an_unknown_force_source_is_refused() -> None:
    with pytest.raises(ConfigError) as refused:
        load_sitl(SHORT_CATCH, overrides=["vehicle.force_source=obsever"])
    (line,) = refused.value.lines
    assert "force_source" in line
    assert "observer" in line
