"""Contact phases in the fast loop: press and leave, a missing surface, a surface that gives way, and commands while pressing."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from companion.analysis.contact import PROBE, contact_lines, contact_summary, write_probe
from companion.analysis.contact_plots import contact_force, contact_path, found_surface
from companion.analysis.log import FlightLog
from companion.core.flight_core import FlightCore
from companion.ground.telemetry.scene import scene_of
from companion.ground.telemetry.stream import replay
from companion.mission.check import check_mission
from companion.mission.plan import Plan
from companion.model.contact import ContactMode
from companion.model.outputs import Outputs
from companion.model.types import Inputs, OperatorCommand
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import row_of
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.flights.ends import after, contact_over, flown_until

pytestmark = pytest.mark.usefixtures("short_start")

PRESS = "configs/missions/press.yaml"
SHORT = (
    "mission.start.position_m=[0.4,0.0]",
    "mission.phases[0]={type: takeoff, height_m: 0.7, duration_s: 1.8}",
    "mission.phases[1].duration_s=0.1",
    "mission.phases[2].to_m=[0.66,0.0,0.7]",
    "mission.phases[4].duration_s=3.0",
    "mission.phases[6].to_m=[0.5,0.0,0.7]",
)
"""The mission with less of a way to the wall and back."""
WALL = {"point_m": [1.5, 0.0, 1.0], "normal": [-1.0, 0.0, 0.0], "stiffness_n_m": 1e4, "friction": 0.5}


def press(
    wall: dict[str, Any] | None = None,
    *,
    hold_after_s: float | None = None,
    from_m: float = 0.7,
    approach_m_s: float = 0.06,
    face_m: float | None = None,
    until: Callable[[Outputs], bool] | None = None,
) -> tuple[FastFlight, FastResult]:
    """Fly a short mission press in the ideal world.

    Args:
        wall: keys of the wall that differ from `WALL`.
        hold_after_s: time after the first touch at which the operator commands a hold.
        from_m: x of where the approach begins.
        approach_m_s: speed of the approach.
        face_m: `face_m` of the approach.
        until: what ends the flight before its landing.
    """
    overrides = [
        *SHORT,
        f"mission.phases[2].to_m=[{from_m},0.0,0.7]",
        f"world.surfaces={json.dumps([WALL | (wall or {})])}",
        f"mission.phases[3].speed_m_s={approach_m_s}",
        f"mission.phases[3].face_m={json.dumps(face_m)}",
    ]
    flight = FastFlight(load_sitl(PRESS, world="ideal", overrides=overrides))
    if hold_after_s is not None:
        step, touched = flight.core.step, list[float]()

        def commanded(inputs: Inputs) -> Outputs:
            due = bool(touched) and 0.0 <= inputs.t_s - touched[0] - hold_after_s < 0.02
            outputs = step(replace(inputs, command=OperatorCommand.HOLD) if due else inputs)
            if outputs.contact is not None and outputs.contact.touches and not touched:
                touched.append(outputs.t_s)
            return outputs

        flight.core.step = commanded  # type: ignore[method-assign]
    return flight, flight.run(120.0, until=until)


def events(result: FastResult) -> list[str]:
    return [event.id for outputs in result.outputs for event in outputs.events]


def force_n(result: FastResult) -> np.ndarray[Any, Any]:
    """True force of the wall on the tip along -x in each tick."""
    assert result.layout is not None
    return np.array([-result.layout.contact(snapshot.sensors)[1][0] for snapshot in result.snapshots])


@pytest.fixture(scope="module")
def pressed() -> tuple[FastFlight, FastResult]:
    wall = {"tilt_error_deg": [12.0, -6.0], "place_error_m": -0.03, "friction": 0.12}
    return press(wall, from_m=0.74, approach_m_s=0.08, face_m=0.15, until=contact_over())


def test_the_force_is_held_on_a_slippery_tilted_wall_that_is_not_where_the_mission_expects_it(
    pressed: tuple[FastFlight, FastResult],
) -> None:
    flight, result = pressed
    assert result.outputs[-1].outcome is None and not result.crashed
    assert not {"contact_lost", "contact_bounce", "surface_missing", "tether_snagged", "catch"} & set(events(result))
    steady = np.array([o.contact is not None and o.contact.wanted_n == 5.0 for o in result.outputs])
    settled = np.flatnonzero(steady)[300:]
    assert abs(force_n(result)[settled].mean() - 5.0) < 0.25
    assert force_n(result)[steady].max() < 7.5
    assert flight.plant.machine.contact is not None and flight.plant.machine.contact.rotor_distance_min_m > 0.1


def test_after_the_contact_nothing_presses_and_the_vehicle_is_back_on_its_plan(
    pressed: tuple[FastFlight, FastResult],
) -> None:
    _, result = pressed
    last = max(k for k, o in enumerate(result.outputs) if o.contact is not None)
    assert result.outputs[last].contact.mode is ContactMode.RETURN  # type: ignore[union-attr]
    after = result.outputs[last + 1].reference
    assert after is not None and after.push_world_n is None
    assert after.position_world_m == pytest.approx((0.74, 0.0, 0.7), abs=1e-3)
    assert force_n(result)[last + 1 :].max() == 0.0


def test_the_reference_never_jumps(pressed: tuple[FastFlight, FastResult]) -> None:
    _, result = pressed
    ticks = [(o.t_s, o.reference) for o in result.outputs if o.contact is not None]
    assert not any(o.limited_by for o in result.outputs)
    for (t0, a), (t1, b) in pairwise(ticks):
        assert a is not None and b is not None
        step = np.subtract(b.position_world_m, a.position_world_m)
        mean = 0.5 * np.add(a.velocity_world_m_s, b.velocity_world_m_s) * (t1 - t0)
        assert np.linalg.norm(step - mean) < 0.002


def test_the_summary_has_the_contact_and_a_replay_is_identical(pressed: tuple[FastFlight, FastResult]) -> None:
    flight, result = pressed
    log: FlightLog = row_of(flight.config.flight, result, None)[1]
    found = contact_summary(log)
    assert found is not None and found["touches"] >= 1
    assert found["wanted_n"] == 5.0 and found["mean_n"] == pytest.approx(5.0, abs=0.1)
    assert 0.0 < found["rms_error_n"] < 0.75 and found["overshoot_n"] < 2.5 and 0.002 < found["path_rms_m"] < 0.05
    assert flight.plant.scene.surfaces is not None
    off_m = flight.plant.scene.surfaces.placed[0].local_m(tuple(found["surface"]["point_m"]))[2]
    assert off_m == pytest.approx(0.0, abs=0.005)
    normal = flight.plant.scene.surfaces.placed[0].normal
    assert np.degrees(np.arccos(np.dot(found["surface"]["normal"], normal))) < 1.0


def test_a_replay_is_identical_and_a_tip_that_presses_beside_its_point_is_reported(
    pressed: tuple[FastFlight, FastResult],
) -> None:
    flight, result = pressed
    core = FlightCore(flight.config.flight)
    reached = next(k for k, o in enumerate(result.outputs) if o.contact is not None and o.contact.wanted_n == 5.0)
    for inputs, outputs in zip(result.inputs[: reached - 3], result.outputs, strict=False):
        assert core.step(inputs) == outputs
    seen: list[str] = []
    for inputs in result.inputs[reached - 3 : reached + 3]:
        assert inputs.arm is not None
        first, *others = inputs.arm.angle_rad
        moved = replace(inputs, arm=replace(inputs.arm, angle_rad=(first + 0.15, *others)))
        seen += [event.text for event in core.step(moved).events if event.id == "contact_beside"]
    assert len(seen) == 1 and seen[0].endswith("cm beside the point of the mission (limit 5 cm)")


def test_report_and_ground_station_show_the_force_and_the_report_the_true_one(
    pressed: tuple[FastFlight, FastResult],
) -> None:
    flight, result = pressed
    log = row_of(flight.config.flight, result, None)[1]
    assert flight.plant.machine.contact is not None
    found = contact_summary(log)
    assert found is not None
    about, force, true, rotors, _, surface = contact_lines(
        {"contact": found, "world": {"contact": flight.plant.machine.contact.report()}}
    )
    assert about[1] == "4 touches, 3 of them to find the surface" and force[1].startswith("5.00 N wanted")
    x, y, z = found["surface"]["point_m"]
    assert surface[1].startswith(f"found by 3 points at [{x:.3f}, {y:.3f}, {z:.3f}] m, normal [-")
    assert 0.1 < float(rotors[1].split()[0]) < 0.6
    true_n = float(true[1].split()[0])
    assert true_n == pytest.approx(5.0, abs=0.25)
    streams, _ = replay(log.rows(), flight.config.flight, "s", 0.0)
    shown = [stream.contact for stream in streams if stream.contact is not None and stream.contact.mode == "press"]
    assert any(4.0 < view.force_n < 6.0 and view.wanted_n == 5.0 for view in shown)
    assert scene_of(flight.config.flight, "s").has_contact
    drawn = contact_force(log)
    assert drawn is not None and contact_path(log) is not None
    assert [line.get_label() for line in drawn.axes[0].get_lines()] == ["measured", "wanted"]
    bands = {text.get_text() for text in drawn.legends[0].get_texts()}
    assert bands == {"tare", "approach", "press", "leave", "move"}
    assert found_surface(log) is None  # a plane fits any three points
    last = max(k for k, o in enumerate(log.outputs) if o.contact is not None)
    contact = log.outputs[last].contact
    assert contact is not None
    probed = replace(log.outputs[last], contact=replace(contact, points=3 * contact.points))
    seen = found_surface(dataclasses.replace(log, outputs=(*log.outputs[:last], probed), inputs=log.inputs[: last + 1]))
    assert seen is not None and seen.axes[0].get_title(loc="left").startswith("9 points, 0.0 mm RMS")
    on_the_ground = dataclasses.replace(log, outputs=log.outputs[:50], inputs=log.inputs[:50], sent=log.sent[:50])
    assert contact_force(on_the_ground) is None and contact_path(on_the_ground) is None
    assert contact_lines({"contact": contact_summary(on_the_ground)}) == []


def test_a_force_sensor_that_dies_during_the_press_leads_away_from_the_wall() -> None:
    faults = "world.faults=[{kind: force_loss, t_s: 11.0}]"
    config = load_sitl("press", world="wall", overrides=[faults, "mission.phases[3].face_m=null", *SHORT])
    flight = FastFlight(config)
    result = flown_until(flight, after("contact_lost", 2.5))
    contact = flight.plant.machine.contact
    assert "contact_lost" in events(result) and "tether_snagged" not in events(result)
    assert not result.crashed and force_n(result)[-100:].max() == 0.0
    assert contact is not None and contact.force_max_n < 7.5 and contact.rotor_distance_min_m > 0.15


def test_a_force_sensor_whose_zero_shifts_during_the_approach_neither_pushes_into_the_wall_nor_stays_at_it() -> None:
    faults = "world.faults=[{kind: force_bias, t_s: 7.0, size: 3.0}]"
    # A shift by 3 N also looks like a tether that pulls: whether that is noticed first would be luck.
    sets = [faults, "vehicle.tether=null", "mission.phases[3].face_m=null", *SHORT]
    flight = FastFlight(load_sitl("press", world="wall", overrides=sets))
    result = flown_until(flight, after("contact_lost", 4.0))
    contact = flight.plant.machine.contact
    assert "contact_lost" in events(result) and not result.crashed and force_n(result)[-200:].max() == 0.0
    assert contact is not None and contact.force_max_n < 7.5 and contact.rotor_distance_min_m > 0.15


def test_without_a_force_sensor_gusts_feign_no_touch_and_the_force_is_held() -> None:
    sets = ["world.seed=318", "vehicle.force_source=observer", "mission.phases[3].face_m=null", *SHORT]
    result = FastFlight(load_sitl(PRESS, world="wall", overrides=sets)).run(until=lambda o: o.phase == "detach")
    assert result.outputs[-1].outcome is None and not result.crashed
    true_n = force_n(result)
    touched = next(k for k, o in enumerate(result.outputs) if o.contact is not None and o.contact.touches)
    assert true_n[touched - 60 : touched].max() > 0.3
    wanted = np.array([o.contact is not None and o.contact.wanted_n == 5.0 for o in result.outputs])
    assert abs(true_n[np.flatnonzero(wanted)[200:]].mean() - 5.0) < 0.75


def test_a_surface_that_gives_way_is_not_followed() -> None:
    _, result = press({"gives_way_n": 4.8}, approach_m_s=0.02, until=after("contact_lost", 2.0))
    assert "contact_lost" in events(result) and not result.crashed
    assert max(o.contact.offset_m for o in result.outputs if o.contact is not None) < 0.45


def test_a_hold_while_pressing_leads_away_from_the_wall_first() -> None:
    """A landing does, too: test_contact_steps.py."""
    _, result = press(hold_after_s=1.6, until=after("operator_hold", 2.5))
    assert not result.crashed
    since_s = next(o.t_s for o in result.outputs for e in o.events if e.id == "operator_hold")
    pressing = force_n(result)[[o.t_s > since_s + 1.0 for o in result.outputs]]
    assert pressing.max() == 0.0
    floor = [o.reference.position_world_m for o in result.outputs if o.t_s > since_s + 1.0 and o.reference is not None]
    assert all(x < 0.85 for x, _, z in floor if z < 1.0)


def test_a_hold_just_before_the_approach_touches_no_wall() -> None:
    config = load_sitl(PRESS, world="ideal", overrides=[*SHORT, f"world.surfaces={json.dumps([WALL])}"])
    plan = Plan.build(config.mission, config.vehicle)
    begin_s = next(segment.start_s for segment in plan.segments if segment.index == 3)
    flight = FastFlight(config)
    step, asked = flight.core.step, list[float]()

    def commanded(inputs: Inputs) -> Outputs:
        outputs = step(replace(inputs, command=OperatorCommand.HOLD) if len(asked) == 1 else inputs)
        if outputs.mission_t_s >= begin_s - 0.15:
            asked.append(outputs.t_s)
        return outputs

    flight.core.step = commanded  # type: ignore[method-assign]
    result = flight.run(until=after("operator_hold", 9.0))
    assert "operator_hold" in events(result) and "touched" not in events(result) and not result.crashed
    assert force_n(result).max() == 0.0


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"mission.phases[4].force_n": 9.0}, "safety.contact_force_max_n"),
        ({"mission.phases[4].force_n": 8.0, "vehicle.safety.contact_force_max_n": 30.0}, "tilts by"),
        ({"mission.phases[3].distance_max_m": 1.5}, "if it touches nothing"),
        ({"mission.phases[3].direction": [-1.0, 0.0, 0.0]}, "beyond the rotors"),
        ({"mission.phases[2].arm_deg": [60.0, 60.0]}, "N m of joint 1"),
    ],
)
def test_the_check_refuses_what_cannot_press(changes: dict[str, object], text: str) -> None:
    config = load_sitl(PRESS, overrides=[f"{key}={json.dumps(value)}" for key, value in changes.items()])
    assert any(text in problem for problem in check_mission(config.mission, config.vehicle))


def test_a_probe_finds_the_surface_and_writes_its_points(tmp_path: Path) -> None:
    wall = WALL | {"tilt_error_deg": [9.0, -7.0], "place_error_m": 0.03, "friction": 0.15}
    way = ["mission.start.position_m=[0.4,0.0]", "mission.phases[0]={type: takeoff, height_m: 0.7, duration_s: 1.8}"]
    way += [
        "mission.phases[1].duration_s=0.1",
        "mission.phases[2].to_m=[0.62,0.0,0.7]",
        "mission.phases[4].to_m=[0.5,0.0,0.7]",
    ]
    grid = [f"mission.phases[3].{key}" for key in ("rows=2", "columns=2", "spacing_m=0.06", "speed_m_s=0.05")]
    flight = FastFlight(
        load_sitl("probe", world="ideal", overrides=[f"world.surfaces={json.dumps([wall])}", *way, *grid])
    )
    result = flight.run(120.0, until=contact_over())
    assert result.outputs[-1].outcome is None and events(result).count("touched") == 4
    log: FlightLog = row_of(flight.config.flight, result, None)[1]
    summary = contact_summary(log)
    assert summary is not None and flight.plant.scene.surfaces is not None
    placed, found = flight.plant.scene.surfaces.placed[0], summary["surface"]
    assert abs(placed.local_m(tuple(found["point_m"]))[2]) < 0.003
    assert np.degrees(np.arccos(np.dot(found["normal"], placed.normal))) < 0.7
    write_probe(log, tmp_path / PROBE)
    head, *points = (tmp_path / PROBE).read_text().splitlines()
    assert head == "t_s,x_m,y_m,z_m,force_n,residual_mm" and len(points) == 4
    x, y, z, _, residual_mm = map(float, points[2].split(",")[1:])
    assert abs(placed.local_m((x, y, z))[2]) < 0.004 and abs(residual_mm) < 3.0
